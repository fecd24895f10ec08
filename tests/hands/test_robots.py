"""Robots with two hands: what both share moves both palms, and all else moves one."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from handmap_qp import Hand, HandError, load_hand
from handmap_qp.hands.library import why_missing
from handmap_qp.hands.robot import (
    load_robot,
    read_hands,
    read_robot_spec,
    robot_files,
)
from handmap_qp.hands.shape_pairs import random_postures

INSTALLED = [
    name
    for name, file in robot_files().items()
    if not any(map(why_missing, read_hands(read_robot_spec(file)).values()))
]
SHARED = {
    "alex": {"SpineYaw", "SpineRoll", "SpinePitch"},
    "g1": {"waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint"},
    "panda_pair": set[str](),
    "romeo": {"TrunkYaw"},
    "tiago_dual": {"torso_lift_joint"},
    "ur5_pair": set[str](),
}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=INSTALLED)
def robot(request: pytest.FixtureRequest) -> Hand:
    return load_robot(request.param)


def palms(robot: Hand, q: np.ndarray) -> np.ndarray:
    return np.array([hand.frame_pose("palm", q) for hand in robot.by_side.values()])


def test_the_robots_of_the_package_are_these() -> None:
    assert set(robot_files()) == set(SHARED)


def test_both_hands_have_all_joints(robot: Hand) -> None:
    left, right = robot.by_side["left"], robot.by_side["right"]
    assert left.joint_names == right.joint_names
    np.testing.assert_array_equal(left.rest, right.rest)
    assert (left.side, right.side) == ("left", "right")


def test_a_shared_joint_moves_both_palms_and_another_one_at_most(robot: Hand) -> None:
    hand = robot.by_side["left"]
    before = palms(robot, hand.rest)
    middle = 0.5 * (hand.lower_limits + hand.upper_limits)
    step = np.where(hand.rest < middle, 0.05, -0.05)
    moved = {}
    for i, joint in enumerate(hand.joint_names):
        q = hand.rest.copy()
        q[i] += step[i]
        is_moved = np.abs(palms(robot, q) - before).max(axis=(1, 2)) > 1e-9
        moved[joint] = is_moved.tolist()
    assert {joint for joint, ends in moved.items() if all(ends)} == SHARED[robot.name]
    for side, own in zip(robot.by_side, np.array([*moved.values()]).T, strict=True):
        np.testing.assert_array_equal(own, robot.by_side[side].moves_wrist)


def test_palms_are_where_each_hand_alone_has_them(robot: Hand) -> None:
    spec = read_robot_spec(robot_files()[robot.name])
    for side, hand in robot.by_side.items():
        alone = load_hand(read_hands(spec)[side])
        prefix = "" if alone.joint_names[-1] in hand.joint_names else f"{side}_"
        columns = [hand.joint_names.index(f"{prefix}{j}") for j in alone.joint_names]
        place = np.array(spec.hands[side].xyz)
        for q in random_postures(hand, 5):
            pose = hand.frame_pose("palm", q)
            pose[:3, 3] -= place
            other = alone.frame_pose("palm", q[columns])
            np.testing.assert_allclose(pose, other, atol=1e-9)


def test_joints_that_follow_others_do_so_on_the_robot(robot: Hand) -> None:
    followers = 0
    for spec in read_hands(read_robot_spec(robot_files()[robot.name])).values():
        alone = load_hand(spec)
        followers += alone.all_joint_roles.count("follower")
    assert robot.all_joint_roles.count("follower") == followers


G1 = """name: two
hands:
  left: {hand: dex3_left}
  right: {hand: dex3_right}
"""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("dex3_left", "dex3_right"), "hands.left: dex3_right is a right hand"),
        (("name: two", "name: two\nlegs: 2"), "legs"),
        (("dex3_left", "absent.yaml"), "absent.yaml: cannot be read"),
        (("dex3_left", "dex3_lef"), "no hand 'dex3_lef': did you mean dex3_left"),
        (("right:", "middle:"), "middle"),
        (("hands:", "hand:"), "hand"),
        ((G1, "{"), "YAML"),
    ],
)
def test_a_description_that_cannot_be_used_gets_one_clear_line(
    change: tuple[str, str], message: str, tmp_path: Path
) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(G1.replace(*change), encoding="utf-8")
    with pytest.raises(HandError, match=re.escape(message)) as caught:
        load_robot(file)
    assert str(file.parent) in str(caught.value) or "no hand" in message
    assert "\n" not in str(caught.value)


def test_a_robot_that_there_is_not_is_answered_with_the_nearest_one() -> None:
    with pytest.raises(HandError, match=r"no robot 'rome': did you mean romeo\?"):
        load_robot("rome")


@pytest.mark.parametrize("given", ["g1", robot_files()["g1"]])
def test_a_robot_in_place_of_a_hand_is_answered_with_what_takes_it(
    given: str | Path,
) -> None:
    with pytest.raises(
        HandError, match=r"g1 is a robot with hands, .*`handmap robots`"
    ):
        load_hand(given)


def test_arms_of_one_urdf_begin_at_the_same_link(tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    right = robot_files()["g1"].with_name("right.yaml")
    text = G1.replace("dex3_left", "g1_arm_left").replace("dex3_right", str(right))
    file.write_text(text, encoding="utf-8")
    with pytest.raises(HandError, match=r"hands: .* different links .* torso_link"):
        load_robot(file)
