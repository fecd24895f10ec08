"""The judge of hostile streams takes many commands a call, and finds what it finds one by one.

Short runs of `tests/judges/exact_streams.py`. Gates are broken on purpose: the judge has limits
that are a little lower, and commands and time stamps are changed after the gate.
"""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from marks import crossed

STEPS = 250
RUNS = (("three_finger", 14), ("allegro_right", 8), ("shadow_right", 9))
"""Hands and seeds of streams by time stamps, times and instants, with acceleration limits."""
PAUSED = (("romeo", 91309), ("tiago_dual", 96016))
"""Robots and seeds of streams that pause for 20 s before one of the hands has its first sample."""


class Call(NamedTuple):
    """A command that was judged, with its stamp [s] and limit; or a start, without a limit."""

    q: np.ndarray
    time: float
    limit: float | None
    is_start: bool


@pytest.fixture(scope="module")
def streams() -> ModuleType:
    """The judge, whose import loads hands: only where tests of it run."""
    return importlib.import_module("streams")


@pytest.fixture(scope="module", params=RUNS, ids=lambda run: run[0])
def recorded(request: Any, streams: ModuleType) -> tuple[Any, list[Call]]:
    """Return a robot, and what its judge was given, command by command."""
    run = streams.StreamRun(*request.param)
    calls: list[Call] = []
    start, take = run.checker.start, run.checker.take

    def recording_start(q: np.ndarray, time: float) -> None:
        calls.append(Call(q.copy(), time, None, True))
        start(q, time)

    def recording_take(q: np.ndarray, times: np.ndarray, limit: float | None) -> None:
        calls.extend(
            Call(each.copy(), float(time), limit, False)
            for each, time in zip(q, times, strict=True)
        )
        take(q, times, limit)

    run.checker.start, run.checker.take = recording_start, recording_take
    tally = tally_of(streams)
    run.advance(STEPS, tally)
    assert not tally.undocumented
    assert run.checker.commands > 0.8 * STEPS
    return run.robot, calls


def tally_of(streams: ModuleType) -> Any:
    return streams.hostile.Tally()


def judge(
    checker: Any, calls: list[Call], size: int
) -> tuple[dict[str, int], dict[str, int], dict[str, float], float]:
    """Give a judge up to so many commands a call; return its verdict."""
    k = 0
    while k < len(calls):
        q, time, limit, is_start = calls[k]
        if is_start:
            checker.start(q, time)
            k += 1
            continue
        stop = k
        while stop < min(k + size, len(calls)) and calls[stop][2:] == (limit, False):
            stop += 1
        many = calls[k:stop]
        checker.take(
            np.array([each.q for each in many]), [each.time for each in many], limit
        )
        k = stop
    found = {what: count for what, count in checker.violations.items() if count}
    return found, checker.first, checker.worst, checker.time


def moved(robot: Any, calls: list[Call], where: int) -> list[Call]:
    """Change one command by .3 rad."""
    del robot
    return changed(calls, where, lambda call: call._replace(q=call.q + 0.3))


def beyond(robot: Any, calls: list[Call], where: int) -> list[Call]:
    """Put a joint beyond its limit by one rounding."""

    def change(call: Call) -> Call:
        q = call.q.copy()
        q[robot.q_indices[0]] = np.nextafter(robot.upper_limits[0], np.inf)
        return call._replace(q=q)

    return changed(calls, where, change)


def early(robot: Any, calls: list[Call], where: int) -> list[Call]:
    """Let all commands from one on claim to be 1 s earlier than they are."""
    del robot
    return [
        call._replace(time=call.time - 1.0) if k >= where else call
        for k, call in enumerate(calls)
    ]


def lost(robot: Any, calls: list[Call], where: int) -> list[Call]:
    """Replace one joint by NaN."""

    def change(call: Call) -> Call:
        q = call.q.copy()
        q[robot.q_indices[0]] = np.nan
        return call._replace(q=q)

    return changed(calls, where, change)


def lowered(robot: Any, calls: list[Call], where: int) -> list[Call]:
    """Let the judge have a limit of acceleration that is .1 % lower than the gate's."""
    del robot, where
    return [call._replace(limit=call.limit and call.limit / 1.001) for call in calls]


def changed(
    calls: list[Call], where: int, change: Callable[[Call], Call]
) -> list[Call]:
    return [change(call) if k == where else call for k, call in enumerate(calls)]


