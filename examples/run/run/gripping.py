"""Followers of saved hands that hold what these meet, where samples come with measured joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import ArrayLike

from handmap_qp.errors import expect
from handmap_qp.hands import Side
from handmap_qp.human.sample import HumanSample
from handmap_qp.ik.limits import When
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.method import MapStep
from handmap_qp.mapping.robot_mapper import RobotMapper, RobotStep
from handmap_qp.stream.follower import Follower
from handmap_qp.stream.grip import GripFollower, RobotGripFollower
from handmap_qp.stream.hand_grip import GripOptions, can_grip
from handmap_qp.stream.object_place import PLACE_DEVIATION
from handmap_qp.stream.robot_follower import RobotFollower


class GrippingFollower(Follower):
    """A `Follower` that holds what the hand meets; see `GripFollower`.

    Args:
        mapper: Maps the samples.
        grip: How what is met is held; None to hold nothing.
        **options: As of `Follower`.

    Attributes:
        gripping: Holds it; None for a hand that cannot grip, or shall not.

    Raises:
        InvalidInputError: If `grip` is something else.
    """

    def __init__(
        self, mapper: HandMapper, grip: GripOptions | None, **options: Any
    ) -> None:
        super().__init__(mapper, **options)
        self.gripping = None
        if _is_asked(grip) and can_grip(mapper):
            self.gripping = GripFollower(_Plain(self), grip)

    def map_sample(
        self,
        sample: HumanSample,
        *,
        dt: When | None = None,
        arrival: float | None = None,
        measured_q: ArrayLike | None = None,
        object_centre: ArrayLike | None = None,
        object_deviation: float = PLACE_DEVIATION,
    ) -> MapStep:
        """Map one sample of a tracker; see `Follower.map_sample`.

        Args:
            sample: The sample.
            dt: As there.
            arrival: As there.
            measured_q: Joint positions that the robot has now, as of `GripFollower.map_sample`. A
                hand that cannot grip ignores them, and the object.
            object_centre: Middle of the object, as there.
            object_deviation: Standard deviation of its error, as there.
        """
        if self.gripping is None:
            return super().map_sample(sample, dt=dt, arrival=arrival)
        return self.gripping.map_sample(
            sample,
            measured_q,
            object_centre,
            object_deviation,
            dt=dt,
            arrival=arrival,
        )


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
        if _is_asked(grip) and any(map(can_grip, mapper.leaders.values())):
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


class _Plain(Follower):
    """What a grip leads: a follower by the method of its base class."""

    def __init__(self, follower: GrippingFollower) -> None:
        self.mapper = follower.mapper
        self.work = follower.work
        self._follower = follower

    def map_sample(self, sample: HumanSample, **times: Any) -> MapStep:
        return Follower.map_sample(self._follower, sample, **times)


class _PlainRobot(RobotFollower):
    """The same of a robot."""

    def __init__(self, follower: GrippingRobotFollower) -> None:
        self.mapper = follower.mapper
        self.work = follower.work
        self._follower = follower

    def map_samples(
        self, samples: Mapping[Side, HumanSample], **times: Any
    ) -> RobotStep:
        return RobotFollower.map_samples(self._follower, samples, **times)


def _is_asked(grip: GripOptions | None) -> bool:
    """Return whether a hand holds what it meets.

    Raises:
        InvalidInputError: If `grip` is neither options nor None.
    """
    wanted = "a GripOptions, or None to hold nothing"
    expect(isinstance(grip, GripOptions | None), "grip", wanted, value=grip)
    return grip is not None
