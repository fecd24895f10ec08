"""`HandPair`: the matched posture of the description, and the fingers of any hand."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from marks import slow

from handmap_qp import HandMapper, InvalidOptionsError, load_hand
from handmap_qp.hands import FINGERS
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.mapping.hand_pair import (
    bone_lengths,
    hand_pair,
    match_palms,
    require_partners,
    resting_posture,
    robot_fingers,
)
from handmap_qp.mapping.presets import default_preset
from handmap_qp.se3 import inverse_pose, transform_points

HUMAN = load_hand("human")
HUMAN_TIPS = [point.name for point in HUMAN.reference_points]


def with_matched(robot: Hand, q: np.ndarray) -> Hand:
    named = dict(zip(robot.joint_names, q.tolist(), strict=True))
    matched = {joint: named[joint] for joint in robot.spec.joints}
    return load_hand(msgspec.structs.replace(robot.spec, neutral_match=matched))


@pytest.mark.parametrize(
    "name", ["allegro_right", *map(slow, ["g1_right", "ur5_allegro", "romeo_right"])]
)
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
    step = HandMapper(HUMAN, own, "teleoperation").map_step(
        resting_posture(HUMAN), np.eye(4)
    )
    palm = step.wrist_target @ pair.robot.wrist_to_palm
    expected = pair.robot.points(given)
    there = transform_points(
        inverse_pose(pair.robot.frame_pose("palm", given)), expected
    )
    targets = transform_points(inverse_pose(palm), step.targets)
    np.testing.assert_allclose(targets, there, atol=1e-9)


def test_jaws_open_and_close_with_thumb_and_index() -> None:
    gripper = load_hand("panda_gripper")
    pair = hand_pair(HUMAN, gripper)
    assert pair.has_jaws
    assert not hand_pair(HUMAN, load_hand("romeo_right")).has_jaws
    mapper = HandMapper(HUMAN, gripper)
    thumb, index = (HUMAN_TIPS.index(f"{finger}_tip") for finger in ("thumb", "index"))
    rest = HUMAN.points(resting_posture(HUMAN))
    openings = []
    for wanted in (0.02, 0.05, 0.07):
        # Move the thumb along the line to the index finger, so that the gap is as wanted.
        points = rest.copy()
        apart = points[thumb] - points[index]
        points[thumb] = points[index] + wanted * apart / np.linalg.norm(apart)
        step = [mapper.map_points(points, np.eye(4)) for _ in range(100)][-1]
        openings.append(2.0 * step.command.q[0])
        np.testing.assert_allclose(step.command.wrist, step.wrist_target, atol=1e-3)
    # An object is as large for the gripper as for the fingers, but for where pads touch.
    np.testing.assert_allclose(np.diff(openings), [0.03, 0.02], atol=0.003)
    assert openings[0] < 0.02
    # The resting human's jaws are neither shut nor wide open.
    assert 0.005 < pair.matched[0] < 0.035


def test_the_last_point_of_a_finger_has_the_tip_for_its_partner() -> None:
    robot = load_hand("three_finger")
    plain = tuple(
        msgspec.structs.replace(point, partner=None)
        for point in robot.spec.points
        if not point.name.startswith("contact")
    )
    sets = {"all": tuple(point.name for point in plain)}
    bare = load_hand(
        msgspec.structs.replace(robot.spec, points=plain, sets=sets, reference="all")
    )
    pairs = require_partners(HUMAN, bare, option="method")
    named = {
        bare.reference_points[j].name: HUMAN.reference_points[i].name for j, i in pairs
    }
    assert named == {
        "finger1_tip": "thumb_tip",
        "finger2_tip": "middle_tip",
        "finger3_tip": "index_tip",
    }
    # Given names win; a point with a landmark's name keeps it, whatever its finger.
    given = msgspec.structs.replace(plain[0], partner="ring_tip")
    index = msgspec.structs.replace(plain[2], name="index_pip")
    own = load_hand(
        msgspec.structs.replace(
            robot.spec,
            points=(given, index),
            sets={"all": (given.name, index.name)},
            reference="all",
        )
    )
    assert [
        HUMAN.reference_points[i].name
        for _, i in require_partners(HUMAN, own, option="method")
    ] == [
        "ring_tip",
        "index_pip",
    ]


def test_points_without_a_finger_have_no_partner_and_need_the_preset_object() -> None:
    robot = load_hand("three_finger")
    points = tuple(
        msgspec.structs.replace(p, partner=None, finger=None) for p in robot.spec.points
    )
    nameless = load_hand(msgspec.structs.replace(robot.spec, points=points))
    with pytest.raises(InvalidOptionsError, match="needs partner points"):
        require_partners(HUMAN, nameless, option="method")
    assert default_preset(HUMAN, nameless) == "object"
    step = HandMapper(HUMAN, nameless).map_step(HUMAN.rest, np.eye(4))
    assert np.isfinite(step.command.q).all()


@pytest.mark.parametrize(("name", "length"), [("human", 0.15), ("human_left", 0.21)])
def test_bones_of_a_person_are_those_of_its_lengths(name: str, length: float) -> None:
    person = HumanLengths.from_hand_length(length)
    human = load_hand(name, lengths=person)
    # In any order, and one finger more than once.
    bones = bone_lengths(human, ["ring", "thumb", "ring"])
    np.testing.assert_allclose(
        bones, person.segments.sum(axis=1)[[3, 0, 3]], rtol=1e-12
    )


@pytest.mark.parametrize(
    ("apart", "likeness"), [(0.09, 1.0), (0.15, 0.75), (0.25, 0.25), (0.31, 0.0)]
)
def test_palms_are_the_less_alike_the_more_reaches_differ(
    apart: float, likeness: float
) -> None:
    """One finger's reach differs from the palm's scale, by a logarithm of 0.1 to 0.3."""
    human = load_hand("human", points="landmarks")
    bases = robot_fingers(human).bases
    ratios = np.array([1.0, np.exp(apart), 1.0, 1.0, 1.0])
    match = match_palms(bases, bases, FINGERS, ratios)
    assert match.likeness == pytest.approx(likeness)