@pytest.mark.parametrize(
    ("spoil", "what"),
    [
        (moved, "speed"),
        (beyond, "position"),
        (early, "speed"),
        (lost, "position"),
        (lowered, "acceleration"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_many_commands_a_call_have_the_verdict_of_one_by_one(
    streams: ModuleType, recorded: tuple[Any, list[Call]], spoil: Any, what: str
) -> None:
    robot, calls = recorded
    # In the middle, among commands of the same limit.
    spoilt = spoil(robot, calls, len(calls) // 2)
    one_by_one = judge(streams.Checker(robot), spoilt, 1)
    assert one_by_one[0][what] > 0
    for size in (2, 7, len(calls)):
        assert judge(streams.Checker(robot), spoilt, size) == one_by_one


def test_a_stream_within_its_limits_has_no_violation(
    streams: ModuleType, recorded: tuple[Any, list[Call]]
) -> None:
    robot, calls = recorded
    one_by_one = judge(streams.Checker(robot), calls, 1)
    assert one_by_one[0] == {}
    assert judge(streams.Checker(robot), calls, len(calls)) == one_by_one
    # It reaches its limits, so that a lower one is seen.
    assert one_by_one[2]["acceleration"] > 0.999


@pytest.mark.parametrize(("run", "known"), crossed(PAUSED, [0.0, 1.0], every=2))
def test_a_robot_keeps_its_limits_after_a_pause_that_a_new_hand_ends(
    streams: ModuleType, run: tuple[str, int], known: float
) -> None:
    tally = tally_of(streams)
    paused = streams.StreamRun(*run)
    # Share of the samples whose arrival is known.
    paused._arrivals._known = known
    streams.hostile.take(paused, STEPS, tally)
    assert tally.is_exact, tally.found


def test_a_speed_limit_that_is_a_little_lower_is_seen(
    streams: ModuleType, recorded: tuple[Any, list[Call]]
) -> None:
    robot, calls = recorded
    fastest = judge(streams.Checker(robot), calls, 1)[2]["speed"]

    def checker() -> Any:
        slower = streams.Checker(robot)
        slower._speed = slower._speed * fastest / 1.001
        return slower

    one_by_one = judge(checker(), calls, 1)
    assert one_by_one[0].keys() == {"speed"}
    assert judge(checker(), calls, len(calls)) == one_by_one


def test_a_command_that_no_gate_saw_is_found_by_the_run(streams: ModuleType) -> None:
    run, judged = streams.StreamRun("allegro_right", 8), 0
    forward, target = run._judge, 100

    def doctored(command: Any, stamp: float) -> None:
        nonlocal judged
        # The first command is where the judge starts.
        if judged == target + 1:
            command = SimpleNamespace(q=command.q + 0.5, wrist=command.wrist)
        judged += 1
        forward(command, stamp)

    run._judge = doctored
    tally = tally_of(streams)
    streams.hostile.take(run, STEPS, tally)
    assert run.checker.first["speed"] == target
    assert not tally.is_exact
    (line, *_) = [line for line in tally.found if "speed" in line]
    assert "allegro_right" in line
    assert "seed 8" in line


def test_commands_are_judged_as_they_were_given(streams: ModuleType) -> None:
    run = streams.StreamRun("three_finger", 14)
    given: list[Call] = []
    judged: list[Call] = []
    sizes: list[int] = []
    forward, take = run._judge, run.checker.take

    def watched(command: Any, stamp: float) -> None:
        # The first command is where the judge starts.
        if run._is_placed:
            vector = run.robot.configuration_vector(command.q, command.wrist)
            limit = run._mapper.ik.max_acceleration
            given.append(Call(vector, stamp, limit, False))
        forward(command, stamp)

    def keeping(q: np.ndarray, times: np.ndarray, limit: float | None) -> None:
        sizes.append(len(q))
        judged.extend(
            Call(each, float(time), limit, False)
            for each, time in zip(q, times, strict=True)
        )
        take(q, times, limit)

    run._judge, run.checker.take = watched, keeping
    run.advance(4 * STEPS, tally_of(streams))
    assert run.checker.commands == len(given)
    looked_at = [*range(7), *run.robot.q_indices]
    for before, after in zip(given, judged, strict=True):
        assert after[1:] == before[1:]
        np.testing.assert_array_equal(after.q[looked_at], before.q[looked_at])
    # The limit changes on the way, and commands of one limit are one call.
    limits = [call.limit for call in given]
    changes = sum(a != b for a, b in itertools.pairwise(limits))
    assert len(sizes) == changes + 1 > 1
    # The run's clock is that of the judge.
    assert run._last == run.checker.time


def test_commands_before_an_exception_are_judged_too(streams: ModuleType) -> None:
    run, taken = streams.StreamRun("allegro_right", 8), 0
    forward = run._take

    def failing(sample: Any) -> Any:
        nonlocal taken
        taken += 1
        if taken > 50:
            raise RuntimeError("a defect")
        return forward(sample)

    run._take = failing
    tally = tally_of(streams)
    run.advance(STEPS, tally)
    assert len(tally.undocumented) == 1
    assert run.checker.commands >= 0.8 * 50


def test_no_stall_of_arrivals_is_longer_than_a_follower_accepts(
    streams: ModuleType,
) -> None:
    rng = np.random.default_rng(3)
    bursts = 0
    for _ in range(40):
        arrivals = streams.Arrivals(rng)
        arrivals._known = 1.0
        stamp = newest = 0.0
        last = -np.inf
        for period in rng.uniform(-0.1, 0.4, 200):
            stamp += period
            arrival = arrivals.arrival(stamp)
            assert arrival >= max(stamp, last)
            bursts += arrival == last
            if 0.0 < stamp - newest <= streams.GAP:
                assert arrival - newest <= streams.GAP + 1e-9
            last = arrival
            newest = max(newest, stamp)
    assert bursts > 100


def test_landmarks_that_are_computed_ahead_are_those_of_their_instants(
    streams: ModuleType,
) -> None:
    rng = np.random.default_rng(0)
    person = streams.Person(("left", "right"), rng)
    ahead = [*zip(range(450), streams.events(("left", "right"), rng), strict=False)]
    events = [event for _, event in ahead]
    samples = [*person.samples(iter(events))]
    assert [sample.stamp for sample in samples] == [event.stamp for event in events]
    for event, sample in zip(events, samples, strict=True):
        assert (*sample.landmarks,) == event.sides
        for side, landmarks in sample.landmarks.items():
            (alone,) = person.landmarks(side, np.array([event.stamp]))
            np.testing.assert_allclose(landmarks, alone, atol=1e-12)
    # Bones are rigid, and the hand moves.
    own = np.array([each.landmarks["left"] for each in samples if "left" in each[1]])
    bones = np.linalg.norm(np.diff(own[:, [0, 5, 6, 7, 8]], axis=1), axis=-1)
    np.testing.assert_allclose(bones, bones[:1].repeat(len(bones), axis=0), atol=1e-9)
    assert np.ptp(own[:, 8], axis=0).max() > 0.1
