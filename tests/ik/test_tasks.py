"""Further tasks of the QP: their derivatives, their optimum, and the same QP through mink."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from ik_cases import HANDS, hand_of, random_cases

from handmap_core.ik.tasks import (
    AttachedPoints,
    PointDistances,
    PointOffset,
    TaskRows,
)
from handmap_qp import HandMapper, IkOptions, InvalidInputError, MapStep, load_hand
from handmap_qp.hands import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.qp import PointIk
from handmap_qp.reference.daqp_solver import solve_by_daqp
from handmap_qp.reference.solvers import make_solver
from handmap_qp.reference.task_rows import task_rows

SETTLE = IkOptions(max_iterations=200, step_tolerance=1e-10, has_velocity_limits=False)
SOME = [
    which
    for which in HANDS
    if which[0] in ("three_finger", "allegro_right", "ur5_allegro")
]
each_hand = pytest.mark.parametrize(
    "which", SOME, ids=lambda which: "-".join(filter(None, which))
)


class Height:
    """Keep a point at a height: a task as a user would write it."""

    def __init__(self, point: int, height: float, weight: float) -> None:
        self.point, self.height, self.weight = point, height, weight

    def linearise(self, hand: Configuration) -> TaskRows:
        error = hand.points[self.point, 2] - self.height
        row = hand.point_jacobian()[3 * self.point + 2]
        return TaskRows(np.array([self.weight * error]), self.weight * row[None])


@each_hand
def test_the_rows_are_the_derivative_of_the_residual(which: Any) -> None:
    hand = hand_of(which)
    points = AttachedPoints.reference_points(hand)
    task = PointDistances(points, [(0, 1), (2, 0)], [0.02, 0.05], [8.0, 3.0])
    configuration = hand.configuration()
    for case in random_cases(hand, 5, seed=3, is_inside=True):
        configuration.place(case.q)
        residual, jacobian = (part[:2] for part in task.linearise(configuration)[:2])
        offsets = configuration.points[[0, 2]] - configuration.points[[1, 0]]
        lengths = np.linalg.norm(offsets, axis=1)
        np.testing.assert_allclose(
            residual, np.array([800.0, 300.0]) * (lengths - [0.02, 0.05]), atol=1e-9
        )
        step = 1e-6
        for column in range(configuration.nv):
            moved = [np.zeros(configuration.nv) for _ in range(2)]
            moved[0][column], moved[1][column] = step, -step
            values = []
            for displacement in moved:
                configuration.displace(case.q, displacement)
                values.append(task.linearise(configuration).residual[:2])
            slope = (values[0] - values[1]) / (2.0 * step)
            np.testing.assert_allclose(slope, jacobian[:, column], atol=1e-4)


@each_hand
def test_the_rows_of_the_core_are_those_over_pinocchio(which: Any) -> None:
    hand = hand_of(which)
    points = AttachedPoints.reference_points(hand)
    pairs = [(0, 1), (2, 0), (1, 2)]
    # The last pair has no weight.
    task = PointDistances(points, pairs, [0.02, 0.2, 0.05], [8.0, 3.0, 0.0])
    ends = AttachedPoints(
        hand, [*zip(points.joints[:2], points.offsets[:2], strict=True)]
    )
    offset = PointOffset(ends, np.array([0.1, -0.2, 0.05]), 6.0)
    configuration = hand.configuration()
    for case in random_cases(hand, 5, seed=9, is_inside=True):
        configuration.place(case.q)
        for each in (task, offset):
            rows = each.linearise(configuration)
            expected = task_rows(each, configuration)
            count = min(3, len(rows.residual))
            for part in ("residual", "jacobian"):
                given, wanted = getattr(rows, part), getattr(expected, part)
                np.testing.assert_allclose(given[:count], wanted[:count], atol=1e-9)
            # The other rows may come in another order.
            np.testing.assert_allclose(
                *(each.jacobian.T @ each.jacobian for each in (rows, expected)),
                rtol=1e-9,
                atol=1e-6,
            )
            wanted = np.broadcast_to(expected.damping, configuration.nv)
            np.testing.assert_allclose(rows.damping, wanted, rtol=1e-9, atol=1e-9)


def curvature(task: PointDistances, configuration: Configuration) -> np.ndarray:
    """Return the diagonal of the Hessian that the QP is given, without the slopes' part."""
    rows = task.linearise(configuration)
    return (rows.jacobian[len(task.weights) :] ** 2).sum(axis=0) + rows.damping


