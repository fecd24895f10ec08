"""Closing hands on objects, planning grasps and rating them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
import scipy.optimize
from experiment_variants import moved_grasp
from grasp_cases import coupled_hand
from grasp_closing import (
    MARGIN,
    HandCloser,
    Preshape,
    default_preshape,
    palm_centre,
)
from grasp_measures import (
    QUALITIES,
    SMALLER_IS_BETTER,
    cone_wrenches,
    ferrari_canny,
    grasp_quality,
)
from grasp_planning import PlannedGrasp, circumradius, contact_counts, plan_grasps
from hypothesis import given, settings
from hypothesis import strategies as st
from section_four.contacts import Grasp
from section_four.cube import reference_grasp
from strategies import generators, motion_of, poses, rotations

from handmap_qp.errors import HandError, InvalidInputError, MissingExtraError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.mapping.objects import Box, Cylinder, MeshShape, Shape, Sphere

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

HANDS = ("human", "three_finger")
CUBE = Box((0.05, 0.05, 0.05))
SHAPES = (CUBE, Sphere(0.03), Cylinder(0.025, 0.09))
MIRROR = np.diag([-1.0, 1.0, 1.0])


def load(name: str) -> Hand:
    try:
        return load_hand(name)
    except MissingExtraError:
        pytest.skip("example-robot-data is not installed")


@pytest.fixture(scope="module", params=HANDS)
def plan(request: pytest.FixtureRequest) -> list[PlannedGrasp]:
    """Plan six grasps of each shape by one hand."""
    hand = load(request.param)
    return [
        one
        for shape in SHAPES
        for one in plan_grasps(hand, shape, samples=6, quality="msvg", seed=3)
    ]


def distance_from(shape: Shape, point: np.ndarray) -> tuple[float, np.ndarray]:
    """Return a point's distance from a shape, and the nearest point of the shape, in its frame."""
    match shape:
        case Box(size):
            nearest = np.clip(point, -0.5 * np.array(size), 0.5 * np.array(size))
        case Sphere(radius):
            nearest = point * min(1.0, radius / np.linalg.norm(point))
        case Cylinder(radius, length):
            aside = point[:2] * min(1.0, radius / max(np.linalg.norm(point[:2]), 1e-12))
            nearest = np.append(aside, np.clip(point[2], -0.5 * length, 0.5 * length))
        case MeshShape():
            raise NotImplementedError
    return float(np.linalg.norm(point - nearest)), nearest


def carried_by(hand: Hand, joint: int, links: Sequence[str]) -> set[str]:
    """Return the links that a joint moves, by moving it."""
    q = np.array(hand.rest)
    before = hand.link_poses(links, q)
    q[joint] += 0.1
    return {
        link
        for link, a, b in zip(links, before, hand.link_poses(links, q), strict=True)
        if np.abs(a - b).max() > 1e-9
    }


def closer_for(grasp: Grasp) -> HandCloser:
    assert grasp.shape is not None
    return HandCloser(grasp.hand, grasp.shape, grasp.object_pose)


# Closing


@pytest.mark.slow
def test_closing_never_reaches_into_the_object(plan: Sequence[PlannedGrasp]) -> None:
    for grasp in (one.grasp for one in plan):
        # A touching link is one margin away, as far as a microradian of the joint allows.
        assert (
            closer_for(grasp).distances(grasp.q, grasp.wrist_pose).min() > MARGIN - 1e-6
        )


@pytest.mark.slow
def test_closing_stays_inside_the_limits(plan: Sequence[PlannedGrasp]) -> None:
    for grasp in (one.grasp for one in plan):
        assert (grasp.hand.lower_limits <= grasp.q).all()
        assert (grasp.q <= grasp.hand.upper_limits).all()


def test_contacts_lie_one_margin_off_the_object_and_face_it(
    plan: Sequence[PlannedGrasp],
) -> None:
    for grasp in (one.grasp for one in plan):
        assert grasp.shape is not None
        for point, normal in zip(grasp.points, grasp.normals, strict=True):
            distance, nearest = distance_from(grasp.shape, point - grasp.centre)
            assert distance == pytest.approx(MARGIN, abs=1e-6)
            # The direction is taken over 0.1 mm, between points that are exact to some nanometres.
            np.testing.assert_allclose(
                normal, (nearest + grasp.centre - point) / distance, atol=5e-3
            )


def test_every_joint_that_stopped_short_carries_a_link_that_touches(
    plan: Sequence[PlannedGrasp],
) -> None:
    hand = plan[0].grasp.hand
    preshape = default_preshape(hand)
    ends = np.where(preshape.direction > 0.0, hand.upper_limits, hand.lower_limits)
    carried = [
        carried_by(hand, joint, closer_for(plan[0].grasp).links)
        for joint in range(len(ends))
    ]
    for grasp in (one.grasp for one in plan):
        closer = closer_for(grasp)
        near = closer.distances(grasp.q, grasp.wrist_pose) <= MARGIN
        touching = {
            link for link, is_near in zip(closer.links, near, strict=True) if is_near
        }
        for joint in np.flatnonzero(preshape.direction):
            assert grasp.q[joint] == ends[joint] or carried[joint] & touching


