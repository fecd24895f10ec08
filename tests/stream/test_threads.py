"""A mapper that two threads use: the second one gets an error, and the first one ends right."""

from __future__ import annotations

import copy
import pickle
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from faulty_recordings import DEMO
from meeting_hands import meeting_hands

from handmap_core.human.recording import sample_columns
from handmap_core.human.sample import human_name
from handmap_core.ik.tasks import JointPositions
from handmap_qp import (
    Follower,
    HandMapper,
    HumanLengths,
    HumanSample,
    InvalidInputError,
    MapperBusyError,
    load_hand,
)
from handmap_qp.errors import HandmapError
from handmap_qp.hands.robot import load_robot
from handmap_qp.mapping.method import core_pose
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.stream.guard import StreamGuard
from handmap_qp.trackers.plausibility import InputCheck

HUMAN = load_hand(
    "human", points="landmarks", lengths=HumanLengths.from_hand_length(0.19)
)
ROBOT = load_hand("three_finger")
COLUMNS = sample_columns(DEMO.part(slice(0, 150)))
SAMPLE = COLUMNS.sample(20)
MEETING = meeting_hands()
PEOPLE = {side: load_hand(human_name(side), points="landmarks") for side in MEETING}
PATIENCE = 60.0  # of what must happen soon [s]


def follower() -> Follower:
    return Follower(HandMapper(HUMAN, ROBOT))


class Pause:
    """Stops a thread at a place that it calls, once."""

    def __init__(self) -> None:
        self.has_come = threading.Event()
        self.may_go = threading.Event()

    def __call__(self, *_: Any) -> None:
        self.has_come.set()
        assert self.may_go.wait(PATIENCE)


@contextmanager
def at_work(work: Callable[[Pause], Any]) -> Iterator[Callable[[], Any]]:
    """Let another thread work until it pauses; yield what lets it go on, and gives its result."""
    pause = Pause()
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(work, pause)

        def finish() -> Any:
            pause.may_go.set()
            return future.result(PATIENCE)

        try:
            assert pause.has_come.wait(PATIENCE)
            yield finish
        finally:
            pause.may_go.set()


def entries_of(follower: Follower) -> dict[str, Callable[[], Any]]:
    """Return every call of a follower and of its mapper."""
    mapper = follower.mapper
    pose = mapper.landmarks.read(SAMPLE.landmarks)[0]
    step = HandMapper(HUMAN, ROBOT).map(pose)
    motion = HandMapper(HUMAN, ROBOT).motion
    return {
        "map_sample": lambda: follower.map_sample(SAMPLE),
        "map_samples": lambda: follower.map_samples(COLUMNS),
        "follower.map": lambda: follower.map(pose, 0.02),
        "forget": lambda: follower.forget(step),
        "map_landmarks": lambda: mapper.map_landmarks(SAMPLE.landmarks),
        "map_points": lambda: mapper.map_points(pose.points, pose.wrist),
        "map": lambda: mapper.map(pose),
        "hold": lambda: mapper.hold(0.02),
        "reset": mapper.reset,
        "clutch": mapper.clutch,
        "configure": lambda: mapper.configure("paper"),
        "release": mapper.release,
        "motion": lambda: mapper.motion,
        "motion =": lambda: setattr(mapper, "motion", motion),
        "deepcopy": lambda: copy.deepcopy(mapper),
        "copy": lambda: copy.copy(mapper),
        "pickle": lambda: pickle.dumps(mapper),
        "deepcopy of a follower": lambda: copy.deepcopy(follower),
        "pickle of a follower": lambda: pickle.dumps(follower),
    }


def refuse(calls: list[Callable[[], Any]]) -> None:
    for call in calls:
        with pytest.raises(MapperBusyError, match="at work in another thread"):
            call()


