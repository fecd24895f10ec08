"""The virtual sphere: the published numbers, exact similarities, and its limits."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from mapping_cases import little_pose, near_rest
from virtual_object_cases import HUMAN, closing, rotation_of, sphere_matrix

from handmap_qp import (
    DegeneratePointsError,
    HandMapper,
    InvalidInputError,
    InvalidOptionsError,
    VirtualEllipsoid,
    VirtualSphere,
    load_hand,
    load_synergies,
)
from handmap_qp.mapping.methods.virtual_object import enclosing_ball
from handmap_qp.se3 import transform_points

THREE = load_hand("three_finger")
PANDA = load_hand("panda_gripper")
Arrays = dict[str, Any]


@pytest.fixture(scope="module")
def published(load_data: Callable[[str], Arrays]) -> Arrays:
    return load_data("virtual_sphere")


def velocity_map(
    human: tuple[Any, Any, Any], robot: tuple[Any, Any, Any], ratio: float
) -> np.ndarray:
    """`J_r^+ A_r S_c A_h^+ J_h`; each hand is its points, Jacobian and centre."""
    (
        (human_points, human_jacobian, human_centre),
        (robot_points, robot_jacobian, robot_centre),
    ) = (tuple(map(np.asarray, hand)) for hand in (human, robot))
    sphere = np.linalg.pinv(sphere_matrix(human_points, human_centre)) @ human_jacobian
    scaled = np.diag([ratio] * 3 + [1.0] * 4) @ sphere
    return (
        np.linalg.pinv(robot_jacobian)
        @ sphere_matrix(robot_points, robot_centre)
        @ scaled
    )


# -- the published numbers


@pytest.mark.parametrize(("name", "hand"), [("human", HUMAN), ("robot", THREE)])
def test_spheres_and_matrices_are_the_published_ones(
    name: str, hand: Any, published: Arrays
) -> None:
    given = published[name]
    points = 1e3 * hand.points(given["q"])
    np.testing.assert_allclose(points, given["fingertips"], atol=1e-9)
    centre, radius = enclosing_ball(points)
    np.testing.assert_allclose(centre, given["sphere_center"], atol=1e-9)
    np.testing.assert_allclose(radius, given["sphere_radius"], atol=1e-9)
    np.testing.assert_allclose(sphere_matrix(points, centre), given["A"], atol=1e-9)
    jacobian = 1e3 * hand.point_jacobian(given["q"])
    np.testing.assert_allclose(jacobian, given.get("J_true", given["J"]), atol=1e-9)


def test_the_map_of_joint_velocities_is_the_published_one(published: Arrays) -> None:
    human, robot = published["human"], published["robot"]
    ratio = robot["sphere_radius"] / human["sphere_radius"]
    np.testing.assert_allclose(ratio, robot["k"], rtol=1e-12)
    np.testing.assert_allclose(
        np.diag([ratio] * 3 + [1.0] * 4), robot["Sc"], rtol=1e-12
    )
    directions = load_synergies().matrix
    led = (human["fingertips"], human["J"], human["sphere_center"])
    for jacobian, expected in (("J", "S_r"), ("J_true", "S_r_with_true_J")):
        follows = (robot["fingertips"], robot[jacobian], robot["sphere_center"])
        found = velocity_map(led, follows, ratio) @ directions
        np.testing.assert_allclose(found, robot[expected], atol=1e-10)


@pytest.mark.parametrize("run", range(3))
def test_runs_along_a_synergy_are_the_published_ones(
    run: int, published: Arrays
) -> None:
    human, robot = published["human"], published["robot"]
    given, ratio = robot["runs"][run], robot["k"]
    directions = load_synergies().matrix
    velocity = directions @ given["zdot"]
    q, posture = np.array(human["q"]), np.array(robot["q"])
    centres = np.array(human["sphere_center"]), np.array(robot["sphere_center"])
    moved, mapped = [], np.empty(0)
    for i in range(11):
        np.testing.assert_allclose(q, given["q_human"][i], atol=1e-9)
        np.testing.assert_allclose(posture, given["q_robot"][i], atol=1e-9)
        np.testing.assert_allclose(centres[0], given["center_human"][i], atol=1e-9)
        np.testing.assert_allclose(centres[1], given["center_robot"][i], atol=1e-8)
        points = 1e3 * HUMAN.points(q), 1e3 * THREE.points(posture)
        mapped = velocity_map(
            (points[0], human["J"], centres[0]),
            (points[1], robot["J"], centres[1]),
            ratio,
        )
        moved.append(np.abs(1e3 * HUMAN.point_jacobian(q) - human["J"]).max())
        sphere = (
            np.linalg.pinv(sphere_matrix(points[0], centres[0])) @ human["J"] @ velocity
        )
        turning = mapped @ velocity
        achieved = (
            np.linalg.pinv(sphere_matrix(points[1], centres[1])) @ robot["J"] @ turning
        )
        q, posture = q + given["dt"] * velocity, posture + given["dt"] * turning
        centres = (
            centres[0] + given["dt"] * sphere[:3],
            centres[1] + given["dt"] * achieved[:3],
        )
    np.testing.assert_allclose(mapped @ directions, given["S_r_end"], atol=1e-8)
    np.testing.assert_allclose(moved[1:], given["J_stale_error_mm_per_rad"], atol=1e-8)


def test_small_displacements_move_the_sphere_as_the_published_pseudoinverse_does() -> (
    None
):
    rng = np.random.default_rng(0)
    points = HUMAN.points(HUMAN.rest)
    sphere = VirtualSphere().enclose(points)
    inverse = np.linalg.pinv(sphere_matrix(points, sphere.centre))
    for _ in range(5):
        way, tiny = rng.normal(size=points.shape), 1e-6
        ahead, behind = (
            sphere.motion_to(points + sign * tiny * way) for sign in (1, -1)
        )
        shift, angles, growth = np.split(inverse @ way.ravel(), [3, 6])
        np.testing.assert_allclose(
            (ahead.shift - behind.shift) / (2 * tiny), shift, atol=1e-5
        )
        np.testing.assert_allclose(
            (ahead.ratios - behind.ratios)[:1] / (2 * tiny), growth, atol=1e-4
        )
        spin = np.array(
            [
                [growth[0], -angles[2], angles[1]],
                [0, growth[0], -angles[0]],
                [0, 0, growth[0]],
            ]
        )
        spin[[1, 2, 2], [0, 0, 1]] = angles[2], -angles[1], angles[0]
        np.testing.assert_allclose(
            (ahead.linear - behind.linear) / (2 * tiny), spin, atol=1e-4
        )


# -- the smallest ball


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 9, 30])
def test_the_ball_encloses_all_points_and_none_is_smaller(count: int) -> None:
    rng = np.random.default_rng(count)
    for _ in range(10):
        points = rng.normal(size=(count, 3)) * [1.0, 0.6, 0.2]
        centre, radius = enclosing_ball(points)
        offsets = points - centre
        distances = np.linalg.norm(offsets, axis=1)
        assert distances.max() <= radius * (1.0 + 1e-9)
        # The centre is a convex combination of the points on the surface: that proves it optimal.
        surface = offsets[distances >= radius * (1.0 - 1e-7)]
        rows = np.vstack([surface.T, np.full(len(surface), max(radius, 1.0))])
        shares = nonnegative_solution(rows, np.array([0.0, 0.0, 0.0, max(radius, 1.0)]))
        np.testing.assert_allclose(
            rows @ shares, [0, 0, 0, max(radius, 1.0)], atol=1e-6
        )


def nonnegative_solution(rows: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Non-negative least squares by trying every subset of at most four columns."""
    best, error = np.zeros(rows.shape[1]), np.inf
    for size in range(1, 5):
        for subset in combinations(range(rows.shape[1]), size):
            found = np.linalg.lstsq(rows[:, subset], wanted, rcond=None)[0]
            off = float(np.linalg.norm(rows[:, subset] @ found - wanted))
            if (found >= -1e-9).all() and off < error:
                best, error = np.zeros(rows.shape[1]), off
                best[list(subset)] = found
    return best


