"""Self-collision avoidance: rows of the QP from coal's distances between collision shapes.

Meshes count as their convex hulls.

For a pair of shapes a, b at the signed distance d, with the unit normal n from a to b,

    d(q + dq) ~ d + n^T (J_b - J_a) dq >= margin    becomes    -n^T (J_b - J_a) dq <= gain (d -
    margin)

with J_a and J_b the Jacobians of the nearest points. Both lie on one line along n, so the wrench
(n, p x n) of either does for both. The first order is an approximation: a shape that turns by an
angle x at a radius r may come r x^2 / 2 closer than the row says, which is what the margin is for.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.placements import moved_by, placement_views
from handmap_qp.hands.shape_pairs import ShapePairs, named_pairs


class CollisionLimit:
    """Rows that keep pairs of collision shapes apart.

    Args:
        hand: The hand.
        pairs: The pairs to keep apart; those that the hand's description names if omitted.
        margin: Distance to keep [m]; the description's if omitted.
        gain: Part of the free distance that one step may use, in (0, 1].
        horizon: Pairs farther apart than this get no row [m]. Infinite by default: every pair has a
            row, in an order that never changes.

    Attributes:
        pairs: The links of each pair; a link with several shapes has several.
        margin: Distance to keep [m].

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
        self._model, self._geometry = hand.model, found.geometry
        self._data = self._geometry.createData()
        for request in self._data.distanceRequests:
            # GJK is warm-started: at 1e-6 the result depends on the last query by as much.
            request.gjk_tolerance = request.epa_tolerance = 1e-9
        shapes, shape_pairs = self._geometry.geometryObjects, self._geometry.collisionPairs
        self._first = np.array([pair.first for pair in shape_pairs], dtype=int)
        self._second = np.array([pair.second for pair in shape_pairs], dtype=int)
        supports = np.array([moved_by(hand.model, shape.parentJoint) for shape in shapes])
        supports = supports.reshape(-1, hand.model.nv)
        self._relative_support = supports[self._second] - supports[self._first]
        self._all = np.arange(len(shape_pairs))
        self._placed = placement_views(self._data.oMg)
        for shape in shapes:
            shape.geometry.computeLocalAABB()
        self._centres = np.array([shape.geometry.aabb_center for shape in shapes]).reshape(-1, 3)
        radii = np.array([shape.geometry.aabb_radius for shape in shapes])
        self._reaches = radii[self._first] + radii[self._second] + horizon

    def distances(self, configuration: Configuration) -> np.ndarray:
        """Return signed distances of all pairs [m], negative where shapes overlap, shape (k,).

        Args:
            configuration: Of the hand, placed.
        """
        pin.updateGeometryPlacements(self._model, configuration.data, self._geometry, self._data)
        return self._measure(self._all)[0]

    def rows(
        self, configuration: Configuration, margins: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Linearise the distances of the pairs within the horizon as rows `G dq <= h`.

        Args:
            configuration: Of the hand, placed with Jacobians.
            margins: Distance that each of all pairs keeps [m], shape (k,); `margin` if omitted.

        Returns:
            G, shape (r, n) over the active coordinates; h [m], shape (r,), negative where a pair is
            nearer than the margin.
        """
        pin.updateGeometryPlacements(self._model, configuration.data, self._geometry, self._data)
        near = self._near()
        distances, wrenches = self._measure(near)
        if len(near) < len(self._all):
            is_near = distances <= self._horizon
            near, distances, wrenches = near[is_near], distances[is_near], wrenches[is_near]
        kept = self.margin if margins is None else margins[near]
        relative = self._relative_support[near]
        G = configuration.contracted(-wrenches.dot(configuration.joint_jacobian()) * relative)
        return G, self._gain * (distances - kept)

    def feasible_rows(
        self,
        configuration: Configuration,
        lower: np.ndarray,
        upper: np.ndarray,
        margins: np.ndarray | None = None,
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

        Returns:
            G, shape (k, n), and h, shape (k,).
        """
        G, h = self.rows(configuration, margins)
        witness = np.minimum(np.maximum(0.0, lower), upper)
        excess = G @ witness - h
        is_near = excess > 0.0
        if is_near.any():
            parting = np.linalg.lstsq(G[is_near], -excess[is_near], rcond=1e-6)[0]
            parted = np.minimum(np.maximum(witness + parting, lower), upper)
            if (G[~is_near] @ parted <= h[~is_near]).all():
                witness = parted
        return G, np.maximum(h, G @ witness)

    def _near(self) -> np.ndarray:
        """Return the pairs whose bounding balls are within the horizon, by index."""
        if self._horizon == np.inf:
            return self._all
        rotations, translations = self._placed
        centres = np.einsum("ijk,ik->ij", rotations, self._centres) + translations
        offsets = centres[self._first] - centres[self._second]
        lengths = np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
        return np.flatnonzero(lengths <= self._reaches)

    def _measure(self, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distances, and the wrenches (n, p x n) of a unit force along each normal."""
        distances, wrenches = np.empty(len(pairs)), np.empty((len(pairs), 6))
        points = np.empty((len(pairs), 3))
        for i, k in enumerate(pairs.tolist()):
            result = pin.computeDistance(self._geometry, self._data, k)
            distances[i] = result.min_distance
            wrenches[i, :3] = result.normal
            points[i] = result.getNearestPoint1()
        normals = wrenches[:, :3]
        # np.cross takes as long as all else here.
        wrenches[:, 3:] = (
            points[:, _NEXT] * normals[:, _LAST] - points[:, _LAST] * normals[:, _NEXT]
        )
        return distances, wrenches


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
