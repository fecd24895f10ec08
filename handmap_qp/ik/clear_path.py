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
from handmap_qp.ik.distances import Gaps, NearPairs, ShapeDistances
from handmap_qp.transform import lengths

_KEPT = 2e-4
"""Pairs do not come nearer than this, or than they are at the start, where a way is measured; and
not nearer than half of it between [m]."""
_MOST_POINTS = 32
"""Points of a way that are measured, at most; a way that needs more counts as not clear."""


class ClearPath:
    """Checks straight ways of a hand in joint space.

    Args:
        hand: The hand.
        distances: Measures the pairs of shapes that are kept apart.

    Attributes:
        columns: Which active coordinates move the shapes of any pair against each other, shape
            (k,). The others, such as those of a floating wrist, change no distance.
    """

    def __init__(self, hand: Hand, distances: ShapeDistances) -> None:
        self._model = hand.model
        self._expansion = None if hand.expansion is None else hand.expansion.matrix
        self._distances, levers = distances, distances.levers
        active = levers if self._expansion is None else levers @ np.abs(self._expansion)
        self.columns: np.ndarray = np.any(active > 0.0, axis=0)
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
            start: The pairs there.
            displacement: Displacement in the active coordinates [rad or m], shape (n,).
            end: The pairs where it ends; measured where they matter if omitted.
        """
        step = displacement if self._expansion is None else self._expansion.dot(displacement)
        turns = np.abs(step)
        travel = self._levers.dot(turns)
        way = _Way(self._model, q, step)
        if end is None:
            end = self._distances.bound_at(way.at(1.0), start.bounds - travel)
        # What travel leaves open, of pairs that are apart at the start.
        open_ = ((start.bounds + end.bounds < travel + _KEPT) & (start.bounds > 0.0)).nonzero()[0]
        if not len(open_):
            return True
        after = self._gaps(end, way, 1.0, open_)
        # A pair that was only bounded may be closed now that it is measured.
        pairs = open_[start.bounds[open_] + after.distances < travel[open_] + _KEPT]
        if not len(pairs):
            return True
        before, after = self._gaps(start, way, 0.0, pairs), end.gaps(pairs)
        kept = np.minimum(before.distances, _KEPT)
        if (after.distances < kept).any():
            return False
        motion = self._motions[pairs].dot(turns)
        return self._is_clear_between(way, pairs, (0.0, 1.0), (before, after), motion, kept)

    def _gaps(self, known: NearPairs, way: _Way, part: float, pairs: np.ndarray) -> Gaps:
        """Return some pairs at a point of a way; measure those that are not known there."""
        unknown = pairs[~known.is_measured[pairs]]
        if len(unknown):
            known.add(unknown, self._distances.results_at(way.at(part), unknown))
        return known.gaps(pairs)

    def _is_clear_between(
        self,
        way: _Way,
        pairs: np.ndarray,
        ends: tuple[float, float],
        gaps: tuple[Gaps, Gaps],
        motion: np.ndarray,
        kept: np.ndarray,
    ) -> bool:
        """Halve a part of the way until a bound suffices for every pair.

        Args:
            way: The way.
            pairs: Indices of r pairs.
            ends: Where the part begins and ends, in [0, 1].
            gaps: Of these pairs there.
            motion: Along this part, travel [m] and turns S + 2 C of each pair [rad], shape (r, 2).
            kept: Distance that each pair keeps where it is measured [m], shape (r,).
        """
        before, after = gaps
        nearest = np.minimum(before.distances, after.distances)
        bend = 2.0 * lengths(after.normals - before.normals) + motion[:, 1]
        is_open = nearest - 0.125 * bend * motion[:, 0] < 0.5 * kept
        if not is_open.any():
            return True
        if way.points_taken >= _MOST_POINTS:
            return False
        pairs, kept, motion = pairs[is_open], kept[is_open], 0.5 * motion[is_open]
        before, after = (Gaps(*(values[is_open] for values in gap)) for gap in gaps)
        low, high = ends
        middle = 0.5 * (low + high)
        between = self._distances.gaps_at(way.at(middle), pairs)
        if (between.distances < kept).any():
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
