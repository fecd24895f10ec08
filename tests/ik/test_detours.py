"""Ways round: a caught hand comes as near to its targets as from rest, and within its limits."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from mapping_cases import pinched
from oracles.shape_distances import MeasuredPairs

from handmap_core.ik.motion import Motion
from handmap_core.ik.tasks import TaskRows
from handmap_qp import HandMapper, load_hand
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.errors import MissingPackageError
from handmap_qp.mapping.presets import get_preset

DT = 1.0 / 60.0
PRESET = get_preset("teleoperation").ik
PALM = np.eye(4)


def mapper_of(robot: str = "allegro_right", **options: Any) -> HandMapper:
    """Return a mapper that stands at the human's rest."""
    human = load_hand("human", points="landmarks")
    ik = PRESET.replaced(**options)
    mapper = HandMapper(human, load_hand(robot), "teleoperation", ik=ik, dt=DT)
    mapper.map_step(human.rest, PALM)
    return mapper


def human_postures() -> Iterator[np.ndarray]:
    """Yield joint angles of a person, anywhere inside the limits."""
    human = load_hand("human")
    rng = np.random.default_rng(1)
    while True:
        yield rng.uniform(human.lower_limits, human.upper_limits)


def starts(mapper: HandMapper, count: int) -> list[Motion]:
    """Return random postures of the fingers without overlaps; the wrist is where it is."""
    rng = np.random.default_rng(0)
    ik, robot = mapper.point_ik, mapper.robot
    limit = MeasuredPairs.of(ik)
    wrist = ik.configuration.wrist.homogeneous.copy()
    found: list[Motion] = []
    while len(found) < count:
        q = rng.uniform(robot.lower_limits, robot.upper_limits)
        vector = robot.configuration_vector(q, wrist)
        if not len(limit.within(vector, 1e-3).pairs):
            found.append(Motion.at_rest(vector, len(robot.active_columns)))
    return found


def run(
    mapper: HandMapper, start: Motion, human_q: np.ndarray, seconds: float = 1.5
) -> np.ndarray:
    """Map one posture of a person from a start on; return the joints of all samples."""
    mapper.motion = start
    samples = range(round(seconds / DT))
    return np.array([mapper.map_step(human_q, PALM).command.q for _ in samples])


def end_error(mapper: HandMapper, start: Motion, human_q: np.ndarray) -> float:
    """Return the largest weighted error of a point where the hand ends [cost]."""
    run(mapper, start, human_q)
    errors = mapper.map_step(human_q, PALM).ik.errors
    costs = PRESET.point_costs(mapper.robot)
    return float((costs * np.linalg.norm(errors, axis=1)).max())


def is_on_detour(mapper: HandMapper) -> bool:
    """Return whether a hand is on a detour, on either path."""
    detours = mapper.point_ik.__reduce__()[1][-1]
    return any(via is not None for via, *_ in detours or ())


def start_detour(mapper: HandMapper, start: Motion, human_q: np.ndarray) -> None:
    """Map until the hand stands away from its targets, and takes a detour."""
    mapper.motion = start
    for _ in range(round(0.5 / DT)):
        mapper.map_step(human_q, PALM)
        if is_on_detour(mapper):
            return
    pytest.fail("no detour")


@pytest.fixture(scope="module")
def caught() -> tuple[Motion, np.ndarray]:
    """Return a start from which a hand is caught that would not be by a detour, and a posture."""
    mapper, plain = mapper_of(), mapper_of(takes_detours=False)
    rest = plain.motion
    for human_q, _ in zip(human_postures(), range(24), strict=False):
        least = max(3.0, end_error(plain, rest, human_q))
        for start in starts(plain, 8):
            if end_error(plain, start, human_q) < 2.0 * least:
                continue
            if end_error(mapper, start, human_q) < 1.5 * least:
                return start, human_q
    pytest.fail("no start is caught")


def test_a_hand_ends_as_near_as_from_rest_whatever_its_start() -> None:
    mapper, plain = mapper_of(), mapper_of(takes_detours=False)
    rest = mapper.motion
    cases = [
        (human_q, start)
        for human_q, _ in zip(human_postures(), range(12), strict=False)
        for start in starts(mapper, 8)
    ]
    worse = np.zeros(2, dtype=int)
    for human_q, start in cases:
        # The fingers' extension counts in the cost too.
        most = max(3.0, end_error(mapper, rest, human_q)) + 1.25
        ends = [end_error(each, start, human_q) for each in (mapper, plain)]
        worse += np.array(ends) > most
        # A detour is taken only where it helps.
        assert ends[0] < ends[1] + 0.5
    assert worse[0] <= 2 < worse[1]


