"""The gate owns the time: limits hold by the time stamps of commands, whoever asked for them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from limit_judge import (
    HUMANS,
    SIDES,
    Event,
    Worst,
    in_turns,
    judge,
    landmarks_at,
    samples_of,
    without,
)
from marks import crossed, rotated

from handmap_core.human.sample import HumanSample
from handmap_core.ik.gate import Gate
from handmap_core.ik.motion import SHORTEST_DT, Instant, Motion
from handmap_core.ik.options import IkOptions
from handmap_qp import Hand, HandMapper, Recording, load_hand
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands import Side
from handmap_qp.hands.robot import load_robot
from handmap_qp.mapping.presets import get_preset
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.stream.follower import Follower
from handmap_qp.stream.guard import GAP
from handmap_qp.stream.robot_follower import RobotFollower, paired

MOST = 30.0
"""Limit of acceleration [rad/s^2]."""
PRESET = get_preset("teleoperation")
FORMULATIONS = ("compiled", "direct")
# Of the samples before a jump, and of the one behind it [s].
ARRIVALS = [(None, None), (3.0, None), (None, 3.005)]
PAUSE = without(in_turns((60.0, 60.0), 1.2), "right", 0.6, 0.8)
STREAMS = {
    "in turns": in_turns((60.0, 60.0), 1.0),
    "one back after .2 s": PAUSE,
    "60 and 45 Hz": in_turns((60.0, 45.0), 1.0, 0.3),
    "120 and 10 Hz": in_turns((120.0, 10.0), 1.0, 0.1),
    "both back after .4 s": without(
        without(in_turns((60.0, 60.0), 1.2), "right", 0.5, 0.9), "left", 0.5, 0.9
    ),
    "together": [Event(k / 60.0, SIDES) for k in range(60)],
    "one stamp, in turns": [
        Event(k / 60.0, (side,)) for k in range(60) for side in SIDES
    ],
}


@pytest.fixture(scope="module")
def g1() -> Hand:
    return load_robot("g1")


def mapper_of(robot: Hand, most: float | None = MOST, kind: str = "") -> RobotMapper:
    ik = PRESET.ik.replaced(max_acceleration=most)
    if kind:
        ik = ik.replaced(formulation=kind)
    return RobotMapper(robot, HUMANS, "teleoperation", ik=ik)


def followed(follower: RobotFollower, events: Sequence[Event]) -> Worst:
    """Follow samples by their time stamps, and judge the commands."""
    q = [follower.map_samples(each).command.q for each in samples_of(events)]
    return judge(follower.mapper.robot, [event.time for event in events], q)


def mapped(mapper: RobotMapper, events: Sequence[Event]) -> Worst:
    """Map landmarks at their instants, and judge the commands."""
    q = []
    for time, sides in events:
        landmarks = {side: landmarks_at(side, time) for side in sides}
        q.append(mapper.map_landmarks(landmarks, time=1e3 + time).command.q)
    return judge(mapper.robot, [event.time for event in events], q)


def check(worst: Worst, most: float = MOST) -> None:
    """Compare with the limits, which the stream has to reach."""
    assert 0.9 < worst.speed <= 1.0 + 1e-6, worst
    assert 0.9 * most < worst.acceleration <= most * (1.0 + 1e-6), worst


@pytest.mark.parametrize("name", STREAMS)
def test_a_follower_keeps_its_limits_by_time_stamps(g1: Hand, name: str) -> None:
    check(followed(RobotFollower(mapper_of(g1)), STREAMS[name]))


@pytest.mark.parametrize("name", rotated(STREAMS, 2))
def test_a_mapper_keeps_its_limits_by_the_instants_it_is_given(
    g1: Hand, name: str
) -> None:
    check(mapped(mapper_of(g1), STREAMS[name]))


@pytest.mark.parametrize("name", ["in turns", "one back after .2 s"])
def test_the_python_path_keeps_them_as_the_core_does(g1: Hand, name: str) -> None:
    events = STREAMS[name][:40] + STREAMS[name][90:110]
    ends = []
    for kind in FORMULATIONS:
        follower = RobotFollower(mapper_of(g1, kind=kind), smoothing=None)
        q = [follower.map_samples(each).command.q for each in samples_of(events)]
        worst = judge(follower.mapper.robot, [event.time for event in events], q)
        assert worst.speed <= 1.0 + 1e-6
        assert worst.acceleration <= MOST * (1.0 + 1e-6)
        ends.append(q)
    np.testing.assert_allclose(ends[0], ends[-1], atol=1e-6)


@pytest.fixture(scope="module")
def fresh(g1: Hand) -> RobotFollower:
    """A follower to copy, that has not moved."""
    return RobotFollower(mapper_of(g1))


@st.composite
def interleavings(draw: st.DrawFn) -> list[Event]:
    """Samples of both hands in any order, with gaps, repeated stamps and stamps that go back."""
    steps = st.sampled_from(
        [0.0, 1e-4, 0.004, 1.0 / 120.0, 1.0 / 60.0, 0.05, 0.2, 0.6, 20.0]
    )
    sides = st.sampled_from([SIDES, ("left",), ("right",)])
    late = st.sampled_from([0.0, 0.0, 0.0, 0.0, 0.003, 0.1])
    time = 0.0
    events = []
    for _ in range(draw(st.integers(5, 40))):
        time += draw(steps)
        events.append(Event(time - draw(late), draw(sides)))
    return events


@settings(
    max_examples=8,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(events=interleavings())
def test_limits_hold_in_any_order_of_samples(
    fresh: RobotFollower, events: list[Event]
) -> None:
    worst = followed(copy.deepcopy(fresh), events)
    assert worst.speed <= 1.0 + 1e-6
    assert worst.acceleration <= MOST * (1.0 + 1e-6)


def test_hands_with_clocks_of_their_own_are_related_by_their_arrival(
    fresh: RobotFollower,
) -> None:
    events = STREAMS["60 and 45 Hz"]
    follower = copy.deepcopy(fresh)
    q = []
    # One of the tracker's clocks is set on the way, too.
    for samples, event in zip(
        samples_of(events, {"left": 1.7e6, "right": -40.0}), events, strict=True
    ):
        q.append(follower.map_samples(samples, arrival=event.time).command.q)
    worst = judge(follower.mapper.robot, [event.time for event in events], q)
    assert worst.speed <= 1.0 + 1e-4
    # The stamps of the left hand are rounded to 2e-10 s.
    assert worst.acceleration <= MOST * (1.0 + 1e-4)


def after_a_pause(*later: Event) -> list[Event]:
    """Return samples of the left hand alone, then others, whose times begin 20 s later [s]."""
    events = [Event(k / 60.0, ("left",)) for k in range(40)]
    end = events[-1].time + 20.0
    return events + sorted(Event(end + time, sides) for time, sides in later)


PAUSED = {
    "the other hand 2 ms later": after_a_pause(
        *[Event(k / 60.0, ("right",)) for k in range(6)],
        *[Event(k / 60.0 + 0.002, ("left",)) for k in range(6)],
    ),
    "the other hand much later": after_a_pause(
        *[Event(k / 60.0, ("right",)) for k in range(60)],
        *[Event(k / 60.0 + 1.05, ("left",)) for k in range(30)],
    ),
    "both hands at once": after_a_pause(*[Event(k / 60.0, SIDES) for k in range(40)]),
}
"""A hand that had no sample before ends a pause of the other one."""


@pytest.mark.parametrize("name", PAUSED)
def test_a_pause_counts_once_whichever_hand_ends_it(
    fresh: RobotFollower, name: str
) -> None:
    worst = followed(copy.deepcopy(fresh), PAUSED[name])
    assert worst.speed <= 1.0 + 1e-6
    assert worst.acceleration <= MOST * (1.0 + 1e-6)


@pytest.mark.parametrize(
    ("ahead", "arrivals"), crossed([1e6, -5e3, -1e6], ARRIVALS, every=3)
)
def test_a_sample_of_another_clock_takes_no_time_unless_its_arrival_is_known(
    fresh: RobotFollower, ahead: float, arrivals: tuple[float | None, float | None]
) -> None:
    follower = copy.deepcopy(fresh)
    events = [Event(k / 60.0, ("right",)) for k in range(10)]
    for samples in samples_of(events):
        follower.map_samples(samples, arrival=arrivals[0])
    before = follower.mapper.motion.time
    (other,) = samples_of([Event(10.0 / 60.0, ("left",))], {"left": ahead})
    follower.map_samples(other, arrival=arrivals[1])
    taken = follower.mapper.motion.time - before
    assert taken == pytest.approx(SHORTEST_DT, rel=1e-6)


@pytest.mark.parametrize(("side", "arrivals"), crossed(SIDES, ARRIVALS, every=2))
def test_a_robot_stands_still_for_a_pause_that_may_be_another_clock(
    fresh: RobotFollower, side: Side, arrivals: tuple[float | None, float | None]
) -> None:
    follower = copy.deepcopy(fresh)
    events = [Event(k / 60.0, ("right",)) for k in range(10)]
    for samples in samples_of(events):
        follower.map_samples(samples, arrival=arrivals[0])
    before = follower.mapper.motion
    (later,) = samples_of([Event(10.0 / 60.0, (side,))], {side: 5e3})
    follower.map_samples(later, arrival=arrivals[1])
    # No joint is faster than 100 rad/s.
    np.testing.assert_allclose(
        follower.mapper.motion.q, before.q, rtol=0.0, atol=100.0 * SHORTEST_DT
    )
    assert np.abs(follower.mapper.motion.velocity).max() < 1e-6
    passed = follower.mapper.motion.time - before.time
    assert passed == pytest.approx(5e3 + 1.0 / 60.0, rel=1e-9)


@pytest.mark.parametrize(("pause", "moves"), [(9.9, True), (10.1, False)])
def test_a_pause_of_more_than_10_s_may_be_another_clock(
    fresh: RobotFollower, pause: float, moves: bool
) -> None:
    follower = copy.deepcopy(fresh)
    events = [Event(k / 60.0, ("right",)) for k in range(10)]
    for samples in samples_of(events):
        follower.map_samples(samples)
    before = follower.mapper.motion.q
    (later,) = samples_of([Event(9.0 / 60.0 + pause, ("right",))])
    follower.map_samples(later)
    moved = np.abs(follower.mapper.motion.q - before).max()
    # No joint is faster than 100 rad/s.
    assert bool(moved > 100.0 * SHORTEST_DT) is moves


def test_a_hand_holds_after_a_quarter_of_a_second_without_a_sample(
    fresh: RobotFollower,
) -> None:
    follower = copy.deepcopy(fresh)
    rules = {}
    for k in range(100):
        time = 0.01 * k
        sides = SIDES if k <= 40 else ("right",)
        (samples,) = samples_of([Event(time, sides)])
        step = follower.map_samples(samples)
        rules[round(time - 0.4, 2)] = step.hands["left"].rule
    assert {gap for gap, rule in rules.items() if rule == "missing"} == {
        gap for gap in rules if gap > 0.255
    }


def test_a_refused_sample_leaves_the_other_hand_as_it_was(fresh: RobotFollower) -> None:
    calm, disturbed = copy.deepcopy(fresh), copy.deepcopy(fresh)
    events = [Event(k / 60.0, SIDES) for k in range(40)]
    for k, samples in enumerate(samples_of(events)):
        expected = calm.map_samples(samples)
        if k % 10 == 9:
            wrong = HumanSample(
                samples["left"].time, "right", samples["left"].landmarks
            )
            for order in (("right", "left"), ("left", "right")):
                refused = {"left": wrong, "right": samples["right"]}
                with pytest.raises(InvalidInputError, match="side"):
                    disturbed.map_samples({side: refused[side] for side in order})
        step = disturbed.map_samples(samples)
        np.testing.assert_array_equal(step.command.q, expected.command.q)
        for side in SIDES:
            assert step.hands[side].rule == expected.hands[side].rule


def test_a_pause_is_that_of_the_stamps_where_arrivals_agree(
    fresh: RobotFollower,
) -> None:
    follower = copy.deepcopy(fresh)
    events = in_turns((60.0, 60.0), 0.4)
    events += [Event(event.time + 20.0, event.sides) for event in events]
    rng = np.random.default_rng(5)
    times = []
    for event, samples in zip(events, samples_of(events), strict=True):
        arrival = event.time + rng.uniform(0.0, 0.004)
        follower.map_samples(samples, arrival=arrival)
        times.append(follower.mapper.motion.time)
    expected = np.diff([event.time for event in events])
    np.testing.assert_allclose(np.diff(times), expected, atol=2.0 * SHORTEST_DT)


@pytest.mark.parametrize("knows_arrival", [True, False])
def test_a_clock_that_jumps_ahead_is_right_unless_arrival_contradicts_it(
    fresh: RobotFollower, knows_arrival: bool
) -> None:
    follower = copy.deepcopy(fresh)
    events = [Event(k / 60.0, ("left",)) for k in range(12)]
    times = []
    for k, (event, samples) in enumerate(zip(events, samples_of(events), strict=True)):
        if k >= 6:
            (samples,) = samples_of([event], {"left": 20.0})
        follower.map_samples(samples, arrival=event.time if knows_arrival else None)
        times.append(follower.mapper.motion.time)
    expected = np.full(11, 1.0 / 60.0)
    expected[5] += 0.0 if knows_arrival else 20.0
    np.testing.assert_allclose(np.diff(times), expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("sides", "back"), crossed([("left",), SIDES], [0.0, 3.0], every=2)
)
def test_stamps_that_outrun_arrival_give_a_robot_no_more_time(
    fresh: RobotFollower, back: float, sides: tuple[Side, ...]
) -> None:
    follower = copy.deepcopy(fresh)
    follower.map_samples(next(samples_of([Event(0.0, SIDES)])), arrival=0.0)
    q = follower.mapper.motion.q[follower.mapper.robot.q_indices]
    # Time that the motion needs at the limits of speed [s].
    needed = 0.0
    ahead = 0.0
    for k in range(1, 75):
        arrival = k / 60.0
        # The clocks of these hands run three times as fast, and may be set back now and then.
        ahead += 2.0 / 60.0 - back * (k % 20 == 0)
        clocks = dict.fromkeys(sides, ahead)
        for side in SIDES:
            sample = HumanSample(
                arrival + clocks.get(side, 0.0), side, landmarks_at(side, 3.0 * arrival)
            )
            before, q = (
                q,
                follower.map_samples({side: sample}, arrival=arrival).command.q,
            )
            moved = np.abs(q - before) / follower.mapper.robot.velocity_limits
            needed += moved.max()
        assert needed <= 1.02 * arrival + GAP + 1e-3
    # The motion is too fast for the robot, so that it needs most of it.
    assert needed >= 0.5 * arrival


def test_hands_of_one_clock_keep_it_after_stamps_that_outrun_arrival(
    fresh: RobotFollower,
) -> None:
    follower = copy.deepcopy(fresh)
    events = in_turns((60.0, 45.0), 2.0, 0.3)
    times = []
    for event, samples in zip(events, samples_of(events), strict=True):
        # For half a second, no sample arrives.
        is_late = 0.5 < event.time <= 1.0
        follower.map_samples(samples, arrival=1.0 if is_late else event.time)
        times.append(follower.mapper.motion.time)
    stamps = np.array([event.time for event in events])
    later = stamps > 1.3
    passed = np.diff(np.array(times)[later])
    np.testing.assert_allclose(passed, np.diff(stamps[later]), atol=1e-9)
    # The robot lags behind what arrived too late.
    assert times[-1] - times[0] < stamps[-1] - stamps[0] - 0.1


def test_a_robot_that_waits_for_both_hands_starts_from_rest(
    fresh: RobotFollower,
) -> None:
    events = in_turns((60.0, 60.0), 0.6)
    events += [Event(event.time + 30.0, event.sides) for event in events]
    check(followed(copy.deepcopy(fresh), events))


def test_a_clock_that_both_hands_share_is_set_for_both(fresh: RobotFollower) -> None:
    follower = copy.deepcopy(fresh)
    events = in_turns((60.0, 60.0), 0.4)
    for samples in samples_of(events):
        follower.map_samples(samples)
    later = [Event(event.time + 0.4, event.sides) for event in events]
    times = []
    for samples in samples_of(later, {"left": -50.0, "right": -50.0}):
        follower.map_samples(samples)
        times.append(follower.mapper.motion.time)
    # The first sample after it takes no time; all others take that since the one before.
    np.testing.assert_allclose(np.diff(times)[1:], 1.0 / 120.0, rtol=1e-6)


@pytest.mark.parametrize("knows_arrival", [True, False])
def test_a_shared_clock_that_is_set_back_a_little_stops_a_robot_for_a_few_samples(
    fresh: RobotFollower, knows_arrival: bool
) -> None:
    follower = copy.deepcopy(fresh)
    events = in_turns((60.0, 60.0), 1.2)
    still = 0
    for event in events:
        back = 0.9 * (event.time > 0.4)
        (samples,) = samples_of([event], {"left": -back, "right": -back})
        before = follower.mapper.motion.time
        arrival = event.time if knows_arrival else None
        follower.map_samples(samples, arrival=arrival)
        still += follower.mapper.motion.time - before < 1e-3
    # Five late samples in a row tell a clock that was set back, of each hand.
    assert still <= 12


def test_each_hand_counts_the_time_since_its_own_sample(g1: Hand) -> None:
    mapper = mapper_of(g1)
    for time, sides in in_turns((60.0, 20.0), 0.5):
        landmarks = {side: landmarks_at(side, time) for side in sides}
        mapper.map_landmarks(landmarks, time=time)
    left, right = (mapper.hands[side] for side in SIDES)
    assert left.request.dt == pytest.approx(1.0 / 60.0, rel=0.2)
    assert right.request.dt == pytest.approx(1.0 / 20.0, rel=0.2)
    # Palms turn as soon at any rate.
    assert left.state.since == pytest.approx(right.state.since, abs=0.06)


def test_a_stop_between_samples_takes_its_time_from_them(g1: Hand) -> None:
    single = g1.by_side["left"]
    ik = PRESET.ik.replaced(max_acceleration=MOST)
    mapper = HandMapper(HUMANS["left"], single, "teleoperation", ik=ik)
    follower = Follower(mapper)
    q, times = [], []
    for k in range(60):
        time = k / 60.0
        for samples in samples_of([Event(time, ("left",))]):
            q.append(follower.map_sample(samples["left"]).command.q)
            times.append(time)
        if k % 7 == 6:
            q.append(mapper.hold(0.01).command.q)
            times.append(time + 0.01)
    worst = judge(mapper.robot, times, q)
    assert worst.speed <= 1.0 + 1e-6
    assert worst.acceleration <= MOST * (1.0 + 1e-6)


@pytest.mark.parametrize(
    ("gap", "most"), crossed([0.06, 0.12, 0.2, 0.3, 0.6, 5.0], [3.0, MOST], every=2)
)
def test_a_single_hand_starts_from_rest_after_a_gap(
    g1: Hand, gap: float, most: float
) -> None:
    single = g1.by_side["left"]
    ik = PRESET.ik.replaced(max_acceleration=most)
    mapper = HandMapper(HUMANS["left"], single, "teleoperation", ik=ik)
    follower = Follower(mapper)
    times = [k / 60.0 for k in range(40)]
    times += [times[-1] + gap + k / 60.0 for k in range(20)]
    q = []
    for time in times:
        (samples,) = samples_of([Event(time, ("left",))])
        q.append(follower.map_sample(samples["left"]).command.q)
    worst = judge(mapper.robot, times, q)
    assert worst.speed <= 1.0 + 1e-6
    assert worst.acceleration <= most * (1.0 + 1e-6)
    # It does not make up for the gap, but for the stop that it was on.
    moved = np.abs(q[40] - q[39])
    last = np.abs(q[39] - q[38]) * 60.0
    braking = last * gap * max(1.0 - gap / 0.5, 0.0)
    assert (moved <= mapper.robot.velocity_limits * 0.05 + braking + 1e-9).all()


def recording_of(side: Side, times: np.ndarray) -> Recording:
    landmarks = np.array([landmarks_at(side, time) for time in times])
    return Recording(side, times, landmarks, np.ones(len(times), bool), side)


@pytest.mark.parametrize("lost", [0.5, 5.0])
def test_recordings_keep_one_clock_where_a_hand_was_lost_at_the_start(
    fresh: RobotFollower, lost: float
) -> None:
    times = np.arange(120) / 60.0
    # The right hand is lost before the left one comes, and returns a little later.
    right = np.concatenate([times[:30] - lost - 0.5, times[40:80] + 0.002])
    recordings: dict[Side, Recording] = {
        "left": recording_of("left", times),
        "right": recording_of("right", right),
    }
    follower = copy.deepcopy(fresh)
    q = [follower.map_samples(each).command.q for each in paired(recordings)]
    check(judge(follower.mapper.robot, [*times], q))


# -- the gate


@pytest.fixture
def gate(g1: Hand) -> Gate:
    q = g1.configuration_vector(g1.rest)
    motion = Motion.at_rest(q, len(g1.active_columns), time=5.0)
    return Gate(g1, motion, IkOptions(max_acceleration=10.0))


@pytest.mark.parametrize("when", [5.0, 4.0, -np.inf, np.nan, 5.0 + 1e-9])
def test_a_command_that_is_not_later_takes_no_time(gate: Gate, when: float) -> None:
    far = np.full(gate.limits.size, 10.0)
    taken = gate.admit(far, far, Instant(when))
    assert np.abs(taken).max() <= 10.0 * SHORTEST_DT**2 * (1.0 + 1e-6)
    assert gate.motion.time == 5.0 + SHORTEST_DT
    assert gate.motion.dt == SHORTEST_DT


def test_the_time_of_a_command_is_taken_once(gate: Gate) -> None:
    for k in range(100):
        far = np.full(gate.limits.size, 10.0)
        before = gate.motion
        taken = gate.admit(far, far, Instant(5.5))
        assert gate.motion.dt == (0.5 if k == 0 else SHORTEST_DT)
        assert np.abs(taken).max() <= 10.0 * gate.motion.dt * (gate.motion.dt + 1.0)
        assert gate.motion.time > before.time
    assert gate.motion.time < 5.5 + 1e-3


def test_what_moves_a_robot_does_not_set_its_clock_back(g1: Hand) -> None:
    mapper = mapper_of(g1)
    mapper.map_landmarks({"left": landmarks_at("left", 0.0)}, dt=0.5)
    mapper.reset()
    assert mapper.motion.time == 0.5
    mapper.motion = Motion.at_rest(mapper.motion.q, mapper.point_ik.gate.limits.size)
    assert mapper.motion.time == 0.5
    mapper.motion = mapper.motion._replace(time=2.0)
    assert mapper.motion.time == 2.0


@pytest.mark.parametrize(
    "times", [{"time": np.nan}, {"time": "now"}, {"time": 1.0, "dt": 0.1}]
)
def test_an_instant_that_cannot_be_used_changes_nothing(g1: Hand, times: dict) -> None:
    mapper = mapper_of(g1)
    landmarks = {side: landmarks_at(side, 0.0) for side in SIDES}
    mapper.map_landmarks(landmarks, time=100.0)
    before = mapper.point_ik.gate.stamp
    with pytest.raises(InvalidInputError):
        mapper.map_landmarks(landmarks, **times)
    assert mapper.point_ik.gate.stamp == before
    single = HandMapper(HUMANS["left"], load_hand("three_finger"), "teleoperation")
    with pytest.raises(InvalidInputError):
        single.map_landmarks(landmarks["left"], **times)


WRONG = {
    "an instant that never comes": Instant(np.inf),
    "an instant that is not a number": Instant(np.nan),
    "an instant that is a text": Instant("now"),  # ty: ignore[invalid-argument-type]
    "a longest time of zero": Instant(1e3, 0.0),
    "a longest time that is not a number": Instant(1e3, np.nan),
    "a pair that is not an instant": (1e3, 0.1),
    "a pair with one number": (1e3,),
}
"""What cannot be a time of a command."""


@pytest.mark.parametrize("samples", [0, 2])
def test_a_time_that_cannot_be_one_changes_nothing(g1: Hand, samples: int) -> None:
    # The core maps samples after the first ones.
    mapper = mapper_of(g1)
    single = HandMapper(HUMANS["left"], load_hand("three_finger"), "teleoperation")
    follower = Follower(copy.deepcopy(single))
    landmarks = {side: landmarks_at(side, 0.0) for side in SIDES}
    events = [Event(k / 60.0, ("left",)) for k in range(samples + 1)]
    *earlier, last = [each["left"] for each in samples_of(events)]
    for sample in earlier:
        mapper.map_landmarks(landmarks)
        single.map_landmarks(landmarks["left"])
        follower.map_sample(sample)
    movers = mapper, single, follower.mapper
    before = [mover.point_ik.gate.stamp for mover in movers]
    calls: list[Callable[[Any], object]] = [
        lambda when: mapper.map_landmarks(landmarks, dt=when),
        lambda when: single.map_landmarks(landmarks["left"], dt=when),
        single.hold,
        lambda when: follower.map_sample(last, dt=when),
    ]
    for what, when in WRONG.items():
        for call in calls:
            with pytest.raises(InvalidInputError, match="dt: expected"):
                call(when)
        assert [mover.point_ik.gate.stamp for mover in movers] == before, what


def moved_in(mapper: HandMapper | RobotMapper, count: int) -> int:
    """Map samples from time 0 on; return the number of commands that move the robot."""
    moved = 0
    for k in range(count):
        landmarks: Any = {side: landmarks_at(side, k / 60.0) for side in SIDES}
        if isinstance(mapper, HandMapper):
            landmarks = landmarks["right"]
        before = mapper.motion.q
        mapper.map_landmarks(landmarks, time=k / 60.0)
        moved += np.abs(mapper.motion.q - before).max() > 1e-4
    return moved


@pytest.mark.parametrize("kind", ["hand", "robot"])
def test_a_reset_begins_a_new_clock(g1: Hand, kind: str) -> None:
    mapper: HandMapper | RobotMapper = mapper_of(g1)
    if kind == "hand":
        mapper = HandMapper(HUMANS["right"], load_hand("three_finger"))
    first = moved_in(mapper, 75)
    assert first > 50
    mapper.reset()
    # A second recording may begin at 0, too.
    assert moved_in(mapper, 75) == first


@pytest.mark.parametrize("kind", ["hand", "robot"])
def test_a_reset_gives_no_time_where_the_clock_goes_on(g1: Hand, kind: str) -> None:
    mapper: HandMapper | RobotMapper = mapper_of(g1)
    landmarks: Any = {side: landmarks_at(side, 0.0) for side in SIDES}
    if kind == "hand":
        mapper = HandMapper(HUMANS["right"], load_hand("three_finger"))
        landmarks = landmarks["right"]
    mapper.map_landmarks(landmarks, time=100.0)
    for k in range(1, 6):
        mapper.reset(robot_q=mapper.motion.q[mapper.robot.q_indices])
        mapper.map_landmarks(landmarks, time=100.0 + k / 240.0)
        assert mapper.motion.dt == pytest.approx(1.0 / 240.0, abs=2.0 * SHORTEST_DT)
        mapper.reset(robot_q=mapper.motion.q[mapper.robot.q_indices])
        mapper.map_landmarks(landmarks, time=100.0 + k / 240.0)
        assert mapper.motion.dt == SHORTEST_DT


def test_a_stream_goes_on_after_a_pause_of_its_clock() -> None:
    mapper = HandMapper(HUMANS["left"], load_hand("three_finger"), "teleoperation")
    follower = Follower(mapper)
    events = [Event(k / 60.0, ("left",)) for k in range(60)]
    samples = [each["left"] for each in samples_of(events)]
    for sample in samples[:30]:
        follower.map_sample(sample)
    for _ in range(300):
        mapper.hold(1.0 / 60.0)
    paused = copy.deepcopy(follower)
    for number, sample in enumerate(samples[30:]):
        follower.map_sample(sample)
        # The first one takes nearly no time, because nobody knows how much has passed.
        expected = 1.0 / 60.0 if number else SHORTEST_DT
        assert mapper.motion.dt == pytest.approx(expected, rel=1e-6)
    recording = Recording(
        "after a pause",
        np.array([sample.time for sample in samples[30:]]),
        np.array([sample.landmarks for sample in samples[30:]]),
        np.ones(30, bool),
        "left",
    )
    q, *_ = paused.map_samples(recording).columns
    assert np.abs(np.diff(q, axis=0)).max() > 0.01
    np.testing.assert_allclose(q[-1], mapper.motion.q[mapper.robot.q_indices])


def test_a_hand_alone_takes_instants_too() -> None:
    mapper = HandMapper(
        HUMANS["right"],
        load_hand("three_finger"),
        ik=PRESET.ik.replaced(max_acceleration=MOST),
    )
    times = [0.0, 0.01, 0.03, 0.03, 0.02, 0.05, 0.3, 0.31, 0.33, 0.36]
    q = []
    for time in times:
        step = mapper.map_landmarks(landmarks_at("right", time), time=50.0 + time)
        q.append(step.command.q)
    worst = judge(mapper.robot, times, q)
    assert worst.speed <= 1.0 + 1e-6
    assert worst.acceleration <= MOST * (1.0 + 1e-6)
    assert mapper.motion.time == pytest.approx(mapper.dt + 0.36, abs=1e-4)
