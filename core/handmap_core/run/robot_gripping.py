"""`GrippingRobotFollower`: holds what both hands of a saved robot meet; see `gripping`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Generic

from numpy.typing import ArrayLike

from handmap_core.hands import GraspFinger, Side
from handmap_core.human import HumanSample
from handmap_core.ik import When
from handmap_core.mapping.robot_step import RobotStep
from handmap_core.stream.grip import RobotGripFollower
from handmap_core.stream.hand_grip import GripOptions, can_grip
from handmap_core.stream.robot_follower import AnyRobot, RobotFollower
from .gripping import check_grip


class GrippingRobotFollower(Generic[AnyRobot]):
    """Follows as a `RobotFollower`, and holds what each hand meets as a `RobotGripFollower`.

    Args:
        follower: Follows the samples.
        fingers: What grips, the thumb first, by side; empty where nothing does.
        grip: How what is met is held; None to hold nothing.

    Attributes:
        follower: As given.
        gripping: Holds what the hands meet; None if none of them can grip, or must not.

    Raises:
        InvalidInputError: If `grip` is something else.
    """

    def __init__(
        self,
        follower: RobotFollower[AnyRobot],
        fingers: Mapping[Side, Sequence[GraspFinger]],
        grip: GripOptions | None,
    ) -> None:
        self.follower = follower
        self.gripping: RobotGripFollower[AnyRobot] | None = None
        hands = follower.mapper.hands.items()
        check_grip(grip)
        if grip is not None and any(
            can_grip(hand.source, fingers[side]) for side, hand in hands
        ):
            self.gripping = RobotGripFollower(follower, fingers, grip)

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @property
    def mapper(self) -> AnyRobot:
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
