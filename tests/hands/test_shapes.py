"""Fingers, pads and shape pairs of any hand, found on its model."""

from __future__ import annotations

import copy
import pickle
from functools import cache
from itertools import product

import coal
import numpy as np
import pinocchio as pin
import pytest
from ik_cases import two_joint_hand
from scipy.spatial import ConvexHull

from handmap_qp import HandSpec, PointSpec, hand_names, load_hand
from handmap_qp.hands import moved_by
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.fingers import (
    THUMB,
    PalmKinematics,
    find_fingers,
    finger_tips,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import hand_files
from handmap_qp.hands.pads import find_pads
from handmap_qp.hands.shape_pairs import all_pairs, distal_shapes, named_pairs
from handmap_qp.hands.spec import PalmSpec, WristSpec

# How exact pads are on meshes of other packages is not known.
OWN = [name for name in hand_names() if hand_files()[name].name == "hand.yaml"]
HANDS = [name for name in OWN if not name.endswith("_left")]


@cache
def hand(name: str) -> Hand:
    return load_hand(name)


@pytest.mark.parametrize("name", HANDS)
def test_reach_bounds_every_posture(name: str) -> None:
    robot, rng = hand(name), np.random.default_rng(0)
    data = robot.model.createData()
    for chain in find_fingers(robot).values():
        if not chain.joints:
            continue
        longest = 0.0
        for q in rng.uniform(
            robot.lower_limits, robot.upper_limits, size=(60, len(robot.rest))
        ):
            pin.forwardKinematics(robot.model, data, robot.configuration_vector(q))
            ends = [
                data.oMi[joint].act(offset)
                for joint, offset in (chain.knuckle, chain.tip)
            ]
            longest = max(longest, float(np.linalg.norm(ends[1] - ends[0])))
        assert longest <= chain.reach + 1e-4
        pin.forwardKinematics(
            robot.model, data, robot.configuration_vector(chain.stretched)
        )
        ends = [
            data.oMi[joint].act(offset) for joint, offset in (chain.knuckle, chain.tip)
        ]
        assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(chain.reach, abs=1e-9)


def test_the_reach_of_a_finger_that_is_bent_at_zero_is_the_length_of_its_links() -> (
    None
):
    lengths, bends = (0.04, 0.03, 0.02), (0.2, 0.7, -0.5)
    parts = ['<robot name="bent"><link name="palm"/>']
    for i, (bend, before) in enumerate(zip(bends, (0.05, *lengths[:2]), strict=True)):
        parts.append(
            f'<link name="l{i}"/><joint name="j{i}" type="revolute">'
            f'<parent link="{f"l{i - 1}" if i else "palm"}"/><child link="l{i}"/>'
            f'<origin xyz="0 {before} 0" rpy="{bend} 0 0"/><axis xyz="1 0 0"/>'
            '<limit lower="-1" upper="1" velocity="8" effort="1"/></joint>'
        )
    spec = HandSpec(
        name="bent",
        urdf="",
        side="right",
        palm=PalmSpec("palm", distal=(0.0, 1.0, 0.0), dorsal=(0.0, 0.0, 1.0)),
        wrist=WristSpec("palm"),
        joints=("j0", "j1", "j2"),
        rest={"j0": 0.0, "j1": 0.0, "j2": 0.0},
        points=(PointSpec("index_tip", "l2", (0.0, lengths[2], 0.0), finger="index"),),
        sets={"tips": ("index_tip",)},
        reference="tips",
    )
    chain = find_fingers(Hand(spec, urdf_text="".join([*parts, "</robot>"])))["index"]
    assert chain.reach == pytest.approx(sum(lengths), abs=1e-6)
    # Straight where the joints turn back what the URDF bends; the first one only turns the finger.
    np.testing.assert_allclose(chain.stretched[1:], -np.array(bends[1:]), atol=2e-3)


@pytest.mark.parametrize(
    ("name", "tips"),
    [
        (
            "human",
            {
                finger: f"{finger}_tip"
                for finger in ("thumb", "index", "middle", "ring", "little")
            },
        ),
        (
            "three_finger",
            {"thumb": "finger1_tip", "middle": "finger2_tip", "index": "finger3_tip"},
        ),
        (
            "allegro_right",
            {
                finger: f"{finger}_tip"
                for finger in ("thumb", "index", "middle", "ring")
            },
        ),
    ],
)
@pytest.mark.parametrize("points", [None, "fingertips_middle"])
def test_tips_are_found_whatever_points_are_in_use(
    name: str, tips: dict[str, str], points: str | None
) -> None:
    found = finger_tips(load_hand(name, points=points))
    assert {finger: point.name for finger, point in found.items()} == tips


@pytest.mark.parametrize("name", HANDS)
def test_motions_of_a_fingertip_are_derivatives_of_its_place(name: str) -> None:
    robot = hand(name)
    view = PalmKinematics(robot)
    for finger in find_fingers(robot).values():
        motion = view.motion(robot.rest, finger.tip)
        others = np.setdiff1d(np.arange(len(robot.rest)), finger.columns)
        assert not motion[:, others].any()
        for column in finger.columns:
            ends = np.tile(robot.rest, (2, 1))
            ends[:, column] += -1e-6, 1e-6
            before, after = view.points(ends, [finger.tip])[:, 0]
            np.testing.assert_allclose(
                motion[:3, column], (after - before) / 2e-6, atol=1e-7
            )


@pytest.mark.parametrize("name", HANDS)
def test_flexing_joints_shorten_a_straight_finger_towards_the_palm(name: str) -> None:
    robot = hand(name)
    view, limits = PalmKinematics(robot), (robot.lower_limits, robot.upper_limits)
    for finger in find_fingers(robot).values():
        flexion = finger.flexion
        if flexion is None or not flexion.curls:
            continue
        straight, closed = flexion.straight, robot.zero.copy()
        for column in np.flatnonzero(flexion.signs):
            closed[column] = limits[int(finger.closing[column] > 0.0)][column]
        lengths = np.linalg.norm(
            view.points(np.array([straight, closed]), [finger.tip])[:, 0]
            - flexion.knuckle,
            axis=1,
        )
        assert lengths[1] < 0.95 * lengths[0]
        if finger.name != THUMB:
            assert view.motion(straight, finger.tip)[2] @ finger.closing < 0.0


def test_axes_a_few_degrees_apart_bend_a_finger_and_others_do_not() -> None:
    """Axes of Romeo's fingers are 7 degrees apart, those of its thumb 35."""
    fingers = find_fingers(hand("romeo_right"))
    assert fingers["index"].bending == [*fingers["index"].joints]
    assert fingers["thumb"].bending == [*fingers["thumb"].joints[1:]]


def test_a_round_fingertip_is_its_own_pad() -> None:
    robot = hand("allegro_right")
    chains = find_fingers(robot)
    geometry = read_collision_shapes(robot)
    for finger, pad in find_pads(robot).items():
        sphere = next(
            geometry.geometryObjects[i]
            for i in distal_shapes(chains[finger], geometry)
            if hasattr(geometry.geometryObjects[i].geometry, "radius")
        )
        np.testing.assert_allclose(pad.offset, sphere.placement.translation, atol=1e-9)
        assert pad.radius == pytest.approx(sphere.geometry.radius, abs=1e-9)


def depth_in(shape: pin.GeometryObject, point: np.ndarray) -> float:
    """Return how deep a point of the joint's frame lies in a shape [m]; negative outside."""
    x, geometry = shape.placement.actInv(point), shape.geometry
    if isinstance(geometry, coal.Sphere):
        return geometry.radius - float(np.linalg.norm(x))
    if isinstance(geometry, coal.Capsule):
        on_axis = np.array(
            [0.0, 0.0, np.clip(x[2], -geometry.halfLength, geometry.halfLength)]
        )
        return geometry.radius - float(np.linalg.norm(x - on_axis))
    corners = (
        geometry.halfSide * list(product((-1.0, 1.0), repeat=3))
        if isinstance(geometry, coal.Box)
        else np.array([geometry.point(i) for i in range(geometry.num_points)])
    )
    return -float((ConvexHull(corners).equations @ np.append(x, 1.0)).max())


@pytest.mark.parametrize("name", HANDS)
def test_a_pad_lies_inside_its_finger(name: str) -> None:
    robot = hand(name)
    chains = find_fingers(robot)
    geometry = read_collision_shapes(robot)
    for finger, pad in find_pads(robot).items():
        joint, tip = chains[finger].tip
        assert 0.003 <= pad.radius <= 0.03
        assert np.linalg.norm(pad.offset - tip) <= 0.0161
        shapes = [
            geometry.geometryObjects[i] for i in distal_shapes(chains[finger], geometry)
        ]
        depths = [
            depth_in(shape, pad.offset)
            for shape in shapes
            if shape.parentJoint == joint
        ]
        if depths:
            # `find_pads` samples directions, so it overestimates by up to 0.8 mm.
            assert max(depths) == pytest.approx(pad.radius, abs=8e-4)


@pytest.mark.parametrize("name", ["allegro_right", "hey5", "human", "three_finger"])
def test_pairs_are_of_different_fingers_and_apart_at_rest(name: str) -> None:
    robot = hand(name)
    chains = find_fingers(robot)
    pairs = all_pairs(robot)
    owner = {
        joint: finger for finger, chain in chains.items() for joint in chain.joints
    }
    shapes, data = pairs.geometry.geometryObjects, pairs.geometry.createData()
    for posture in (robot.rest, np.clip(0.0, robot.lower_limits, robot.upper_limits)):
        vector = robot.configuration_vector(posture)
        pin.updateGeometryPlacements(
            robot.model, robot.model.createData(), pairs.geometry, data, vector
        )
        pin.computeDistances(pairs.geometry, data)
        assert min(result.min_distance for result in data.distanceResults) > 0.0
    for pair, finger in zip(pairs.geometry.collisionPairs, pairs.fingers, strict=True):
        joints = shapes[pair.first].parentJoint, shapes[pair.second].parentJoint
        owners = [owner.get(joint) for joint in joints]
        assert owners[0] is None or owners[0] != owners[1]
        if finger:
            assert set(owners) == {THUMB, finger}
            ends = {pair.first, pair.second}
            for each in (THUMB, finger):
                assert ends & {*distal_shapes(chains[each], pairs.geometry)}
    assert set(pairs.fingers) - {""} == set(chains) - {THUMB}
    for pair, links in zip(pairs.geometry.collisionPairs, pairs.links, strict=True):
        for i, link in zip((pair.first, pair.second), links, strict=True):
            assert robot.model.frames[shapes[i].parentFrame].name == link


@pytest.mark.parametrize(("gap", "count"), [(0.97e-3, 0), (4e-3, 1)])
def test_a_pair_that_never_parts_is_left_out(gap: float, count: int) -> None:
    # A disc on two joints about its own axis, always as far from the palm.
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        for parent, name in (("palm", "swing"), ("swing", "disc"))
    )
    urdf = (
        '<robot name="disc"><link name="palm"><collision><geometry><box size="0.1 0.1 0.02"/>'
        '</geometry></collision></link><link name="swing"/><link name="disc"><collision>'
        f'<origin xyz="0.01 0 {0.015 + gap}"/><geometry><cylinder radius="0.01" length="0.01"/>'
        f"</geometry></collision></link>{joints}</robot>"
    )
    tip = PointSpec("tip", "disc", (0.02, 0.0, 0.0))
    robot = two_joint_hand(urdf, ("swing", "disc"), tip, (1.0, 0.0, 0.0))
    pairs = all_pairs(robot)
    assert len(pairs.fingers) == count
    assert pairs.joined == (("palm", "disc"),)[count:]