@each_hand
@pytest.mark.parametrize("distance", [0.001, 0.2], ids=["too far", "too near"])
def test_the_curvature_is_the_distances_own_where_that_is_convex(
    which: Any, distance: float
) -> None:
    hand = hand_of(which)
    points = AttachedPoints.reference_points(hand)
    task = PointDistances(points, [(0, 1)], distance, 5.0)
    configuration = hand.configuration()
    step, convex = 1e-4, 0
    for case in random_cases(hand, 5, seed=4, is_inside=True):
        configuration.place(case.q)
        residual, given = (
            task.linearise(configuration).residual[0],
            curvature(task, configuration),
        )
        for column in range(configuration.nv):
            apart = []
            for size in (step, 0.0, -step):
                displacement = np.zeros(configuration.nv)
                displacement[column] = size
                configuration.displace(case.q, displacement)
                apart.append(task.linearise(configuration).residual[0])
            bend = residual * (apart[0] - 2.0 * apart[1] + apart[2]) / step**2
            # Equal for one joint where both parts are convex, else more.
            assert given[column] > bend - 1e-2 * abs(bend) - 0.1
            convex += bend > 1.0
    assert convex


def test_no_pairs_are_no_rows() -> None:
    hand = load_hand("three_finger")
    configuration = hand.configuration()
    configuration.place(hand.configuration_vector(hand.rest))
    task = PointDistances(AttachedPoints.reference_points(hand), [], [])
    rows = task.linearise(configuration)
    assert rows.jacobian.shape == (0, configuration.nv)
    assert len(rows.residual) == 0


@pytest.mark.parametrize("distance", [0.0, 0.5], ids=["too far", "too near"])
def test_a_distance_out_of_reach_leaves_free_what_does_not_change_it(
    distance: float,
) -> None:
    hand = load_hand("allegro_right", mount="floating")
    configuration = hand.configuration()
    configuration.place(hand.configuration_vector(hand.rest))
    points = AttachedPoints.reference_points(hand)
    given = curvature(PointDistances(points, [(0, 1)], distance, 5.0), configuration)
    # A wrist carries both points.
    np.testing.assert_array_equal(given[:6], 0.0)
    assert given[6:].max() > 1.0


@each_hand
def test_mink_takes_the_same_step_with_further_tasks(which: Any) -> None:
    hand = hand_of(which)
    options = IkOptions(max_iterations=1, speed_weight=0.3, acceleration_weight=0.2)
    iks = [
        PointIk(hand, options.replaced(formulation=each)) for each in ("direct", "mink")
    ]
    tasks = (
        PointDistances(AttachedPoints.reference_points(hand), [(0, 1)], [0.01], [8.0]),
        Height(1, 0.1, 50.0),
    )
    rest = 0.5 * (hand.lower_limits + hand.upper_limits)
    for case in random_cases(hand, 10, seed=4):
        for ik in iks:
            ik.place(case.q)
        # The second sample starts with a velocity.
        for _ in range(2):
            expected, step = (
                ik.solve(
                    case.point_targets,
                    case.wrist_target,
                    case.dt,
                    rest=rest,
                    tasks=tasks,
                )
                for ik in iks
            )
            np.testing.assert_allclose(
                step.displacement, expected.displacement, atol=1e-8
            )


