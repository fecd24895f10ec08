"""Overlap of convex shapes, measured without coal's penetration depth.

For a unit vector n, the shapes a and b are apart by at least

    s(n) = min_b n x - max_a n x,

so they overlap by at most `-s(n)`, for any n. The best of many directions, refined by smaller and
smaller turns, gives the depth from above. coal's own depth on convex meshes can be wrong by
millimetres, and its sign with it.
"""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs

NEAR = 1e-3
"""Pairs that coal finds farther apart than this count as apart [m]."""
_COUNT, _ROUNDS = 600, 12


class OverlapMeter:
    """Measures the largest overlap of a hand's pairs of shapes.

    Args:
        hand: The hand.
        shapes: Its pairs.

    Attributes:
        disputed: Number of pairs that coal found apart by more than they are.
    """

    def __init__(self, hand: Hand, shapes: ShapePairs) -> None:
        self._model, self._geometry = hand.model, shapes.geometry
        self._data, self._placed = hand.model.createData(), shapes.geometry.createData()
        for request in self._placed.distanceRequests:
            request.gjk_tolerance = request.epa_tolerance = 1e-9
        for request in self._placed.collisionRequests:
            request.security_margin = NEAR
        self._shapes = [
            _Support(shape.geometry) for shape in self._geometry.geometryObjects
        ]
        self.disputed = 0

    def depth(self, q: np.ndarray, *, checks_all: bool = False) -> float:
        """Return the largest overlap at a configuration [m]; 0 if there is none.

        Args:
            q: Pinocchio configuration, shape (nq,).
            checks_all: Whether pairs that coal finds apart are checked too.
        """
        pin.updateGeometryPlacements(
            self._model, self._data, self._geometry, self._placed, q
        )
        if checks_all:
            pairs = range(len(self._geometry.collisionPairs))
        elif pin.computeCollisions(self._geometry, self._placed, False):
            results = enumerate(self._placed.collisionResults)
            pairs = [k for k, result in results if result.isCollision()]
        else:
            return 0.0
        return max(0.0, *map(self._depth, pairs))

    def _depth(self, k: int) -> float:
        """Return the overlap of a pair, where the shapes are placed [m]."""
        result = pin.computeDistance(self._geometry, self._placed, k)
        gap = float(self._gap(k, np.array(result.normal)))
        if result.min_distance > max(gap, 0.0) + 1e-5:
            gap = self._searched(k)
            self.disputed += result.min_distance > max(gap, 0.0) + 1e-4
        elif gap < 0.0:
            gap = self._searched(k)
        return -gap

    def _gap(self, k: int, normals: np.ndarray) -> np.ndarray:
        """Return s(n) of a pair for directions of shape (..., 3) [m]."""
        pair = self._geometry.collisionPairs[k]
        first, second = self._placed.oMg[pair.first], self._placed.oMg[pair.second]
        return -(
            self._shapes[pair.first].largest(normals, first)
            + self._shapes[pair.second].largest(-normals, second)
        )

    def _searched(self, k: int) -> float:
        """Return the largest s(n) that a search finds [m]."""
        generator, directions = np.random.default_rng(k), _sphere(_COUNT)
        gaps = self._gap(k, directions)
        best, gap, width = directions[gaps.argmax()], float(gaps.max()), 0.2
        for _ in range(_ROUNDS):
            tried = best + width * generator.normal(size=(60, 3))
            tried /= np.linalg.norm(tried, axis=1, keepdims=True)
            gaps = self._gap(k, tried)
            if gaps.max() > gap:
                best, gap = tried[gaps.argmax()], float(gaps.max())
            width *= 0.55
        return gap


class _Support:
    """Support function of a convex shape."""

    def __init__(self, geometry: coal.CollisionGeometry) -> None:
        self._radius, self._disc = 0.0, 0.0
        if isinstance(geometry, coal.Box):
            corners = [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
            self._points = np.array(corners) * geometry.halfSide
        elif isinstance(geometry, coal.Sphere):
            self._points, self._radius = np.zeros((1, 3)), geometry.radius
        elif isinstance(geometry, coal.Capsule | coal.Cylinder):
            half = geometry.halfLength
            self._points = np.array([[0.0, 0.0, half], [0.0, 0.0, -half]])
            if isinstance(geometry, coal.Capsule):
                self._radius = geometry.radius
            else:
                self._disc = geometry.radius
        elif isinstance(geometry, coal.ConvexBase):
            self._points = np.array(
                [geometry.point(i) for i in range(geometry.num_points)]
            )
        else:
            raise TypeError(f"no support function for {type(geometry).__name__}")

    def largest(self, normals: np.ndarray, placement: pin.SE3) -> np.ndarray:
        """Return the largest n x over the placed shape for directions of shape (..., 3)."""
        local = normals @ placement.rotation
        found = (local @ self._points.T).max(axis=-1) + self._radius
        if self._disc:
            found = found + self._disc * np.hypot(local[..., 0], local[..., 1])
        return found + normals @ placement.translation


def _sphere(count: int) -> np.ndarray:
    """Spread unit vectors evenly over the sphere (Fibonacci's lattice), shape (count, 3)."""
    i = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * i / count, np.pi * (1.0 + np.sqrt(5.0)) * i
    flat = np.sqrt(1.0 - z * z)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])
