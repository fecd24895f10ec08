"""`GrippingRobotFollower`: holds what both hands of a saved robot meet; see `gripping`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import ArrayLike

from handmap_qp.hands import Side
from handmap_qp.human.sample import HumanSample
from handmap_qp.ik.motion import When
from handmap_qp.mapping.robot_mapper import RobotMapper, RobotStep
from handmap_qp.stream.grip import RobotGripFollower
from handmap_qp.stream.hand_grip import GripOptions, can_grip
from handmap_qp.stream.robot_follower import RobotFollower
from .gripping import is_asked


class GrippingRobotFollower(RobotFollower):
    """A `RobotFollower` that holds what each hand meets; see `RobotGripFollower`.

    Args:
        mapper: Maps the samples.
        grip: How what is met is held; None to hold nothing.
        **options: As of `Follower`.

    Attributes:
        gripping: Holds it; None for a robot whose hands cannot grip, or shall not.

    Raises:
        InvalidInputError: If `grip` is something else.
    """

    def __init__(
        self, mapper: RobotMapper, grip: GripOptions | None, **options: Any
    ) -> None:
        super().__init__(mapper, **options)
        self.gripping = None
        if is_asked(grip) and any(map(can_grip, mapper.leaders.values())):
            self.gripping = RobotGripFollower(_PlainRobot(self), grip)

    def map_samples(
        self,
        samples: Mapping[Side, HumanSample],
        *,
        dt: When | None = None,
        arrival: float | None = None,
        measured_q: ArrayLike | None = None,
    ) -> RobotStep:
        """Map one sample of each hand that has one; see `RobotFollower.map_samples`.

        Args:
            samples: The samples by side.
            dt: As there.
            arrival: As there.
            measured_q: Joint positions that the robot has now, as of `GripFollower.map_sample`. A
                robot whose hands cannot grip ignores them.
        """
        if self.gripping is None:
            return super().map_samples(samples, dt=dt, arrival=arrival)
        return self.gripping.map_samples(samples, measured_q, dt=dt, arrival=arrival)


class _PlainRobot(RobotFollower):
    """What a grip leads: a follower by the method of its base class."""

    def __init__(self, follower: GrippingRobotFollower) -> None:
        self.mapper = follower.mapper
        self.work = follower.work
        self._follower = follower

    def map_samples(
        self, samples: Mapping[Side, HumanSample], **times: Any
    ) -> RobotStep:
        return RobotFollower.map_samples(self._follower, samples, **times)