def test_two_fingertips_meet_when_they_are_told_to() -> None:
    hand = load_hand("allegro_right")
    ik = PointIk(hand, SETTLE)
    ik.place(hand.configuration_vector(hand.rest))
    points, wrist = ik.configuration.points.copy(), ik.configuration.wrist.homogeneous
    task = PointDistances(
        AttachedPoints.reference_points(hand), [(0, 1)], [0.01], [100.0]
    )
    apart = np.linalg.norm(points[0] - points[1])
    ik.solve(points, wrist, 1.0, tasks=[task])
    together = np.linalg.norm(ik.configuration.points[0] - ik.configuration.points[1])
    assert apart > 0.03
    assert together == pytest.approx(0.01, abs=2e-4)


def test_the_end_is_a_minimum_of_the_cost_with_its_tasks() -> None:
    hand, rng = load_hand("allegro_right"), np.random.default_rng(0)
    options = IkOptions(
        max_iterations=300,
        step_tolerance=1e-12,
        has_velocity_limits=False,
        rest_weight=0.3,
    )
    ik = PointIk(hand, options)
    ik.place(hand.configuration_vector(hand.rest))
    points = ik.configuration.points + rng.normal(
        scale=0.003, size=ik.configuration.points.shape
    )
    wrist, rest = ik.configuration.wrist.homogeneous, hand.rest + 0.02
    points_of = AttachedPoints.reference_points(hand)
    task = PointDistances(points_of, [(0, 1), (0, 2)], [0.06, 0.07], [4.0, 2.0])
    ik.solve(points, wrist, 1.0, rest=rest, tasks=[task])

    def cost(q: np.ndarray) -> float:
        at = hand.configuration()
        at.place(q)
        twist = pin.log6(at.wrist.actInv(pin.SE3(wrist))).vector
        residual = task.linearise(at).residual
        return float(
            1e4 * ((at.points - points) ** 2).sum()
            + (300.0 * twist[:3]) @ (300.0 * twist[:3])
            + (30.0 * twist[3:]) @ (30.0 * twist[3:])
            + 0.09 * ((q[hand.q_indices] - rest) ** 2).sum()
            + residual @ residual
        )

    end = ik.configuration.q.copy()
    for _ in range(40):
        direction = 1e-3 * rng.normal(size=hand.model.nv)
        assert cost(pin.integrate(hand.model, end, direction)) > cost(end)


def settle(mapper: HandMapper, human: Hand) -> MapStep:
    """Map the human's rest posture 60 times and return the last step."""
    return [mapper.map_step(human.rest, np.eye(4)) for _ in range(60)][-1]


def test_a_users_task_reaches_the_qp_through_the_mapper() -> None:
    human, robot = load_hand("human"), load_hand("three_finger")
    task = Height(0, -0.05, 1000.0)
    plain, tasked = (
        HandMapper(human, robot, "paper"),
        HandMapper(human, robot, "paper", tasks=[task]),
    )
    without, within = (settle(mapper, human) for mapper in (plain, tasked))
    assert abs(without.points[0, 2] + 0.05) > 0.01
    assert within.points[0, 2] == pytest.approx(-0.05, abs=1e-3)
    tasked.configure(tasks=())
    within = settle(tasked, human)
    np.testing.assert_allclose(within.points, without.points, atol=1e-4)


def test_points_in_one_place_can_be_parted() -> None:
    hand = load_hand("three_finger")
    place = (hand.model.njoints - 1, np.array([0.01, 0.0, 0.0]))
    configuration = hand.configuration()
    configuration.place(hand.configuration_vector(hand.rest))
    rows = PointDistances(
        AttachedPoints(hand, [place] * 2), [(0, 1)], [0.01]
    ).linearise(configuration)
    assert all(np.isfinite(part).all() for part in rows)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (([(0, 0)], [0.1]), "pairs"),
        (([(0, -1)], [0.1]), "pairs"),
        (([(0, 1)], [0.1, 0.2]), "distances"),
        (([(0, 1)], [-0.1]), "distances"),
        (([(0, 1)], ["a"]), "distances"),
        (([(0, 1)], [0.1], [np.nan]), "weights"),
        (([(0, 1)], [0.1], [1.0, 2.0]), "weights"),
    ],
    ids=str,
)
def test_distances_without_a_meaning_are_rejected_by_name(
    arguments: Any, name: str
) -> None:
    with pytest.raises(InvalidInputError) as raised:
        PointDistances(
            AttachedPoints.reference_points(load_hand("three_finger")), *arguments
        )
    assert raised.value.argument == name


