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

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.hands.hand import Hand
from handmap_qp.ik.distances import NearPairs, ShapeDistances
from handmap_qp.transform import lengths

_KEPT = 2e-4
"""Pairs do not come nearer than this, or than they are at the start, where a way is measured; and
not nearer than half of it between [m]."""
_MOST_POINTS = 32
"""Points of a way that are measured, at most; a way that needs more counts as not clear."""


class End(NamedTuple):
    """Where a way ends.

    Attributes:
        near: The pairs of shapes there.
        open_below: Below which distance there the way is not clear by travel alone [m], shape (k,);
            pairs that may be nearer are measured.
    """

    near: NearPairs
    open_below: np.ndarray


def open_below(start: NearPairs, travel: np.ndarray) -> np.ndarray:
    """Return `End.open_below`.

    Args:
        start: The pairs where the way begins.
        travel: By how much each distance changes on it at most [m], shape (k,).
    """
    return travel - start.bounds + _KEPT


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
        end: End | None = None,
    ) -> bool:
        """Return whether no pair of shapes touches on a way.

        Pairs that touch at the start already are left out.

        Args:
            q: Pinocchio configuration where it begins, shape (nq,).
            start: The pairs there; those that matter are measured.
            displacement: Displacement in the active coordinates [rad or m], shape (n,).
            end: Where it ends; measured where it matters if omitted.
        """
        step = displacement if self._expansion is None else self._expansion.dot(displacement)
        way, turns = _Way(self._model, q, step), np.abs(step)
        near, below = self._end(start, way, turns) if end is None else end
        is_open = near.distances < below.take(near.pairs)
        if not is_open.any():
            return True
        pairs, after = near.pairs.compress(is_open), near.found.compress(is_open, 0)
        before = self._found_at_start(start, way, pairs)
        is_apart = before[:, 0] > 0.0
        if not is_apart.all():
            pairs, after, before = pairs[is_apart], after[is_apart], before[is_apart]
        kept = np.minimum(before[:, 0], _KEPT)
        if (after[:, 0] < kept).any():
            return False
        motion = self._motions.take(pairs, 0).dot(turns)
        return self._is_clear_between(way, pairs, (0.0, 1.0), (before, after), motion, kept)

    def _end(self, start: NearPairs, way: _Way, turns: np.ndarray) -> End:
        """Measure the end of a way where it matters."""
        travel = self._levers.dot(turns)
        below = open_below(start, travel)
        near = self._distances.measure_at(way.at(1.0), start.bounds - travel, below)
        return End(near, below)

    def _found_at_start(self, start: NearPairs, way: _Way, pairs: np.ndarray) -> np.ndarray:
        """Return distance, normal and first nearest point where a way begins, shape (r, 7)."""
        places, is_known = start.find(pairs)
        if is_known.all():
            return start.found.take(places, 0)
        found = np.empty((len(pairs), 7))
        found[is_known] = start.found[places[is_known]]
        found[~is_known] = self._distances.found_at(way.at(0.0), pairs[~is_known])
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
        if not is_open.any():
            return True
        if way.points_taken >= _MOST_POINTS:
            return False
        pairs, kept, motion = pairs[is_open], kept[is_open], 0.5 * motion[is_open]
        before, after = before[is_open], after[is_open]
        low, high = ends
        middle = 0.5 * (low + high)
        between = self._distances.found_at(way.at(middle), pairs)
        if (between[:, 0] < kept).any():
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
