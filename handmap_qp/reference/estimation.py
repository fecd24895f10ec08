"""Estimate the linear motion T that carries one set of points to another (eqs. 5-6).

    min_A  sum_k w_k |y_k - A x_k|^2 + ridge s^2 |A - R0|_F^2

`x` and `y` are the points before and after the motion, from their weighted centroids.
`MotionEstimator` has the rest of the formula, and what of it does not depend on `y`.
"""

from __future__ import annotations

from numpy.typing import ArrayLike

from handmap_core.errors import expect
from handmap_core.se3 import (
    Array,
    affine,
    as_floats,
    as_points,
    check_pose,
    nearest_rotation,
)
from handmap_qp.mapping import MotionEstimate, MotionEstimator


def estimate(
    estimator: MotionEstimator, points_after: Array, prior: Array | None = None
) -> MotionEstimate:
    """Fit the motion to the points' present positions.

    Args:
        estimator: What is known of the points before the motion.
        points_after: The same points now [m], shape (..., n, 3), finite.
        prior: Prior rotation R0, shape (..., 3, 3); the weighted Kabsch fit of the points if
            omitted.

    Returns:
        The estimate.
    """
    centroid = estimator.shares @ points_after
    centred = points_after - centroid[..., None, :]
    linear = (estimator.gain @ centred).mT
    if estimator.ridge != 0.0:
        if prior is None:
            covariance = (estimator.centred.T * estimator.shares) @ centred
            prior = nearest_rotation(covariance.mT)
        linear = linear + prior @ estimator.prior_gain
    return estimator.estimate_of(linear, centroid, points_after)


def estimate_motion(
    points_before: ArrayLike,
    points_after: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    ridge: float = 0.0,
    prior: ArrayLike | None = None,
) -> MotionEstimate:
    """Estimate the linear motion T with `points_after = T points_before`.

    Eqs. (5)-(6), weighted, with an optional ridge.

    Args:
        points_before: Reference points before the motion [m], shape (n, 3).
        points_after: The same points after it [m], shape (n, 3).
        weights: Weight of each point, shape (n,); equal if omitted.
        ridge: Pull towards the prior rotation, without unit; 0 is eq. (6) of the paper, 0.1 suits
            fingertips.
        prior: Prior rotation, shape (3, 3); the Kabsch fit of the same points if omitted.

    Returns:
        The motion with its fit residuals and the singular values of the points.

    Raises:
        InvalidInputError: On wrong shapes or non-finite numbers.
        DegeneratePointsError: If the points cannot determine T; carries the singular values.
    """
    before = as_points(points_before, "points_before")
    after = as_points(points_after, "points_after")
    expected = f"{len(before)} points as in points_before"
    is_same = len(after) == len(before)
    expect(is_same, "points_after", expected, got=f"{len(after)}")
    shares = None
    if weights is not None:
        shares = as_floats(weights, "weights", shape=(len(before),), is_finite=True)
        is_usable = shares.min() >= 0.0 and shares.max() > 0.0
        expected = f"{len(before)} numbers >= 0, not all zero"
        expect(is_usable, "weights", expected, value=weights)
    pull = float(as_floats(ridge, "ridge", shape=(), is_finite=True))
    expect(pull >= 0.0, "ridge", "a number >= 0", value=ridge)
    estimator = MotionEstimator(
        before, weights=shares, ridge=pull, has_prior=prior is not None
    )
    if prior is None:
        return estimate(estimator, after)
    turn = affine(as_floats(prior, "prior", shape=(3, 3)))
    return estimate(estimator, after, check_pose(turn, "prior")[:3, :3])