def test_joints_that_do_not_close_keep_their_angle(
    plan: Sequence[PlannedGrasp],
) -> None:
    preshape = default_preshape(plan[0].grasp.hand)
    still = preshape.direction == 0.0
    for grasp in (one.grasp for one in plan):
        np.testing.assert_array_equal(grasp.q[still], preshape.start[still])


def test_a_smaller_step_leads_to_the_same_grasp() -> None:
    hand = load("human")
    wrist = plan_grasps(hand, CUBE, samples=1, quality="msvg")[0].grasp.wrist_pose
    coarse, fine = (
        HandCloser(hand, CUBE, step=step).close(wrist) for step in (0.02, 0.002)
    )
    # Joints of a finger stop one after another, each found to a microradian.
    np.testing.assert_allclose(coarse.q, fine.q, atol=2e-5)


def test_a_hand_beside_the_object_closes_to_its_limits_and_has_no_contact() -> None:
    hand = load("three_finger")
    grasp = HandCloser(
        hand, CUBE, motion_of(np.eye(3), np.array([1.0, 0.0, 0.0]))
    ).close()
    preshape = default_preshape(hand)
    assert grasp.contacts == ()
    np.testing.assert_array_equal(
        grasp.q, np.where(preshape.direction > 0.0, hand.upper_limits, 0.0)
    )


def test_a_left_hand_closes_as_the_right_one_in_a_mirror() -> None:
    right, left = load("human"), load("human_left")
    grasp = plan_grasps(right, CUBE, samples=1, quality="msvg")[0].grasp
    assert grasp.wrist_pose is not None
    R, t = grasp.wrist_pose[:3, :3], grasp.wrist_pose[:3, 3]
    mirrored = HandCloser(left, CUBE).close(motion_of(MIRROR @ R @ MIRROR, MIRROR @ t))
    # Two solutions by the same iterative distance algorithm, each exact to a micrometre.
    np.testing.assert_allclose(mirrored.q, grasp.q, atol=1e-4)
    np.testing.assert_allclose(mirrored.points, grasp.points @ MIRROR, atol=1e-4)


def test_contacts_at_the_joint_of_two_links_are_one() -> None:
    for one in plan_grasps(load("human"), CUBE, samples=12, quality="msvg"):
        gaps = np.linalg.norm(
            one.grasp.points[:, None] - one.grasp.points, axis=2
        ) + np.eye(len(one.grasp.points))
        assert gaps.min() >= 1e-3


def test_coupled_joints_stop_together() -> None:
    for one in plan_grasps(coupled_hand(), CUBE, samples=10, quality="msvg"):
        assert (
            closer_for(one.grasp).distances(one.grasp.q, one.grasp.wrist_pose).min()
            > MARGIN - 1e-6
        )
        assert len(one.grasp.contacts) >= 2


def test_closing_refuses_to_start_in_the_object() -> None:
    hand = load("three_finger")
    with pytest.raises(InvalidInputError, match="touches the object"):
        HandCloser(hand, CUBE, hand.frame_pose("finger1_tip", np.zeros(8))).close()


def test_a_hand_without_collision_shapes_is_refused() -> None:
    hand = load("three_finger")
    bare = Hand(
        hand.spec,
        urdf_text=hand.urdf_text.replace("<collision name", "<ignored name").replace(
            "</collision>", "</ignored>"
        ),
    )
    with pytest.raises(HandError, match="no collision shapes"):
        HandCloser(bare, CUBE)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"start": np.full(8, 9.0)}, "limits"),
        ({"start": np.zeros(7)}, "start"),
        ({"direction": np.zeros(8)}, "direction"),
        ({"direction": np.full(8, 0.5)}, "direction"),
    ],
)
def test_a_closing_has_to_fit_its_hand(
    change: dict[str, np.ndarray], what: str
) -> None:
    hand = load("three_finger")
    with pytest.raises(InvalidInputError, match=what):
        HandCloser(
            hand, CUBE, preshape=dataclasses.replace(default_preshape(hand), **change)
        )


# How hands close


@pytest.mark.parametrize("name", ["three_finger", "human"])
def test_geometry_finds_the_joints_that_the_toolbox_closes(name: str) -> None:
    hand = load(name)
    # Under another name, the hand has no `grasp_cube50.json`.
    stranger = Hand(msgspec.structs.replace(hand.spec, name="stranger"))
    found, known = (
        default_preshape(stranger).direction,
        default_preshape(hand).direction,
    )
    fingers = [
        i for i, joint in enumerate(hand.joint_names) if not joint.startswith("thumb")
    ]
    np.testing.assert_array_equal(found[fingers], known[fingers])


