"""`GrippingFollower`: holds what a saved hand meets, where samples come with measured joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Generic

from numpy.typing import ArrayLike

from handmap_core.errors import expect
from handmap_core.hands import GraspFinger
from handmap_core.human import HumanSample, Recording
from handmap_core.ik import When
from handmap_core.mapping import MapStep
from handmap_core.stream.follower import AnyMapper, Follower
from handmap_core.stream.grip import GripFollower
from handmap_core.stream.hand_grip import GripOptions, can_grip
from handmap_core.stream.object_place import PLACE_DEVIATION
from handmap_core.stream.step_table import StepTable


class GrippingFollower(Generic[AnyMapper]):
    """Follows as a `Follower`, and holds what the hand meets as a `GripFollower`.

    Args:
        follower: Follows the samples.
        fingers: What grips, the thumb first; empty where nothing does.
        grip: How what is met is held; None to hold nothing.

    Attributes:
        follower: As given.
        gripping: Holds what the hand meets; None if it cannot grip, or must not.

    Raises:
        InvalidInputError: If `grip` is something else.
    """

    def __init__(
        self,
        follower: Follower[AnyMapper],
        fingers: Sequence[GraspFinger],
        grip: GripOptions | None,
    ) -> None:
        self.follower = follower
        self.gripping: GripFollower[AnyMapper] | None = None
        check_grip(grip)
        if grip is not None and can_grip(follower.mapper.source, fingers):
            self.gripping = GripFollower(follower, fingers, grip)

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @property
    def mapper(self) -> AnyMapper:
        """Maps the samples."""
        return self.follower.mapper

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
            return self.follower.map_sample(sample, dt=dt, arrival=arrival)
        return self.gripping.map_sample(
            sample,
            measured_q,
            object_centre,
            object_deviation,
            dt=dt,
            arrival=arrival,
        )

    def map_samples(
        self, samples: Recording, progress: Callable[[int], None] | None = None
    ) -> StepTable:
        """Map the samples of a recording without a grip; see `Follower.map_samples`."""
        return self.follower.map_samples(samples, progress)


def check_grip(grip: GripOptions | None) -> None:
    """Reject what does not say how a hand holds what it meets.

    Raises:
        InvalidInputError: If `grip` is neither options nor None.
    """
    wanted = "a GripOptions, or None to hold nothing"
    expect(isinstance(grip, GripOptions | None), "grip", wanted, value=grip)
