"""Distances between a robot hand's surfaces over time: pinches and self-penetration."""

from itertools import product

import numpy as np
import pinocchio as pin

from handmap_core.se3 import Array
from handmap_qp.hands import (
    THUMB,
    Hand,
    distal_shapes,
    find_fingers,
    paired,
    read_collision_shapes,
    source_file,
)
from handmap_qp.ik import pair_bounds
from handmap_qp.mapping import robot_fingers
from .hand_trace import ByFinger

FAR = 0.01
"""Distances between links that do not pinch are measured up to here [m]."""


def whose_shapes(hand: Hand) -> str:
    """Return in words whose collision shapes are measured: the hand's, and its file."""
    return f"collision shapes of {hand.name} ({source_file(hand.spec).name})"


class GapMeter:
    """Measures signed gaps of one robot hand, negative where surfaces overlap.

    They are those of the collision shapes of its URDF, which are read once; meshes are their convex
    hulls, cylinders prisms. The core measures them by its own GJK, not by coal, whose distances of
    convex meshes are wrong on some hands. The same motion gives the same numbers each time.

    Args:
        hand: The robot hand.
        shapes: The same hand by another description (`compare.with_urdf`), whose shapes are
            measured in place of its own.

    Attributes:
        whose: The hand and the file whose shapes are measured, in words.

    Raises:
        HandError: If a shape cannot be read.
    """

    def __init__(self, hand: Hand, shapes: Hand | None = None) -> None:
        self._hand = hand = shapes or hand
        self.whose = whose_shapes(hand)
        shapes = read_collision_shapes(hand)
        ends = {
            finger: distal_shapes(chain, shapes)
            for finger, chain in find_fingers(hand).items()
        }
        thumb = ends.pop(THUMB, [])
        self._pinching = {
            finger: paired(shapes, [*product(thumb, others)])
            for finger, others in ends.items()
            if thumb and others
        }

    def pinches(self, q: Array) -> ByFinger:
        """Measure the gaps between the distal links of the thumb and of each other finger [m].

        Fingers whose distal links have no shapes are left out.

        Args:
            q: Joint angles in the order of `hand.joint_names` [rad], shape (T, n).

        Returns:
            Gaps by the finger's name, shape (T,) each.
        """
        return {
            finger: self._smallest(pairs, q, np.inf)
            for finger, pairs in self._pinching.items()
        }

    def nearest(self, q: Array, most: float = FAR) -> Array:
        """Measure the smallest distance between any two links that can collide [m], shape (T,).

        Pairs of shapes on one joint, on neighbouring joints, or that overlap at rest or with the
        hand stretched are not counted.

        Joint angles q are of shape (T, n) [rad]; `most` stands for larger distances [m].
        """
        pairs = robot_fingers(self._hand).contacts
        return self._smallest(pairs.geometry, q, most)

    def _smallest(self, geometry: pin.GeometryModel, q: Array, most: float) -> Array:
        """Measure the least distance of any of the pairs, at most `most` [m], shape (T,)."""
        hand = self._hand
        pairs = pair_bounds(hand.model, geometry)
        return hand.tree.smallest_distances(pairs.core, q, most)
