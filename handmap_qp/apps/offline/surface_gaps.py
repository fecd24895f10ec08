"""Distances between a robot hand's surfaces over time: pinches and self-penetration."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.fingers import Finger, find_fingers
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import THUMB
from handmap_qp.hands.shape_pairs import all_pairs, distal_shapes
from handmap_qp.se3 import lengths

FAR = 0.01
"""Distances between links that do not pinch are measured up to here [m]."""


class SurfaceGaps(NamedTuple):
    """Signed distances between surfaces over time, negative where they overlap.

    Attributes:
        pinches: Gap between the distal links of the thumb and of each other finger [m], shape (T,)
            each, by the finger's name.
        nearest: Smallest distance between any two links that can collide [m], 10 mm at most,
            shape (T,).
    """

    pinches: dict[str, np.ndarray]
    nearest: np.ndarray


def measure_gaps(
    hand: Hand, q: np.ndarray, chains: dict[str, Finger] | None = None
) -> SurfaceGaps:
    """Measure a robot's gaps from the collision shapes of its URDF; meshes are their convex hulls.

    Pairs of shapes on one joint, on neighbouring joints, or that overlap at rest or with the hand
    stretched are not counted as self-penetration.

    Args:
        hand: The robot hand.
        q: Joint angles in the order of `hand.joint_names` [rad], shape (T, n).
        chains: Its fingers, if they have been found before.

    Returns:
        The gaps. Fingers whose distal links have no shapes are left out.

    Raises:
        HandError: If a shape cannot be read.
    """
    meter = GapMeter(hand, chains)
    return SurfaceGaps(meter.pinches(q), meter.nearest(q))


class GapMeter:
    """Measures gaps of one robot hand, whose shapes are read once.

    The same motion gives the same numbers each time.

    Args:
        hand: The robot hand.
        chains: Its fingers, if they have been found before.

    Raises:
        HandError: If a shape cannot be read.
    """

    def __init__(self, hand: Hand, chains: dict[str, Finger] | None = None) -> None:
        self._hand = hand
        self._chains = chains or find_fingers(hand)
        self._geometry = read_collision_shapes(hand)
        self._groups: dict[str, slice] = {}
        shapes = {
            finger: distal_shapes(chain, self._geometry)
            for finger, chain in self._chains.items()
        }
        thumb = shapes.pop(THUMB, [])
        for finger, others in shapes.items():
            first = len(self._geometry.collisionPairs)
            for pair in product(thumb, others):
                self._geometry.addCollisionPair(pin.CollisionPair(*pair))
            if thumb and others:
                last = len(self._geometry.collisionPairs)
                self._groups[finger] = slice(first, last)

    def pinches(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Measure the gaps between the thumb and the other fingers; see `SurfaceGaps.pinches`.

        Args:
            q: Joint angles [rad], shape (T, n).
        """
        smallest = _smallest_distance(self._hand, self._geometry)
        rows = [
            [smallest(a, pairs, np.inf) for pairs in self._groups.values()] for a in q
        ]
        columns = np.array(rows).reshape(len(q), len(self._groups)).T
        return dict(zip(self._groups, columns, strict=True))

    def nearest(self, q: np.ndarray, most: float = FAR) -> np.ndarray:
        """Measure the smallest distance between any two links that can collide [m], shape (T,).

        Args:
            q: Joint angles [rad], shape (T, n).
            most: Distance up to which it is measured, and that stands for larger ones [m].
        """
        smallest = _smallest_distance(self._hand, self._colliding)
        pairs = slice(None)
        return np.array([smallest(angles, pairs, most) for angles in q])

    @cached_property
    def _colliding(self) -> pin.GeometryModel:
        return all_pairs(self._hand, self._chains).geometry


def _smallest_distance(
    hand: Hand, geometry: pin.GeometryModel
) -> Callable[[np.ndarray, slice, float], float]:
    """Return a function of posture, pairs and the largest distance that is told [m].

    Pairs are measured in the order of their bounding spheres' distances, up to the first that
    cannot be nearer. GJK starts from the last result of a pair, so each motion needs its own
    function.
    """
    shapes = [shape.geometry for shape in geometry.geometryObjects]
    for shape in shapes:
        shape.computeLocalAABB()
    centres = [shape.aabb_center for shape in shapes]
    radii = np.array([shape.aabb_radius for shape in shapes])
    pairs = [(pair.first, pair.second) for pair in geometry.collisionPairs]
    first, second = np.array(pairs, dtype=int).reshape(-1, 2).T
    touching = radii[first] + radii[second]
    data = hand.model.createData()
    geometry_data = geometry.createData()
    vector = hand.configuration_vector(hand.rest)

    def smallest(q: np.ndarray, chosen: slice, most: float) -> float:
        hand.write_configuration(vector, q)
        pin.updateGeometryPlacements(hand.model, data, geometry, geometry_data, vector)
        placed = map(pin.SE3.act, geometry_data.oMg, centres)
        places = np.array(list(placed))
        bounds = lengths(places[first] - places[second]) - touching
        for i in np.arange(len(bounds))[chosen][bounds[chosen].argsort()].tolist():
            if bounds[i] >= most:
                break
            most = min(
                most, pin.computeDistance(geometry, geometry_data, i).min_distance
            )
        return most

    return smallest
