"""Whether shapes stay apart on a straight way in joint space, between its ends too.

The distance of a pair changes by at most its `travel` (`handmap_qp.ik.distances`), the sum of
levers times turns. So between two points of the way at which it is `a` and `b`, it is never below

    (a + b - travel) / 2.

Near pairs need more. Let n go from the normal at the one point to that at the other in proportion
to the way, in the axes of the last joint that moves both shapes. Two convex shapes are at least as
far apart as along n, which has no more than unit length. For each two points of theirs, the second
derivative of that is at most `(2 |change of n| + S) travel`, with S the sum of the turns between
the shapes. In those axes n changes by at most its change in the world and the sum C of the turns
that both shapes share. So the distance is never below

    min(a, b) - (2 |change of n in the world| + 2 C + S) travel / 8.

Where that does not suffice, the way is halved, until it does or a point of it is too near.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from handmap_qp.hands.hand import Hand
from handmap_qp.ik.distances import KEPT, NearPairs, ShapeDistances
from handmap_qp.se3 import lengths

_MOST_POINTS = 32
"""Points of a way that are measured, at most; a way that needs more counts as not clear."""


class ClearPath:
    """Checks straight ways of a hand in joint space.

    Args:
        hand: The hand.
        distances: Measures the pairs of shapes that are kept apart.

    Attributes:
        columns: Which active coordinates move the shapes of any pair against each other, shape
            (n,). The others, such as those of a floating wrist, change no distance.
        levers: Bound of the change of each pair's distance per change of each active coordinate
            [m/rad, or 1 for sliding joints], shape (k, n).
    """

    def __init__(self, hand: Hand, distances: ShapeDistances) -> None:
        self._model = hand.model
        self._expansion = None if hand.expansion is None else hand.expansion.matrix
        self._distances, levers = distances, distances.levers
        self.levers = levers if self._expansion is None else levers @ np.abs(self._expansion)
        self.columns: np.ndarray = np.any(self.levers > 0.0, axis=0)
        self._levers = levers
        # By pair: levers, and factors of turns in S + 2 C.
        self._motions = np.stack(
            [levers, distances.relative_turns + 2.0 * distances.common_turns], 1
        )

    def is_clear(
        self,
        q: np.ndarray,
        start: NearPairs,
        displacement: np.ndarray,
        end: NearPairs | None = None,
    ) -> bool:
        """Return whether no pair of shapes touches on a way.

        Pairs that touch at the start already are left out.

        Args:
            q: Pinocchio configuration where it begins, shape (nq,).
            start: The pairs there; those that matter are measured.
            displacement: Displacement in the active coordinates [rad or m], shape (n,).
            end: The pairs where it ends, as measured next; measured if omitted.
        """
        step = displacement if self._expansion is None else self._expansion.dot(displacement)
        way, turns = _Way(self._model, q, step), np.abs(step)
        if end is None:
            end = self._distances.follow_to(way.at(1.0), start, self._levers.dot(turns))
        pairs = end.pairs.compress(end.is_open)
        if not len(pairs):
            return True
        before, after = self._found_at_start(start, way, pairs), end.found.compress(end.is_open, 0)
        kept = np.minimum(before[:, 0], KEPT)
        if np.count_nonzero(after[:, 0] < kept) or np.count_nonzero(kept <= 0.0):
            is_apart = kept > 0.0
            pairs, kept = pairs[is_apart], kept[is_apart]
            before, after = before[is_apart], after[is_apart]
            if (after[:, 0] < kept).any():
                return False
        motion = self._motions.take(pairs, 0).reshape(-1, len(turns)).dot(turns).reshape(-1, 2)
        return self._is_clear_between(way, pairs, (0.0, 1.0), (before, after), motion, kept)

    def _found_at_start(self, start: NearPairs, way: _Way, pairs: np.ndarray) -> np.ndarray:
        """Return distance, normal and first nearest point where a way begins, shape (r, 7)."""
        places, is_known = start.places(pairs)
        if is_known is None:
            return start.found.take(places, 0)
        found, unknown = np.empty((len(pairs), 7)), ~is_known
        found[is_known] = start.found[places[is_known]]
        found[unknown] = self._distances.found_at(way.at(0.0), pairs[unknown])
        return found

    def _is_clear_between(
        self,
        way: _Way,
        pairs: np.ndarray,
        ends: tuple[float, float],
        found: tuple[np.ndarray, np.ndarray],
        motion: np.ndarray,
        kept: np.ndarray,
    ) -> bool:
        """Halve a part of the way until a bound suffices for every pair.

        Args:
            way: The way.
            pairs: Indices of r pairs.
            ends: Where the part begins and ends, in [0, 1].
            found: Distance, normal and first nearest point there, shape (r, 7) each.
            motion: Along this part, travel [m] and turns S + 2 C of each pair [rad], shape (r, 2).
            kept: Distance that each pair keeps where it is measured [m], shape (r,).
        """
        before, after = found
        nearest = np.minimum(before[:, 0], after[:, 0])
        bend = 2.0 * lengths(after[:, 1:4] - before[:, 1:4]) + motion[:, 1]
        is_open = nearest - 0.125 * bend * motion[:, 0] < 0.5 * kept
        if not np.count_nonzero(is_open):
            return True
        if way.points_taken >= _MOST_POINTS:
            return False
        pairs, kept, motion = pairs[is_open], kept[is_open], 0.5 * motion[is_open]
        before, after = before[is_open], after[is_open]
        low, high = ends
        middle = 0.5 * (low + high)
        between = self._distances.found_at(way.at(middle), pairs)
        if np.count_nonzero(between[:, 0] < kept):
            return False
        return self._is_clear_between(
            way, pairs, (low, middle), (before, between), motion, kept
        ) and self._is_clear_between(way, pairs, (middle, high), (between, after), motion, kept)


class _Way:
    """A straight way of the joints; a floating wrist turns and moves evenly with them."""

    __slots__ = ("_model", "_start", "_step", "points_taken")

    def __init__(self, model: pin.Model, start: np.ndarray, step: np.ndarray) -> None:
        self._model, self._start, self._step = model, start, step
        self.points_taken = 0

    def at(self, part: float) -> np.ndarray:
        """Return the configuration after a part of the way, in [0, 1]."""
        self.points_taken += 1
        return pin.integrate(self._model, self._start, part * self._step)
