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
"""

from __future__ import annotations

import numpy as np

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.placements import moved_by
from handmap_qp.hands.shape_pairs import ShapePairs, named_pairs
from handmap_qp.ik.clear_path import ClearPath
from handmap_qp.ik.distances import NearPairs, ShapeDistances
from handmap_qp.transform import shortest_solution

# Where there is a horizon, pairs get rows if they are within their margin, this distance [m], and
# what links approach each other by in the sample at this speed [m/s].
_NEAR, _APPROACH = 0.001, 0.5


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
        self._relative_support = supports[second] - supports[first]

    def distances(self, configuration: Configuration) -> np.ndarray:
        """Return signed distances of all pairs [m], negative where shapes overlap, shape (k,).

        Args:
            configuration: Of the hand, placed.
        """
        return self._distances.measure_all(configuration)

    def measure(
        self, configuration: Configuration, margins: np.ndarray | None = None, dt: float = np.inf
    ) -> NearPairs:
        """Measure the pairs that get rows, as `rows`; measured once in one posture.

        Args:
            configuration: Of the hand, placed.
            margins: Distance that each of all pairs keeps [m], shape (k,); `margin` if omitted.
            dt: Time of the sample [s], in which links approach each other.
        """
        kept = self.margin if margins is None else margins
        reach = min(_NEAR + self._approach * dt, self._horizon)
        return self._distances.measure(configuration, kept + reach)

    def rows(
        self,
        configuration: Configuration,
        margins: np.ndarray | None = None,
        near: NearPairs | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Linearise the distances of the pairs within the horizon as rows `G dq <= h`.

        Args:
            configuration: Of the hand, placed with Jacobians.
            margins: Distance that each of all pairs keeps [m], shape (k,); `margin` if omitted.
            near: What `measure` found there; measured if omitted.

        Returns:
            G, shape (r, n) over the active coordinates; h [m], shape (r,), negative where a pair is
            nearer than the margin.
        """
        measured = self.measure(configuration, margins) if near is None else near
        pairs, wrenches = measured.pairs, measured.wrenches
        kept = self.margin if margins is None else margins[pairs]
        relative = self._relative_support.take(pairs, 0)
        G = configuration.contracted(-wrenches.dot(configuration.joint_jacobian()) * relative)
        return G, self._gain * (measured.distances - kept)

    def feasible_rows(
        self,
        configuration: Configuration,
        lower: np.ndarray,
        upper: np.ndarray,
        margins: np.ndarray | None = None,
        *,
        near: NearPairs | None = None,
        stopping: float = 0.0,
        so_far: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """The same rows, loosened where they contradict each other or a box.

        The displacement nearest to none inside the box always satisfies them: where a pair is
        nearer than the margin already, it need not part at once, only not come closer than the
        limits make it. Where a displacement is found that parts all those pairs without harm to the
        others, that is what they are held to.

        Args:
            configuration: Of the hand, placed with Jacobians.
            lower: Lower bound of the displacement, shape (n,).
            upper: Upper bound, shape (n,).
            margins: Distance that each pair keeps [m], shape (k,); `margin` for all if omitted.
            near: What `measure` found there; measured if omitted.
            stopping: Part of the sample's displacement that the hand needs to stop behind it.
            so_far: Displacement of the sample up to here, shape (n,); none if omitted.

        Returns:
            G, shape (k, n), and h, shape (k,).
        """
        G, h = self.rows(configuration, margins, near)
        if stopping > 0.0:
            h = (h if so_far is None else h - stopping * G.dot(so_far)) / (1.0 + stopping)
        witness = np.minimum(np.maximum(0.0, lower), upper)
        excess = G.dot(witness) - h
        nearer = (excess > 0.0).nonzero()[0]
        if not len(nearer):
            return G, h
        parting = shortest_solution(G.take(nearer, 0), -excess.take(nearer), 1e-6)
        parted = G.dot(np.minimum(np.maximum(witness + parting, lower), upper))
        does_harm = parted > h
        does_harm[nearer] = False
        return G, np.maximum(h, G.dot(witness) if does_harm.any() else parted)
