"""The reference: both hands at the instant that motion is counted from."""

from __future__ import annotations

from enum import Enum, auto
from typing import NamedTuple, Protocol

from handmap_core.hands import Hand
from handmap_core.se3 import Array
from .bound_method import BoundMethod
from .targets import CoreMap, HumanPose, RobotPosture, TargetMap, check_members


class Placement(Enum):
    """Whether it is known where a robot is."""

    KNOWN = auto()
    UNKNOWN = auto()
    """Only its joints are known: the first sample puts its palm on the human's."""


class PlacedRobot(Protocol):
    """What a reference needs to know of a robot."""

    @property
    def placement(self) -> Placement:
        """Whether it is known where the robot is."""

    @property
    def q(self) -> Array:
        """Configuration last commanded, shape (nq,)."""


class Reference(NamedTuple):
    """Both hands at the reference.

    Attributes:
        sample: The human hand.
        posture: The robot hand.
        map: Makes targets of the samples from the reference on.
        q: The robot's configuration, shape (nq,).
    """

    sample: HumanPose
    posture: RobotPosture
    map: TargetMap
    q: Array

    @classmethod
    def at(cls, bound: BoundMethod, sample: HumanPose, q: Array) -> Reference:
        """Count from a sample, with the robot at a configuration (nq,).

        Raises:
            DegeneratePointsError: If the sample's points do not determine a motion.
            InvalidOptionsError: If what the method starts is no map.
        """
        posture = posture_of(bound.robot, q)
        target_map = bound.start(sample, posture)
        if not isinstance(target_map, CoreMap):
            maker = f"{type(bound).__name__}.start(sample, robot)"
            check_members(target_map, ("rest", "targets"), maker)
        return cls(sample, posture, target_map, q)

    def bound_again(self, bound: BoundMethod) -> Reference | None:
        """Count from the same instant by another method; None if it needs a wrist pose here."""
        needs_wrist = bound.needs_wrist or bound.reference_needs_wrist
        if needs_wrist and self.sample.wrist is None:
            return None
        return Reference.at(bound, self.sample, self.q)


def posture_of(robot: Hand, q: Array) -> RobotPosture:
    """Return where a robot's points and its wrist are in a configuration, shape (nq,)."""
    points, wrists = robot.tree.posture(q)
    return RobotPosture(q[robot.q_indices], points, wrists[0])
