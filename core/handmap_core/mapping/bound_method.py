"""`BoundMethod`: a mapping method for two given hands, as far as samples need to know it."""

from __future__ import annotations

from typing import Protocol

from handmap_core.hands import Hand
from handmap_core.se3 import Array
from .targets import HumanPose, RobotPosture, TargetMap


class BoundMethod(Protocol):
    """A method for two given hands.

    Attributes:
        needs_wrist: Use of every sample's wrist pose, for error messages; empty if not needed.
        reference_needs_wrist: Use of the reference sample's wrist pose, likewise.
        renews_reference: True if every sample becomes the reference of the next one (Fig. 3).
    """

    needs_wrist: str
    reference_needs_wrist: str
    renews_reference: bool

    @property
    def robot(self) -> Hand:
        """The hand that follows, with the reference points that the method moves."""

    def start_palm(self, sample: HumanPose) -> Array:
        """Return where a floating robot's palm is put at the first sample, shape (4, 4)."""

    def start(self, sample: HumanPose, robot: RobotPosture) -> TargetMap:
        """Take both hands as they are for the reference.

        Raises:
            DegeneratePointsError: If the sample's points do not determine a motion.
        """
