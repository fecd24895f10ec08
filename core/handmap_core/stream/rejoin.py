"""`Rejoin`: how a robot comes back to the human after a hold, without a snap."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from msgspec import structs

from handmap_core.core import core
from handmap_core.mapping import AnyPose, HumanPose
from handmap_core.se3 import (
    Array,
    ArrayStruct,
    affine,
    lengths,
    transform_points,
)

RejoinKind = Literal["glide", "clutch"]
"""How the robot comes back to the human after a hold."""

FINGER_SPEED = 0.4
"""Largest speed that fading adds to a point in wrist axes [m/s]."""
PALM_SPEED = 0.5
"""Largest speed that fading adds to the wrist [m/s]."""
TURN_SPEED = 3.0
"""Largest angular speed that fading adds to the wrist [rad/s]."""
_SHORTEST = 0.05  # shortest time of fading [s]
_PEAK = 1.875  # largest speed of a minimum-jerk motion over its mean speed


class _Place(NamedTuple):
    """Where a hand is: points in wrist axes, with the wrist's position behind them (n + 1, 3) [m].

    Without a wrist, points are in the world, and the wrist is its origin.
    """

    points: Array
    rotation: Array
    has_wrist: bool

    @classmethod
    def of(cls, pose: AnyPose) -> _Place:
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

    def to(self, other: _Place) -> Array:
        """Return the way to another place [m], with the turn in own axes behind it [rad]."""
        turn = core.log3(self.rotation.T @ other.rotation)
        return np.vstack([other.points - self.points, turn])

    def moved(self, way: Array) -> _Place:
        """Return the place at the end of a way."""
        rotation = self.rotation @ core.exp3(way[-1])
        return _Place(self.points + way[:-1], rotation, self.has_wrist)


class Rejoin(ArrayStruct, frozen=True):
    """State of the return after a sample; `start` and `advance` return the next one.

    Attributes:
        kind: `glide` or `clutch`.
        seen: The last pose that was mapped; None before the first.
        offset: What was seen last minus what the tracker said at the return (`_Place.to`), shape
            (n + 2, 3); None if nothing is added to the samples.
        duration: Time of fading [s].
        elapsed: Time since the return [s].
    """

    kind: RejoinKind = "glide"
    seen: AnyPose | None = None
    offset: Array | None = None
    duration: float = 0.0
    elapsed: float = 0.0

    @property
    def is_fading(self) -> bool:
        """Whether the robot is still on its way to the human."""
        return self.offset is not None and self.elapsed < self.duration

    def start(self, pose: HumanPose, lost: float = math.inf) -> Rejoin:
        """Begin at the first sample after a hold.

        After a brief loss [s], fading takes no longer than that, and one that has begun goes on.
        """
        before = self.seen
        if self.is_fading and lost < math.inf:
            return self
        if before is None or (before.wrist is None) != (pose.wrist is None):
            return structs.replace(self, offset=None)
        offset = _Place.of(pose).to(_Place.of(before))
        *fingers, palm, turn = lengths(offset)
        times = [max(fingers) / FINGER_SPEED]
        if self.kind == "glide":
            times += [palm / PALM_SPEED, turn / TURN_SPEED]
        duration = max(_SHORTEST, min(lost, _PEAK * max(times)))
        return structs.replace(self, offset=offset, duration=duration, elapsed=0.0)

    def advance(self, pose: HumanPose, dt: float) -> tuple[HumanPose, Rejoin]:
        """Return the pose to map for that of the tracker, dt [s] later, and the state after it."""
        if self.offset is None:
            return pose, self
        left = 1.0 - _minimum_jerk(self.elapsed / self.duration)
        offset = left * self.offset
        stays = self.kind == "clutch"
        if stays:
            offset[-2:] = self.offset[-2:]
        moved = _Place.of(pose).moved(offset).pose()
        return moved, structs.replace(
            self,
            offset=self.offset if left > 0.0 or stays else None,
            elapsed=self.elapsed + dt,
        )


def _minimum_jerk(share: float) -> float:
    """Go from 0 to 1 with no speed and no acceleration at either end (Flash and Hogan 1985)."""
    share = min(max(share, 0.0), 1.0)
    return share * share * share * (10.0 + share * (6.0 * share - 15.0))