def test_a_mapper_at_work_refuses_other_threads() -> None:
    alone = follower()
    expected = alone.map_samples(COLUMNS).rows[:, :-1]
    used = follower()
    entries = entries_of(used)
    with at_work(lambda pause: used.map_samples(COLUMNS, pause)) as finish:
        refuse([*entries.values()])
        np.testing.assert_array_equal(finish().rows[:, :-1], expected)
    # They left it as it was, and all may enter again.
    later = replace(SAMPLE, time=COLUMNS.time[-1] + 0.02)
    one, other = (each.map_sample(later).command.q for each in (alone, used))
    np.testing.assert_array_equal(one, other)
    for enter in entries.values():
        with suppress(InvalidInputError):
            enter()


def test_the_thread_at_work_may_call_its_mapper() -> None:
    used = follower()
    seen = []
    used.map_samples(COLUMNS, lambda _: seen.append(used.mapper.motion))
    assert seen


def test_a_copy_is_free() -> None:
    used = follower()
    used.map_sample(COLUMNS.sample(0))
    twins = [copy.deepcopy(used), pickle.loads(pickle.dumps(used))]
    with at_work(lambda pause: used.map_samples(COLUMNS, pause)) as finish:
        for twin in twins:
            assert twin.work is twin.mapper.work
            twin.map_sample(COLUMNS.sample(1))
        finish()


def test_an_error_lets_others_in() -> None:
    used = follower()
    wrong = replace(SAMPLE, side="left")

    def fail(_: int) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        used.map_samples(COLUMNS, fail)
    for _ in range(3):
        with pytest.raises(InvalidInputError):
            used.map_sample(wrong)
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(used.map_sample, COLUMNS.sample(0)).result(PATIENCE)


def test_threads_on_one_mapper_end_in_order() -> None:
    """Nothing pauses here: the core maps recordings without the interpreter's lock meanwhile."""
    expected = follower().map_samples(COLUMNS).rows[:, :-1]
    used = follower()
    stop = threading.Event()
    refused = 0

    def disturb() -> None:
        nonlocal refused
        while not stop.is_set():
            try:
                used.mapper.hold(0.02)
            except MapperBusyError:
                refused += 1

    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(disturb)
        try:
            while refused < 20 and not future.done():
                used.mapper.work.lock.acquire()
                try:
                    used.mapper.reset()
                    fresh = Follower(used.mapper)
                    rows = fresh.map_samples(COLUMNS).rows[:, :-1]
                    # The robot's clock goes on, so that intervals are rounded elsewhere.
                    np.testing.assert_allclose(rows, expected, rtol=0.0, atol=1e-9)
                finally:
                    used.mapper.work.lock.release()
        finally:
            stop.set()
        future.result(PATIENCE)


# -- mappers of their own, and a robot whose samples are mapped without the interpreter's lock


def mapped(mapper: HandMapper | RobotMapper) -> np.ndarray:
    """Return the commands of a mapper that follows both hands, or the right one."""
    found = []
    for i in range(60):
        if isinstance(mapper, RobotMapper):
            both = {side: each.landmarks[4 * i] for side, each in MEETING.items()}
            step = mapper.map_landmarks(both, dt=4 / 60)
        else:
            step = mapper.map_landmarks(COLUMNS.landmarks[i], dt=1 / 60)
        found.append(step.command.q)
    return np.array(found)


@pytest.mark.parametrize("kind", ["hand", "robot"])
def test_threads_on_mappers_of_their_own_get_what_each_gets_alone(kind: str) -> None:
    mappers: list[HandMapper | RobotMapper]
    if kind == "hand":
        mappers = [HandMapper(HUMAN, ROBOT, preset) for preset in (None, "paper")]
    else:
        mappers = [two_handed(preset) for preset in ("teleoperation", "object")]
    alone = [mapped(copy.deepcopy(each)) for each in mappers]
    with ThreadPoolExecutor(2) as pool:
        for found, expected in zip(pool.map(mapped, mappers), alone, strict=True):
            np.testing.assert_array_equal(found, expected)


def test_a_robot_at_work_refuses_other_threads() -> None:
    mapper = two_handed("teleoperation")
    hands = {side: each.landmarks[0] for side, each in MEETING.items()}

    def work() -> Any:
        return mapper.map_landmarks(hands, dt=0.02)

    work()
    in_core = mapper.core
    refused_while(work, [work, lambda: mapper.motion, lambda: copy.deepcopy(mapper)])
    assert mapper.core is in_core


