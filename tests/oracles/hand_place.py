"""Where a hand is, in numpy: what `handmap/smoothing.hpp` (`Place`) has in C++."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_core.core import core
from handmap_core.mapping import AnyPose, HumanPose
from handmap_core.se3 import Array, affine, transform_points


class Place(NamedTuple):
    """Where a hand is: points in wrist axes, with the wrist's position behind them (n + 1, 3) [m].

    Without a wrist, points are in the world, and the wrist is its origin.
    """

    points: Array
    rotation: Array
    has_wrist: bool

    has_wrist: bool

    @classmethod
    def of(cls, pose: AnyPose) -> Place:
        """Return where a sample is."""
        wrist = np.eye(4) if pose.wrist is None else pose.wrist
        rotation, position = wrist[:3, :3], wrist[:3, 3]
        points = np.vstack([(pose.points - position) @ rotation, position])
        return cls(points, rotation, pose.wrist is not None)

    def pose(self) -> HumanPose:
        """Return a sample there."""
        wrist = affine(self.rotation, self.points[-1])
        points = transform_points(wrist, self.points[:-1])
        return HumanPose(points, wrist if self.has_wrist else None)

    def to(self, other: Place) -> Array:
        """Return the way to another place [m], with the turn in own axes behind it [rad]."""
        turn = core.log3(self.rotation.T @ other.rotation)
        return np.vstack([other.points - self.points, turn])

    def moved(self, way: Array) -> Place:
        """Return the place at the end of a way."""
        rotation = self.rotation @ core.exp3(way[-1])
        return Place(self.points + way[:-1], rotation, self.has_wrist)
