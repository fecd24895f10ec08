"""Self-collision avoidance as linear rows of the QP, from coal's distances between the links' collision shapes.

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
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand


class CollisionLimit:
    """Keeps pairs of links apart.

    Args:
        hand: The hand; its spec names the pairs and the margin.
        margin: Distance to keep [m], in place of the spec's.
        gain: Part of the free distance that one step may use, in (0, 1].

    Attributes:
        pairs: The links of each row; a link with several shapes has several rows.
        margin: Distance to keep [m].

    Raises:
        InvalidOptionsError: If the spec names no pairs, or margin or gain are out of range.
        HandError: If a link does not exist or has no collision shape, or a shape cannot be read.
    """

    def __init__(self, hand: Hand, *, margin: float | None = None, gain: float = 0.85) -> None:
        spec = hand.spec.collision
        if spec is None:
            raise InvalidOptionsError(
                option="avoids_self_collision",
                problem=f"{hand.name} names no links to keep apart",
                advice="add collision.pairs to its hand.yaml",
            )
        self.margin = spec.margin if margin is None else margin
        if not 0.0 <= self.margin < np.inf:
            raise InvalidOptionsError(option="margin", expected="a distance >= 0", value=margin)
        if not 0.0 < gain <= 1.0:
            raise InvalidOptionsError(option="gain", expected="a number in (0, 1]", value=gain)
        self._gain = gain
        self._model = hand.model
        self._geometry = read_collision_shapes(hand)
        self.pairs = _add_pairs(hand, spec.pairs, self._geometry)
        self._data = self._geometry.createData()
        for request in self._data.distanceRequests:
            # Every search starts where the last one ended, so at the default of 1e-6 the same
            # posture gave distances 1e-6 m apart.
            request.gjk_tolerance = request.epa_tolerance = 1e-9
        count = len(self.pairs)
        self._relative_support = np.array(
            [
                _support(hand.model, shapes[pair.second].parentJoint)
                - _support(hand.model, shapes[pair.first].parentJoint)
                for shapes in [self._geometry.geometryObjects]
                for pair in self._geometry.collisionPairs
            ]
        )
        self._wrenches = np.empty((count, 6))
        self._distances = np.empty(count)

    def distances(self, configuration: Configuration) -> np.ndarray:
        """Signed distances of all pairs [m], negative where shapes overlap, shape (k,).

        Args:
            configuration: Of the hand, placed where it is.
        """
        self._measure(configuration)
        return self._distances.copy()

    def rows(
        self, configuration: Configuration, margins: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows `G dq <= h`, one a pair, in an order that never changes.

        Args:
            configuration: Of the hand, placed with Jacobians.
            margins: Distance that each pair keeps [m], shape (k,); `margin` for all if omitted.

        Returns:
            G, shape (k, n) over the active coordinates; h [m], shape (k,), negative where a pair is
            nearer than the margin.
        """
        self._measure(configuration)
        G = configuration.contracted(
            -(self._wrenches @ configuration.joint_jacobian()) * self._relative_support
        )
        return G, self._gain * (self._distances - (self.margin if margins is None else margins))

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

    def _measure(self, configuration: Configuration) -> None:
        """Distances, and the wrenches (n, p x n) of a unit force along each normal."""
        pin.updateGeometryPlacements(self._model, configuration.data, self._geometry, self._data)
        pin.computeDistances(self._geometry, self._data)
        for i, result in enumerate(self._data.distanceResults):
            self._distances[i] = result.min_distance
            self._wrenches[i, :3] = result.normal
            self._wrenches[i, 3:] = result.getNearestPoint1()
        self._wrenches[:, 3:] = np.cross(self._wrenches[:, 3:], self._wrenches[:, :3])


def _add_pairs(
    hand: Hand, pairs: tuple[tuple[str, str], ...], geometry: pin.GeometryModel
) -> tuple[tuple[str, str], ...]:
    """Make pairs of links pairs of shapes, and return the links of each."""
    shapes: dict[str, list[int]] = {}
    for i, shape in enumerate(geometry.geometryObjects):
        shapes.setdefault(hand.model.frames[shape.parentFrame].name, []).append(i)
    links: list[tuple[str, str]] = []
    for i, pair in enumerate(pairs):
        for link in pair:
            if link not in shapes:
                what = (
                    "has no collision shape"
                    if hand.model.existFrame(link, pin.FrameType.BODY)
                    else "is no link of the URDF"
                )
                raise hand.spec.error(f"{link!r} {what}", key=f"collision.pairs[{i}]", value=link)
        for first in shapes[pair[0]]:
            for second in shapes[pair[1]]:
                geometry.addCollisionPair(pin.CollisionPair(first, second))
                links.append(pair)
    return tuple(links)


def _support(model: pin.Model, joint: int) -> np.ndarray:
    """1 for every velocity coordinate that moves a joint's frame, shape (nv,)."""
    moved = np.zeros(model.nv)
    for ancestor in list(model.supports[joint])[1:]:
        start = model.joints[ancestor].idx_v
        moved[start : start + model.joints[ancestor].nv] = 1.0
    return moved