def test_points_that_coincide_have_a_ball_too() -> None:
    centre, radius = enclosing_ball(np.tile([0.1, 0.2, 0.3], (5, 1)))
    np.testing.assert_allclose(centre, [0.1, 0.2, 0.3])
    assert radius == 0.0


# -- the method


@pytest.mark.parametrize("robot", [THREE, PANDA], ids=lambda hand: hand.name)
def test_a_similarity_of_the_fingertips_reaches_the_robot_exactly(robot: Any) -> None:
    mapper = HandMapper(HUMAN, robot, VirtualSphere())
    points, pose = HUMAN.points(HUMAN.rest), np.eye(4)
    first = mapper.map_points(points, pose)
    human_centre, human_radius = enclosing_ball(points)
    robot_centre, robot_radius = enclosing_ball(first.targets)
    turn, ratio, shift = (
        rotation_of(0.2, -0.3, 0.1),
        0.8,
        np.array([0.004, -0.006, 0.01]),
    )
    step = mapper.map_points(
        ratio * (points - human_centre) @ turn.T + human_centre + shift, pose
    )
    palms = (
        HUMAN.wrist_to_palm[:3, :3],
        (first.wrist_target @ robot.wrist_to_palm)[:3, :3],
    )
    # Both palms coincide at the reference, so that palm axes are the same axes.
    np.testing.assert_allclose(*palms, atol=1e-9)
    scale = robot_radius / human_radius
    expected = (
        ratio * (first.targets - robot_centre) @ turn.T + robot_centre + scale * shift
    )
    np.testing.assert_allclose(step.targets, expected, atol=1e-9)
    np.testing.assert_allclose(step.diagnostics["ratios"], 3 * [ratio], rtol=1e-9)
    np.testing.assert_allclose(step.diagnostics["size_ratio"], scale, rtol=1e-9)
    np.testing.assert_allclose(step.wrist_target, first.wrist_target, atol=1e-12)


