"""The compiled core: each part of it agrees with the Python that says the same."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from marks import crossed
from oracles.shape_distances import MeasuredPairs
from scipy.optimize import nnls

from handmap_core.core import core
from handmap_core.ik.motion import Motion
from handmap_qp import (
    AttachedPoints,
    HandMapper,
    Homogeneous,
    IkOptions,
    PointDistances,
    PublishedMethod,
    TaskRows,
    Teleoperation,
    hand_names,
    load_hand,
    read_recording,
)
from handmap_qp.hands.collision_shapes import shape_model
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.presets import get_preset
from handmap_qp.models import encode
from handmap_qp.reference.daqp_solver import solve_by_daqp
from handmap_qp.reference.task_rows import distance_rows

HUMANS = {
    "right": load_hand("human", points="landmarks"),
    "left": load_hand("human_left", points="landmarks"),
}
HANDS = [name for name in hand_names() if not name.startswith("human")]
PRESETS = ("teleoperation", "object", "paper", "fixed_wrist", "joint-to-joint")
# Of all presets: what is measured on a robot is measured once.
robot_of = lru_cache(maxsize=1)(load_hand)


@pytest.mark.parametrize(("name", "preset"), crossed(HANDS, PRESETS, every=5))
def test_a_sample_of_both_paths_from_one_state_has_one_command(
    name: str, preset: str
) -> None:
    robot = robot_of(name)
    chosen = get_preset(preset)
    options = chosen.ik
    if preset == "fixed_wrist" or not chosen.suits(HUMANS[robot.side], robot):
        options = options.replaced(max_acceleration=60.0)
    reference = options.replaced(formulation="direct")
    method = chosen.method
    if isinstance(method, Homogeneous | Teleoperation):
        method = PublishedMethod(method)
    try:
        fast = HandMapper(HUMANS[robot.side], robot, chosen.method, ik=options)
        slow = HandMapper(HUMANS[robot.side], robot, method, ik=reference)
    except ValueError as error:
        pytest.skip(str(error))
    assert fast.point_ik.is_compiled
    assert not slow.point_ik.is_compiled
    taken = read_recording("demo", robot.side)
    worst = 0.0
    # Every step starts from one state, so few of them have all there is: from the open hand to a
    # fist and a pinch, in steps that reach limits of speed, and contacts.
    for landmarks in taken.landmarks[:180:12]:
        one = fast.map_landmarks(landmarks, dt=0.1)
        other = slow.map_landmarks(landmarks, dt=0.1)
        assert one.status == other.status
        assert one.iterations == other.iterations
        assert one.held_by == other.held_by
        np.testing.assert_array_equal(one.at_bound, other.at_bound)
        np.testing.assert_allclose(one.targets, other.targets, atol=1e-11)
        np.testing.assert_allclose(one.wrist_target, other.wrist_target, atol=1e-11)
        assert one.diagnostics.keys() == other.diagnostics.keys()
        for key, value in other.diagnostics.items():
            np.testing.assert_allclose(one.diagnostics[key], value, atol=1e-10)
        worst = max(worst, np.abs(one.command.q - other.command.q).max())
        # A motion that is set ends a detour, so it is set for both.
        fast.motion = slow.motion = Motion(*slow.motion)
    assert worst < 1e-9


@pytest.mark.parametrize("name", ["allegro_right", "leap_right", "three_finger"])
def test_hands_whose_links_press_have_one_command_on_both_paths(name: str) -> None:
    robot = robot_of(name)
    options = get_preset("teleoperation").ik.replaced(takes_detours=False)
    method = Teleoperation(squeeze=4.0)
    fast = HandMapper(HUMANS["right"], robot, method, ik=options)
    slow = HandMapper(
        HUMANS["right"], robot, method, ik=options.replaced(formulation="direct")
    )
    assert fast.point_ik.is_compiled
    assert not slow.point_ik.is_compiled
    limit = MeasuredPairs.of(slow.point_ik)
    worst = 0.0
    deepest = 0.0
    for landmarks in read_recording("demo", "right").landmarks[:180:3]:
        one = fast.map_landmarks(landmarks, dt=0.05)
        other = slow.map_landmarks(landmarks, dt=0.05)
        assert one.iterations == other.iterations
        assert one.held_by == other.held_by
        worst = max(worst, np.abs(one.command.q - other.command.q).max())
        deepest = min(deepest, limit.nearest(slow.motion.q))
        fast.motion = slow.motion = Motion(*slow.motion)
    assert worst < 1e-9
    # They overlapped, so the paths had to agree on by how much.
    assert deepest < -5e-4


@pytest.mark.parametrize("limit", [None, 25.0], ids=["free", "accelerating"])
@pytest.mark.parametrize("name", ["allegro_right", "three_finger", "g1_left"])
def test_hostile_targets_times_and_speeds_have_one_answer(
    name: str, limit: float | None
) -> None:
    hand = load_hand(name)
    options = IkOptions(
        max_acceleration=limit,
        avoids_self_collision=hand.spec.collision is not None,
        speed_weight=0.1,
        acceleration_weight=0.1,
    )
    fast = PointIk(hand, options)
    slow = PointIk(hand, options.replaced(formulation="direct"))
    rng = np.random.default_rng(4)
    apart = []
    for i in range(160):
        if i % 40 == 0:
            q = rng.uniform(hand.lower_limits - 0.1, hand.upper_limits + 0.1)
            for ik in (fast, slow):
                ik.place(hand.configuration_vector(q))
        points = slow.configuration.points + rng.normal(
            scale=10.0 ** rng.uniform(-3, 1), size=(len(hand.reference_points), 3)
        )
        turn = pin.exp6(10.0 ** rng.uniform(-3, 0.3) * rng.normal(size=6))
        wrist = (slow.configuration.wrist * turn).homogeneous
        dt = 10.0 ** rng.uniform(-4, 0)
        speed = rng.uniform(0.1, 1.0)
        asked = points, wrist if rng.random() < 0.8 else None, dt
        one = fast.solve(*asked, speed=speed)
        other = slow.solve(*asked, speed=speed)
        apart.append(np.abs(one.displacement - other.displacement).max())
        fast.gate.motion = slow.gate.motion
    assert np.quantile(apart, 0.97) < 1e-8
    assert np.median(apart) < 1e-12


def test_shares_of_rest_and_damping_mean_the_same_in_the_core() -> None:
    hand = load_hand("allegro_right")
    options = IkOptions(rest_weight=0.5, damping=2.0)
    random = np.random.default_rng(4)
    start = PointIk(hand, options).configuration
    targets = start.points + random.normal(scale=0.02, size=(4, 3))
    wrist = start.wrist.homogeneous
    shares = random.uniform(0.0, 1.0, len(hand.rest))

    def moved(formulation: str, part: np.ndarray | None) -> np.ndarray:
        ik = PointIk(hand, options.replaced(formulation=formulation))
        return ik.solve(targets, wrist, 0.02, regularisation=part).displacement

    in_core = moved("compiled", shares)
    for formulation in ("direct", "mink"):
        np.testing.assert_allclose(in_core, moved(formulation, shares), atol=1e-9)
    assert np.abs(in_core - moved("compiled", None)).max() > 1e-3


def test_a_stop_without_targets_goes_on_in_the_core() -> None:
    hand = load_hand("allegro_right")
    ik = PointIk(hand, IkOptions(max_acceleration=30.0))
    targets = ik.configuration.points + 0.05
    for _ in range(10):
        ik.solve(targets, None, 0.01)
    held = ik.hold(0.01)
    again = ik.solve(targets, None, 0.01)
    start = ik.gate.motion.q - np.concatenate([np.zeros(7), again.displacement[6:]])
    np.testing.assert_allclose(start[7:], held.q[7:], atol=1e-12)


class Python(PointDistances):
    """The rows of `PointDistances`, written in Python: a class that the core does not know."""

    def linearise(self, hand: Any) -> TaskRows:
        return distance_rows(self, hand)


def test_tasks_in_python_have_the_effect_of_those_in_the_core() -> None:
    hand = load_hand("allegro_right")
    tips = AttachedPoints.reference_points(hand)
    options = IkOptions(rest_weight=0.05)
    native, written = (
        kind(tips, [(0, 1), (0, 2)], [0.02, 0.03], [4.0, 2.0])
        for kind in (PointDistances, Python)
    )
    found = []
    for tasks in ([native], [written], [native, written], [written, native], []):
        ik = PointIk(hand, options)
        ik.place(hand.configuration_vector(hand.rest))
        targets = ik.configuration.points.copy()
        for _ in range(5):
            result = ik.solve(targets, None, 0.02, tasks=tasks)
        found.append(result.q)
    np.testing.assert_allclose(found[0], found[1], atol=1e-10)
    np.testing.assert_allclose(found[2], found[3], atol=1e-10)
    assert np.abs(found[0] - found[4]).max() > 1e-3
    assert np.abs(found[0] - found[2]).max() > 1e-4


class Wrong:
    """A task with rows of another size."""

    def linearise(self, hand: Any) -> TaskRows:
        """Return one row too short."""
        return TaskRows(np.zeros(1), np.zeros((1, hand.nv - 1)))


def test_wrong_rows_of_a_task_are_an_error_and_move_nothing() -> None:
    hand = load_hand("three_finger")
    ik = PointIk(hand, IkOptions())
    before = ik.gate.stamp
    with pytest.raises(ValueError, match="sizes"):
        ik.solve(ik.configuration.points.copy(), None, 0.01, tasks=[Wrong()])
    assert ik.gate.stamp == before


def test_the_solver_is_never_worse_than_daqp() -> None:
    rng = np.random.default_rng(0)
    for _ in range(1500):
        n, rows = int(rng.integers(1, 24)), int(rng.integers(0, 30))
        half = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-3, 2, size=n)
        H = half.T @ half + 10.0 ** rng.uniform(-4, 0) * np.eye(n)
        c = 10.0 ** rng.uniform(-2, 4) * rng.normal(size=n)
        lower, upper = np.sort(rng.normal(scale=0.1, size=(2, n)), axis=0)
        lower[rng.random(n) < 0.2] = -np.inf
        upper[rng.random(n) < 0.2] = np.inf
        equal = rng.random(n) < 0.1
        lower[equal] = upper[equal] = 0.05
        inside = np.clip(0.0, lower, upper)
        G = rng.normal(size=(rows, n)) * (rng.random((rows, n)) < 0.4)
        # Some rows pass through the point that is known to satisfy all of them.
        h = G @ inside + rng.exponential(0.05, rows) * (rng.random(rows) < 0.7)
        is_found, x, _ = core.solve_qp(H, c, lower, upper, G, h)
        assert is_found
        scale = max(1.0, np.abs(x).max())
        assert (x >= lower - 1e-11 * scale).all()
        assert (x <= upper + 1e-11 * scale).all()
        assert (G @ x <= h + 1e-10 * scale).all()
        other = solve_by_daqp(H, c, lower, upper, (G, h))
        if other is not None and (G @ other <= h + 1e-13).all():
            other = np.clip(other, lower, upper)
            ours, theirs = (0.5 * v @ H @ v + c @ v for v in (x, other))
            assert ours <= theirs + 1e-7 * abs(theirs) + 1e-9


def test_the_solver_finds_a_corner_from_a_minimum_that_is_far_away() -> None:
    rng = np.random.default_rng(1)
    for _ in range(400):
        n = int(rng.integers(4, 16))
        half = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(0, 3, size=n)
        H = half.T @ half + np.eye(n)
        c = 10.0 ** rng.uniform(8, 13) * rng.normal(size=n)
        half_width = 10.0 ** rng.uniform(-5, 0) * np.ones(n)
        half_width[rng.random(n) < 0.1] = 0.0
        lower, upper = -half_width, half_width
        # Rows of few directions, some of them parallel up to rounding.
        G = rng.normal(size=(4, n)) * (rng.random((4, n)) < 0.4)
        G = (10.0 ** rng.uniform(-6, 0, (16, 1))) * np.repeat(G, 4, axis=0)
        G *= 1.0 + 1e-15 * rng.normal(size=G.shape)
        h = np.abs(G) @ half_width * rng.uniform(0, 0.5, 16) * (rng.random(16) < 0.7)
        is_found, x, _ = core.solve_qp(H, c, lower, upper, G, h)
        assert is_found
        lengths = np.maximum(np.linalg.norm(G, axis=1), 1e-300)
        normals = np.vstack([-np.eye(n), np.eye(n), G / lengths[:, None]])
        slack = np.concatenate([x - lower, upper - x, (h - G @ x) / lengths])
        assert (slack >= -1e-12).all()
        # What is active can hold the slope: the answer is optimal.
        slope = H @ x + c
        is_active = slack <= 1e-9 * half_width.max()
        _, left = nnls(normals[is_active].T, -slope / np.abs(slope).max())
        assert left < 1e-8


def test_the_solver_says_that_bounds_cannot_hold() -> None:
    G, h = np.array([[1.0], [-1.0]]), np.array([0.0, -1.0])
    one = np.ones(1)
    assert not core.solve_qp(np.eye(1), one, -one, one, G, h)[0]
    assert not core.solve_qp(-np.eye(1), one, -one, one)[0]
    assert not core.solve_qp(np.full((1, 1), np.nan), one, -one, one)[0]


def _ellipsoid(seed: int, count: int) -> np.ndarray:
    """Return random points on an ellipsoid."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points * [0.02, 0.03, 0.05] / np.linalg.norm(points, axis=1, keepdims=True)


