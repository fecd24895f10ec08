"""`GrippingRobotFollower`: holds what both hands of a saved robot meet; see `gripping`."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy

from numpy.typing import ArrayLike

from handmap_core.human.sample import HumanSample
from handmap_core.ik.motion import When
from handmap_core.mapping.robot_step import RobotStep
from handmap_core.stream.hand_grip import GripOptions, can_grip
from handmap_qp.hands import Side
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.stream.grip import RobotGripFollower
from handmap_qp.stream.robot_follower import RobotFollower
from .gripping import is_asked


class GrippingRobotFollower:
    """Follows as a `RobotFollower`, and holds what each hand meets as a `RobotGripFollower`.

    Args:
        follower: Follows the samples.
        grip: How what is met is held; None to hold nothing.

    Attributes:
        follower: As given.
        gripping: Holds what the hands meet; None if none of them can grip, or must not.

    Raises:
        InvalidInputError: If `grip` is something else.
    """

    def __init__(self, follower: RobotFollower, grip: GripOptions | None) -> None:
        self.follower = follower
        self.gripping = None
        if is_asked(grip) and any(map(can_grip, follower.mapper.sources.values())):
            self.gripping = RobotGripFollower(follower, grip)

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @property
    def mapper(self) -> RobotMapper:
        """Maps the samples."""
        return self.follower.mapper

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
            return self.follower.map_samples(samples, dt=dt, arrival=arrival)
        return self.gripping.map_samples(samples, measured_q, dt=dt, arrival=arrival)
