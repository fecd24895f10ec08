"""`ik.nearest_posture` in numpy, over Pinocchio and DAQP.

    min   f(q) = 1/2 sum_j w_j^2 |p_j(q) - t_j|^2 + 1/2 w_q^2 |q - q_rest|^2
    s.t.  q_min <= q <= q_max

with the palm at rest. Targets may be out of reach, so the Hessian holds the curvature of the
points' paths too: the second derivative of a point by the joints i and j, i nearer to the palm, is
the axis of i times the point's derivative by j. Each step solves a QP with the joint limits.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from handmap_qp.hands import AttachedPoints, Hand, moved_by
from handmap_qp.reference.daqp_solver import solve_by_daqp
from handmap_qp.se3 import Array

_MOST_STEPS = 50
_SMALLEST_STEP = 1e-8  # rad or m
_LEAST_DECREASE = 1e-4
"""Share of the decrease that the slope foretells (Armijo)."""
_SMALLEST_SHARE = 1e-4
"""Least share of a step to try."""
_ROUNDING = 1.0 + 1e-14
"""Near the minimum, values differ by less than their rounding."""
_LEAST_CURVATURE = 1e-6
"""Least eigenvalue of the Hessian over its largest; smaller ones are turned or lifted."""


def nearest_posture(
    hand: Hand, targets: Array, costs: Array, rest_cost: float, start: Array
) -> Array:
    """Return the joint positions that bring a hand's points nearest to their targets.

    Joints that move the wrist (those of an arm) stay as in the rest posture.

    Args:
        hand: The hand.
        targets: Targets of its reference points, its wrist being where it is in the rest posture
            with the identity as wrist pose [m], shape (m, 3).
        costs: Cost of each point's error [1/m], shape (m,).
        rest_cost: Cost of leaving the rest posture [1/rad or 1/m].
        start: Joint positions to begin at, shape (n,); of several minima, the one nearby is found.

    Returns:
        Joint positions inside their limits [rad or m], shape (n,).
    """
    lower, upper = hand.limits
    terms_at = distance(hand, targets, costs, rest_cost)
    q = np.where(hand.moves_wrist, hand.rest, np.clip(start, lower, upper))
    here = terms_at(q)
    for _ in range(_MOST_STEPS):
        step = solve_by_daqp(_convex(here.hessian), here.gradient, lower - q, upper - q)
        if step is None:
            break
        slope = step @ here.gradient
        share = 1.0
        while True:
            ahead = np.clip(q + share * step, lower, upper)
            there = terms_at(ahead)
            most = _ROUNDING * here.value + _LEAST_DECREASE * share * slope
            if there.value <= most:
                break
            share *= 0.5
            if share < _SMALLEST_SHARE:
                return q
        length = np.abs(ahead - q).max()
        q = ahead
        here = there
        if length < _SMALLEST_STEP:
            break
    return q


class _Terms(NamedTuple):
    """Value, gradient (n,) and Hessian (n, n) of f."""

    value: float
    gradient: Array
    hessian: Array


def distance(
    hand: Hand, targets: Array, costs: Array, rest_cost: float
) -> Callable[[Array], _Terms]:
    """Return f by joint positions (n,); arguments are as of `nearest_posture`."""
    placed = hand.configuration()
    points = AttachedPoints.reference_points(hand)
    # From the joints to the model's tangent space. Those that move the wrist do not count.
    spread = hand.joint_motion * ~hand.moves_wrist
    # For each coordinate of the model, those that it carries.
    model = hand.model
    carriers = np.repeat(np.arange(model.njoints), model.nvs)
    is_ancestor = moved_by(model, carriers.tolist()).T

    def terms_at(q: Array) -> _Terms:
        away = q - hand.rest
        placed.place(hand.configuration_vector(q))
        errors = placed.points - targets
        forces = costs[:, None] ** 2 * errors
        levers = points.velocities(placed)
        rows = levers.reshape(forces.size, -1)
        # S_ij = axis_i . sum_k (J_kj x force_k), for i an ancestor of j or j itself.
        turning = np.cross(levers, forces[:, :, None], axis=1).sum(axis=0)
        curvature = placed.data.J[3:].T.dot(turning) * is_ancestor
        full = rows.T.dot(np.repeat(costs**2, 3)[:, None] * rows)
        full += curvature + np.triu(curvature, 1).T
        hessian = spread.T.dot(full).dot(spread) + rest_cost**2 * np.eye(len(q))
        gradient = forces.reshape(-1).dot(rows).dot(spread) + rest_cost**2 * away
        value = 0.5 * ((forces * errors).sum() + rest_cost**2 * away.dot(away))
        return _Terms(value, gradient, hessian)

    return terms_at


def _convex(hessian: Array) -> Array:
    """Return a matrix with positive eigenvalues, so that every step leads downhill."""
    values, vectors = np.linalg.eigh(hessian)
    if values[0] > 0.0:
        return hessian
    sizes = np.abs(values)
    return (vectors * sizes.clip(_LEAST_CURVATURE * sizes.max())).dot(vectors.T)
