"""Eq. (8), the baseline that the QP replaces, and the conditions under which both agree."""

from __future__ import annotations

from itertools import islice
from typing import Any

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from ik_cases import (
    HANDS,
    Case,
    box_of,
    each_plain_hand,
    hand_of,
    problem_of,
    random_cases,
)
from pseudoinverse import PseudoinverseIk, weighted_task

from handmap_core.ik.tasks import Goal
from handmap_qp import IkOptions, load_hand
from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.qp import PointIk
from handmap_qp.reference.daqp_solver import solve_by_daqp

PLAIN = IkOptions(error_damping=0.0, has_velocity_limits=False, max_iterations=1)
# Below this singular value of the weighted task a direction counts as lost: eq. (8) takes steps of
# metres and radians there. At 1 the QP's regularisation weighs as much as the task.
WELL_CONDITIONED = 1.0


def smallest_singular_value(hand: Hand, case: Case) -> float:
    """Return the smallest non-zero singular value of the weighted task."""
    ik = PseudoinverseIk(hand, PLAIN)
    ik.place(case.q)
    wrist = None if case.wrist_target is None else pin.SE3(case.wrist_target)
    A, _ = weighted_task(hand, PLAIN, ik.configuration, case.point_targets, wrist)
    regularisation = np.full(A.shape[1], PLAIN.damping**2)
    regularisation[hand.joint_columns] += PLAIN.rest_weight**2
    s = np.linalg.svd(A / np.sqrt(regularisation), compute_uv=False)
    return float(s[s > 1e-8 * s[0]].min())


def well_conditioned_cases(hand: Hand, count: int, seed: int) -> list[Case]:
    """Return up to `count` cases without nearly singular directions; singular ones may occur."""
    cases = random_cases(hand, 60, seed=seed)
    good = (
        case for case in cases if smallest_singular_value(hand, case) > WELL_CONDITIONED
    )
    return list(islice(good, count))


def goal_of(hand: Hand, case: Case, rest: np.ndarray | None = None) -> Goal:
    """Return the targets of a case, with another rest posture than the hand's if given."""
    target = case.wrist_target
    wrists = None if target is None else target[None]
    posture = hand.rest if rest is None else rest
    return Goal(case.point_targets, wrists, posture, ())


def eq_8(
    hand: Hand, case: Case, options: IkOptions = PLAIN, damping: float = 0.0
) -> np.ndarray:
    ik = PseudoinverseIk(hand, options, damping=damping)
    ik.place(case.q)
    return ik.step(goal_of(hand, case))


def slack_qp(hand: Hand, case: Case, options: IkOptions) -> np.ndarray:
    """Return the QP's step with limits too wide to be active."""
    ik = PointIk(hand, options)
    ik.place(case.q)
    H, c, lower, _ = problem_of(ik, case.point_targets, case.wrist_target, case.dt)
    wide = np.full(len(lower), 1e4)
    dq = solve_by_daqp(H, c, -wide, wide)
    assert dq is not None
    return dq


def weakened(options: IkOptions, factor: float) -> IkOptions:
    return options.replaced(
        rest_weight=factor * options.rest_weight, damping=factor * options.damping
    )


@each_plain_hand
def test_eq_8_is_the_qp_without_limits_for_vanishing_damping(
    which: tuple[str, str, str | None],
) -> None:
    hand = hand_of(which)
    cases = well_conditioned_cases(hand, 12, seed=0)
    assert cases
    for case in cases:
        expected = eq_8(hand, case)
        factor = 0.02 * min(smallest_singular_value(hand, case), 3.0)
        near, nearer = (
            slack_qp(hand, case, weakened(PLAIN, part * factor)) for part in (1.0, 0.5)
        )
        size = max(1.0, np.abs(expected).max())
        assert (
            np.abs(nearer - expected).max()
            < 0.3 * np.abs(near - expected).max() + 1e-9 * size
        )
        # The difference is a series in the squared weights. Subtract its first term, because
        # smaller weights would make the Hessian ill-conditioned.
        np.testing.assert_allclose(
            (4.0 * nearer - near) / 3.0, expected, atol=1e-6 * size
        )


@each_plain_hand
def test_damped_least_squares_is_the_qp_without_limits(
    which: tuple[str, str, str | None],
) -> None:
    hand = hand_of(which)
    # Damping by d weighs as much as regularisation d times as strong.
    for case in random_cases(hand, 8, seed=1):
        for damping in (1.0, 0.5):
            np.testing.assert_allclose(
                eq_8(hand, case, damping=damping),
                slack_qp(hand, case, weakened(PLAIN, damping)),
                atol=1e-8,
            )


@each_plain_hand
def test_null_space_motion_does_not_move_the_points(
    which: tuple[str, str, str | None],
) -> None:
    hand = hand_of(which)
    other = hand.rest + 0.3 * (hand.upper_limits - hand.rest)
    for case in well_conditioned_cases(hand, 12, seed=2):
        ik = PseudoinverseIk(hand, PLAIN)
        ik.place(case.q)
        # Two rest postures differ by null-space motion alone.
        there = ik.step(goal_of(hand, case))
        null = ik.step(goal_of(hand, case, other)) - there
        J = ik.configuration.point_jacobian()
        np.testing.assert_allclose(J @ null, 0.0, atol=1e-9)
        if case.wrist_target is not None:
            np.testing.assert_allclose(
                ik.configuration.wrist_jacobian(np.eye(6)) @ null, 0.0, atol=1e-9
            )
        # On the true kinematics too, up to the square of the motion.
        before, size = ik.configuration.points.copy(), 1e-4
        ik.configuration.place(pin.integrate(hand.model, case.q, size * null))
        assert (
            np.abs(ik.configuration.points - before).max()
            <= size**2 * (null @ null) * 1.0 + 1e-12
        )