def test_geometry_bends_the_allegro_fingers_and_leaves_their_spread() -> None:
    hand = load("allegro_right")
    bending = {f"joint_{i}.0" for i in (1, 2, 3, 5, 6, 7, 9, 10, 11, 14, 15)}
    direction = default_preshape(hand).direction
    assert {
        joint
        for joint, way in zip(hand.joint_names, direction, strict=True)
        if way == 1.0
    } == bending
    assert (direction >= 0.0).all()


def test_a_hand_whose_zero_is_a_fist_starts_open() -> None:
    preshape = default_preshape(load("romeo_right"))
    assert (preshape.start.tolist(), preshape.direction.tolist()) == ([1.0], [-1.0])


def test_jaws_start_open_and_close() -> None:
    hand = load("panda_gripper")
    preshape = default_preshape(hand)
    closes = np.where(preshape.direction > 0.0, hand.upper_limits, hand.lower_limits)
    tips = hand.with_points("fingertips")
    gaps = [
        np.linalg.norm(np.subtract(*tips.points(q))) for q in (preshape.start, closes)
    ]
    assert gaps[1] < gaps[0] - 0.05


@pytest.mark.parametrize(
    ("name", "centre"),
    [("human", [-0.0074, 0.0674, 0.0]), ("three_finger", [0.0, 0.0, 0.0])],
)
def test_palm_centre_is_the_toolbox_one(name: str, centre: list[float]) -> None:
    np.testing.assert_allclose(palm_centre(load(name)), centre, atol=1e-12)


# Planning


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "mode", "share"), [("human", 7, 0.4), ("three_finger", 3, 0.9)]
)
def test_on_the_cube_the_human_hand_most_often_has_7_contacts_and_the_three_fingered_3(
    name: str, mode: int, share: float
) -> None:
    reference = reference_grasp(name)
    cube = reference.grasp.object_pose
    counts = contact_counts(
        plan_grasps(
            reference.grasp.hand, CUBE, object_pose=cube, samples=30, quality="msvg"
        )
    )
    assert max(counts, key=lambda number: counts[number]) == mode
    # As in the toolbox's own plans.
    assert (
        max(
            reference.published_counts,
            key=lambda number: reference.published_counts[number],
        )
        == mode
    )
    assert counts[mode] > share * 30


def test_a_plan_is_its_seed() -> None:
    hand = load("three_finger")
    first, again, other = (
        plan_grasps(hand, CUBE, samples=6, seed=seed) for seed in (5, 5, 6)
    )
    for a, b in zip(first, again, strict=True):
        assert (a.trial, a.quality, a.grasp.contacts) == (
            b.trial,
            b.quality,
            b.grasp.contacts,
        )
        np.testing.assert_array_equal(a.grasp.q, b.grasp.q)
    assert not np.array_equal(first[0].grasp.q, other[0].grasp.q)


@pytest.mark.parametrize("measure", ["msvg", "uot"])
def test_plans_are_ranked_best_first(measure: str) -> None:
    planned = plan_grasps(load("three_finger"), CUBE, samples=6, quality=measure)
    values = [one.quality for one in planned]
    assert values == sorted(values, reverse=measure not in SMALLER_IS_BETTER)
    assert sorted(one.trial for one in planned) == list(range(6))
    assert all(one.quality == grasp_quality(one.grasp, measure) for one in planned)


@pytest.mark.parametrize("name", HANDS)
def test_palms_look_at_the_object_from_the_planned_distance(name: str) -> None:
    hand, pose = load(name), motion_of(np.eye(3), np.array([0.3, -0.1, 0.2]))
    farther = dataclasses.replace(default_preshape(hand), clearance=0.04)
    for one in plan_grasps(
        hand, CUBE, object_pose=pose, samples=5, preshape=farther, quality="msvg"
    ):
        palm = hand.frame_pose("palm", one.grasp.q, one.grasp.wrist_pose)
        middle = palm[:3, :3] @ palm_centre(hand) + palm[:3, 3]
        np.testing.assert_allclose(
            middle, pose[:3, 3] + (circumradius(CUBE) + 0.04) * palm[:3, 2], atol=1e-12
        )


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_a_hand_that_would_start_in_the_object_starts_just_clear_of_it(
    shape: Shape,
) -> None:
    hand = load("three_finger")
    inside = Preshape(np.zeros(8), default_preshape(hand).direction, -0.05)
    for one in plan_grasps(hand, shape, samples=5, preshape=inside, quality="msvg"):
        gap = (
            HandCloser(hand, shape).distances(inside.start, one.grasp.wrist_pose).min()
        )
        assert MARGIN < gap < MARGIN + 1.1e-3


