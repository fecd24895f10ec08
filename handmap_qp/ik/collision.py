"""Self-collision avoidance: rows of the QP from coal's distances between collision shapes.

Meshes count as their convex hulls.

For a pair of shapes a, b at the signed distance d, with the unit normal n from a to b,

    d(q + dq) ~ d + n^T (J_b - J_a) dq >= margin

becomes

    -n^T (J_b - J_a) dq <= gain (d - margin)

with J_a and J_b the Jacobians of the nearest points. Both lie on one line along n, so the wrench
(n, p x n) of either does for both. The first order is an approximation: a shape that turns by an
angle x at a radius r may come r x^2 / 2 closer than the row says. The margin is for that, and
`handmap_qp.ik.stopping` checks the whole displacement afterwards.

Rows are linearised where a sample starts, and hold for its whole displacement: a later iteration of
the QP has what the ones before it left. So distances are measured once a sample, where it ends, for
the check and for the rows of the next one. Where there is a horizon, a pair is measured if another
step like the last one may bring it to its margin, or if its way is not clear by travel alone.
"""

from __future__ import annotations

import numpy as np

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.placements import moved_by
from handmap_qp.hands.shape_pairs import ShapePairs, named_pairs
from handmap_qp.ik.clear_path import ClearPath
from handmap_qp.ik.distances import KEPT, NearPairs, ShapeDistances

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
        margin: Distance to keep [m]; the description's if omitted.
        gain: Part of the free distance that one step may use, in (0, 1].
        horizon: Pairs that are farther apart than their margin and this get no row [m]; in short
            samples the horizon is nearer, as links do not come that far. Infinite by default: every
            pair has a row, in an order that never changes.

    Attributes:
        pairs: The links of each pair; a link with several shapes has several.
        margin: Distance to keep [m].
        path: Checks the same pairs along whole ways.

    Raises:
        InvalidOptionsError: If the hand names no pairs, or a number has no meaning.
        HandError: If a link does not exist or has no collision shape, or a shape cannot be read.
    """

    def __init__(
        self,
        hand: Hand,
        *,
        pairs: ShapePairs | None = None,
        margin: float | None = None,
        gain: float = 0.85,
        horizon: float = np.inf,
    ) -> None:
        spec = hand.spec.collision
        if pairs is None and spec is None:
            raise InvalidOptionsError(
                option="avoids_self_collision",
                problem=f"{hand.name} names no links to keep apart",
                advice="add collision.pairs to its hand.yaml",
            )
        self.margin = (spec.margin if spec else 0.0) if margin is None else margin
        if not 0.0 <= self.margin < np.inf:
            raise InvalidOptionsError(option="margin", expected="a distance >= 0", value=margin)
        if not 0.0 < gain <= 1.0:
            raise InvalidOptionsError(option="gain", expected="a number in (0, 1]", value=gain)
        found = named_pairs(hand) if pairs is None else pairs
        self.pairs = found.links
        self._gain, self._horizon = gain, horizon
        self._approach = _APPROACH if horizon < np.inf else np.inf
        geometry = found.geometry
        self._distances = ShapeDistances(hand.model, geometry)
        self.path = ClearPath(hand, self._distances)
        joints = [shape.parentJoint for shape in geometry.geometryObjects]
        supports = moved_by(hand.model, joints)
        first = [pair.first for pair in geometry.collisionPairs]
        second = [pair.second for pair in geometry.collisionPairs]
        self._opposing_support = supports[first] - supports[second]
        # A floating wrist comes first and changes no distance.
        self._moving = slice(int(np.argmax(self.path.columns)), None)
        self._levers = np.ascontiguousarray(self.path.levers[:, self._moving])

    def distances(self, configuration: Configuration) -> np.ndarray:
        """Return signed distances of all pairs [m], negative where shapes overlap, shape (k,).

        Args:
            configuration: Of the hand, placed.
        """
        return self._distances.measure_all(configuration)

    def measure(
        self,
        configuration: Configuration,
        margins: np.ndarray | None = None,
        dt: float = np.inf,
        *,
        before: NearPairs | None = None,
    ) -> NearPairs:
        """Measure the pairs that get rows.

        Args:
            configuration: Of the hand, placed.
            margins: Distance that each of all pairs keeps [m], shape (k,); `margin` if omitted.
            dt: Time of the sample [s], in which links approach each other.
            before: What is known in another posture; nothing if omitted.
        """
        horizon = (self.margin if margins is None else margins) + self._reach(dt)
        return self._distances.measure(configuration, horizon, before)

    def measure_end(
        self,
        configuration: Configuration,
        margins: np.ndarray | None,
        dt: float,
        start: NearPairs,
        displacement: np.ndarray,
    ) -> NearPairs:
        """Measure at the end of a sample: pairs that get rows in the next one, or may have touched.

        Args:
            configuration: Of the hand, placed there.
            margins: Distance that each of all pairs keeps [m], shape (k,); `margin` if omitted.
            dt: Time of the sample [s].
            start: What is known where the sample began.
            displacement: Displacement from there, shape (n,).
        """
        travel = self._levers.dot(np.abs(displacement[self._moving]))
        reach: np.ndarray | float = self._reach(dt)
        if reach < np.inf:
            reach = np.minimum(_NEAR + _EXPECTED * travel, reach)
        horizon = (self.margin if margins is None else margins) + reach
        return self._distances.follow(configuration, horizon, start, travel)

    def _reach(self, dt: float) -> float:
        """Return how far beyond their margin pairs get rows [m]."""
        return max(min(_NEAR + self._approach * dt, self._horizon), KEPT)

    def rows(
        self,
        configuration: Configuration,
        margins: np.ndarray | None = None,
        near: NearPairs | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Linearise the distances of the measured pairs as rows `G dq <= h`.

        Args:
            configuration: Of the hand, placed with Jacobians.
            margins: Distance that each of all pairs keeps [m], shape (k,); `margin` if omitted.
            near: What `measure` found there; measured if omitted.

        Returns:
            G, shape (r, n) over the active coordinates; h [m], shape (r,), negative where a pair is
            nearer than the margin.
        """
        near = self.measure(configuration, margins) if near is None else near
        G = near.wrenches.dot(configuration.joint_jacobian())
        G *= self._opposing_support.take(near.pairs, 0)
        kept = self.margin if margins is None else margins.take(near.pairs)
        return configuration.contracted(G), self._gain * (near.distances - kept)

    def feasible_rows(
        self,
        configuration: Configuration,
        lower: np.ndarray,
        upper: np.ndarray,
        margins: np.ndarray | None = None,
        *,
        near: NearPairs | None = None,
        stopping: float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return `rows`, as `feasible` loosens them."""
        rows = self.rows(configuration, margins, near)
        return self.feasible(rows, lower, upper, stopping=stopping)

    def feasible(
        self,
        rows: tuple[np.ndarray, np.ndarray],
        lower: np.ndarray,
        upper: np.ndarray,
        *,
        stopping: float = 0.0,
        so_far: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Loosen rows where they contradict each other or a box.

        The displacement nearest to none inside the box always satisfies them: where a pair is
        nearer than the margin already, it need not part at once, only not come closer than the
        limits make it. Where a displacement is found that parts all those pairs without harm to the
        others, that is what they are held to; it is damped, so that pairs whose distance hardly
        depends on the joints part slowly. Pairs that are nearer by a few um are not parted.

        Args:
            rows: G and h of `rows`, for the whole displacement of a sample.
            lower: Lower bound of the rest of the displacement, shape (n,).
            upper: Upper bound, shape (n,).
            stopping: Part of the sample's displacement that the hand needs to stop behind it.
            so_far: Displacement of the sample up to here, shape (n,); none if omitted.

        Returns:
            G, shape (r, n), and h, shape (r,), for the rest of the displacement.
        """
        G, h = rows
        if stopping > 0.0:
            h = h / (1.0 + stopping)
        if so_far is not None:
            h = h - G.dot(so_far)
        witness = np.minimum(np.maximum(0.0, lower), upper)
        kept = G.dot(witness)
        excess, loose = kept - h, np.maximum(h, kept)
        nearer = (excess > _ROUGHLY).nonzero()[0]
        if not len(nearer):
            return G, loose
        apart = G.take(nearer, 0)
        gram = apart.dot(apart.T)
        gram.flat[:: len(gram) + 1] += _LEVER**2
        parting = -_PARTED * np.linalg.solve(gram, excess.take(nearer)).dot(apart)
        least, most = _INSIDE * (lower - witness), _INSIDE * (upper - witness)
        parted = kept + G.dot(np.minimum(np.maximum(parting, least), most))
        does_harm = parted > loose
        does_harm[nearer] = False
        return G, loose if np.count_nonzero(does_harm) else np.maximum(h, parted)
