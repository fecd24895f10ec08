"""Distances between a robot hand's surfaces over time: pinches and self-penetration."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.fingers import THUMB, Finger, find_fingers
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.placements import Placements
from handmap_qp.hands.shape_pairs import all_pairs, distal_shapes
from handmap_qp.se3 import lengths

FAR = 0.01
"""Distances between links that do not pinch are measured up to here [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceGaps:
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
    hand: Hand,
    q: np.ndarray,
    chains: dict[str, Finger] | None = None,
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
    return GapMeter(hand, chains).measure(q)


class PinchMeter:
    """Measures the gaps between the thumb and the other fingers of one robot hand.

    Args:
        hand: The robot hand.

    Attributes:
        fingers: The fingers whose gaps are measured: those with shapes.

    Raises:
        HandError: If a shape cannot be read.
    """

    def __init__(self, hand: Hand) -> None:
        self._hand = hand
        self._geometry, self._groups = _pinch_pairs(hand, find_fingers(hand))
        self._data = hand.model.createData()
        self._vector = np.zeros(hand.model.nq)
        self.fingers = tuple(self._groups)

    def measure(self, q: np.ndarray) -> dict[str, float]:
        """Measure the gaps of one posture.

        Args:
            q: Joint angles in the order of `hand.joint_names` [rad], shape (n,).

        Returns:
            Gap between the distal links of the thumb and of each other finger [m], negative where
            they overlap, by the finger's name.
        """
        self._hand.write_configuration(self._vector, q, np.eye(4))
        pin.forwardKinematics(self._hand.model, self._data, self._vector)
        nearest = _NearestPairs(self._hand, self._geometry)
        nearest.place(self._data)
        return {name: nearest.smallest(pairs, np.inf) for name, pairs in self._groups.items()}


class GapMeter:
    """Measures gaps of one robot hand, whose shapes are read once.

    Args:
        hand: The robot hand.
        chains: Its fingers, if they have been found before.

    Raises:
        HandError: If a shape cannot be read.
    """

    def __init__(self, hand: Hand, chains: dict[str, Finger] | None = None) -> None:
        chains = chains or find_fingers(hand)
        self._hand = hand
        pinching, self._groups = _pinch_pairs(hand, chains)
        self._pinching = _NearestPairs(hand, pinching)
        self._colliding = _NearestPairs(hand, all_pairs(hand, chains).geometry)

    def measure(self, q: np.ndarray) -> SurfaceGaps:
        """Measure the gaps of a motion; the same motion gives the same numbers each time.

        Args:
            q: Joint angles in the order of `hand.joint_names` [rad], shape (T, n).
        """
        return SurfaceGaps(self.pinches(q), self.nearest(q))

    def pinches(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Measure the gaps between the thumb and the other fingers; see `SurfaceGaps.pinches`.

        Args:
            q: Joint angles [rad], shape (T, n).
        """
        gaps = {finger: np.empty(len(q)) for finger in self._groups}
        for t, placed in enumerate(self._placed(self._pinching, q)):
            for finger, pairs in self._groups.items():
                gaps[finger][t] = placed.smallest(pairs, np.inf)
        return gaps

    def nearest(self, q: np.ndarray, most: float = FAR) -> np.ndarray:
        """Measure the smallest distance between any two links that can collide [m], shape (T,).

        Args:
            q: Joint angles [rad], shape (T, n).
            most: Distance up to which it is measured, and that stands for larger ones [m].
        """
        everything = slice(None)
        placed = self._placed(self._colliding, q)
        return np.array([pairs.smallest(everything, most) for pairs in placed])

    def _placed(self, pairs: _NearestPairs, q: np.ndarray) -> Iterator[_NearestPairs]:
        """Move pairs from posture to posture."""
        hand = self._hand
        # GJK starts from the last result of a pair, so each motion gets its own.
        placed = pairs.renewed()
        data, vector = hand.model.createData(), hand.configuration_vector(hand.rest)
        for angles in q:
            hand.write_configuration(vector, angles)
            pin.forwardKinematics(hand.model, data, vector)
            placed.place(data)
            yield placed


def _pinch_pairs(
    hand: Hand, chains: dict[str, Finger]
) -> tuple[pin.GeometryModel, dict[str, slice]]:
    """All pairs of distal shapes of the thumb and another finger, and which pairs are whose."""
    geometry, groups = read_collision_shapes(hand), {}
    thumb = distal_shapes(chains[THUMB], geometry) if THUMB in chains else []
    for finger, chain in chains.items():
        others = distal_shapes(chain, geometry)
        if finger == THUMB or not thumb or not others:
            continue
        first = len(geometry.collisionPairs)
        for one in thumb:
            for other in others:
                geometry.addCollisionPair(pin.CollisionPair(one, other))
        groups[finger] = slice(first, len(geometry.collisionPairs))
    return geometry, groups


class _NearestPairs:
    """The smallest distance among pairs of shapes, nearest bounding spheres first."""

    def __init__(self, hand: Hand, geometry: pin.GeometryModel) -> None:
        self._model, self._geometry = hand.model, geometry
        shapes = geometry.geometryObjects
        for shape in shapes:
            shape.geometry.computeLocalAABB()
        centres = np.array([shape.geometry.aabb_center for shape in shapes])
        self._centres = centres.reshape(-1, 3)
        radii = np.array([shape.geometry.aabb_radius for shape in shapes])
        pairs = geometry.collisionPairs
        self._first = np.array([pair.first for pair in pairs], dtype=int)
        self._second = np.array([pair.second for pair in pairs], dtype=int)
        self._radii = radii[self._first] + radii[self._second]
        self._renew()

    def renewed(self) -> _NearestPairs:
        """Return the same pairs without any result of an earlier motion."""
        pairs = copy(self)
        pairs._renew()
        return pairs

    def _renew(self) -> None:
        self._data = self._geometry.createData()
        self._placed = Placements(self._data.oMg)
        self._bounds = np.zeros(len(self._radii))

    def place(self, data: pin.Data) -> None:
        """Move the shapes to where the model's joints are."""
        pin.updateGeometryPlacements(self._model, data, self._geometry, self._data)
        centres = self._placed.points(self._centres)
        self._bounds = lengths(centres[self._first] - centres[self._second]) - self._radii

    def smallest(self, pairs: slice, most: float) -> float:
        """Smallest signed distance of some of the pairs, `most` at most [m]."""
        bounds, first = self._bounds[pairs], pairs.start or 0
        near = (bounds < most).nonzero()[0]
        for i in near[bounds[near].argsort()].tolist():
            if bounds[i] >= most:
                break
            result = pin.computeDistance(self._geometry, self._data, first + i)
            most = min(most, result.min_distance)
        return most