def test_progress_is_told_and_arguments_are_checked() -> None:
    hand = load("three_finger")
    told: list[int] = []
    plan_grasps(hand, CUBE, samples=3, quality="msvg", progress=told.append)
    assert told == [1, 2, 3]
    with pytest.raises(InvalidInputError, match="samples"):
        plan_grasps(hand, CUBE, samples=0)
    with pytest.raises(InvalidInputError, match="ferrari_canny"):
        plan_grasps(hand, CUBE, quality="nice")
    with pytest.raises(InvalidInputError, match="fixed wrist"):
        plan_grasps(load_hand("three_finger", mount="fixed"), CUBE)


# Quality


@pytest.mark.parametrize("measure", QUALITIES)
@given(pose=poses)
@settings(max_examples=8)
def test_quality_does_not_depend_on_where_the_grasp_is(
    measure: str, pose: np.ndarray
) -> None:
    grasp = reference_grasp("three_finger").grasp
    # The edges of the friction pyramid turn with the world, so the measure depends slightly
    # on the frame.
    tolerance = 0.12 if measure == "ferrari_canny" else 1e-7
    assert grasp_quality(moved_grasp(grasp, pose), measure) == pytest.approx(
        grasp_quality(grasp, measure), rel=tolerance
    )


@given(rotations, generators, st.integers(3, 6), st.floats(0.1, 1.0))
@settings(max_examples=30)
def test_force_closure_agrees_with_a_linear_program(
    rotation: np.ndarray, generator: np.random.Generator, count: int, friction: float
) -> None:
    directions = generator.normal(size=(count, 3)) @ rotation
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    wrenches = cone_wrenches(points, -points, friction)
    # Force closure: positive forces on all edges are in balance.
    size = len(wrenches)
    balance = np.column_stack([np.vstack([wrenches.T, np.ones(size)]), np.zeros(7)])
    solved = scipy.optimize.linprog(
        np.append(np.zeros(size), -1.0),
        A_ub=np.column_stack([-np.eye(size), np.ones(size)]),
        b_ub=np.zeros(size),
        A_eq=balance,
        b_eq=np.append(np.zeros(6), 1.0),
        bounds=[(None, None)] * size + [(None, 1.0)],
    )
    closes = solved.status == 0 and -solved.fun > 1e-9
    radius = ferrari_canny(points, -points, friction)
    assert closes == (radius > 1e-9)


def test_every_direction_is_resisted_by_at_least_the_ball() -> None:
    reference = reference_grasp("human").grasp
    offsets = (reference.points - reference.centre) / 0.04
    radius = ferrari_canny(offsets, reference.normals, 0.5)
    directions = np.random.default_rng(0).normal(size=(20000, 6))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    resisted = (directions @ cone_wrenches(offsets, reference.normals, 0.5).T).max(
        axis=1
    )
    assert 0.0 < radius <= resisted.min() + 1e-12
    # This many directions come near the weakest one.
    assert resisted.min() < 1.5 * radius


def test_more_friction_never_weakens_a_grasp() -> None:
    grasp = reference_grasp("human").grasp
    radii = [
        grasp_quality(grasp, friction=friction)
        for friction in (0.0, 0.1, 0.3, 0.5, 0.8, 1.2)
    ]
    assert radii == sorted(radii)
    assert radii[0] <= 0.0 < radii[3]


def test_two_contacts_resist_no_torque_about_their_line() -> None:
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    assert ferrari_canny(points, -points, 0.8) == 0.0


def test_grasps_with_too_few_contacts_rank_last() -> None:
    grasp = reference_grasp("three_finger").grasp
    for count in (0, 2):
        poor = dataclasses.replace(grasp, contacts=grasp.contacts[:count])
        for measure in QUALITIES:
            if measure in SMALLER_IS_BETTER:
                assert grasp_quality(poor, measure) > grasp_quality(grasp, measure)
            else:
                assert grasp_quality(poor, measure) == pytest.approx(0.0, abs=1e-12)


def test_cones_stand_round_their_normals() -> None:
    normals = reference_grasp("human").grasp.normals
    forces = cone_wrenches(np.zeros((7, 3)), normals, 0.5)[:, :3].reshape(7, -1, 3)
    np.testing.assert_allclose(
        np.einsum("cej,cj->ce", forces, normals), 1.0, atol=1e-12
    )
    np.testing.assert_allclose(
        np.linalg.norm(forces - normals[:, None], axis=2), 0.5, atol=1e-12
    )
    with pytest.raises(InvalidInputError, match="friction"):
        cone_wrenches(np.zeros((7, 3)), normals, -0.1)
