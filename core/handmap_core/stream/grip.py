"""`GripFollower`, `RobotGripFollower`: followers that hold what a thumb and a finger have met.

`HandGrip` says how; a touch is found by the measured joints of the robot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Generic, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike

from handmap_core.errors import InvalidInputError, expect
from handmap_core.hands import GraspFinger, Side
from handmap_core.human import HumanSample
from handmap_core.ik import When
from handmap_core.mapping import MapStep, RobotStep, Stages
from handmap_core.mapping.exclusive import exclusively
from handmap_core.se3 import FARTHEST, Array, as_floats, is_real
from .follower import AnyMapper, Follower, map_with
from .further_terms import further_terms
from .hand_grip import GripOptions, HandGrip, can_grip
from .object_place import PLACE_DEVIATION
from .robot_follower import AnyRobot, RobotFollower

S = TypeVar("S", bound=MapStep)

_STILL = ("held", "released")
"""Outcomes of samples that a grip does not count."""


class GripFollower(Generic[AnyMapper]):
    """Lets a follower hold what thumb and finger grip, by the measured joints of the robot.

    It is for one hand, of fingers or jaws, and the method `Teleoperation`. Without an object, it
    follows as before.

    Args:
        follower: Follows the samples.
        fingers: What grips, the thumb first.
        grip: How what is gripped is held.

    Attributes:
        follower: As given.
        grip: As given; may be changed between samples.
        hand_grip: What is held.

    Raises:
        InvalidInputError: If `grip` is something else, it is for another preset, or the robot has
            no thumb with a finger or jaws.
    """

    def __init__(
        self,
        follower: Follower[AnyMapper],
        fingers: Sequence[GraspFinger],
        grip: GripOptions | None = None,
    ) -> None:
        self.follower = follower
        # To work on the grip is to work on what it holds with.
        self.work = follower.work
        options = _checked_options(grip)
        source = follower.mapper.source
        wanted = "a hand that `teleoperation` moves, with a thumb and a finger, or jaws"
        expect(can_grip(source, fingers), "follower", wanted, value=source.robot.name)
        self.hand_grip = HandGrip(source, fingers, options)

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @property
    def grip(self) -> GripOptions:
        """How what is gripped is held."""
        return self.hand_grip.options

    @grip.setter
    def grip(self, options: GripOptions) -> None:
        self.hand_grip.options = options

    def map_sample(
        self,
        sample: HumanSample,
        measured_q: ArrayLike | None,
        object_centre: ArrayLike | None = None,
        object_deviation: float = PLACE_DEVIATION,
        *,
        dt: When | None = None,
        arrival: float | None = None,
    ) -> MapStep:
        """Map one sample of a tracker; see `Follower.map_sample`.

        Args:
            sample: The sample.
            measured_q: Joint positions that the robot has now [rad or m], shape (n,): read anew
                for each sample. None where they were not read: what is held stays held, and nothing
                else is met.
            object_centre: Middle of the object in the robot's world [m], shape (3,), if it is
                known: pads that close near it meet around it. The wrist does not go there.
            object_deviation: Standard deviation of its error along each axis [m]; 0 for an exact
                one. The larger it is, the more the closing is the person's. A touch corrects the
                place along the line between the pads.
            dt: As of `Follower.map_sample` [s].
            arrival: Likewise.

        Returns:
            The step; its command has the `effort` of a grip.

        Raises:
            InvalidInputError: As there, or if a number here cannot be used.
            InvalidOptionsError: As there, or if the method has no pinches.
        """
        grip = self.hand_grip
        follower = self.follower
        # Most sessions never measure.
        if measured_q is None and object_centre is None and grip.is_idle:
            return follower.map_sample(sample, dt=dt, arrival=arrival)
        return self._map_measured(
            sample, measured_q, object_centre, object_deviation, dt, arrival
        )

    @exclusively
    def _map_measured(
        self,
        sample: HumanSample,
        measured_q: ArrayLike | None,
        object_centre: ArrayLike | None,
        object_deviation: float,
        dt: When | None,
        arrival: float | None,
    ) -> MapStep:
        """Map one sample by what is known of the robot and the object; see `map_sample`."""
        grip = self.hand_grip
        follower = self.follower
        mapper = follower.mapper
        q = _checked(measured_q, "measured_q", mapper.source.robot.rest.shape)
        centre: Array | None = None
        if object_centre is not None:
            centre = _checked(object_centre, "object_centre", (3,))
            is_length = (
                is_real(object_deviation) and 0.0 <= object_deviation <= FARTHEST
            )
            wanted = "a length >= 0 m"
            expect(is_length, "object_deviation", wanted, value=object_deviation)
        grip.prepare()
        step = map_with(follower, grip.terms, sample, dt=dt, arrival=arrival)
        if step.status not in _STILL:
            grip.is_seen = False
            if centre is not None:
                grip.see(centre, object_deviation)
            grip.advance(step, q, mapper.motion.dt)
        effort = grip.effort
        return step if effort is None else _with_effort(step, effort)


class RobotGripFollower(Generic[AnyRobot]):
    """Lets a follower of both hands hold what each of them grips; see `GripFollower`.

    Args:
        follower: Follows the samples.
        fingers: What grips, the thumb first, by side.
        grip: How what is gripped is held, by all hands.

    Attributes:
        follower: As given.
        hands: What each hand holds, by side; hands that cannot grip are left out.

    Raises:
        InvalidInputError: If `grip` is something else, or no hand can grip.
    """

    def __init__(
        self,
        follower: RobotFollower[AnyRobot],
        fingers: Mapping[Side, Sequence[GraspFinger]],
        grip: GripOptions | None = None,
    ) -> None:
        self.follower = follower
        # To work on the grip is to work on what it holds with.
        self.work = follower.work
        options = _checked_options(grip)
        self.hands: dict[Side, HandGrip] = {
            side: HandGrip(hand.source, fingers[side], options)
            for side, hand in follower.mapper.hands.items()
            if can_grip(hand.source, fingers[side])
        }
        wanted = "a robot that `teleoperation` moves, with thumbs and fingers, or jaws"
        name = follower.mapper.robot.name
        expect(self.hands, "follower", wanted, value=name)

    __copy__ = deepcopy

    @property
    def grip(self) -> GripOptions:
        """How what is gripped is held."""
        return next(iter(self.hands.values())).options

    @grip.setter
    def grip(self, options: GripOptions) -> None:
        for hand in self.hands.values():
            hand.options = options

    def map_samples(
        self,
        samples: Mapping[Side, HumanSample],
        measured_q: ArrayLike | None,
        *,
        dt: When | None = None,
        arrival: float | None = None,
    ) -> RobotStep:
        """Map one sample of each hand that has one; see `RobotFollower.map_samples`.

        Args:
            samples: The samples by side.
            measured_q: Joint positions of the whole robot, as of `GripFollower.map_sample`.
            dt: As of `RobotFollower.map_samples` [s].
            arrival: Likewise.

        Returns:
            The step; its command has the `effort` of all grips.

        Raises:
            InvalidInputError: As there, or if a number here cannot be used.
        """
        if measured_q is None and all(hand.is_idle for hand in self.hands.values()):
            return self.follower.map_samples(samples, dt=dt, arrival=arrival)
        return self._map_measured(samples, measured_q, dt, arrival)

    @exclusively
    def _map_measured(
        self,
        samples: Mapping[Side, HumanSample],
        measured_q: ArrayLike | None,
        dt: When | None,
        arrival: float | None,
    ) -> RobotStep:
        """Map samples by what is known of the robot; see `map_samples`."""
        follower = self.follower
        mapper = follower.mapper
        q = _checked(measured_q, "measured_q", mapper.robot.rest.shape)
        for hand in self.hands.values():
            hand.prepare()
        terms = [hand.terms for hand in self.hands.values()]
        with further_terms([mapper.hands[side] for side in self.hands], terms):
            step = follower.map_samples(samples, dt=dt, arrival=arrival)
        for side in samples:
            part = step.hands[side]
            if side in self.hands and part.status not in _STILL:
                self.hands[side].advance(part, q, mapper.motion.dt)
        efforts = [hand.effort for hand in self.hands.values()]
        found = [effort for effort in efforts if effort is not None]
        return _with_effort(step, np.sum(found, axis=0)) if found else step


def _checked_options(grip: GripOptions | None) -> GripOptions:
    """Return how what is gripped is held, by default if it is not given."""
    options = grip or GripOptions()
    expect(isinstance(options, GripOptions), "grip", "a GripOptions", value=options)
    return options


def _checked(
    given: ArrayLike | None, name: str, shape: tuple[int, ...]
) -> Array | None:
    """Return finite numbers of a shape, within `FARTHEST`, if there are any."""
    if given is None:
        return None
    numbers = as_floats(given, name, shape=shape)
    # Squares of larger ones overflow. NaN is not near either.
    if not np.abs(numbers).max() <= FARTHEST:
        as_floats(given, name, shape=shape, is_finite=True)
        wanted = f"numbers within {FARTHEST:g}"
        raise InvalidInputError(argument=name, expected=wanted, value=numbers.tolist())
    return numbers


def _with_effort(step: S, effort: Array) -> S:
    """Return a step whose command has the torques of a grip."""
    command = structs.replace(step.command, effort=effort)
    stages = Stages(step.stages.pose, step.asked, step.ik, command)
    return structs.replace(step, stages=stages)
