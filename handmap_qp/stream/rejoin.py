"""The way back to the human after a hold: `Rejoin` keeps what the mapping sees continuous.

After a hold the hand is elsewhere. The difference is added to the samples, and fades smoothly and
slowly (`glide`), or stays for the palm, as after a clutch, and fades for the fingers (`clutch`). So
the robot never snaps, whatever the method.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.mapping.method import HumanPose
from handmap_qp.se3 import affine

RejoinKind = Literal["glide", "clutch"]
"""How the robot comes back to the human after a hold."""

FINGER_SPEED = 0.4
"""Largest speed that fading adds to a point in wrist axes [m/s]."""
PALM_SPEED = 0.5
"""Largest speed that fading adds to the wrist [m/s]."""
TURN_SPEED = 3.0
"""Largest angular speed that fading adds to the wrist [rad/s]."""
_SHORTEST = 0.1
"""Shortest time of fading [s]."""
_PEAK = 1.875
"""Largest speed of a minimum-jerk motion over its mean speed."""


class _Offset(NamedTuple):
    """What was seen last minus what the tracker says, at the return.

    Attributes:
        points: In wrist axes, or in the world without a wrist [m], shape (n, 3).
        position: Of the wrist [m], shape (3,).
        turn: Rotation vector of the wrist, in its own axes [rad], shape (3,).
        duration: Time of fading [s].
    """

    points: np.ndarray
    position: np.ndarray
    turn: np.ndarray
    duration: float


class Rejoin(NamedTuple):
    """State of the return after a sample; `start` and `advance` return the next one.

    Attributes:
        kind: `glide` or `clutch`.
        seen: The last pose that was mapped; None before the first.
        offset: What is added to the samples; None if nothing.
        elapsed: Time since the return [s].
    """

    kind: RejoinKind = "glide"
    seen: HumanPose | None = None
    offset: _Offset | None = None
    elapsed: float = 0.0

    @property
    def is_fading(self) -> bool:
        """Whether the robot is still on its way to the human."""
        return self.offset is not None and self.elapsed < self.offset.duration

    def start(self, pose: HumanPose) -> Rejoin:
        """Begin at the first sample after a hold.

        Args:
            pose: The hand as the tracker sees it.
        """
        before = self.seen
        if before is None or (before.wrist is None) != (pose.wrist is None):
            return self._replace(offset=None)
        points = before.in_wrist - pose.in_wrist
        position, turn = np.zeros(3), np.zeros(3)
        if before.wrist is not None and pose.wrist is not None:
            position = before.wrist[:3, 3] - pose.wrist[:3, 3]
            turn = pin.log3(pose.wrist[:3, :3].T @ before.wrist[:3, :3])
        times = [_SHORTEST, _PEAK * _longest(points) / FINGER_SPEED]
        if self.kind == "glide":
            times += [_PEAK * _longest(position[None]) / PALM_SPEED]
            times += [_PEAK * _longest(turn[None]) / TURN_SPEED]
        return self._replace(offset=_Offset(points, position, turn, max(times)), elapsed=0.0)

    def advance(self, pose: HumanPose, dt: float) -> tuple[HumanPose, Rejoin]:
        """Return the pose to map, and the state after it.

        Args:
            pose: The hand as the tracker sees it.
            dt: Time since the sample before [s]; ignored in the first sample after a hold.
        """
        offset = self.offset
        if offset is None:
            return pose, self._replace(seen=pose)
        left = 1.0 - _minimum_jerk(self.elapsed / offset.duration)
        stays = self.kind == "clutch"
        moved = _moved(pose, offset, left, 1.0 if stays else left)
        is_over = left == 0.0 and not stays
        return moved, self._replace(
            seen=moved, offset=None if is_over else offset, elapsed=self.elapsed + dt
        )


def _moved(pose: HumanPose, offset: _Offset, fingers: float, palm: float) -> HumanPose:
    """Add shares of an offset to a pose."""
    points, wrist = pose.in_wrist + fingers * offset.points, pose.wrist
    if wrist is not None:
        rotation = wrist[:3, :3] @ pin.exp3(palm * offset.turn)
        wrist = affine(rotation, wrist[:3, 3] + palm * offset.position)
    return HumanPose.placed(points, wrist)


def _longest(rows: np.ndarray) -> float:
    return math.sqrt(np.einsum("ij,ij->i", rows, rows).max())


def _minimum_jerk(share: float) -> float:
    """Go from 0 to 1 with no speed and no acceleration at either end (Flash and Hogan 1985)."""
    share = min(max(share, 0.0), 1.0)
    return share * share * share * (10.0 + share * (6.0 * share - 15.0))
