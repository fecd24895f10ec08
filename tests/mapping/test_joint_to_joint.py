"""Joint to joint: angles from landmarks, corresponding joints, and their targets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mapping_cases import little_pose
from marks import slow

from handmap_qp import (
    HandMapper,
    IkOptions,
    InvalidInputError,
    InvalidOptionsError,
    JointToJoint,
    load_hand,
)
from handmap_qp.hands import FINGERS
from handmap_qp.hands.fingers import PalmKinematics, find_fingers
from handmap_qp.mapping.methods.joint_to_joint import BoundJointToJoint, FingerAngles
from handmap_qp.se3 import inverse_pose, transform_points

HUMAN = load_hand("human")
LEFT = load_hand("human_left")
ALLEGRO = load_hand("allegro_right")
SETTLE = IkOptions(
    max_iterations=200,
    step_tolerance=1e-10,
    error_damping=0.0,
    rest_weight=0.0,
    has_velocity_limits=False,
)
FLEXES = np.array(["flexion" in name for name in HUMAN.joint_names])
FLEXES[:4] = False


def in_palm(hand: Any, q: np.ndarray) -> np.ndarray:
    return transform_points(inverse_pose(hand.frame_pose("palm", q)), hand.points(q))


def closing(share: float) -> np.ndarray:
    """Return the straight hand with four fingers flexed by a share of their range."""
    return np.where(FLEXES, share * HUMAN.upper_limits, HUMAN.rest)


@pytest.mark.parametrize("name", ["allegro_right", "allegro_left", "ur5_allegro"])
def test_spreading_fingers_move_sideways_as_the_humans_do(name: str) -> None:
    """At zero, the axes of Allegro's spread joints are at right angles to the human's."""
    robot = load_hand(name)
    human = LEFT if robot.side == "left" else HUMAN
    view, spread = PalmKinematics(robot), human.rest.copy()
    bound, fingers = (
        BoundJointToJoint(JointToJoint(), human, robot),
        find_fingers(robot),
    )
    spread[4::4] += 0.2
    ends = [
        bound.positions(bound.angles.measure(in_palm(human, q)))
        for q in (human.rest, spread)
    ]
    for link in bound.links:
        if link.human[0] and link.finger != "thumb":
            postures = np.tile(robot.rest, (2, 1))
            postures[:, link.column] = [q[link.column] for q in ends]
            before, after = view.points(postures, [fingers[link.finger].tip])[:, 0]
            tip = human.with_points((f"{link.finger}_tip",))
            wanted = in_palm(tip, spread) - in_palm(tip, human.rest)
            assert (after - before)[0] * wanted[0, 0] > 1e-6


# -- angles


@pytest.mark.parametrize("hand", [HUMAN, LEFT], ids=lambda hand: hand.name)
def test_landmarks_give_the_joint_angles_back(hand: Any) -> None:
    rng, angles = np.random.default_rng(0), FingerAngles(hand, FINGERS)
    low, high = hand.lower_limits.copy(), hand.upper_limits.copy()
    # From 90 degrees on, a thumb's or finger's metacarpal angles have two solutions.
    low[::4], high[::4] = np.maximum(low[::4], -1.0), np.minimum(high[::4], 1.0)
    for _ in range(50):
        q = low + rng.uniform(0.05, 0.95, len(low)) * (high - low)
        found = angles.measure(in_palm(hand, q)).ravel()
        flexions = np.arange(len(q)) % 4 > 0
        # Bones parallel to the axis of abduction hardly move by it.
        np.testing.assert_allclose(found[flexions], q[flexions], atol=0.05)
        np.testing.assert_allclose(np.median(np.abs(found - q)), 0.0, atol=1e-3)
    found = angles.measure(in_palm(hand, hand.rest)).ravel()
    np.testing.assert_allclose(found, hand.rest, atol=1e-3)


def test_a_thumb_turned_by_more_than_a_right_angle_is_not_taken_for_one_bent_backwards() -> (
    None
):
    angles = FingerAngles(HUMAN, FINGERS)
    q = HUMAN.rest.copy()
    q[:4] = 2.0, 0.5, 0.3, -0.2
    np.testing.assert_allclose(angles.measure(in_palm(HUMAN, q))[0], q[:4], atol=1e-2)


def test_angles_do_not_depend_on_the_size_of_the_hand() -> None:
    angles = FingerAngles(HUMAN, FINGERS)
    points = in_palm(HUMAN, HUMAN.rest)
    np.testing.assert_allclose(
        angles.measure(1.3 * points + [0.0, 0.01, 0.0]),
        angles.measure(points),
        atol=1e-3,
    )


def test_bones_out_of_the_fingers_plane_still_give_angles() -> None:
    rng, angles = np.random.default_rng(1), FingerAngles(HUMAN, FINGERS)
    points = in_palm(HUMAN, HUMAN.rest)
    noisy = angles.measure(points + rng.normal(scale=0.001, size=points.shape)).ravel()
    np.testing.assert_allclose(noisy, HUMAN.rest, atol=0.25)


# -- the mapping


def test_a_hand_onto_itself_takes_the_same_posture() -> None:
    rng = np.random.default_rng(2)
    mapper = HandMapper(HUMAN, HUMAN, JointToJoint(), ik=SETTLE)
    for _ in range(10):
        room = np.minimum(
            HUMAN.upper_limits - HUMAN.rest, HUMAN.rest - HUMAN.lower_limits
        )
        q = HUMAN.rest + rng.uniform(-0.5, 0.5, len(room)) * room
        step = mapper.map_step(q, little_pose(rng))
        # Each direction of a joint has its own range, which is the same on both hands.
        np.testing.assert_allclose(step.command.q, q, atol=0.01)
        np.testing.assert_allclose(step.targets, step.human_points, atol=1e-3)
        assert step.point_error.max() < 1e-5


def test_joints_go_to_the_same_share_of_their_range() -> None:
    mapper = HandMapper(HUMAN, ALLEGRO, JointToJoint(), ik=SETTLE)
    mapper.map_step(closing(0.0), np.eye(4))
    joints = [
        ALLEGRO.joint_names.index(f"joint_{k}.0") for k in (1, 2, 3, 5, 6, 7, 9, 10, 11)
    ]
    for share in (0.0, 0.3, 0.7, 1.0):
        step = mapper.map_step(closing(share), np.eye(4))
        wanted = share * ALLEGRO.upper_limits[joints]
        np.testing.assert_allclose(step.command.q[joints], wanted, atol=0.01)


@pytest.mark.parametrize(
    "name",
    ["allegro_right", "g1_left", "three_finger", "panda_gripper",
     *map(slow, ["allegro_left", "g1_right", "romeo_right", "hey5"])],
)  # fmt: skip
def test_a_fist_brings_every_fingertip_nearer_to_the_thumb_or_its_knuckle(
    name: str,
) -> None:
    robot = load_hand(name)
    human = LEFT if robot.side == "left" else HUMAN
    bound = BoundJointToJoint(JointToJoint(), human, robot)
    open_angles, fist = (
        np.zeros((len(bound.fingers), 4)),
        np.zeros((len(bound.fingers), 4)),
    )
    for i, columns in enumerate(bound.angles.columns):
        open_angles[i] = fist[i] = human.rest[columns]
        if bound.fingers[i] != "thumb":
            open_angles[i], fist[i] = 0.0, [0.0, *0.9 * human.upper_limits[columns[1:]]]
        else:
            fist[i, 2:] = [1.2, -1.2]
    before, after = (
        robot.points(bound.positions(angles)) for angles in (open_angles, fist)
    )
    nearer = np.linalg.norm(after - after[:1], axis=1)[1:]
    assert (nearer < np.linalg.norm(before - before[:1], axis=1)[1:]).all()


def test_a_pointing_finger_stays_straight_while_the_others_close() -> None:
    mapper = HandMapper(HUMAN, ALLEGRO, JointToJoint(), ik=SETTLE)
    q = closing(0.95)
    q[HUMAN.joint_names.index("index_MCP_flexion") :][:3] = 0.0
    mapper.map_step(HUMAN.rest, np.eye(4))
    step = mapper.map_step(q, np.eye(4))
    index = [ALLEGRO.joint_names.index(f"joint_{k}.0") for k in (1, 2, 3)]
    others = [ALLEGRO.joint_names.index(f"joint_{k}.0") for k in (5, 6, 7, 9, 10, 11)]
    assert np.abs(step.command.q[index]).max() < 0.02
    assert (step.command.q[others] > 0.9 * ALLEGRO.upper_limits[others]).all()


def test_a_pinch_does_not_come_across() -> None:
    # A limit of the method: the human's thumb and index finger touch, the robot's do not.
    q = HUMAN.rest.copy()
    names = HUMAN.joint_names
    pinching = {
        "thumb_TM_abduction": 0.0,
        "thumb_TM_flexion": 0.9,
        "index_MCP_flexion": 0.9,
    }
    for name, angle in pinching.items():
        q[names.index(name)] = angle
    mapper = HandMapper(HUMAN, ALLEGRO, JointToJoint(), ik=SETTLE)
    mapper.map_step(HUMAN.rest, np.eye(4))
    step = mapper.map_step(q, np.eye(4))
    points = {point.name: k for k, point in enumerate(HUMAN.reference_points)}
    pair = [points["thumb_tip"], points["index_tip"]]
    human_gap = np.linalg.norm(np.subtract(*step.human_points[pair]))
    assert np.linalg.norm(step.points[0] - step.points[1]) > 1.5 * human_gap


@pytest.mark.slow
def test_fewer_flexions_take_the_rest_together_and_more_share_them() -> None:
    def led(robot: str, finger: str) -> list[list[int]]:
        bound = BoundJointToJoint(JointToJoint(), HUMAN, load_hand(robot))
        return [
            np.flatnonzero(x.human).tolist() for x in bound.links if x.finger == finger
        ]

    assert led("allegro_right", "index") == [[0], [1], [2], [3]]
    assert led("allegro_right", "thumb") == [[0], [1], [2], [3]]
    assert led("g1_right", "index") == [[1], [2, 3]]
    assert led("romeo_right", "index") == [[1, 2, 3]]
    assert led("three_finger", "thumb") == [[1], [2, 3]]
    assert led("hey5", "index") == [[0], [1], [1], [2], [2], [3], [3]]


def test_joints_are_independent_of_the_hands_place_in_the_world() -> None:
    rng = np.random.default_rng(4)
    here, there = (HandMapper(HUMAN, ALLEGRO, JointToJoint()) for _ in range(2))
    moved = little_pose(rng, 2.0)
    for share in (0.1, 0.4, 0.8):
        expected, found = (
            m.map_step(closing(share), w)
            for m, w in ((here, np.eye(4)), (there, moved))
        )
        np.testing.assert_allclose(found.command.q, expected.command.q, atol=1e-6)
        np.testing.assert_allclose(
            found.targets, transform_points(moved, expected.targets), atol=1e-9
        )


def test_the_arm_of_a_hand_follows_the_wrist() -> None:
    robot = load_hand("ur5_allegro")
    mapper = HandMapper(HUMAN, robot, JointToJoint(), ik=SETTLE)
    mapper.map_step(HUMAN.rest, np.eye(4))
    shift = np.eye(4)
    shift[:3, 3] = 0.0, 0.02, 0.01
    first = mapper.map_step(HUMAN.rest, np.eye(4))
    step = mapper.map_step(HUMAN.rest, shift)
    moved = step.command.wrist[:3, 3] - first.command.wrist[:3, 3]
    np.testing.assert_allclose(moved, shift[:3, 3], atol=1e-3)
    fingers = [name in ALLEGRO.joint_names for name in robot.joint_names]
    np.testing.assert_allclose(
        step.command.q[fingers], first.command.q[fingers], atol=1e-2
    )


def test_joint_to_joint_names_its_missing_requirement() -> None:
    with pytest.raises(InvalidInputError) as unmeasured:
        HandMapper(HUMAN, ALLEGRO, JointToJoint()).map_points(HUMAN.points(HUMAN.rest))
    assert unmeasured.value.argument == "wrist_pose"
    with pytest.raises(InvalidOptionsError, match="index_mcp") as missing:
        HandMapper(HUMAN.with_points("fingertips"), ALLEGRO, JointToJoint())
    assert missing.value.option == "human_points"
    with pytest.raises(InvalidOptionsError, match="other joints") as other:
        HandMapper(ALLEGRO, ALLEGRO, JointToJoint())
    assert other.value.option == "human"


def test_a_joint_that_fingers_share_takes_the_mean_of_what_they_ask() -> None:
    bound = BoundJointToJoint(JointToJoint(), HUMAN, ALLEGRO)
    angles = np.tile([0.0, 0.3, 0.2, 0.1], (len(bound.fingers), 1))
    angles *= 1.0 + np.arange(len(bound.fingers))[:, None]
    led = bound.links
    asked = [
        link.position(angles[bound.fingers.index(link.finger)]) for link in led[:3]
    ]
    bound.links = [link._replace(column=0) for link in led[:3]]
    assert bound.positions(angles)[0] == pytest.approx(np.mean(asked), abs=1e-12)
    assert max(asked) > min(asked) + 0.01