@pytest.mark.parametrize("method", [VirtualSphere(), VirtualEllipsoid()], ids=str)
@pytest.mark.parametrize("robot", [THREE, PANDA], ids=lambda hand: hand.name)
def test_a_closing_hand_closes_hands_without_partners(method: Any, robot: Any) -> None:
    nameless = robot.with_points(tuple(point.name for point in robot.reference_points))
    mapper = HandMapper(HUMAN, nameless, method)
    openings = []
    for share in np.linspace(0.0, 0.5, 40):
        step = mapper.map_step(closing(share), np.eye(4))
        openings.append(float(np.linalg.norm(step.points[0] - step.points[1])))
    assert openings[-1] < 0.9 * openings[0]
    assert openings[20] < openings[0]


@pytest.mark.parametrize("method", [VirtualSphere(), VirtualEllipsoid()], ids=str)
def test_joints_are_independent_of_the_hands_place_in_the_world(method: Any) -> None:
    rng = np.random.default_rng(4)
    postures = [near_rest(rng, 0.5, HUMAN) for _ in range(4)]
    here, there = (HandMapper(HUMAN, THREE, method) for _ in range(2))
    moved = little_pose(rng, 2.0)
    for q in postures:
        expected, found = here.map_step(q, np.eye(4)), there.map_step(q, moved)
        np.testing.assert_allclose(found.command.q, expected.command.q, atol=1e-6)
        np.testing.assert_allclose(
            found.targets, transform_points(moved, expected.targets), atol=1e-9
        )


@pytest.mark.parametrize("method", [VirtualSphere(), VirtualEllipsoid()], ids=str)
def test_the_wrist_carries_the_object_along(method: Any) -> None:
    mapper = HandMapper(HUMAN, THREE, method)
    first = mapper.map_step(HUMAN.rest, np.eye(4))
    moved = little_pose(np.random.default_rng(5), 0.5)
    step = mapper.map_step(HUMAN.rest, moved)
    np.testing.assert_allclose(
        step.targets, transform_points(moved, first.targets), atol=1e-9
    )
    np.testing.assert_allclose(step.wrist_target, moved @ first.wrist_target, atol=1e-9)


@pytest.mark.parametrize("method", [VirtualSphere(), VirtualEllipsoid()], ids=str)
def test_a_virtual_object_names_its_missing_requirement(method: Any) -> None:
    mapper = HandMapper(HUMAN, THREE, method)
    with pytest.raises(InvalidInputError) as unmeasured:
        mapper.map_points(HUMAN.points(HUMAN.rest))
    assert unmeasured.value.argument == "wrist_pose"
    on_a_line = np.outer(np.linspace(0.0, 0.1, 5), [1.0, 2.0, 3.0])
    with pytest.raises(DegeneratePointsError, match="on a line"):
        mapper.map_points(on_a_line, np.eye(4))
    # Neither failure has set a reference.
    mapper.map_points(HUMAN.points(HUMAN.rest), np.eye(4))
    with pytest.raises(InvalidOptionsError, match="needs 3 points") as few:
        HandMapper(HUMAN.with_points(("thumb_tip", "index_tip")), THREE, method)
    assert few.value.option == "method"
    for wrong in (0.0, -1.0, np.inf, np.nan, "1"):
        with pytest.raises(InvalidOptionsError) as raised:
            type(method)(scale=wrong)
        assert raised.value.option == "scale"


def test_landmarks_of_the_palm_do_not_hide_the_fingers() -> None:
    motions = []
    for points in ("fingertips", "landmarks"):
        mapper = HandMapper(load_hand("human", points=points), THREE, VirtualSphere())
        mapper.map_step(closing(0.0), np.eye(4))
        motions.append(mapper.map_step(closing(0.4), np.eye(4)).diagnostics)
    np.testing.assert_allclose(motions[0]["linear"], motions[1]["linear"], atol=1e-12)
    assert motions[0]["ratios"][0] < 0.9


def test_a_sphere_cannot_tell_one_finger_from_another() -> None:
    # A bent middle finger turns the sphere, which moves the robot's thumb more than its middle.
    mapper = HandMapper(HUMAN, THREE, VirtualSphere())
    first = mapper.map_step(HUMAN.rest, np.eye(4))
    bent = HUMAN.rest.copy()
    bent[HUMAN.joint_names.index("middle_MCP_flexion")] += 0.8
    step = mapper.map_step(bent, np.eye(4))
    moved = np.linalg.norm(step.targets - first.targets, axis=1)
    fingers = [point.finger for point in THREE.reference_points]
    assert moved[fingers.index("thumb")] > 2.0 * moved[fingers.index("middle")] > 0.01
