"""`Mapper`: what `HandMapper` and `RobotMapper` have in common: one robot that they move."""

from __future__ import annotations

from copy import deepcopy
from typing import Generic, TypeVar

from handmap_core.core import core
from handmap_core.ik import IkOptions, Motion
from .exclusive import WorkLock, exclusively
from .moving_robot import AnySolver, MovingRobot
from .reference import Placement

Core = TypeVar("Core", core.HandMapper, core.RobotMapper)


class Mapper(Generic[Core, AnySolver]):
    """Base of mappers.

    Attributes:
        moving_robot: The robot's side.
        work: Lets one thread at a time work on it; others get a `MapperBusyError`.
        core: What maps the next sample in the compiled core; None where Python has to look at it.
    """

    moving_robot: MovingRobot[AnySolver]
    work: WorkLock
    core: Core | None
    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @exclusively
    def __getstate__(self) -> dict[str, object]:
        """Return what a copy continues from."""
        return vars(self).copy()

    @property
    def point_ik(self) -> AnySolver:
        """The robot's posture and the QP. Read it only: changing it breaks the mapper."""
        return self.moving_robot.point_ik

    @property
    def ik(self) -> IkOptions:
        """Weights and settings of the QP."""
        return self.moving_robot.point_ik.options

    @property
    def placement(self) -> Placement:
        """Whether it is known where the robot is; setting `motion` says it."""
        return self.moving_robot.placement

    @property
    def time(self) -> float:
        """Instant of the last command, on the robot's clock [s]."""
        return self.moving_robot.time

    @property
    @exclusively
    def motion(self) -> Motion:
        """How the robot moves. Set it where something else has moved the robot.

        That does not set the robot's clock back.
        """
        return self.moving_robot.motion

    @motion.setter
    @exclusively
    def motion(self, motion: Motion) -> None:
        self.moving_robot.set_motion(motion)
        self._was_moved()

    def _was_moved(self) -> None:
        """Go on from where something else has moved the robot."""

    def engage(self) -> None:
        """Engage the robot: the next sample is the reference; it continues from where it is."""
        raise NotImplementedError

    @exclusively
    def disengage(self) -> None:
        """Disengage the robot: it brakes and holds still until `engage`, whatever comes."""
        self.moving_robot.is_released = True
        self.core = None

    def clutch(self) -> None:
        """Engage the robot: the former name of `engage`."""
        self.engage()

    def release(self) -> None:
        """Disengage the robot: the former name of `disengage`."""
        self.disengage()
