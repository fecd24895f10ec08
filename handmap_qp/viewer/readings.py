"""The numbers of one instant: wrist error and pinch gaps (`Readings`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS
from handmap_qp.offline.surface_gaps import GapMeter
from handmap_qp.trackers.contact_gap import tip_gaps
from handmap_qp.viewer.sample import ViewSample


@dataclass(frozen=True, slots=True)
class Readings:
    """What the gauges say about one robot at one instant.

    Attributes:
        error: Mean and largest point error [m]; None without targets.
        wrist: Distance [m] and angle [rad] of the wrist from its target; None without a target, or
            for a wrist that cannot move.
        pinches: Gap between the surfaces of the thumb's and each other finger's last link [m],
            negative where they overlap, by the finger's name.
    """

    error: tuple[float, float] | None
    wrist: tuple[float, float] | None
    pinches: dict[str, float]


class RobotReader:
    """Reads the numbers of one robot hand.

    Args:
        robot: The robot hand.
    """

    def __init__(self, robot: Hand) -> None:
        self._has_moving_wrist = robot.has_moving_wrist
        try:
            self._meter = GapMeter(robot)
        except HandError:
            # Without readable collision shapes, only the pinch gaps are missing.
            self._meter = None

    def read(self, sample: ViewSample) -> Readings:
        """Return the numbers of a sample."""
        error = sample.point_error
        return Readings(
            (float(error.mean()), float(error.max())) if len(error) else None,
            self._wrist_error(sample),
            self._pinches(sample),
        )

    def _pinches(self, sample: ViewSample) -> dict[str, float]:
        gaps = {} if self._meter is None else self._meter.pinches(sample.robot_q[None])
        return {finger: float(gap[0]) for finger, gap in gaps.items()}

    def _wrist_error(self, sample: ViewSample) -> tuple[float, float] | None:
        wanted, wrist = sample.wrist_target, sample.robot_wrist
        if wanted is None or not self._has_moving_wrist:
            return None
        angle = np.linalg.norm(pin.log3(wanted[:3, :3].T @ wrist[:3, :3]))
        return float(np.linalg.norm(wrist[:3, 3] - wanted[:3, 3])), float(angle)


def human_pinches(sample: ViewSample, contact_gap: float) -> dict[str, float]:
    """Return the human's gap between thumb and each other finger [m], by the finger's name.

    Args:
        sample: The sample.
        contact_gap: What the tracker measures between two tips where the skin touches [m]. It is
            subtracted, so that a touch reads zero.
    """
    if sample.landmarks is None or not np.isfinite(sample.landmarks).all():
        return {}
    gaps = np.maximum(tip_gaps(sample.landmarks) - contact_gap, 0.0)
    return dict(zip(FINGERS[1:], map(float, gaps), strict=True))
