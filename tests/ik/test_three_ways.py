"""The QP formulated in three ways.

Mink's way on Pinocchio, preallocated arrays, and mink's own tasks on MuJoCo.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import mink
import numpy as np
import pinocchio as pin
import pytest
import qpsolvers
from ik_cases import HANDS, Case, each_kind_of_hand, hand_of, problem_of, random_cases
from oracles.mujoco_ik import MujocoIk

from handmap_core.ik.tasks import Goal
from handmap_qp import IkOptions
from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.qp import PointIk
from handmap_qp.reference.daqp_solver import solve_by_daqp
from handmap_qp.reference.mink_problem import Term, build_problem
from handmap_qp.reference.solvers import solve_problem

ONE_STEP = IkOptions(max_iterations=1)
# All weights differ, so that a wrong one is noticed.
UNEQUAL = IkOptions(
    point_weight=0.7,
    wrist_position_weight=1.3,
    wrist_orientation_weight=2.1,
    rest_weight=0.4,
    damping=0.05,
    error_damping=0.3,
    max_iterations=1,
)
# Active-set methods are exact; the others stop at a tolerance, and interior-point methods reach no
# bound exactly (9e-5 at worst).
ACCURACY = {"daqp": 1e-9, "quadprog": 1e-9, "proxqp": 1e-7, "osqp": 2e-2}
INTERIOR_POINT = 3e-4


def placed(hand: Hand, case: Case, options: IkOptions = ONE_STEP) -> PointIk:
    ik = PointIk(hand, options)
    ik.place(case.q)
    return ik


def way_1(
    ik: PointIk, case: Case, extra_tasks: Sequence[mink.Task] = ()
) -> qpsolvers.Problem:
    target = case.wrist_target
    wrists = None if target is None else target[None]
    goal = Goal(case.point_targets, wrists, ik.hand.rest, ())
    configuration = ik.configuration
    problem = build_problem(ik.gate, configuration, goal, extra_tasks=extra_tasks)
    problem.lb, problem.ub = ik.gate.bounds(case.dt)
    return problem


def way_2(
    ik: PointIk, case: Case
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return problem_of(ik, case.point_targets, case.wrist_target, case.dt)


def step_of(ik: PointIk, case: Case) -> np.ndarray:
    """Return the step of the default formulation in one iteration."""
    ik.solve(case.point_targets, case.wrist_target, case.dt)
    return pin.difference(ik.hand.model, case.q, ik.configuration.q)[
        ik.hand.active_columns
    ]


def relative(actual: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference, relative to the largest number if that is above one."""
    return float(np.abs(actual - expected).max() / max(1.0, np.abs(expected).max()))


@each_kind_of_hand
@pytest.mark.parametrize(
    "options",
    [ONE_STEP, UNEQUAL, ONE_STEP.replaced(points_follow_wrist=True)],
    ids=["default", "unequal", "follow"],
)
def test_ways_1_and_2_pose_the_same_problem(
    which: tuple[str, str, str | None], options: IkOptions
) -> None:
    hand = hand_of(which)
    for case in random_cases(hand, 8):
        ik = placed(hand, case, options)
        problem, (H, c, lower, upper) = way_1(ik, case), way_2(ik, case)
        assert problem.G is None
        assert relative(np.asarray(problem.P), H) < 1e-9
        assert relative(problem.q, c) < 1e-9
        np.testing.assert_allclose([problem.lb, problem.ub], [lower, upper], atol=1e-9)


@each_kind_of_hand
def test_ways_1_and_2_take_the_same_step(which: tuple[str, str, str | None]) -> None:
    hand = hand_of(which)
    for case in random_cases(hand, 20, seed=1):
        ik = placed(hand, case)
        expected = solve_problem(way_1(ik, case))
        assert expected is not None
        np.testing.assert_allclose(step_of(ik, case), expected, atol=5e-9)


@each_kind_of_hand
@pytest.mark.parametrize("acceleration", [None, 30.0])
def test_mink_moves_the_hand_as_the_direct_formulation_does(
    which: tuple[str, str, str | None], acceleration: float | None
) -> None:
    # Every case starts at rest, and goes on with the velocity of the first sample.
    hand = hand_of(which)
    options = IkOptions(
        max_iterations=2,
        step_tolerance=0.0,
        avoids_self_collision=hand.spec.collision is not None,
        max_acceleration=acceleration,
    )
    iks = [
        PointIk(hand, options.replaced(formulation=each)) for each in ("direct", "mink")
    ]
    for case in random_cases(hand, 4, seed=12):
        for ik in iks:
            ik.place(case.q)
        for _ in range(2):
            expected, result = (
                ik.solve(case.point_targets, case.wrist_target, case.dt) for ik in iks
            )
            # GJK ends within 1e-9 m of the distance, so normals agree to about 1e-6.
            displacement = expected.displacement
            np.testing.assert_allclose(result.displacement, displacement, atol=2e-6)
            assert result.status == expected.status


