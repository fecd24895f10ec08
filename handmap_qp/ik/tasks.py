"""Further terms of the QP's cost: a small protocol, and the distances of pairs of points.

A task adds `|J dq + e|^2 + dq^T diag(d) dq` to the cost, with its weights already multiplied in. Give
tasks of your own to `HandMapper(..., tasks=[...])`:

    class KeepTipUp:
        def linearise(self, hand):
            height = hand.points[0, 2] - 0.05
            return TaskRows(np.array([100.0 * height]), 100.0 * hand.point_jacobian()[2:3])

Lengths count in units of 10 mm (`LENGTH_UNIT`), so a weight of 100 per metre is that of a reference
point. `handmap_qp.ik.mink_tasks.as_mink_task` makes the same task one of mink's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.configuration import Configuration
from handmap_qp.ik.options import LENGTH_UNIT
from handmap_qp.transform import as_floats

_SHORTEST = 1e-9
"""Distance below which two points have no direction from one to the other [m]."""


class TaskRows(NamedTuple):
    """A task at one configuration: `|jacobian dq + residual|^2 + dq^T diag(damping) dq`.

    Attributes:
        residual: Weighted error, value minus target, shape (k,).
        jacobian: Weighted derivative of the error in the active coordinates, shape (k, nv).
        damping: Squared cost of moving each coordinate, shape (nv,) or one number: bounds the step
            where the error is far from linear (Levenberg-Marquardt).
    """

    residual: np.ndarray
    jacobian: np.ndarray
    damping: np.ndarray | float = 0.0


class Task(Protocol):
    """One more term of the QP's cost."""

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return the task's rows at the hand's present configuration.

        Args:
            hand: The robot hand, placed with Jacobians; not to be changed.
        """
        ...


class PointDistances:
    """Keep pairs of reference points at given distances.

    Args:
        pairs: Indices of reference points, p pairs.
        distances: Wanted distance of each pair [m], shape (p,).
        weights: Weight of each pair per 10 mm of error, shape (p,); 1 if omitted.
        damping: Levenberg-Marquardt factor on the curvature that the linearisation neglects.

    Raises:
        InvalidInputError: On wrong shapes, numbers that are not finite, or negative ones.
    """

    __slots__ = ("_damping", "_distances", "_first", "_second", "_weights", "pairs")

    def __init__(
        self,
        pairs: Sequence[tuple[int, int]],
        distances: npt.ArrayLike,
        weights: npt.ArrayLike = 1.0,
        *,
        damping: float = 1.5,
    ) -> None:
        self.pairs = tuple((int(first), int(second)) for first, second in pairs)
        if any(first == second or min(first, second) < 0 for first, second in self.pairs):
            raise InvalidInputError(
                argument="pairs", expected="two different points each", value=self.pairs
            )
        self._first, self._second = np.array(self.pairs, dtype=int).reshape(-1, 2).T
        self._distances = _check_numbers(distances, len(self.pairs), "distances")
        self._weights = _check_numbers(weights, len(self.pairs), "weights") / LENGTH_UNIT
        self._damping = float(_check_numbers(damping, 1, "damping")[0])

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return a row a pair; see `Task.linearise`."""
        offsets = hand.points[self._first] - hand.points[self._second]
        lengths = np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
        # Points in one place have no direction: any will do to part them.
        directions = np.where(
            lengths[:, None] > _SHORTEST, offsets / np.maximum(lengths, _SHORTEST)[:, None], _UP
        )
        jacobian = hand.point_jacobian().reshape(len(hand.points), 3, -1)
        levers = self._weights[:, None, None] * (jacobian[self._first] - jacobian[self._second])
        rows = np.einsum("ij,ijk->ik", directions, levers)
        residual = self._weights * (lengths - self._distances)
        # Per column the norm of the whole lever, which has the row and what is across it.
        columns = np.sqrt(np.einsum("ijk,ijk->ik", levers, levers))
        return TaskRows(residual, rows, self._damping * np.abs(residual).dot(columns))


_UP = np.array([0.0, 0.0, 1.0])


def _check_numbers(values: npt.ArrayLike, count: int, name: str) -> np.ndarray:
    numbers = np.broadcast_to(as_floats(values, name), (count,)) if np.ndim(values) == 0 else None
    array = np.array(as_floats(values, name)) if numbers is None else numbers.copy()
    if array.shape != (count,) or not (np.isfinite(array).all() and (array >= 0.0).all()):
        raise InvalidInputError(
            argument=name, expected=f"{count} finite numbers >= 0, or one for all", value=values
        )
    return array
