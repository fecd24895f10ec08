"""A ball inside a fingertip's surface, and the gap of two: `Pad`, `PadPair`."""

from __future__ import annotations

import math
from typing import NamedTuple

from handmap_core.se3 import Array, unit


class Pad(NamedTuple):
    """A ball that touches a fingertip's surface from inside.

    Attributes:
        joint: Joint of the model that carries it.
        offset: Its middle in the joint's frame [m], shape (3,).
        radius: Its radius [m].
        cover: How far a pad of the description rises above the collision shapes [m], as a soft
            cover does that the URDF does not have.
    """

    joint: int
    offset: Array
    radius: float
    cover: float = 0.0

    @property
    def place(self) -> tuple[int, Array]:
        """Its middle."""
        return self.joint, self.offset


class PadPair(NamedTuple):
    """The pads of a thumb and a finger."""

    thumb: Pad
    finger: Pad

    def gap(self, places: Array) -> float:
        """Return the distance between their surfaces, < 0 for pads in each other [m].

        Args:
            places: Their middles [m], shape (2, 3).
        """
        return math.dist(*places) - self.thumb.radius - self.finger.radius

    def middle(self, places: Array) -> Array:
        """Return the point midway between their surfaces [m], shape (3,); see `gap`."""
        thumb, finger = places
        farther = self.thumb.radius - self.finger.radius
        return (thumb + finger + farther * unit(finger - thumb)) / 2.0