def two_handed(preset: str) -> RobotMapper:
    return RobotMapper(load_robot("ur5_pair"), PEOPLE, preset)


# -- the core by itself, where a call of Python inside it lets other threads in


class Pausing(JointPositions):
    """A task of Python that pauses while the core solves."""

    pause: Any = None

    def linearise(self, hand: Any) -> Any:
        self.pause()
        return super().linearise(hand)


def pausing_task(pause: Callable[..., Any]) -> Pausing:
    task = Pausing(ROBOT, slice(None), ROBOT.rest, 0.1)
    object.__setattr__(task, "pause", pause)
    return task


def test_a_solver_at_work_refuses_every_call() -> None:
    mapper = HandMapper(HUMAN, ROBOT)
    mapper.map_landmarks(SAMPLE.landmarks)
    ik = mapper.point_ik
    in_core = mapper.core
    assert in_core is not None
    solver = ik.core
    reader: Any = mapper.landmarks.core
    reference: Any = mapper.reference
    motion = mapper.motion
    points = ik.configuration.points

    def solve(task: Pausing) -> Any:
        return ik.solve(points, None, 0.02, tasks=[task])

    with at_work(lambda pause: solve(pausing_task(pause))) as finish:
        refuse(
            [
                lambda: solve(pausing_task(lambda: None)),
                lambda: solver.hold(0.02),
                lambda: solver.set_motion(
                    motion.q, motion.displacement, 0.02, motion.stop_times
                ),
                lambda: solver.detours,
                lambda: solver.go_on([]),
                lambda: in_core.follow(core_pose(reference), 0.02, 1.0),
                lambda: in_core.map(reader, SAMPLE.landmarks, None, 0.02),
            ]
        )
        assert finish().status
    # The same thread must not come in from a call of Python either.
    with pytest.raises(MapperBusyError):
        solve(pausing_task(lambda: solver.hold(0.02)))

    def fail() -> None:
        raise ZeroDivisionError

    for _ in range(3):
        with pytest.raises(ZeroDivisionError):
            solve(pausing_task(fail))
    assert solver.hold(0.02).status == "released"


def refused_while(work: Callable[[], Any], calls: Sequence[Callable[[], Any]]) -> None:
    """Check that each call is refused while another thread works, and works by itself."""
    stop = threading.Event()

    def go_on() -> None:
        while not stop.is_set():
            with suppress(MapperBusyError):
                work()

    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(go_on)
        try:
            for call in calls:
                refused = False
                while not (refused or future.done()):
                    try:
                        call()
                    except MapperBusyError:
                        refused = True
        finally:
            stop.set()
        future.result(PATIENCE)
    for call in calls:
        call()


def test_a_guard_at_work_refuses_every_call() -> None:
    """It judges a recording without the interpreter's lock."""
    guard = StreamGuard(HUMAN)
    columns = sample_columns(DEMO)
    refused_while(
        lambda: guard.holds(columns),
        [
            lambda: guard.check(SAMPLE),
            guard.forget,
            lambda: guard.holds(columns),
            lambda: pickle.dumps(guard),
        ],
    )


def test_an_input_check_at_work_refuses_every_call() -> None:
    check = InputCheck("right")
    refused_while(
        lambda: check.examine(DEMO),
        [
            lambda: check.update(0.0, SAMPLE.landmarks, None),
            check.alert,
            check.finish,
            lambda: check.finding,
            lambda: check.is_wrist_proven,
            lambda: check.examine(DEMO),
            lambda: pickle.dumps(check),
        ],
    )


def test_the_error_is_one_of_the_package() -> None:
    error = pickle.loads(pickle.dumps(MapperBusyError()))
    assert isinstance(error, HandmapError)
    assert str(error) == "this mapper is at work in another thread"
    assert isinstance(SAMPLE, HumanSample)
