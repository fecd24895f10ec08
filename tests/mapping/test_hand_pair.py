"""`HandPair`: the matched posture of the description, and the fingers of any hand."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from handmap_qp import HandMapper, InvalidInputError, load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.hand_pair import HandPair, hand_pair, resting_posture
from handmap_qp.transform import inverse_pose, transform_points

HUMAN = load_hand("human")


def with_matched(robot: Hand, q: np.ndarray) -> Hand:
    named = dict(zip(robot.joint_names, q.tolist(), strict=True))
    matched = {joint: named[joint] for joint in robot.spec.joints}
    return load_hand(msgspec.structs.replace(robot.spec, matched=matched))


@pytest.mark.parametrize("name", ["allegro_right", "g1_right", "ur5_allegro", "romeo_right"])
def test_the_matched_posture_of_the_description_is_used(name: str) -> None:
    robot = load_hand(name)
    solved = hand_pair(HUMAN, robot).matched
    given = robot.rest + 0.3 * (robot.upper_limits - robot.rest)
    arm = len(robot.joint_names) - len(robot.spec.joints)
    given[:arm] = robot.rest[:arm]
    own = with_matched(robot, given)
    pair = hand_pair(HUMAN, own)
    np.testing.assert_array_equal(pair.matched, given)
    np.testing.assert_allclose(pair.solve_matched(), solved, atol=1e-12)
    # Where the human rests, the robot's points are to be where they are in the given posture.
    step = HandMapper(HUMAN, own, "teleoperation").map_step(resting_posture(HUMAN), np.eye(4))
    palm = step.wrist_target @ pair.robot.wrist_to_palm
    expected = pair.robot.points(given)
    there = transform_points(inverse_pose(pair.robot.frame_pose("palm", given)), expected)
    targets = transform_points(inverse_pose(palm), step.targets)
    np.testing.assert_allclose(targets, there, atol=1e-9)


def test_an_argument_wins_over_the_description() -> None:
    robot = load_hand("three_finger")
    own = with_matched(robot, robot.rest)
    q = 0.5 * (robot.lower_limits + robot.upper_limits)
    np.testing.assert_array_equal(HandPair(HUMAN, own, q).matched, q)
    for bad in (q[1:], np.full(len(q), np.nan)):
        with pytest.raises(InvalidInputError) as caught:
            HandPair(HUMAN, own, bad)
        assert caught.value.argument == "matched"