@pytest.mark.slow
def test_the_qps_rest_term_moves_no_point_either() -> None:
    hand = hand_of(("human", "fixed", "fingertips"))
    moved = 0.0
    for case in well_conditioned_cases(hand, 30, seed=3):
        steps = []
        for rest in (hand.rest, hand.rest + 0.3 * (hand.upper_limits - hand.rest)):
            steps.append(slack_qp(_with_rest(hand, rest), case, weakened(PLAIN, 0.01)))
        configuration = hand.configuration()
        configuration.place(case.q)
        null = steps[1] - steps[0]
        moved = max(moved, np.abs(null).max())
        # 1e-5 m per rad: the effect of the weights (0.01 squared), which vanishes in the limit.
        assert np.abs(configuration.point_jacobian() @ null).max() < 1e-5 * max(
            1.0, np.abs(null).max()
        )
    assert moved > 0.1


def _with_rest(hand: Hand, rest: np.ndarray) -> Hand:
    """Return the same hand with another rest posture."""
    names = dict(zip(hand.joint_names, map(float, rest), strict=True))
    spec = msgspec.structs.replace(hand.spec, rest=names, mirror=False)
    return Hand(
        spec, points=hand.reference_points, mount=hand.mount, urdf_text=hand.urdf_text
    )


def test_plain_steps_ignore_limits_and_clipped_ones_hold_them() -> None:
    hand, options = load_hand("allegro_right"), IkOptions()
    broken = 0
    for case in random_cases(hand, 40, seed=4, is_inside=True):
        plain, clipped = (
            PseudoinverseIk(hand, options),
            PseudoinverseIk(hand, options, limits="clip"),
        )
        lower, upper = box_of(hand, case.q, case.dt)
        for ik in (plain, clipped):
            ik.place(case.q)
            ik.solve(case.point_targets, case.wrist_target, case.dt)
        q = plain.configuration.q[hand.q_indices]
        broken += bool(((q < hand.lower_limits) | (q > hand.upper_limits)).any())
        dq = pin.difference(hand.model, case.q, clipped.configuration.q)[
            hand.active_columns
        ]
        assert (dq <= upper + 1e-9).all()
        assert (dq >= lower - 1e-9).all()
    assert broken > 20


def test_a_plain_sample_is_one_step_of_eq_8() -> None:
    hand, options = load_hand("allegro_right"), IkOptions(max_iterations=1)
    for case in random_cases(hand, 5, seed=6, is_inside=True):
        ik = PseudoinverseIk(hand, options)
        ik.place(case.q)
        expected = ik.step(goal_of(hand, case))
        result = ik.solve(case.point_targets, case.wrist_target, case.dt)
        np.testing.assert_allclose(result.displacement, expected, atol=1e-12)


@pytest.mark.parametrize("damping", [0.0, 1.0])
def test_clipping_costs_more_than_the_qp(damping: float) -> None:
    # The QP's answer is the best inside the box; a clipped step is inside too.
    hand = load_hand("allegro_right")
    options = PLAIN.replaced(has_velocity_limits=True)
    dearer = 0
    for case in random_cases(hand, 40, seed=5, is_inside=True):
        ik = PointIk(hand, options)
        ik.place(case.q)
        H, c, lower, upper = problem_of(
            ik, case.point_targets, case.wrist_target, case.dt
        )
        best = solve_by_daqp(H, c, lower, upper)
        assert best is not None
        clipped = np.clip(eq_8(hand, case, options, damping), lower, upper)
        costs = [0.5 * x @ H @ x + c @ x for x in (best, clipped)]
        assert costs[0] <= costs[1] + 1e-9 * abs(costs[1])
        dearer += costs[1] > costs[0] + 1e-3 * abs(costs[0])
    assert dearer > 10


def test_it_converges_like_the_qp_without_active_limits() -> None:
    hand = load_hand("allegro_right")
    configuration = hand.configuration()
    vector = hand.configuration_vector(hand.rest, np.eye(4))
    configuration.place(vector)
    shift = np.array([0.0, 0.0, 0.01])
    targets, wrist = configuration.points + shift, pin.SE3(np.eye(3), shift).homogeneous
    for ik in (
        PointIk(hand, IkOptions(max_iterations=5)),
        PseudoinverseIk(hand, IkOptions(max_iterations=5), limits="clip"),
    ):
        ik.place(vector)
        assert ik.solve(targets, wrist, 0.1).status == "converged"


def test_an_answer_that_is_none_leaves_the_hand_where_it_was() -> None:
    hand = load_hand("three_finger")
    ik = PseudoinverseIk(hand, IkOptions())
    vector = hand.configuration_vector(hand.rest)
    ik.place(vector)
    result = ik.solve(np.full((3, 3), np.nan), None, 0.01)
    assert result.status == "failed"
    np.testing.assert_array_equal(ik.configuration.q, vector)


def test_holding_moves_nothing() -> None:
    hand = hand_of(HANDS[0])
    ik = PseudoinverseIk(hand, IkOptions())
    vector = hand.configuration_vector(hand.rest, np.eye(4))
    ik.place(vector)
    assert ik.hold(0.01).status == "released"
    np.testing.assert_array_equal(ik.configuration.q, vector)


@pytest.mark.parametrize(
    ("key", "value"), [("damping", -1.0), ("damping", np.nan), ("limits", "wish")]
)
def test_settings_are_checked(key: str, value: Any) -> None:
    with pytest.raises(InvalidOptionsError, match=key):
        PseudoinverseIk(load_hand("three_finger"), IkOptions(), **{key: value})