@pytest.mark.parametrize("name", ["romeo_right", "ur5_allegro", "three_finger"])
def test_attached_points_and_their_derivatives_follow_the_hand(name: str) -> None:
    hand, rng = load_hand(name), np.random.default_rng(6)
    places = [
        (joint, rng.normal(scale=0.02, size=3))
        for joint in range(1, hand.model.njoints)
    ]
    points = AttachedPoints(hand, places)
    configuration = hand.configuration()
    q = hand.configuration_vector(0.5 * (hand.lower_limits + hand.upper_limits))
    configuration.place(q)
    positions = points.positions(configuration)
    for (joint, offset), position in zip(places, positions, strict=True):
        np.testing.assert_allclose(
            position, configuration.data.oMi[joint].act(offset), atol=1e-12
        )
    jacobians = points.jacobians(configuration)
    step = 1e-6
    for column in range(configuration.nv):
        ends = []
        for sign in (step, -step):
            displacement = np.zeros(configuration.nv)
            displacement[column] = sign
            configuration.displace(q, displacement)
            ends.append(points.positions(configuration))
        slope = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(slope, jacobians[:, :, column], atol=1e-8)


def test_reference_points_are_attached_points() -> None:
    hand = load_hand("hey5")
    configuration = hand.configuration()
    configuration.place(hand.configuration_vector(hand.rest))
    points = AttachedPoints.reference_points(hand)
    positions = points.positions(configuration)
    np.testing.assert_allclose(positions, configuration.points, atol=1e-12)
    np.testing.assert_allclose(
        points.jacobians(configuration).reshape(-1, configuration.nv),
        configuration.point_jacobian(),
        atol=1e-12,
    )


def test_pairs_without_weight_add_nothing_and_the_others_are_those_asked_for() -> None:
    hand = load_hand("allegro_right")
    points = AttachedPoints.reference_points(hand)
    task = PointDistances(points, [(0, 1), (0, 2), (0, 3)], np.zeros(3))
    distances, weights = np.array([0.01, 0.02, 0.03]), np.array([2.0, 0.0, 5.0])
    configuration = hand.configuration()
    configuration.place(hand.configuration_vector(hand.rest))
    aimed = task.aimed_at(distances, weights).linearise(configuration)
    made = PointDistances(points, [(0, 1), (0, 3)], [0.01, 0.03], [2.0, 5.0]).linearise(
        configuration
    )
    np.testing.assert_array_equal(aimed.residual[1], 0.0)
    np.testing.assert_array_equal(aimed.jacobian[1], 0.0)
    for left in ("jacobian", "residual"):
        products = [getattr(rows, left).T @ rows.jacobian for rows in (aimed, made)]
        np.testing.assert_allclose(*products, atol=1e-9)
    np.testing.assert_allclose(aimed.damping, made.damping, atol=1e-12)


def test_costs_of_speed_and_acceleration_smooth_the_way_and_keep_its_end() -> None:
    hand = load_hand("allegro_right")
    start = hand.configuration_vector(hand.rest)
    targets = hand.points(hand.rest + 0.2 * (hand.upper_limits - hand.rest))
    wrist = hand.frame_pose("wrist", hand.rest)
    ways = []
    # A strong rest term, so that directions without effect on the points converge too.
    firm = IkOptions(rest_weight=2.0)
    for options in (firm, firm.replaced(speed_weight=2.0, acceleration_weight=4.0)):
        ik = PointIk(hand, options)
        ik.place(start)
        way = [ik.configuration.q[hand.q_indices]]
        for _ in range(300):
            ik.solve(targets, wrist, 0.01)
            way.append(ik.configuration.q[hand.q_indices])
        ways.append(np.array(way))
    np.testing.assert_allclose(ways[0][-1], ways[1][-1], atol=1e-3)
    rough, smooth = (np.abs(np.diff(way, 2, axis=0)).max() for way in ways)
    assert smooth < 0.6 * rough


