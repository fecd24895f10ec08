"""Estimate the linear motion T that carries one set of points to another (eqs. 5-6).

The paper writes eq. (6) as one system of 3 n equations in 12 unknowns. Its rows decouple: all three
rows of `A` share one (n, 3) system, which depends only on the points before the motion.
`MotionEstimator` factors it once per reference configuration; every later sample costs a few small
products. With `ridge = 0` the solution is exactly the paper's.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from handmap_qp.errors import DegeneratePointsError, InvalidInputError
from handmap_qp.transform import (
    affine,
    as_floats,
    determinant,
    frozen,
    nearest_rotation,
    nearest_rotations,
)

# Below this ratio of smallest to largest singular value, rounding hides whether the points span
# more than a plane (or a line).
_RANK_TOLERANCE = 1e-9
# Below this share of the largest coordinate, the points' spread is rounding error.
_SPREAD_TOLERANCE = 1e-14


class MotionEstimate(msgspec.Struct, frozen=True, eq=False):
    """A motion fitted to point pairs; T and its residuals are computed on first access.

    Attributes:
        linear: Linear part A of T, shape (3, 3).
        centroid_before: Weighted centroid of the points before the motion [m], shape (3,).
        centroid_after: The same after it [m], shape (3,).
        centred_before: Points before the motion relative to their centroid [m], shape (n, 3).
        centred_after: The same after it [m], shape (n, 3).
        singular_values: Of the weighted, centred points before the motion, largest first [m], shape
            (3,). The smallest tells how well the points determine T: a plane has zero.
    """

    linear: np.ndarray
    centroid_before: np.ndarray
    centroid_after: np.ndarray
    centred_before: np.ndarray
    centred_after: np.ndarray
    singular_values: np.ndarray

    @property
    def motion(self) -> np.ndarray:
        """The homogeneous transformation T, active, shape (4, 4)."""
        return affine(self.linear, self.image(_ORIGIN))

    @property
    def residual_vectors(self) -> np.ndarray:
        """`y_k - T x_k` for every point [m], shape (n, 3)."""
        return self.centred_after - self.centred_before.dot(self.linear.T)

    @property
    def residual_norms(self) -> np.ndarray:
        """Distance of every point from where T takes it [m], shape (n,)."""
        return np.linalg.norm(self.residual_vectors, axis=1)

    def image(self, point: np.ndarray) -> np.ndarray:
        """Return where T takes a point [m], shape (3,)."""
        if point is self.centroid_before:
            return self.centroid_after
        return self.linear.dot(point - self.centroid_before) + self.centroid_after


_ORIGIN = np.zeros(3)


class MotionColumns(NamedTuple):
    """Motions fitted in many samples.

    Attributes:
        linear: Linear parts, shape (T, 3, 3).
        centroids: Centroids of the points after the motion [m], shape (T, 3).
        estimates: The estimate of each sample; they share these arrays.
    """

    linear: np.ndarray
    centroids: np.ndarray
    estimates: list[MotionEstimate]


class MotionEstimator:
    """Least-squares motion from fixed reference points to where they are now.

    Minimises `sum_k w_k |y_k - A x_k|^2 + ridge s^2 |A - R0|_F^2` over `A`, with `x`, `y` centred
    at their weighted centroids and `s^2 = trace(sum_k w_k x_k x_k^T) / 3`, so that `ridge` has no
    unit.

    Args:
        points_before: Reference points [m], shape (n, 3).
        weights: Weight of each point, shape (n,); equal if omitted.
        ridge: Pull of `A` towards the prior rotation; 0 is eq. (6) of the paper.
        has_prior: True if `estimate` will always be given a prior rotation, which makes any points
            usable with a ridge.

    Raises:
        InvalidInputError: On wrong shapes, non-finite numbers, negative weights or ridge.
        DegeneratePointsError: If the points cannot determine T: with `ridge = 0` unless four or
            more lie off a plane; with a ridge and no given prior unless three or more lie off a
            line.
    """

    def __init__(
        self,
        points_before: npt.ArrayLike,
        *,
        weights: npt.ArrayLike | None = None,
        ridge: float = 0.0,
        has_prior: bool = False,
    ) -> None:
        points = _check_points(points_before, "points_before")
        self.weights = _check_weights(weights, len(points))
        self.ridge = _check_ridge(ridge)
        # Estimates hand both out, so they are write-protected.
        self.centroid = frozen(self.weights @ points)
        self._centred = frozen(points - self.centroid)
        self._weighted = self._centred * self.weights[:, None]
        roots = np.sqrt(self.weights * len(points))
        # The SVD of the points, not of their normal matrix, which would square the condition of
        # points near a plane.
        left, values, right = np.linalg.svd(self._centred * roots[:, None], full_matrices=False)
        self.singular_values = np.zeros(3)
        self.singular_values[: len(values)] = values
        frozen(self.singular_values)
        floor = max(_RANK_TOLERANCE * values[0], _SPREAD_TOLERANCE * np.abs(points).max())
        self._check_rank(floor, has_prior)
        # Directions in which the points do not spread get no gain: A is the prior there, however
        # small the ridge.
        known = np.where(values > floor, values, 0.0)
        pull = self.ridge * (values @ values) / 3.0
        gains = np.divide(known, known * known + pull, out=np.zeros_like(known), where=known > 0.0)
        # (n, 3) and (3, 3): A = y^T gain + R0 prior_gain
        self._gain = np.ascontiguousarray((roots[:, None] * left * gains) @ right)
        self._prior_gain = np.eye(3) - (right.T * (known * gains)) @ right
        # One product gives both sums of a sample: the one with the gain, and Kabsch's covariance.
        self._moments = np.hstack([self._gain, self._weighted])
        # Centres a sample in a third of the time of a subtraction from every row.
        self._centring = np.eye(len(points)) - self.weights

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

    def estimate(self, points_after: np.ndarray, prior: np.ndarray | None = None) -> MotionEstimate:
        """Fit the motion to the points' present positions.

        Args:
            points_after: The same points now [m], shape (n, 3), finite; not checked here.
            prior: Prior rotation R0, shape (3, 3); the weighted Kabsch fit of the points if
                omitted.

        Returns:
            The estimate.
        """
        # `dot` takes half the time of `@` on arrays this small.
        centroid_after = self.weights.dot(points_after)
        after = self._centring.dot(points_after)
        moments = after.T.dot(self._moments)
        linear = moments[:, :3]
        if self.ridge != 0.0:
            rotation = nearest_rotation(moments[:, 3:]) if prior is None else prior
            linear = linear + rotation.dot(self._prior_gain)
        return MotionEstimate(
            linear, self.centroid, centroid_after, self._centred, after, self.singular_values
        )

    def estimate_all(self, points_after: np.ndarray) -> MotionColumns:
        """Fit the motion to the points' positions in many samples, as `estimate` up to rounding.

        Args:
            points_after: The same points in every sample [m], shape (T, n, 3), finite.
        """
        centroids = self.weights @ points_after
        after = self._centring @ points_after
        moments = after.transpose(0, 2, 1) @ self._moments
        linear = moments[:, :, :3]
        if self.ridge != 0.0:
            linear = linear + nearest_rotations(moments[:, :, 3:]) @ self._prior_gain
        columns = zip(linear, centroids, after, strict=True)
        estimates = [
            MotionEstimate(
                motion, self.centroid, centroid, self._centred, centred, self.singular_values
            )
            for motion, centroid, centred in columns
        ]
        return MotionColumns(linear, centroids, estimates)


def estimate_motion(
    points_before: npt.ArrayLike,
    points_after: npt.ArrayLike,
    *,
    weights: npt.ArrayLike | None = None,
    ridge: float = 0.0,
    prior: npt.ArrayLike | None = None,
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
    estimator = MotionEstimator(
        points_before, weights=weights, ridge=ridge, has_prior=prior is not None
    )
    after = _check_points(points_after, "points_after")
    if len(after) != len(estimator.weights):
        raise InvalidInputError(
            argument="points_after",
            expected=f"{len(estimator.weights)} points as in points_before",
            got=f"{len(after)}",
        )
    if prior is None:
        return estimator.estimate(after)
    rotation = as_floats(prior, "prior")
    is_orthogonal = (
        rotation.shape == (3, 3) and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6
    )
    if not (is_orthogonal and determinant(rotation) > 0.0):
        raise InvalidInputError(
            argument="prior", expected="a rotation of shape (3, 3)", value=prior
        )
    return estimator.estimate(after, rotation)


def _check_points(points: npt.ArrayLike, name: str) -> np.ndarray:
    array = as_floats(points, name)
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise InvalidInputError(
            argument=name, expected="shape (n, 3) with n >= 1", got=f"{array.shape}"
        )
    if not np.isfinite(array).all():
        raise InvalidInputError(argument=name, expected="finite numbers", value=array.tolist())
    return array


def _check_weights(weights: npt.ArrayLike | None, count: int) -> np.ndarray:
    if weights is None:
        return np.full(count, 1.0 / count)
    array = as_floats(weights, "weights")
    if array.shape != (count,) or not (
        np.isfinite(array).all() and (array >= 0.0).all() and array.max() > 0.0
    ):
        raise InvalidInputError(
            argument="weights", expected=f"{count} numbers >= 0, not all zero", value=weights
        )
    shares = array / array.max()  # first, so that the sum of huge weights cannot overflow
    return shares / shares.sum()


def _check_ridge(ridge: float) -> float:
    number = as_floats(ridge, "ridge")
    if number.shape != () or not (np.isfinite(number) and number >= 0.0):
        raise InvalidInputError(argument="ridge", expected="a number >= 0", value=ridge)
    return float(number)
