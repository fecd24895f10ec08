"""`GrippingFollower`: holds what a saved hand meets, where samples come with measured joints."""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike

from handmap_core.errors import expect
from handmap_qp.human.sample import HumanSample
from handmap_qp.ik.motion import When
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.method import MapStep
from handmap_qp.stream.follower import Follower
from handmap_qp.stream.grip import GripFollower
from handmap_qp.stream.hand_grip import GripOptions, can_grip
from handmap_qp.stream.object_place import PLACE_DEVIATION


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
        if is_asked(grip) and can_grip(mapper):
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


class _Plain(Follower):
    """What a grip leads: a follower by the method of its base class."""

    def __init__(self, follower: GrippingFollower) -> None:
        self.mapper = follower.mapper
        self.work = follower.work
        self._follower = follower

    def map_sample(self, sample: HumanSample, **times: Any) -> MapStep:
        return Follower.map_sample(self._follower, sample, **times)


def is_asked(grip: GripOptions | None) -> bool:
    """Return whether a hand holds what it meets.

    Raises:
        InvalidInputError: If `grip` is neither options nor None.
    """
    wanted = "a GripOptions, or None to hold nothing"
    expect(isinstance(grip, GripOptions | None), "grip", wanted, value=grip)
    return grip is not None