@pytest.mark.parametrize("name", ["proxqp", "osqp"])
def test_every_solver_takes_rows(name: str) -> None:
    rng, size = np.random.default_rng(7), 8
    for count in (0, 3, 5):
        A = rng.normal(size=(size, size))
        H, c = A @ A.T + np.eye(size), rng.normal(size=size)
        lower, upper = -np.ones(size), np.ones(size)
        rows = (rng.normal(size=(count, size)), np.full(count, 0.1))
        x = make_solver(name)(H, c, lower, upper, rows)
        exact = solve_by_daqp(H, c, lower, upper, rows)
        assert x is not None
        assert exact is not None
        np.testing.assert_allclose(x, exact, atol=1e-5)


def test_points_in_one_place_are_parted() -> None:
    hand = load_hand("three_finger")
    joint, other = (hand.model.getJointId(f"f{k}_distal") for k in (1, 2))
    configuration = hand.configuration()
    configuration.place(hand.configuration_vector(hand.rest))
    # The second point lies on another finger, where the first one is.
    (place,) = AttachedPoints(hand, [(joint, np.zeros(3))]).positions(configuration)
    data = hand.model.createData()
    pin.forwardKinematics(hand.model, data, hand.configuration_vector(hand.rest))
    points = AttachedPoints(
        hand, [(joint, np.zeros(3)), (other, data.oMi[other].actInv(place))]
    )
    task = PointDistances(points, [(0, 1)], 0.05)
    residual, rows, _ = task.linearise(configuration)
    assert residual[0] == pytest.approx(-5.0)
    assert np.abs(rows).max() > 0.1


class _Twice(PointOffset):
    """An offset with other rows."""

    def linearise(self, hand: Configuration) -> TaskRows:
        rows = super().linearise(hand)
        return TaskRows(2.0 * rows.residual, 2.0 * rows.jacobian)


class _FarTwice(PointDistances):
    """Distances with other rows."""

    def linearise(self, hand: Configuration) -> TaskRows:
        rows = super().linearise(hand)
        return TaskRows(2.0 * rows.residual, 2.0 * rows.jacobian, 4.0 * rows.damping)


@pytest.mark.parametrize("formulation", ["compiled", "direct"])
def test_a_subclass_has_rows_of_its_own(formulation: Any) -> None:
    hand = load_hand("three_finger")
    options = IkOptions(formulation=formulation, max_iterations=1)
    points = AttachedPoints.reference_points(hand)
    places = [*zip(points.joints[:2], points.offsets[:2], strict=True)]
    two = AttachedPoints(hand, places)
    aim = np.array([0.0, 0.05, 0.0])
    pairs = [(0, 1)]
    twins: list[tuple[Any, Any]] = [
        (_Twice(two, aim, 1.0), PointOffset(two, aim, 2.0)),
        (_FarTwice(two, pairs, [0.05]), PointDistances(two, pairs, [0.05], [2.0])),
    ]
    for twin in twins:
        ends = []
        for task in twin:
            ik = PointIk(hand, options)
            ik.place(hand.configuration_vector(hand.rest))
            placed = ik.configuration
            wrist = placed.wrist.homogeneous
            ends.append(ik.solve(placed.points, wrist, 0.1, tasks=[task]).q)
        one, other = ends
        np.testing.assert_allclose(one, other, atol=1e-7)
        # It moves at all.
        assert np.abs(one - hand.configuration_vector(hand.rest)).max() > 1e-3
