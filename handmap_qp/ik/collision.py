"""Self-collision avoidance: rows of the QP from coal's distances between collision shapes.

Meshes count as their convex hulls.

For a pair of shapes a, b at the signed distance d, with the unit normal n from a to b,

    d(q + dq) ~ d + n^T (J_b - J_a) dq >= margin

becomes

    -n^T (J_b - J_a) dq <= gain (d - margin)

with J_a and J_b the Jacobians of the nearest points. Both lie on one line along n, so the wrench
(n, p x n) of either does for both. The first order is an approximation: a shape that turns by an
angle x at a radius r may come r x^2 / 2 closer than the row says. The margin is for that, and
`handmap_qp.ik.gate` checks the whole displacement afterwards.

Rows are linearised where a sample starts, and hold for its whole displacement: a later iteration of
the QP has what the ones before it left. So distances are measured once a sample, where it ends, for
the check and for the rows of the next one. Where there is a horizon, a pair is measured if another
step like the last one may bring it to its margin, or if its path is not clear by travel alone.
"""

from __future__ import annotations

import numpy as np

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.configuration import Configuration, moved_by
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs, named_pairs
from handmap_qp.ik.distances import KEPT, NearPairs, ShapeDistances
from handmap_qp.ik.limits import clip
from handmap_qp.ik.solvers import Rows

_YZX, _ZXY = [1, 2, 0], [2, 0, 1]
# Part of the free distance that one step may use.
_GAIN = 0.85
# Where there is a horizon, pairs get rows that may be within their margin, this distance [m], and
# what links approach each other by in a sample at this speed [m/s].
_NEAR, _APPROACH = 0.001, 0.5
# They approach by no more than this part of their travel in the last sample.
_EXPECTED = 0.25
# Pairs that are nearer than their margin by less than this need not part [m].
_ROUGHLY = 2e-5
# Share of their excess by which pairs part in a sample. All of it makes links oscillate that are
# pressed together.
_PARTED = 0.3
# Pairs whose distance changes by less than this part slowly [m/rad]: all of the box would part them
# by a few um, and the fingers would jump.
_LEVER = 0.015
# Parting takes this share of the box at most. All of it may leave nothing but its corner, which
# DAQP reports as infeasible.
_INSIDE = 0.9