def test_named_pairs_are_those_of_the_description() -> None:
    robot = hand("allegro_right")
    assert robot.spec.collision is not None
    pairs = robot.spec.collision.pairs
    assert set(named_pairs(robot, pairs).links) == set(pairs)


def test_moved_by_marks_the_columns_that_change_a_placement() -> None:
    robot = hand("ur5_allegro")
    data, q = robot.model.createData(), robot.configuration_vector(robot.rest)
    for joint in (3, robot.model.njoints - 1):
        pin.forwardKinematics(robot.model, data, q)
        before = data.oMi[joint].homogeneous
        for column, moves in enumerate(moved_by(robot.model, [joint])[0]):
            step = np.zeros(robot.model.nv)
            step[column] = 1e-3
            pin.forwardKinematics(
                robot.model, data, pin.integrate(robot.model, q, step)
            )
            assert (np.abs(data.oMi[joint].homogeneous - before).max() > 1e-9) == bool(
                moves
            )


def test_links_that_a_knuckle_of_crossing_axes_joins_are_neighbours() -> None:
    """A proximal link that dips into the palm as it bends would hold its finger for good."""
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}"/>'
        f'<axis xyz="{axis}"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        for parent, name, axis in (
            ("palm", "spread", "0 0 1"),
            ("spread", "bent", "0 1 0"),
        )
    )
    urdf = (
        '<robot name="knuckle"><link name="palm"><collision><geometry><box size="0.1 0.1 0.02"/>'
        '</geometry></collision></link><link name="spread"/><link name="bent"><collision>'
        '<origin xyz="0.02 0 0.022"/><geometry><box size="0.04 0.01 0.01"/></geometry>'
        f"</collision></link>{joints}</robot>"
    )
    tip = PointSpec("tip", "bent", (0.04, 0.0, 0.022))
    robot = two_joint_hand(urdf, ("spread", "bent"), tip, (1.0, 0.0, 0.0))
    assert not len(all_pairs(robot).fingers)


def test_a_copy_has_a_workspace_of_its_own() -> None:
    hand = load_hand("allegro_right")
    view = PalmKinematics(hand)
    place = [(5, np.array([0.01, 0.02, 0.03]))]
    expected = view.points(hand.rest, place)
    for copied in (copy.deepcopy(view), pickle.loads(pickle.dumps(view))):
        # Pinocchio 4.0 writes one down, and cannot read it.
        assert not any(isinstance(each, pin.Data) for each in vars(copied).values())
        np.testing.assert_array_equal(copied.points(hand.rest, place), expected)
