"""Closed postures of a linkage, and lines along which its joints follow others.

Constraints leave some joints free to lead; the others follow, each along a curve or a surface. The
postures are found by Newton's method, each from its neighbour; a follower's best line is found by
least squares.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array

Residual = Callable[[Array], tuple[Array, Array]]
"""Residuals of constraints [m or rad], (m,), and their derivatives by n joints, (m, n)."""

# Iterations for each posture, and the residual of a closed one [rad or m].
_ITERATIONS = 20
_CLOSED = 1e-6
# Singular values below this share of the largest count as zero.
_RANK = 1e-4
# Positions of a joint that leads alone; of each of several, and steps on the way to their corners.
_SAMPLES = 41
_OF_SEVERAL = 9
_STEPS = 6
# Halvings of the step in which a way ends.
_HALVINGS = 10
# Most corners of the ranges of several.
_CORNERS = 16
# A follower is this far outside its limits [rad or m] before they bound what it follows.
_OUTSIDE = 1e-4


class Line(NamedTuple):
    """The line along which a joint follows a leader.

    Attributes:
        leader: Index of the leader among those that lead.
        multiplier: Change per unit of the leader's.
        offset: Position at zero of the leader's [rad or m].
        error: Largest distance of a posture from the line [rad or m].
        width: Range of the positions that it takes [rad or m].
    """

    leader: int
    multiplier: float
    offset: float
    error: float
    width: float


class ClosedLoop:
    """The closed postures of a linkage around one of them.

    Args:
        residual: Its constraints.
        start: A posture near a closed one, shape (n,).
        limits: Limits of the joints, infinite without any, shape (2, n).

    Attributes:
        limits: Those limits.
        freedom: How many joints can lead.
        start: The closed posture.
        is_closed: Whether there is one.
    """

    def __init__(self, residual: Residual, start: Array, limits: Array) -> None:
        self._residual = residual
        self.limits = limits
        found = self._close(start, np.full(len(start), True))
        self.is_closed = found is not None
        self.start = start if found is None else found
        self._slopes = residual(self.start)[1]
        self.freedom = 0
        if self.is_closed:
            self.freedom = len(start) - self._rank(np.full(len(start), True))

    def _rank(self, columns: Array) -> int:
        return int(np.linalg.matrix_rank(self._slopes[:, columns], rtol=_RANK))

    def leaders(self, order: Sequence[int]) -> list[int]:
        """Return joints that can lead, the first ones in an order that are independent."""
        rank = self._rank(np.full(len(self.start), True))
        follows = np.full(len(self.start), True)
        for joint in order:
            if len(self.start) - follows.sum() == self.freedom:
                break
            follows[joint] = False
            follows[joint] = self._rank(follows) < rank
        return np.flatnonzero(~follows).tolist()

    def postures(
        self, leaders: Sequence[int], ends: Array, *, is_bounded: bool = True
    ) -> Array:
        """Return closed postures, shape (k, n), with the start.

        A joint that leads alone goes to both ends of its range. Of several, each does, and then all
        together. Where the loop opens, or another joint leaves its limits, the way ends.

        Args:
            leaders: Joints that lead.
            ends: Their ranges, shape (2, f).
            is_bounded: Whether the limits of the others count, too.
        """
        found = [self.start]
        middle = self.start[leaders]
        count = _SAMPLES if len(leaders) == 1 else _OF_SEVERAL
        for k, (low, high) in enumerate(ends.T.tolist()):
            grid = np.linspace(low, high, count)
            for way in (grid[grid > middle[k]], grid[grid < middle[k]][::-1]):
                places = np.tile(middle, (len(way), 1))
                places[:, k] = way
                found += self._along(leaders, places, is_bounded=is_bounded)
        if len(leaders) > 1:
            shares = np.linspace(0.0, 1.0, _STEPS + 1)[1:, None]
            sides = [*product((0, 1), repeat=len(leaders))][:_CORNERS]
            for chosen in sides:
                corner = ends[list(chosen), range(len(leaders))]
                places = middle + shares * (corner - middle)
                found += self._along(leaders, places, is_bounded=is_bounded)
        return np.array(found)

    def _along(
        self, leaders: Sequence[int], places: Array, *, is_bounded: bool
    ) -> Iterator[Array]:
        """Iterate over closed postures along a way of the leaders, to the last that is one."""
        q = self.start
        follows = np.full(len(q), True)
        follows[leaders] = False

        def closed_at(place: Array) -> Array | None:
            near = q.copy()
            near[leaders] = place
            return self._close(near, follows)

        def is_allowed(found: Array) -> bool:
            return not is_bounded or self._is_inside(found, follows)

        for place in places:
            found = closed_at(place)
            if found is None:
                # Just before a loop opens it is nearly singular: no place to come to.
                break
            if not is_allowed(found):
                # A limit is between the last place and this one.
                beyond = place
                for _ in range(_HALVINGS):
                    middle = 0.5 * (q[leaders] + beyond)
                    found = closed_at(middle)
                    if found is not None and is_allowed(found):
                        q = found
                    else:
                        beyond = middle
                yield q
                break
            q = found
            yield q

    def _is_inside(self, q: Array, follows: Array) -> bool:
        low, high = self.limits[:, follows]
        own = q[follows]
        return bool(((own > low - _OUTSIDE) & (own < high + _OUTSIDE)).all())

    def _close(self, q: Array, moves: Array) -> Array | None:
        """Find a posture near another that satisfies the constraints by some joints."""
        q = q.copy()
        for _ in range(_ITERATIONS):
            gap, slopes = self._residual(q)
            # A model with NaN in its numbers, or one that ran away.
            if not (np.isfinite(gap).all() and np.isfinite(slopes).all()):
                return None
            if np.abs(gap).max(initial=0.0) < 1e-6 * _CLOSED:
                break
            q[moves] -= np.linalg.lstsq(slopes[:, moves], gap, rcond=_RANK)[0]
        return q if np.abs(gap).max(initial=0.0) < _CLOSED else None


def best_line(leading: Array, follower: Array) -> Line:
    """Fit a follower's positions, shape (k,), to those of the best of its leaders, (k, f)."""
    lines = []
    for k, positions in enumerate(leading.T):
        powers = np.vander(positions, 2)
        # Digits beyond these are noise of the fit.
        slope, offset = np.linalg.lstsq(powers, follower, rcond=None)[0].round(14)
        error = np.abs(follower - powers @ (slope, offset)).max()
        lines.append((float(error), k, float(slope), float(offset)))
    error, k, slope, offset = min(lines, default=(math.inf, 0, 0.0, 0.0))
    return Line(k, slope, offset, error, float(np.ptp(follower)))
