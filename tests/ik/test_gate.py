"""One gate: each command passes it once, whoever asks, and it owns motion and time."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from copy import deepcopy

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robot_cases import landmarks_at, write_robot

from handmap_core.human.sample import HumanSample
from handmap_core.ik.gate import Gate
from handmap_core.ik.motion import Instant, Motion
from handmap_core.ik.tasks import TaskRows
from handmap_qp import Follower, HandMapper, IkOptions, load_hand
from handmap_qp.apps.service.safety import CommandedRobot
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands import Configuration
from handmap_qp.hands.robot import load_robot
from handmap_qp.hands.shape_pairs import all_pairs
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.robot_mapper import RobotMapper

HUMAN = load_hand("human", points="landmarks")
RIGHT = "right"
FORMULATIONS = ("compiled", "direct", "mink")


def samples(count: int) -> list[HumanSample]:
    """Return samples of a moving right hand."""
    return [
        HumanSample(k / 60.0, RIGHT, landmarks_at(RIGHT, k / 60.0))
        for k in range(count)
    ]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_every_sample_of_a_mapper_is_one_command(formulation: str) -> None:
    options = IkOptions().replaced(formulation=formulation)
    mapper = HandMapper(HUMAN, load_hand("three_finger"), "object", ik=options)
    gate = mapper.point_ik.gate
    for k, sample in enumerate(samples(5)):
        mapper.map_landmarks(sample.landmarks)
        assert gate.commands == k + 1
    mapper.hold(0.01)
    assert gate.commands == 6
    mapper.release()
    mapper.map_landmarks(samples(1)[0].landmarks)
    assert gate.commands == 7


def test_a_look_ahead_is_no_command() -> None:
    mapper = HandMapper(HUMAN, load_hand("allegro_right"))
    for k, sample in enumerate(samples(60)):
        mapper.map_landmarks(sample.landmarks)
        assert mapper.point_ik.gate.commands == k + 1


def test_followed_and_held_samples_are_one_command_each() -> None:
    mapper = HandMapper(HUMAN, load_hand("leap_right"))
    follower = Follower(mapper)
    taken = samples(60)
    lost = np.full((21, 3), np.nan)
    for k, sample in enumerate(taken):
        is_lost = 20 <= k < 30
        landmarks = lost if is_lost else sample.landmarks
        step = follower.map_sample(
            HumanSample(sample.time, RIGHT, landmarks, valid=not is_lost)
        )
        assert mapper.point_ik.gate.commands == k + 1
        assert step.is_held or not is_lost


def test_two_hands_are_moved_by_one_command(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    robot = load_robot(write_robot(tmp_path_factory.mktemp("robot")))
    mapper = RobotMapper(robot)
    for k in range(5):
        time = k / 60.0
        mapper.map_landmarks({side: landmarks_at(side, time) for side in robot.by_side})
        assert mapper.point_ik.gate.commands == k + 1
    mapper.map_landmarks({"left": landmarks_at("left", 0.1)})
    assert mapper.point_ik.gate.commands == 6


def test_a_slew_and_a_stop_pass_the_same_gate() -> None:
    robot = load_hand("allegro_right")
    mapper = HandMapper(HUMAN, robot)
    step = mapper.map_landmarks(samples(1)[0].landmarks)
    commanded = CommandedRobot(robot, robot.rest, np.eye(4))
    commanded.obey(mapper.point_ik)
    commanded.follow_command(mapper.point_ik.gate, step.command)
    assert commanded.moves_as(mapper.point_ik.gate)
    assert commanded.commands == 1
    commanded.move_to(robot.rest, None, 0.01)
    commanded.brake(0.01)
    assert commanded.commands == 3
    assert not commanded.moves_as(mapper.point_ik.gate)
    # The mapper's own gate has not moved.
    assert mapper.point_ik.gate.commands == 1


def free_gate(**options: float) -> Gate:
    """Return the gate of a hand with a floating wrist, at rest."""
    hand = load_hand("three_finger")
    start = hand.configuration_vector(hand.rest, np.eye(4))
    at_rest = Motion.at_rest(start, len(hand.active_columns))
    return Gate(hand, at_rest, IkOptions().replaced(**options))


@given(seed=st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_the_way_to_a_configuration_is_the_difference_on_its_manifold(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    gate = free_gate(has_velocity_limits=False)
    hand = gate.hand
    q = rng.uniform(hand.lower_limits, hand.upper_limits)
    turn = pin.exp6(np.append(rng.normal(size=3), rng.uniform(-1.5, 1.5, 3)))
    goal = hand.configuration_vector(q, turn.homogeneous)
    way = pin.difference(hand.model, gate.motion.q, goal)[hand.active_columns]
    assert gate.advance(goal, 0.01)
    np.testing.assert_allclose(gate.motion.displacement, way, atol=1e-9)
    np.testing.assert_array_equal(gate.motion.q, goal)


def test_what_a_gate_is_told_is_what_it_has() -> None:
    gate = free_gate()
    rng = np.random.default_rng(0)
    size = gate.limits.size
    told = Motion(
        gate.motion.q, rng.normal(size=size), 0.02, rng.uniform(size=size), 3.0
    )
    gate.motion = told
    for one, other in zip(gate.motion, told, strict=True):
        np.testing.assert_array_equal(one, other)
    assert gate.interval(Instant(3.5)).dt == 0.5
    before = gate.stamp
    gate.motion = told
    assert gate.stamp != before


@pytest.mark.parametrize(
    "call",
    [
        lambda gate, wrong: gate.admit(wrong, wrong, 0.01),
        lambda gate, wrong: gate.advance(wrong, 0.01),
        lambda gate, wrong: gate.core.set_motion(wrong, wrong, 0.01, wrong),
    ],
)
def test_arrays_of_another_robot_are_refused_and_move_nothing(
    call: Callable[[Gate, np.ndarray], object],
) -> None:
    gate = free_gate()
    before = gate.stamp
    with pytest.raises((ValueError, InvalidInputError), match="wrong size"):
        call(gate, np.zeros(3))
    assert gate.stamp == before


def test_a_gate_does_not_follow_that_of_another_robot() -> None:
    hand = load_hand("allegro_right")
    q = hand.configuration_vector(hand.rest)
    other = Gate(hand, Motion.at_rest(q, len(hand.active_columns)))
    gate = free_gate()
    with pytest.raises(ValueError, match="another robot"):
        gate.follow(other)


def test_a_slew_without_speed_limits_keeps_the_acceleration_limit() -> None:
    gate = free_gate(has_velocity_limits=False, max_acceleration=20.0)
    hand = gate.hand
    far = hand.configuration_vector(hand.upper_limits, np.eye(4))
    start = gate.motion.q.copy()
    assert not gate.advance(far, 0.01)
    moved = np.abs(gate.motion.q - start)[hand.q_indices]
    assert moved.max() <= 20.0 * 0.01**2 * (1.0 + 1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_slew_to_what_is_not_finite_brakes(bad: float) -> None:
    gate = free_gate(max_acceleration=20.0)
    hand = gate.hand
    goal = hand.configuration_vector(hand.upper_limits, np.eye(4))
    gate.advance(goal, 0.01)
    before = gate.motion
    assert not gate.advance(np.full_like(goal, bad), 0.01)
    assert np.isfinite(gate.motion.q).all()
    speeds = np.abs(gate.motion.velocity), np.abs(before.velocity)
    assert (speeds[0] <= speeds[1] + 1e-12).all()


def test_the_first_slew_ends_where_it_is_measured() -> None:
    """A posture of zeros is like that of kinematics which nobody has placed yet."""
    hand = load_hand("allegro_right", mount="fixed")
    zeros = np.clip(np.zeros(len(hand.rest)), hand.lower_limits, hand.upper_limits)
    start = np.clip(zeros + 0.02, hand.lower_limits, hand.upper_limits)
    at_rest = Motion.at_rest(hand.configuration_vector(start), len(hand.active_columns))
    collisions = CollisionLimit(hand, all_pairs(hand))
    gate = Gate(hand, at_rest, IkOptions(), collisions)
    assert gate.advance(hand.configuration_vector(zeros), 1.0)
    assert gate.held_by == -1


class Watcher:
    """A task that reads the motion while its rows are asked for."""

    def __init__(self, ik: PointIk) -> None:
        self.ik = ik
        self.seen: list[float] = []

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return no rows."""
        self.seen.append(self.ik.gate.motion.time)
        return TaskRows(np.zeros(0), np.zeros((0, hand.nv)))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_task_may_read_the_motion(formulation: str) -> None:
    hand = load_hand("three_finger")
    ik = PointIk(hand, IkOptions().replaced(formulation=formulation))
    watcher = Watcher(ik)
    points = ik.configuration.points.copy()
    for _ in range(2):
        ik.solve(points, None, 0.01, tasks=[watcher])
    assert {0.0, 0.01} == set(watcher.seen)


def test_rows_serve_one_command() -> None:
    hand = load_hand("three_finger")
    ik = PointIk(hand, IkOptions(avoids_self_collision=True))
    gate = ik.gate
    lower, upper = gate.bounds(0.01)
    rows = gate.rows(0.01, lower, upper)
    assert rows is not None
    gate.brake(0.01)
    with pytest.raises(ValueError, match="another command"):
        rows.behind(np.zeros_like(lower))


@pytest.mark.parametrize(
    "copied", [deepcopy, lambda gate: pickle.loads(pickle.dumps(gate))]
)
def test_a_copy_goes_on_by_itself(copied: Callable[[Gate], Gate]) -> None:
    gate = free_gate(max_acceleration=20.0)
    goal = gate.hand.configuration_vector(gate.hand.upper_limits, np.eye(4))
    gate.advance(goal, 0.01)
    other = copied(gate)
    for each in (gate, other):
        each.advance(goal, 0.01)
    for one, two in zip(gate.motion, other.motion, strict=True):
        np.testing.assert_array_equal(one, two)
    other.brake(0.01)
    assert gate.time < other.time