def _prism(count: int) -> np.ndarray:
    """Return the corners of a prism, whose ends are flat and have many corners."""
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    end = np.stack([0.02 * np.cos(angles), 0.03 * np.sin(angles)], axis=1)
    return np.vstack([np.c_[end, np.full(count, z)] for z in (-0.04, 0.04)])


def _hull(points: np.ndarray) -> coal.Convex:
    from scipy.spatial import ConvexHull

    vertices, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    vertices.extend([*points])
    faces.extend([coal.Triangle(*t) for t in ConvexHull(points).simplices.tolist()])
    return coal.Convex(vertices, faces)


SHAPES = {
    "box": coal.Box(0.04, 0.06, 0.1),
    "sphere": coal.Sphere(0.02),
    "capsule": coal.Capsule(0.015, 0.08),
    "convex": _hull(_ellipsoid(3, 60)),
    "fine": _hull(_ellipsoid(4, 600)),
    "prism": _hull(_prism(60)),
}


@pytest.mark.parametrize(
    ("first", "second"), list(combinations_with_replacement(SHAPES, 2))
)
def test_distances_are_those_of_coal(first: str, second: str) -> None:
    a, b = SHAPES[first], SHAPES[second]
    rng = np.random.default_rng(1)
    request = coal.DistanceRequest()
    request.gjk_tolerance = request.epa_tolerance = 1e-12
    is_fine = not {"fine", "prism"}.isdisjoint((first, second))
    depths = []
    for _ in range(40 if is_fine else 150):
        here, there = (pin.exp6(3.0 * rng.normal(size=6)) for _ in range(2))
        here.translation = 0.02 * rng.normal(size=3)
        there.translation = 0.06 * rng.normal(size=3)
        result = coal.DistanceResult()
        pose_a, pose_b = (
            coal.Transform3s(p.rotation, p.translation) for p in (here, there)
        )
        expected = coal.distance(a, pose_a, b, pose_b, request, result)
        distance, normal, point = core.measure_shapes(
            encode(shape_model(a)),
            here.homogeneous,
            encode(shape_model(b)),
            there.homogeneous,
        )
        depths.append(distance)
        assert distance == pytest.approx(expected, abs=1e-9)
        assert math.hypot(*normal) == pytest.approx(1.0, abs=1e-12)
        # The second shape lies on the far side of the plane through the point.
        if distance > 1e-6:
            nearest = np.array(result.getNearestPoint2())
            gap = np.dot(normal, nearest - np.array(point))
            assert gap == pytest.approx(distance, abs=1e-6)
    assert min(depths) < 0.0 < max(depths)


@pytest.mark.parametrize("choice", [{"formulation": "direct"}, {"solver": "proxqp"}])
def test_options_choose_the_python_path(choice: dict[str, Any]) -> None:
    hand = load_hand("three_finger")
    assert PointIk(hand, IkOptions()).is_compiled
    assert not PointIk(hand, IkOptions(**choice)).is_compiled
