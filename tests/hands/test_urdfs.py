"""The hands that come with the package.

Published kinematics, limits, shapes, and hand.yaml files that fit their URDFs.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yourdfpy

from handmap_qp.errors import MissingExtraError
from handmap_qp.hands import FINGERS
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HUMAN_JOINTS
from handmap_qp.hands.sources import urdf_directory
from handmap_qp.hands.spec import HandSpec, read_hand_spec

LoadData = Callable[[str], dict[str, Any]]
OWN_HANDS = ("human", "human_left", "three_finger")
ALL_HANDS = (*OWN_HANDS, "allegro_right", "allegro_left")
# The toolbox's frames of these fingers are left-handed; ours have the z axis reversed.
LEFT_HANDED = ("finger2", "finger3")


def load(name: str, **options: Any) -> Hand:
    try:
        return Hand(
            read_hand_spec(urdf_directory() / name / "hand.yaml"),
            mount="fixed",
            **options,
        )
    except MissingExtraError:
        pytest.skip("example-robot-data is not installed")


def spec_of(name: str) -> HandSpec:
    return read_hand_spec(urdf_directory() / name / "hand.yaml")


def in_palm(hand: Hand, points: np.ndarray) -> np.ndarray:
    palm = hand.frame_pose("palm", hand.rest)
    return (points - palm[:3, 3]) @ palm[:3, :3]


@pytest.mark.parametrize("name", ["human", "three_finger"])
def test_fk_is_the_published_one(name: str, load_data: LoadData) -> None:
    reference = load_data("fk_reference")[name]
    hand = load(name)
    joints = list(hand.joint_names)
    assert joints == reference["joint_names"]
    for posture in reference["postures"]:
        q, first = posture["q"], 0
        for finger, tip in zip(
            posture["joint_origins"], posture["fingertips"], strict=True
        ):
            *origins, end = posture["joint_origins"][finger]
            for name_of_joint, origin in zip(joints[first:], origins, strict=False):
                np.testing.assert_allclose(
                    hand.frame_pose(name_of_joint, q)[:3, 3], origin, atol=1e-9
                )
            first += len(origins)
            frame = np.array(posture["fingertip_frames"][finger])
            frame[:, 2] *= -1.0 if finger in LEFT_HANDED else 1.0
            np.testing.assert_allclose(
                hand.frame_pose(f"{finger}_tip", q)[:3], frame, atol=1e-9
            )
            np.testing.assert_allclose(end, tip, atol=1e-12)
            np.testing.assert_allclose(
                hand.frame_pose(f"{finger}_tip", q)[:3, 3], tip, atol=1e-9
            )


@pytest.mark.parametrize(
    ("name", "grasp"), [("human", "human"), ("three_finger", "robot")]
)
def test_contacts_are_those_of_the_cube_grasp(
    name: str, grasp: str, load_data: LoadData
) -> None:
    reference = load_data("fk_reference")["cube_grasp"][grasp]
    hand = load(name, points="contacts")
    palm = np.array(reference["palm"])
    # The planner places the robot's fingers farther out than the hand.
    local = hand.points(reference["q"]) + np.array(reference["base_shifts"])
    points = local @ palm[:, :3].T + palm[:, 3]
    np.testing.assert_allclose(points, reference["contacts"], atol=1e-9)
    assert (hand.lower_limits <= reference["q"]).all()
    assert (reference["q"] <= hand.upper_limits).all()


@pytest.mark.parametrize("points", ["landmarks", "contacts", "fingertips_middle"])
def test_left_human_is_the_right_one_mirrored(points: str) -> None:
    right, left = load("human", points=points), load("human_left", points=points)
    for q in (right.rest, np.zeros(20), np.linspace(-0.5, 0.9, 20)):
        np.testing.assert_allclose(
            left.points(q), right.points(q) * [-1.0, 1.0, 1.0], atol=1e-12
        )
    np.testing.assert_array_equal(left.rest, right.rest)
    np.testing.assert_array_equal(left.upper_limits, right.upper_limits)


def test_landmarks_are_mediapipes() -> None:
    names = spec_of("human").sets["landmarks"]
    assert len(names) == 21
    assert names[0] == "wrist"
    assert names[1:6] == (
        "thumb_cmc",
        "thumb_mcp",
        "thumb_ip",
        "thumb_tip",
        "index_mcp",
    )
    assert spec_of("human").sets["joints"] == names[1:]
    assert spec_of("human").joints == HUMAN_JOINTS


@pytest.mark.parametrize("name", ALL_HANDS)
def test_rest_is_strictly_inside_limits(name: str) -> None:
    hand = load(name)
    assert (hand.lower_limits < hand.rest).all()
    assert (hand.rest < hand.upper_limits).all()


@pytest.mark.parametrize("name", ALL_HANDS)
def test_palm_frame_is_anatomical(name: str) -> None:
    hand = load(name).with_points("fingertips")
    straight = np.clip(np.zeros(len(hand.rest)), hand.lower_limits, hand.upper_limits)
    where = {
        point.finger: tip
        for point, tip in zip(
            hand.reference_points, in_palm(hand, hand.points(straight)), strict=True
        )
    }
    bent = {
        point.finger: tip
        for point, tip in zip(
            hand.reference_points, in_palm(hand, hand.points(hand.rest)), strict=True
        )
    }
    radial = -1.0 if hand.side == "right" else 1.0
    assert len(where) == len(hand.reference_points)
    for finger in set(where) - {"thumb"}:
        assert where[finger][1] > 0.0, "fingers point distally"
        assert bent[finger][2] < where[finger][2] - 0.01, "fingers flex palmar"
    # From the thumb's side towards the little finger.
    across = [radial * where[finger][0] for finger in FINGERS[1:] if finger in where]
    assert across == sorted(across, reverse=True)
    if name != "three_finger":
        assert radial * where["thumb"][0] > across[0]


def test_left_allegro_is_the_right_one_mirrored() -> None:
    right, left = (
        load("allegro_right", points="fingertips_middle"),
        load("allegro_left", points="fingertips_middle"),
    )
    mirrored = in_palm(right, right.points(right.rest)) * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(
        in_palm(left, left.points(left.rest)), mirrored, atol=1e-6
    )


def test_allegro_fingers_spread_at_rest() -> None:
    hand = load("allegro_right")
    spread = {
        p.finger: x
        for p, x in zip(
            hand.reference_points,
            in_palm(hand, hand.points(hand.rest))[:, 0],
            strict=True,
        )
    }
    middle = load("allegro_right", points=("index_pip", "ring_pip"))
    index_pip, ring_pip = in_palm(middle, middle.points(middle.rest))[:, 0]
    assert spread["index"] < index_pip
    assert spread["ring"] > ring_pip


def collision_geometry(hand: Hand) -> pin.GeometryModel:
    return pin.buildGeomFromUrdfString(
        hand.model, hand.urdf_text, pin.GeometryType.COLLISION
    )


@pytest.mark.parametrize("name", OWN_HANDS)
def test_bones_are_capsules(name: str) -> None:
    shapes = {
        item.name: type(item.geometry).__name__
        for item in collision_geometry(load(name)).geometryObjects
    }
    assert len(shapes) == (7 if name == "three_finger" else 16)
    for shape_name, shape in shapes.items():
        palm = "Cylinder" if name == "three_finger" else "Box"
        assert shape == (palm if shape_name == "palm_0" else "Capsule"), shape_name


def neighbours(name: str) -> set[frozenset[str]]:
    """Return links connected by a joint; the link between two axes of one joint has no shape."""
    if name == "three_finger":
        chains = [
            ("palm", f"finger{i}_proximal", f"finger{i}_distal") for i in (1, 2, 3)
        ]
    else:
        chains = [
            ("palm", *(f"{f}_{bone}" for bone in ("proximal", "middle", "distal")))
            for f in FINGERS[1:]
        ]
        chains.append(("palm", "thumb_metacarpal", "thumb_proximal", "thumb_distal"))
    return {frozenset(pair) for chain in chains for pair in itertools.pairwise(chain)}


@pytest.mark.parametrize("posture", ["zero", "rest"])
@pytest.mark.parametrize("name", OWN_HANDS)
def test_only_neighbours_touch(name: str, posture: str) -> None:
    hand = load(name)
    geometry = collision_geometry(hand)
    geometry.addAllCollisionPairs()
    meeting = neighbours(name)
    q = hand.configuration_vector(
        hand.rest if posture == "rest" else np.zeros(len(hand.rest))
    )
    data, shapes = hand.model.createData(), geometry.createData()
    pin.computeDistances(hand.model, data, geometry, shapes, q)
    for pair, result in zip(
        geometry.collisionPairs, shapes.distanceResults, strict=True
    ):
        links = [
            geometry.geometryObjects[i].name.removesuffix("_0")
            for i in (pair.first, pair.second)
        ]
        if frozenset(links) not in meeting:
            assert result.min_distance > 0.0, links


@pytest.mark.parametrize("name", ["human", "three_finger"])
def test_yourdfpy_reads_it(name: str) -> None:
    robot = yourdfpy.URDF.load(str(urdf_directory() / name / "hand.urdf"))
    assert robot.validate()
    assert robot.base_link == "palm"
    assert len(robot.actuated_joint_names) == len(spec_of(name).joints)