def test_a_detour_frees_a_caught_finger_within_all_limits(
    caught: tuple[Motion, np.ndarray],
) -> None:
    start, human_q = caught
    mapper = mapper_of()
    robot, collisions = mapper.robot, MeasuredPairs.of(mapper.point_ik)
    free = max(3.0, end_error(mapper, mapper.motion, human_q))
    mapper.motion = start
    before = start.q[robot.q_indices]
    for _ in range(90):
        q = mapper.map_step(human_q, PALM).command.q
        assert (q >= robot.lower_limits).all()
        assert (q <= robot.upper_limits).all()
        speeds = np.abs(q - before) / DT
        assert (speeds <= robot.velocity_limits * (1.0 + 1e-9)).all()
        assert collisions.nearest(mapper.point_ik.configuration.q) > 0.0
        before = q
    # Another posture has to be clearly nearer than where the hand stands.
    assert end_error(mapper, mapper.motion, human_q) < free / 0.75 + 0.25


def test_a_detour_is_another_way_than_the_straight_one(
    caught: tuple[Motion, np.ndarray],
) -> None:
    start, human_q = caught
    way = run(mapper_of(), start, human_q)
    straight = run(mapper_of(takes_detours=False), start, human_q)
    assert np.abs(straight - way).max() > 0.3


@pytest.mark.parametrize(
    "way", [copy.deepcopy, lambda mapper: pickle.loads(pickle.dumps(mapper))]
)
def test_a_copy_in_a_detour_goes_on_with_it(
    way: Callable[[HandMapper], HandMapper],
    caught: tuple[Motion, np.ndarray],
) -> None:
    start, human_q = caught
    mapper = mapper_of()
    start_detour(mapper, start, human_q)
    other = way(mapper)
    assert is_on_detour(other)
    for _ in range(30):
        one, two = (each.map_step(human_q, PALM) for each in (mapper, other))
        np.testing.assert_allclose(one.command.q, two.command.q, atol=1e-9)


def test_a_copy_that_looks_ahead_goes_on_with_its_look(
    caught: tuple[Motion, np.ndarray],
) -> None:
    start, human_q = caught
    mapper = mapper_of()
    mapper.motion = start
    copies = []
    while not is_on_detour(mapper):
        mapper.map_step(human_q, PALM)
        copies.append(copy.deepcopy(mapper))
    # A look takes some samples, in which the hand goes on.
    assert len(copies) > 3
    ((via, *_),) = mapper.point_ik.core.detours
    for taken, other in enumerate(copies):
        # A copy knows no distances yet: in its first sample it measures more, and foresees less.
        left = len(copies) - taken
        while not is_on_detour(other) and left >= 0:
            other.map_step(human_q, PALM)
            left -= 1
        assert is_on_detour(other)
        ((same, *_),) = other.point_ik.core.detours
        assert via is not None
        assert same is not None
        np.testing.assert_allclose(same, via, atol=0.05)


def test_numbers_of_a_detour_that_are_wrong_are_refused(
    caught: tuple[Motion, np.ndarray],
) -> None:
    start, human_q = caught
    mapper = mapper_of()
    core = mapper.point_ik.core
    start_detour(mapper, start, human_q)
    ((via, points, numbers),) = detours = core.detours
    worse = numbers.copy()
    worse[-1] = np.nan
    for wrong in (
        numbers[:-1],
        numbers[:1],
        np.append(numbers, 0.0),
        1e9 * numbers,
        worse,
    ):
        with pytest.raises(ValueError, match="detour"):
            core.go_on([(via, points, wrong)])
    with pytest.raises(ValueError, match="detour"):
        core.go_on([])
    ((_, _, left),) = core.detours
    np.testing.assert_array_equal(left, detours[0][2])


def test_a_detour_ends_where_the_person_or_something_else_moves(
    caught: tuple[Motion, np.ndarray],
) -> None:
    start, human_q = caught
    mapper = mapper_of()
    rest = mapper.motion
    moved = PALM.copy()
    moved[0, 3] = 0.06
    for motion, pose in ((None, moved), (rest, PALM)):
        start_detour(mapper, start, human_q)
        ((_, old, *_),) = mapper.point_ik.__reduce__()[1][-1]
        if motion is not None:
            mapper.motion = motion
        step = mapper.map_step(human_q, pose)
        # A new one may begin at once, towards the targets of this sample.
        ((via, points, *_),) = mapper.point_ik.__reduce__()[1][-1] or [(None, None)]
        if via is not None:
            there = points - old
            there = there + (step.ik.wrist - step.wrist_target)[:3, 3]
            np.testing.assert_allclose(there, step.ik.targets - old, atol=1e-6)
    start_detour(mapper, start, human_q)
    held = mapper.hold(DT).command.q
    np.testing.assert_allclose(mapper.hold(DT).command.q, held, atol=1e-12)


