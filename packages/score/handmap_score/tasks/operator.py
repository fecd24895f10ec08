"""The seam of operators: an operator sees a scene and shows a human hand, or two."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple, Protocol

from handmap_qp.human import Recording
from handmap_qp.se3 import Array

if TYPE_CHECKING:
    from .task import Scene

Joints = Mapping[str, float]
"""Joint positions by the robot's joint names [rad or m]."""

OTHER = "/other/"
"""Begin of the names of all joints and bodies of the robot's other hand, in a task of two hands."""
_NO_JOINTS: Joints = MappingProxyType({})


class HumanHand(NamedTuple):
    """A human hand at one instant, as a tracker would give it.

    Attributes:
        landmarks: The 21 landmarks in MediaPipe's order, in the task's world [m], shape (21, 3).
        wrist: Pose that the operator wants for the robot's wrist, in the task's world, (4, 4).
        joints: Joints that the operator commands itself, by name [rad or m]: all joints of an
            expert on its own hand, arm included. Empty for an operator with another hand.
        other: The person's other hand at the same instant, in a task of two hands; it leads the
            robot's other hand. None in a task of one hand.
    """

    landmarks: Array
    wrist: Array
    joints: Joints = _NO_JOINTS
    other: "HumanHand | None" = None


class Operator(Protocol):
    """A person, or a stand-in for one, who closes the loop.

    An operator is used by one process at a time. Two operators of one name, reset with one seed,
    show the same hands for the same scenes.
    """

    @property
    def name(self) -> str:
        """Short name, for tables."""
        ...

    @property
    def has_finished(self) -> bool:
        """Whether the operator will do nothing more in this attempt."""
        ...

    def calibrate(self, seed: int) -> Recording:
        """Return a recording from which the person is measured, before any attempt.

        Args:
            seed: Chooses the motion. Other seeds show how much the measurement decides.
        """
        ...

    def reset(self, seed: int) -> None:
        """Begin an attempt: forget all that was seen and learned.

        Args:
            seed: Seed of everything random in the operator.
        """
        ...

    def see(self, scene: "Scene") -> HumanHand:
        """Return the hand at the scene's instant; called once a step, in order of time."""
        ...
