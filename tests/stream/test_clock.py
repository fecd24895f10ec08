"""Time stamps: what is unusual is named, and time granted never exceeds the time that passed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handmap_core.core import core
from handmap_core.human.sample import HumanSample
from handmap_core.ik.motion import LONGEST_STEP
from handmap_qp import load_hand
from handmap_qp.stream.guard import GAP, SampleClock, StreamGuard

PERIOD = 0.01
HUMAN = load_hand("human", points="landmarks")


def run(stamps: list[float]) -> list[SampleClock]:
    clock, ticks = SampleClock(), []
    for stamp in stamps:
        clock = clock.advance(stamp)
        ticks.append(clock)
    return ticks


def regular(count: int, start: float = 0.0) -> list[float]:
    return [start + i * PERIOD for i in range(count)]


@given(
    start=st.floats(-1e9, 1e9),
    steps=st.lists(st.floats(2e-3, 2e-2), min_size=1, max_size=40),
)
def test_increasing_stamps_are_ordinary_and_their_time_is_granted(
    start: float, steps: list[float]
) -> None:
    stamps = start + np.cumsum([0.0, *steps])
    ticks = run(stamps.tolist())
    assert {tick.rule for tick in ticks} == {""}
    differences = np.diff(stamps)
    np.testing.assert_array_equal([tick.elapsed for tick in ticks[1:]], differences)
    # The usual period is never below the shortest interval, so at least 6 ms are granted.
    granted = np.array([tick.dt for tick in ticks[1:]])
    assert (granted <= differences).all()
    assert (granted >= np.minimum(differences, LONGEST_STEP * 2e-3)).all()


@pytest.mark.parametrize(
    ("pause", "rule", "periods"),
    [(1.0 / 30.0, "", 2.0), (0.24, "", 3.0), (0.26, "gap", 1.0)],
)
def test_a_pause_is_granted_three_periods_and_beyond_a_quarter_of_a_second_one(
    pause: float, rule: str, periods: float
) -> None:
    *_, clock = run([0.0, pause])
    assert clock.rule == rule
    # Before anything else is known, samples come at 60 Hz.
    assert clock.dt == pytest.approx(periods / 60.0)


@given(stamps=st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=40))
def test_no_stamp_grants_more_than_the_longest_step_or_less_than_nothing(
    stamps: list[float],
) -> None:
    for tick in run(stamps)[1:]:
        assert 0.0 <= tick.dt <= LONGEST_STEP * GAP
        assert math.isfinite(tick.elapsed)


def test_a_repeated_stamp_is_a_duplicate_and_takes_no_time() -> None:
    ticks = run([*regular(100), 0.99, 1.0])
    assert [tick.rule for tick in ticks[98:]] == ["", "", "duplicate", ""]
    assert sum(tick.dt for tick in ticks[1:]) == pytest.approx(1.0, rel=1e-3)


def test_late_samples_are_out_of_order_and_never_make_the_next_step_longer() -> None:
    ticks = run([*regular(100), 1.01, 1.0, 1.04, 1.035, 1.05])
    assert [tick.rule for tick in ticks[99:]] == [
        "",
        "",
        "disorder",
        "",
        "disorder",
        "",
    ]
    # The stamps say 30 ms, and the late sample's command has taken one period of them.
    assert ticks[102].dt == pytest.approx(PERIOD, rel=0.1)
    assert ticks[102].elapsed == pytest.approx(3 * PERIOD)


@pytest.mark.parametrize("shift", [-3600.0, -1.5, 11.0, 3600.0])
def test_a_clock_that_is_set_far_costs_no_sample(shift: float) -> None:
    ticks = run([*regular(20), *regular(20, shift + 20 * PERIOD)])
    assert [tick.rule for tick in ticks[20:]] == ["clock_jump", *[""] * 19]
    # The usual period stands in for the jump.
    assert ticks[20].dt < 0.02
    assert ticks[21].dt == pytest.approx(PERIOD)


def test_a_clock_that_is_set_back_a_little_is_believed_after_five_samples() -> None:
    ticks = run([*regular(20), *regular(20, -0.5)])
    assert [tick.rule for tick in ticks[20:26]] == [*["disorder"] * 4, "clock_jump", ""]


def test_a_pause_is_a_gap_whose_time_is_not_granted() -> None:
    tick = run([*regular(100), 0.99 + 2.0])[100]
    assert tick.rule == "gap"
    assert tick.dt == pytest.approx(PERIOD, rel=0.02)
    assert tick.elapsed == pytest.approx(2.0)


def test_jitter_does_not_shorten_the_time_that_speeds_are_computed_over() -> None:
    clock = SampleClock()
    for stamp in regular(200):
        clock = clock.advance(stamp)
    assert clock.shortest == pytest.approx(0.5 * PERIOD, rel=0.05)


def rates(stamps: np.ndarray, arrivals: np.ndarray) -> list[float | None]:
    check = core.RateCheck()
    return [
        check.update(*pair)
        for pair in zip(stamps.tolist(), arrivals.tolist(), strict=True)
    ]


@pytest.mark.parametrize("rate", [10.0, 2.0, 0.5, -1.0])
@pytest.mark.parametrize("period", [1 / 200, 1 / 30])
def test_stamps_that_run_at_another_rate_are_found_and_so_is_their_end(
    rate: float, period: float
) -> None:
    arrivals = np.arange(0.0, 6.0, period)
    stamps = np.where(arrivals < 3.0, rate * arrivals, 3.0 * rate + arrivals - 3.0)
    found = np.array([each is not None for each in rates(stamps, arrivals)])
    assert arrivals[found][0] <= 1.6
    assert found[(arrivals > 1.7) & (arrivals < 3.0)].all()
    assert not found[arrivals > 4.1].any()
    wrong = [
        each for each in rates(stamps[arrivals < 3.0], arrivals[arrivals < 3.0]) if each
    ]
    np.testing.assert_allclose(wrong, rate, atol=0.1 * abs(rate))


def test_delays_of_a_network_are_no_other_rate() -> None:
    stamps, random = np.arange(0.0, 20.0, PERIOD), np.random.default_rng(2)
    late = random.exponential(0.05, len(stamps))
    # Stalls of 0.2 to 2 s, each with a burst behind it; a clock that is set; a lasting delay.
    arrivals = stamps + late
    for start, duration in ((2.0, 0.2), (5.0, 0.6), (8.0, 2.0)):
        arrivals = np.where(
            stamps >= start, np.maximum(arrivals, start + duration), arrivals
        )
    arrivals = np.maximum.accumulate(arrivals + np.where(stamps > 14.0, 0.4, 0.0))
    assert set(rates(stamps, arrivals)) == {None}
    # A clock that is set forth and back, and delays that are often long.
    swinging = stamps + np.where(np.floor(stamps / 0.5) % 2.0 == 0.0, 0.4, 0.0)
    assert set(rates(swinging, stamps)) == {None}
    for seed in range(5):
        random = np.random.default_rng(seed)
        delayed = stamps + random.exponential(0.1, len(stamps)) * (
            random.random(len(stamps)) < 0.3
        )
        assert set(rates(stamps, np.maximum.accumulate(delayed))) == {None}
    for shift in (-3600.0, 0.7, 3600.0):
        assert set(rates(stamps + np.where(stamps > 16.0, shift, 0.0), arrivals)) == {
            None
        }


# -- stamps against arrivals, through the whole guard


def granted(
    steps: list[float], delays: list[float]
) -> tuple[np.ndarray, np.ndarray, set[str]]:
    """Send a moving hand; return what each sample may account for, arrivals [s], and the rules."""
    stamps, arrivals = np.cumsum(steps), np.cumsum(delays)
    random, guard = np.random.default_rng(0), StreamGuard(HUMAN)
    at_rest = HUMAN.points(HUMAN.rest)
    times, rules = [], set()
    for stamp, arrival in zip(stamps.tolist(), arrivals.tolist(), strict=True):
        points = at_rest + np.array([0.02 * math.sin(arrival), 0.0, 0.0])
        points += random.normal(0.0, 3e-4, (21, 3))
        verdict = guard.check(HumanSample(stamp, "right", points), arrival=arrival)
        times.append(verdict.dt)
        rules.add(verdict.rule)
    return np.array(times), arrivals, rules


def sawtooth(count: int) -> list[float]:
    """Stamps of 20 ms that are set back by 0.9 s again and again."""
    return [-0.9 if i % 46 == 45 else 0.02 for i in range(count)]


def test_stamps_that_are_set_back_again_and_again_take_no_more_time_than_passes() -> (
    None
):
    times, arrivals, rules = granted(sawtooth(2000), [1e-3] * 2000)
    assert times.sum() < 1.02 * np.ptp(arrivals) + GAP + PERIOD
    assert "time" in rules


@given(
    steps=st.lists(
        st.sampled_from([0.001, 0.02, 0.2, 0.3, 9.0, 11.0, -0.01, -0.3, -0.9, -5.0]),
        min_size=30,
        max_size=200,
    ),
    delay=st.sampled_from([0.0, 1e-4, 1e-3, 1e-2]),
)
def test_no_stamps_take_more_time_than_passes(steps: list[float], delay: float) -> None:
    times, arrivals, _ = granted(steps, [delay] * len(steps))
    taken = np.cumsum(times)
    # From any sample to any later one; a burst behind a stall takes the time of the stall.
    for i in range(0, len(steps), 7):
        passed = 1.02 * (arrivals[i:] - arrivals[i])
        assert (taken[i:] - taken[i] <= passed + GAP + 1e-9).all()


def test_bursts_behind_short_stalls_cost_no_time() -> None:
    stamps = np.arange(0.0, 6.0, PERIOD)
    arrivals = 0.2 * np.ceil(stamps / 0.2)
    times, _, rules = granted([0.0, *np.diff(stamps)], [0.0, *np.diff(arrivals)])
    np.testing.assert_allclose(times[20:], PERIOD, rtol=1e-6)
    assert rules == {""}


def test_a_clock_that_runs_a_little_fast_costs_no_time() -> None:
    stamps = np.arange(0.0, 20.0, PERIOD)
    steps = [0.0, *np.diff(1.01 * stamps)]
    times, _, rules = granted(steps, [0.0, *np.diff(stamps)])
    np.testing.assert_allclose(times[20:], 1.01 * PERIOD, rtol=1e-6)
    assert rules == {""}