def test_fingers_on_their_way_do_not_look_for_a_detour(
    caught: tuple[Motion, np.ndarray],
) -> None:
    start, human_q = caught
    mapper = mapper_of()
    robot = mapper.robot
    # The Allegro hand has four joints a finger.
    first = {"index": 0, "middle": 4, "ring": 8, "thumb": 12}
    starts_at = [first[str(point.finger)] for point in robot.reference_points]
    joints = np.array(starts_at)[:, None] + np.arange(4)
    costs = PRESET.point_costs(robot)
    mapper.motion = start
    is_on = [False]
    for _ in range(round(0.5 / DT)):
        before = mapper.motion.q[robot.q_indices]
        step = mapper.map_step(human_q, PALM)
        is_fast = np.abs(step.command.q - before) > 0.8 * robot.velocity_limits * DT
        is_away = costs * np.linalg.norm(step.ik.errors, axis=1) > 3.0
        is_on.append(is_on_detour(mapper))
        if is_on[-1] and not is_on[-2]:
            assert (is_away & ~is_fast[joints].any(axis=1)).any()
    assert is_on[1:].index(True) > 1


class Failing:
    """A task that adds nothing, and raises at one of its calls."""

    def __init__(self, at: int) -> None:
        self.left = at

    def linearise(self, hand: Any) -> TaskRows:
        self.left -= 1
        if self.left == 0:
            raise RuntimeError("a task fails")
        return TaskRows(np.zeros(0), np.zeros((0, hand.nv)), np.zeros(hand.nv))


def test_a_failure_while_looking_ahead_moves_nothing(
    caught: tuple[Motion, np.ndarray],
) -> None:
    start, human_q = caught
    mapper = mapper_of()
    mapper.motion = start
    failed = 0
    for _ in range(round(0.5 / DT)):
        before = mapper.motion.q.copy()
        # A sample takes at most six QPs; later calls are those of a look ahead.
        mapper.configure(tasks=[Failing(8)])
        try:
            mapper.map_step(human_q, PALM)
        except RuntimeError:
            failed += 1
            np.testing.assert_array_equal(mapper.motion.q, before)
            mapper.configure(tasks=[])
            step = mapper.map_step(human_q, PALM)
            q = before[mapper.robot.q_indices]
            most = mapper.robot.velocity_limits * DT * (1.0 + 1e-9)
            assert (np.abs(step.command.q - q) <= most).all()
    assert failed


def test_a_detour_leaves_an_arm_to_its_wrist() -> None:
    mapper = mapper_of("ur5_allegro")
    robot = mapper.robot
    assert robot.spec.arm is not None
    arm = robot.spec.arm.rest
    (pulls,) = robot.finger_joints
    assert pulls.tolist() == [name not in arm for name in robot.joint_names]


def test_a_detour_that_ends_late_is_not_taken_again_at_once(
    caught: tuple[Motion, np.ndarray],
) -> None:
    """A posture that is out of reach would pull the hand away from its targets for ever."""
    start, human_q = caught
    mapper = mapper_of()
    start_detour(mapper, start, human_q)
    core = mapper.point_ik.core
    were_on = []
    for _ in range(round(1.8 / DT)):
        detours = core.detours
        # The hand stays where it was caught, as if something held it.
        mapper.motion = start
        core.go_on(detours)
        mapper.map_step(human_q, PALM)
        were_on.append(is_on_detour(mapper))
    ended = were_on.index(False)
    assert ended * DT == pytest.approx(0.3, abs=0.04)
    assert not any(were_on[ended:])


@pytest.mark.parametrize("finger", ["middle", "ring"])
def test_a_pinch_that_stays_open_is_closed_by_another_way(finger: str) -> None:
    human_q = pinched(finger, 0.010)
    try:
        mapper = mapper_of("shadow_right")
    except MissingPackageError as error:
        pytest.skip(str(error))
    plain = mapper_of("shadow_right", takes_detours=False)
    meter = GapMeter(mapper.robot)
    gaps = []
    for start in starts(mapper, 24):
        ends = [run(each, start, human_q)[-1] for each in (mapper, plain)]
        gaps.append(meter.pinches(np.array(ends))[finger])
    is_open = np.array(gaps) > 0.002
    assert is_open[:, 0].sum() == 0 < is_open[:, 1].sum()