@each_kind_of_hand
def test_way_3_takes_the_same_step(which: tuple[str, str, str | None]) -> None:
    # Inside the limits: outside them mink's stacked limits contradict each other.
    hand = hand_of(which)
    mujoco = MujocoIk(hand, ONE_STEP)
    for case in random_cases(hand, 16, seed=2, is_inside=True):
        ik = placed(hand, case)
        H, c, *_ = way_2(ik, case)
        mujoco.place(case.q)
        problem = mujoco.problem(case.point_targets, case.wrist_target, case.dt)
        assert relative(np.asarray(problem.P), H) < 1e-6
        # Points are rounded to 1e-16 m, and their errors are shrunk before they are weighted.
        assert relative(problem.q, c) < 1e-5
        dq = solve_problem(problem)
        assert dq is not None
        np.testing.assert_allclose(dq, step_of(ik, case), atol=1e-6)


@pytest.mark.parametrize("formulation", ["direct", "mink"])
@pytest.mark.parametrize("solver", qpsolvers.available_solvers)
def test_every_solver_serves_both_formulations(
    solver: str, formulation: Literal["direct", "mink"]
) -> None:
    hand = hand_of(HANDS[0])
    options = IkOptions(max_iterations=1, solver=solver, formulation=formulation)
    for case in random_cases(hand, 6, seed=4):
        expected = step_of(placed(hand, case), case)
        step = step_of(placed(hand, case, options), case)
        np.testing.assert_allclose(
            step, expected, atol=ACCURACY.get(solver, INTERIOR_POINT)
        )


@each_kind_of_hand
def test_every_step_is_optimal(which: tuple[str, str, str | None]) -> None:
    # Karush-Kuhn-Tucker: feasible, no slope where free, and a slope only outwards where at a bound.
    hand = hand_of(which)
    for case in random_cases(hand, 20, seed=5):
        H, c, lower, upper = way_2(placed(hand, case), case)
        x = solve_by_daqp(H, c, lower, upper)
        assert x is not None
        assert (x - upper).max() < 1e-9
        assert (lower - x).max() < 1e-9
        # In units of a displacement: how far the unbounded minimiser along each coordinate is, from
        # inside the box.
        slope = (H @ x + c) / np.diag(H)
        np.testing.assert_allclose(np.clip(x - slope, lower, upper), x, atol=1e-9)


@each_kind_of_hand
def test_tangent_map_takes_steps_from_one_library_to_the_other(
    which: tuple[str, str, str | None],
) -> None:
    hand = hand_of(which)
    mujoco = MujocoIk(hand, ONE_STEP)
    for case in random_cases(hand, 3, seed=6):
        mujoco.place(case.q)
        T = mujoco.tangent_map()
        if not hand.rules:
            np.testing.assert_allclose(T @ T.T, np.eye(len(T)), atol=1e-12)
        dq = 1e-6 * np.random.default_rng(0).normal(size=T.shape[1])
        workspace = hand.configuration()
        workspace.displace(case.q, dq)
        expected = mujoco.qpos(workspace.q)
        configuration = mink.Configuration(mujoco.model, mujoco.qpos(case.q))
        # Both libraries agree to first order; 1e-12 is the square of the step.
        np.testing.assert_allclose(
            configuration.integrate(T @ dq, 1.0), expected, atol=1e-11
        )


def test_stacked_limits_contradict_each_other_where_the_box_does_not() -> None:
    hand = hand_of(HANDS[0])
    mujoco, answered = MujocoIk(hand, ONE_STEP), 0
    for case in random_cases(hand, 40, seed=7):
        lower, upper = way_2(placed(hand, case), case)[2:]
        assert (lower <= upper).all()
        mujoco.place(case.q)
        answered += (
            solve_problem(
                mujoco.problem(case.point_targets, case.wrist_target, case.dt)
            )
            is not None
        )
    assert 0 < answered < 40


def test_a_users_task_joins_the_mink_problem() -> None:
    hand = hand_of(HANDS[0])
    case = next(random_cases(hand, 1))
    ik = placed(hand, case)
    eye = np.eye(hand.model.nv)
    still = Term(np.array([3.0]), np.zeros(len(eye)), eye)
    alone, joined = way_1(ik, case), way_1(ik, case, [still])
    np.testing.assert_allclose(joined.P - alone.P, 9.0 * eye, atol=1e-9)


def test_the_configuration_is_all_that_mink_asks_for() -> None:
    class ThumbStill(mink.Task):
        """A user's task, written for mink alone."""

        def __init__(self, nv: int) -> None:
            super().__init__(cost=np.ones(1))
            self.row = np.eye(1, nv)

        def compute_error(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
            return self.row @ np.ones(configuration.nv)

        def compute_jacobian(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
            return self.row

    hand = hand_of(HANDS[0])
    configuration = hand.configuration()
    problem = mink.build_ik(
        configuration,  # ty: ignore[invalid-argument-type]
        [ThumbStill(hand.model.nv)],
        0.01,
        damping=1.0,
        limits=[],
    )
    dq = solve_problem(problem)
    assert dq is not None
    np.testing.assert_allclose(dq, -0.5 * np.eye(1, hand.model.nv)[0], atol=1e-9)


@pytest.mark.parametrize("formulation", ["direct", "mink"])
def test_an_unknown_solver_is_named(formulation: Literal["direct", "mink"]) -> None:
    options = IkOptions(formulation=formulation, solver="abacus")
    with pytest.raises(InvalidOptionsError, match="abacus"):
        PointIk(hand_of(HANDS[0]), options)


def test_an_unknown_task_is_named() -> None:
    with pytest.raises(InvalidOptionsError, match="juggle"):
        PointIk(hand_of(HANDS[0]), IkOptions(tasks=("juggle",)))
