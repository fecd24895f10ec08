"""Grips of jaws, and of both hands of a robot."""

from __future__ import annotations

import copy
from functools import cache
from typing import Any

import numpy as np
import pytest
from grip_cases import (
    WIDTH,
    Blocked,
    BlockedHands,
    both_hands,
    gap_of,
    grip_follower,
    run,
    samples,
)

from handmap_core.human.sample import HumanSample
from handmap_core.mapping.robot_step import RobotStep
from handmap_core.stream.hand_grip import GripOptions
from handmap_qp import load_hand
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.robot import load_robot
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.stream.grip import RobotGripFollower
from handmap_qp.stream.robot_follower import RobotFollower


@pytest.mark.parametrize("name", ["panda_gripper", "robotiq_2f85"])
def test_jaws_press_with_the_force_and_let_go_with_the_person(name: str) -> None:
    jaws = load_hand(name)
    grip = grip_follower(jaws, force=4.0)
    ran = [(step.command, q) for step, q in run(grip, opens=True)]
    pressing = [(c.effort, q) for c, q in ran if c.effort is not None]
    assert pressing
    assert ran[0][0].effort is None
    assert ran[-1][0].effort is None
    # One joint moves both jaws: its torque is the force times how fast the gap closes.
    effort, q = pressing[len(pressing) // 2]
    slope = (gap_of(jaws, q + 1e-6) - gap_of(jaws, q - 1e-6)) / 2e-6
    np.testing.assert_allclose(effort, [-4.0 * slope], rtol=0.01)


def test_jaws_press_by_the_stiffness_of_their_slide() -> None:
    jaws = load_hand("panda_gripper")
    grip = grip_follower(jaws, force=4.0, sliding_stiffness=1000.0)
    *_, (step, measured) = run(grip)
    effort = step.command.effort
    assert effort is not None
    pressed = 1000.0 * (step.command.q - measured)
    np.testing.assert_allclose(pressed, effort, rtol=0.1)


def test_jaws_around_nothing_grip_nothing() -> None:
    grip = grip_follower(load_hand("panda_gripper"))
    for step, _ in run(grip, width=-1.0, opens=True):
        assert step.command.effort is None


# Those that no test changes.
robot_of = cache(load_robot)


def robot_grip(**options: Any) -> RobotGripFollower:
    mapper = RobotMapper(robot_of("ur5_pair"))
    return RobotGripFollower(RobotFollower(mapper), GripOptions(**options))


def gripped(
    grip: RobotGripFollower, widths: dict[str, float], opens: bool = False
) -> list[RobotStep]:
    robot = grip.follower.mapper.robot
    plant = BlockedHands(robot, widths)
    steps = []
    for hands in both_hands(opens):
        steps.append(grip.map_samples(hands, plant.q))
        plant.follow(steps[-1].command.q)
    return steps


@pytest.mark.slow
def test_each_hand_of_a_robot_grips_for_itself() -> None:
    grip = robot_grip(force=3.0)
    steps = gripped(grip, {"left": WIDTH, "right": -1.0}, opens=True)
    robot = grip.follower.mapper.robot
    left, right = (
        robot.finger_joints[[*robot.by_side].index(s)] for s in ("left", "right")
    )
    efforts = [step.command.effort for step in steps]
    found = [effort for effort in efforts if effort is not None]
    assert found
    for effort in found:
        assert (effort[~left] == 0.0).all()
        assert np.abs(effort[left]).max() > 0.01
    assert (right & left).sum() == 0
    assert efforts[-1] is None
    # The limits of the robot hold, and no mapper keeps the terms of a grip.
    q = np.array([step.command.q for step in steps])
    most = robot.velocity_limits + 1e-9
    assert (np.abs(np.diff(q, axis=0)) * 60.0 <= most).all()
    assert all(not source.tasks for source in grip.follower.mapper.sources.values())


@pytest.mark.slow
def test_both_hands_of_a_robot_grip_at_once() -> None:
    grip = robot_grip(force=3.0)
    steps = gripped(grip, {"left": WIDTH, "right": WIDTH})
    robot = grip.follower.mapper.robot
    effort = steps[-1].command.effort
    assert effort is not None
    for own in robot.finger_joints:
        assert np.abs(effort[own]).max() > 0.01
    # Both are told another force at once.
    grip.grip = GripOptions(force=1.5)
    again = copy.deepcopy(grip)
    last = both_hands()[-1]
    later = {s: HumanSample(2.0, x.side, x.landmarks) for s, x in last.items()}
    halved = again.map_samples(later, None).command.effort
    assert halved is not None
    np.testing.assert_allclose(halved, effort / 2.0, rtol=0.02, atol=1e-6)


@pytest.mark.slow
def test_a_robot_that_meets_nothing_follows_as_without_a_grip() -> None:
    grip = robot_grip()
    plain = RobotFollower(RobotMapper(robot_of("ur5_pair")))
    robot = plain.mapper.robot
    plant = BlockedHands(robot, {"left": -1.0, "right": -1.0})
    for hands in both_hands():
        step = grip.map_samples(hands, plant.q)
        plant.follow(step.command.q)
        assert step.command.effort is None
        other = plain.map_samples(hands)
        np.testing.assert_array_equal(step.command.q, other.command.q)
    with pytest.raises(InvalidInputError, match="measured_q"):
        grip.map_samples({}, plant.q[1:])


def test_what_is_held_stays_where_encoders_are_not_read() -> None:
    hand = load_hand("allegro_right")
    grip = grip_follower(hand)
    plant = Blocked(hand)
    *before, last = samples()
    for sample in before:
        plant.follow(grip.map_sample(sample, plant.q).command.q)
    effort = grip.map_sample(last, None).command.effort
    assert effort is not None
    assert np.abs(effort).max() > 0.1
    # Nothing is met without them.
    blind = grip_follower(hand)
    for sample in samples():
        assert blind.map_sample(sample, None).command.effort is None
