"""Prepare the estimate of the linear motion T of points, and read its result (eqs. 5-6).

The paper writes eq. (6) as one system of 3 n equations in 12 unknowns. Its rows decouple: all three
rows of `A` share one (n, 3) system, which depends only on the points before the motion.
`MotionEstimator` factors it once per reference configuration; every later sample costs a few small
products, which the compiled core computes. With `ridge = 0` the solution is exactly the paper's.
"""

from __future__ import annotations

import numpy as np

from handmap_core.errors import DegeneratePointsError
from handmap_core.models import EstimatorModel
from handmap_core.se3 import (
    Array,
    ArrayStruct,
    affine,
    frozen,
    lengths,
)

# Below this ratio of smallest to largest singular value, rounding hides whether the points span
# more than a plane (or a line).
_RANK_TOLERANCE = 1e-9
# Below this share of the largest coordinate, the points' spread is rounding error.
_SPREAD_TOLERANCE = 1e-14


class MotionEstimate(ArrayStruct, frozen=True):
    """A motion fitted to point pairs, or one for each of many samples along leading axes.

    T and its residuals are computed on access.

    Attributes:
        linear: Linear part A of T, shape (..., 3, 3).
        centroid_before: Weighted centroid of the points before the motion [m], shape (3,).
        centroid_after: The same after it [m], shape (..., 3).
        centred_before: Points before the motion relative to their centroid [m], shape (n, 3).
        points_after: Points after it [m], shape (..., n, 3).
        singular_values: Of the weighted, centred points before the motion, largest first [m], shape
            (3,). The smallest tells how well the points determine T: a plane has zero.
    """

    linear: Array
    centroid_before: Array
    centroid_after: Array
    centred_before: Array
    points_after: Array
    singular_values: Array

    @property
    def motion(self) -> Array:
        """The homogeneous transformation T, active, shape (..., 4, 4)."""
        return about(self.linear, self.centroid_before, self.centroid_after)

    @property
    def residual_vectors(self) -> Array:
        """`y_k - T x_k` for every point [m], shape (..., n, 3)."""
        after = self.points_after - self.centroid_after[..., None, :]
        return after - self.centred_before @ self.linear.swapaxes(-1, -2)

    @property
    def residual_norms(self) -> Array:
        """Distance of every point from where T takes it [m], shape (..., n)."""
        return lengths(self.residual_vectors)

    def image(self, point: Array) -> Array:
        """Return where T takes a point (3,) [m], shape (..., 3)."""
        return self.linear @ (point - self.centroid_before) + self.centroid_after


class MotionEstimator:
    """Least-squares motion from fixed reference points to where they are now.

    Minimises `sum_k w_k |y_k - A x_k|^2 + ridge s^2 |A - R0|_F^2` over `A`, with `x`, `y` centred
    at their weighted centroids and `s^2 = trace(sum_k w_k x_k x_k^T) / 3`, so that `ridge` has no
    unit.

    Args:
        points: Reference points [m], shape (n, 3).
        weights: Weight of each point, shape (n,); equal if omitted.
        ridge: Pull of `A` towards the prior rotation; 0 is eq. (6) of the paper.
        has_prior: True if every estimate will have a prior rotation, which makes any points
            usable with a ridge.

    Attributes:
        ridge: As given.
        centroid: Weighted centroid of the points [m], shape (3,).
        shares: Weights of the points, which add up to 1, shape (n,).
        centred: Points relative to their centroid [m], shape (n, 3).
        gain: Times a sample's centred points, it gives A^T without the prior, shape (3, n).
        prior_gain: Behind the prior rotation, what it adds to A, shape (3, 3).
        singular_values: As of `MotionEstimate` [m], shape (3,).

    Raises:
        DegeneratePointsError: If the points cannot determine T: with `ridge = 0` unless four or
            more lie off a plane; with a ridge and no given prior unless three or more lie off a
            line.
    """

    def __init__(
        self,
        points: Array,
        *,
        weights: Array | None = None,
        ridge: float = 0.0,
        has_prior: bool = False,
    ) -> None:
        count = len(points)
        shares = np.ones(count) if weights is None else weights / weights.max()
        self.shares = shares / shares.sum()
        self.ridge = ridge
        # Estimates hand these out, so they are write-protected.
        self.centroid = frozen(self.shares @ points)
        self.centred = frozen(points - self.centroid)
        roots = np.sqrt(self.shares * count)
        # The SVD of the points, not of their normal matrix, which would square the condition of
        # points near a plane.
        left, values, right = np.linalg.svd(
            self.centred * roots[:, None], full_matrices=False
        )
        self.singular_values = frozen(np.append(values, np.zeros(3 - len(values))))
        floor = max(
            _RANK_TOLERANCE * values[0], _SPREAD_TOLERANCE * np.abs(points).max()
        )
        self._check_rank(floor, has_prior)
        # Directions in which the points do not spread get no gain: A is the prior there, however
        # small the ridge.
        known = np.where(values > floor, values, 0.0)
        pull = ridge * (values @ values) / 3.0
        gains = known / np.where(known > 0.0, known * known + pull, 1.0)
        # A^T = gain y + prior_gain R0^T, of centred points y
        self.gain = right.T @ (roots[:, None] * left * gains).T
        self.prior_gain = np.eye(3) - (right.T * (known * gains)) @ right

    @classmethod
    def of_model(cls, model: EstimatorModel, singular_values: Array) -> MotionEstimator:
        """Return the estimator that a model was made of.

        Args:
            model: As of `model()`.
            singular_values: The estimator's own.
        """
        estimator = object.__new__(cls)
        estimator.shares = model.shares
        estimator.ridge = model.ridge
        estimator.centroid = model.centroid
        estimator.centred = model.centred
        estimator.gain = model.gain
        estimator.prior_gain = model.prior_gain
        estimator.singular_values = singular_values
        return estimator

    def model(self) -> EstimatorModel:
        """Return what the core estimates by."""
        return EstimatorModel(
            shares=self.shares,
            centroid=self.centroid,
            centred=self.centred,
            gain=self.gain,
            prior_gain=self.prior_gain,
            ridge=self.ridge,
        )

    def _check_rank(self, floor: float, has_prior: bool) -> None:
        _, middle, smallest = self.singular_values
        if self.ridge == 0.0 and not smallest > floor:
            raise DegeneratePointsError(
                "ridge = 0 needs four or more reference points off a plane; "
                "add points or give ridge > 0",
                singular_values=self.singular_values,
            )
        if not has_prior and not middle > floor:
            raise DegeneratePointsError(
                "the reference points lie on a line, so their rotation is unknown; "
                "add points or give a prior rotation",
                singular_values=self.singular_values,
            )

    def estimate_of(
        self, linear: Array, centroid: Array, points_after: Array
    ) -> MotionEstimate:
        """Return the estimate that a linear part and a centroid after the motion belong to."""
        return MotionEstimate(
            linear,
            self.centroid,
            centroid,
            self.centred,
            points_after,
            self.singular_values,
        )


def about(linear: Array, point: Array, image: Array) -> Array:
    """Return the motion `x -> linear (x - point) + image`, shape (..., 4, 4)."""
    return affine(linear, image - linear @ point)