class CollisionLimit:
    """Rows that keep pairs of collision shapes apart.

    Args:
        hand: The hand.
        pairs: The pairs to keep apart; those that the hand's description names if omitted.
        horizon: Pairs that are farther apart than their margin and this get no row [m]; in short
            samples the horizon is nearer, as links do not come that far. Infinite by default: every
            pair has a row, in an order that never changes.

    Attributes:
        pairs: The links of each pair; a link with several shapes has several.
        margin: Distance to keep [m].
        columns: Which active coordinates move the shapes of any pair against each other, shape
            (n,). The others, such as those of a floating wrist, change no distance.

    Raises:
        InvalidOptionsError: If the hand names no pairs.
        HandError: If a link does not exist or has no collision shape, or a shape cannot be read.
    """

    def __init__(
        self, hand: Hand, *, pairs: ShapePairs | None = None, horizon: float = np.inf
    ) -> None:
        spec = hand.spec.collision
        if pairs is None and spec is None:
            raise InvalidOptionsError(
                option="avoids_self_collision",
                problem=f"{hand.name} names no links to keep apart",
                advice="add collision.pairs to its hand.yaml",
            )
        self.margin = spec.margin if spec else 0.0
        found = named_pairs(hand) if pairs is None else pairs
        self.pairs, self._horizon = found.links, horizon
        self._expansion = None if hand.expansion is None else hand.expansion.matrix
        self._distances = ShapeDistances(hand.model, found.geometry)
        levers = self._distances.levers
        if self._expansion is not None:
            levers = levers @ np.abs(self._expansion)
        self.columns: np.ndarray = np.any(levers > 0.0, axis=0)
        pairs_of, shapes = found.geometry.collisionPairs, found.geometry.geometryObjects
        supports = moved_by(hand.model, [shape.parentJoint for shape in shapes])
        first, second = (
            [getattr(pair, end) for pair in pairs_of] for end in ("first", "second")
        )
        self._opposing_support = supports[first] - supports[second]

    def distances(self, configuration: Configuration) -> np.ndarray:
        """Return signed distances of all pairs [m], negative where shapes overlap, shape (k,).

        Args:
            configuration: Of the hand, placed.
        """
        return self._distances.measure(configuration.q).bounds

    def measure(
        self,
        q: np.ndarray,
        dt: float = np.inf,
        margins: np.ndarray | None = None,
        *,
        before: NearPairs | None = None,
        after_step: bool = False,
    ) -> NearPairs:
        """Measure the pairs that get rows, and those that may have touched since another posture.

        Args:
            q: Pinocchio configuration, shape (nq,).
            dt: Time of the sample [s], in which links approach each other.
            margins: Distance that each of all pairs keeps [m], shape (k,); `margin` if omitted.
            before: What is known in another posture; nothing if omitted.
            after_step: Whether `q` ends a sample that began at `before`, and the next one is
                expected to move as far.
        """
        reach = np.inf if self._horizon == np.inf else _NEAR + _APPROACH * dt
        reach, bounds = max(min(reach, self._horizon), KEPT), -np.inf
        if before is not None:
            travel = self._distances.travel(before.q, q)
            bounds = before.bounds - travel
            if after_step and reach < np.inf:
                reach = np.minimum(_NEAR + _EXPECTED * travel, reach)
        horizon = (self.margin if margins is None else margins) + reach
        return self._distances.measure(q, bounds, horizon, is_path=after_step)

    def is_clear(
        self, start: NearPairs, displacement: np.ndarray, end: NearPairs | None = None
    ) -> bool:
        """Return whether no pair of shapes touches on a straight path.

        Args:
            start: The pairs where it begins.
            displacement: Displacement in the active coordinates [rad or m], shape (n,).
            end: The pairs where it ends, as measured next; measured if omitted.
        """
        step = (
            displacement
            if self._expansion is None
            else self._expansion.dot(displacement)
        )
        return self._distances.is_clear(start, step, end)

    def rows(
        self,
        configuration: Configuration,
        near: NearPairs,
        margins: np.ndarray | None = None,
    ) -> Rows:
        """Linearise the distances of the measured pairs as rows `G dq <= h`.

        Args:
            configuration: Of the hand, placed with Jacobians.
            near: What `measure` found there.
            margins: Distance that each of all pairs keeps [m], shape (k,); `margin` if omitted.

        Returns:
            G, shape (r, n) over the active coordinates; h [m], shape (r,), negative where a pair is
            nearer than the margin.
        """
        pairs = near.pairs
        normals, points = near.found[pairs, 1:4], near.found[pairs, 4:]
        # np.cross takes five times as long.
        moments = (
            points[:, _YZX] * normals[:, _ZXY] - points[:, _ZXY] * normals[:, _YZX]
        )
        wrenches = np.hstack([normals, moments])
        G = self._opposing_support[pairs] * wrenches.dot(configuration.joint_jacobian())
        kept = self.margin if margins is None else margins[pairs]
        return configuration.contracted(G), _GAIN * (near.bounds[pairs] - kept)


def feasible(
    rows: Rows,
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    stopping: float = 0.0,
    so_far: np.ndarray | None = None,
) -> Rows:
    """Loosen rows where they contradict each other or a box.

    The displacement nearest to none inside the box always satisfies them: where a pair is nearer
    than the margin already, it need not part at once, only not come closer than the limits make it.
    Where a displacement is found that parts all those pairs without harm to the others, that is
    what they are held to; it is damped, so that pairs whose distance hardly depends on the joints
    part slowly. Pairs that are nearer by a few um are not parted.

    Args:
        rows: G and h of `CollisionLimit.rows`, for the whole displacement of a sample.
        lower: Lower bound of the rest of the displacement, shape (n,).
        upper: Upper bound, shape (n,).
        stopping: Part of the sample's displacement that the hand needs to stop behind it.
        so_far: Displacement of the sample up to here, shape (n,); none if omitted.

    Returns:
        G, shape (r, n), and h, shape (r,), for the rest of the displacement.
    """
    G, h = rows
    h = h / (1.0 + stopping)
    if so_far is not None:
        h = h - G.dot(so_far)
    witness = clip(0.0, lower, upper)
    kept = G.dot(witness)
    excess, loose = kept - h, np.maximum(h, kept)
    is_nearer = excess > _ROUGHLY
    if not is_nearer.any():
        return G, loose
    apart = G[is_nearer]
    gram = apart.dot(apart.T) + _LEVER**2 * np.eye(len(apart))
    parting = -_PARTED * np.linalg.solve(gram, excess[is_nearer]).dot(apart)
    within = clip(parting, _INSIDE * (lower - witness), _INSIDE * (upper - witness))
    parted = kept + G.dot(within)
    does_harm = (parted > loose) & ~is_nearer
    return G, loose if does_harm.any() else np.maximum(h, parted)
