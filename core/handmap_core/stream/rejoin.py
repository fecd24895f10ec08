"""`Rejoin`: how a robot comes back to the human after a hold, without a snap.

The compiled core has the formulas (`handmap/rejoin.hpp`), which the library in C++ follows by, too.
"""

from __future__ import annotations

import math
from typing import Literal

from msgspec import structs

from handmap_core.core import core
from handmap_core.mapping import AnyPose, HumanPose, core_pose
from handmap_core.se3 import Array, ArrayStruct

RejoinKind = Literal["glide", "clutch"]
"""How the robot comes back to the human after a hold."""

FINGER_SPEED, PALM_SPEED, TURN_SPEED = core.FADING_SPEEDS
"""Largest speeds that fading adds to a point in wrist axes [m/s], and to the wrist [m/s, rad/s]."""


class Rejoin(ArrayStruct, frozen=True):
    """State of the return after a sample; `start` and `advance` return the next one.

    Attributes:
        kind: `glide` or `clutch`.
        seen: The last pose that was mapped; None before the first.
        offset: What was seen last minus what the tracker said at the return: of the n points in
            wrist axes and of the wrist [m], and the turn in own axes behind them [rad], shape
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

    @property
    def _palm_fades(self) -> bool:
        """Whether the palm comes back, too, instead of staying where it is."""
        return self.kind == "glide"

    def start(self, pose: HumanPose, lost: float = math.inf) -> Rejoin:
        """Begin at the first sample after a hold.

        After a brief loss [s], fading takes no longer than that, and one that has begun goes on.
        """
        before = self.seen
        if self.is_fading and lost < math.inf:
            return self
        if before is None or (before.wrist is None) != (pose.wrist is None):
            return structs.replace(self, offset=None)
        offset, duration = core.offset_of_return(
            core_pose(pose), core_pose(before), self._palm_fades, lost
        )
        return structs.replace(self, offset=offset, duration=duration, elapsed=0.0)

    def advance(self, pose: HumanPose, dt: float) -> tuple[HumanPose, Rejoin]:
        """Return the pose to map for that of the tracker, dt [s] later, and the state after it."""
        if self.offset is None:
            return pose, self
        fades = self._palm_fades
        left = 1.0 - core.minimum_jerk(self.elapsed / self.duration)
        moved = core.pose_with_offset(core_pose(pose), self.offset, left, fades)
        goes_on = left > 0.0 or not fades
        return HumanPose.of_core(moved), structs.replace(
            self,
            offset=self.offset if goes_on else None,
            elapsed=self.elapsed + dt,
        )
