"""`RobotFollower`: a robot follows the samples of both hands of a person that make sense.

Each hand has the guard, the return and the smoothing of a `Follower`; the robot moves once for all.
Hands may come together, in turns, and at rates of their own. Filters of a hand count in the time
since its own last sample, and the robot's limits in the time since the robot's last command, which
`CommandClock` reads from the time stamps of all hands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from typing import Generic, Protocol, TypeVar

from handmap_core.errors import HandmapError, expect
from handmap_core.hands import Hand, Side
from handmap_core.human import HumanSample, Verdict
from handmap_core.ik import Motion, When
from handmap_core.mapping.exclusive import WorkLock, exclusively
from handmap_core.mapping.robot_step import RequestStep, RobotStep
from .command_clock import CommandClock
from .further_terms import TaskedMapper
from .guard import StreamGuard
from .hand_follower import HandFollower, SampleMapper
from .rejoin import RejoinKind
from .smoothing import Smoothing

_SILENCE = 0.25
"""Time without a sample after which a hand is held [s]."""


class TrackedHand(SampleMapper[RequestStep], TaskedMapper, Protocol):
    """One hand of a robot."""


class TrackedRobot(Protocol):
    """What moves a robot with two hands: a `RobotMapper`.

    Attributes:
        work: Lets one thread at a time work on it.
    """

    work: WorkLock

    @property
    def hands(self) -> Mapping[Side, TrackedHand]:
        """Each hand of the robot, by side."""

    @property
    def robot(self) -> Hand:
        """The robot as one hand."""

    @property
    def time(self) -> float:
        """Instant of the last command, on the robot's clock [s]."""

    @property
    def motion(self) -> Motion:
        """How the robot moves."""

    def time_since_sample(self, side: Side, when: When) -> float:
        """Return the time from a hand's last sample to a command that it has one for [s]."""

    def step(
        self,
        sides: Iterable[Side],
        request_of: Callable[[Side], RequestStep],
        when: When | None = None,
    ) -> RobotStep:
        """Move the robot for requests of its hands; see `RobotMapper.step`."""

    def stay(self, side: Side, verdict: Verdict) -> None:
        """Let a hand of the robot stay where it is until its next sample."""


AnyRobot = TypeVar("AnyRobot", bound=TrackedRobot)


class RobotFollower(Generic[AnyRobot]):
    """Lets a robot follow the samples of a tracker of both hands.

    A hand whose sample makes no sense, or that has been without one for a quarter
    of a second, holds its side of the robot; the other one is followed.

    Args:
        mapper: Maps the samples; its human hands must be scaled to the person.
        guards: Judge the samples of each hand, by side.
        rejoin: As of `Follower`.
        smoothing: Likewise.

    Attributes:
        mapper: As given.
        hands: The follower of each hand, by side.
    """

    def __init__(
        self,
        mapper: AnyRobot,
        guards: Mapping[Side, StreamGuard],
        *,
        rejoin: RejoinKind = "glide",
        smoothing: Smoothing | None = Smoothing(),
    ) -> None:
        self.mapper = mapper
        self.work = mapper.work
        self.hands = {
            side: HandFollower(
                hand,
                guards[side],
                RequestStep,
                rejoin=rejoin,
                smoothing=smoothing,
            )
            for side, hand in mapper.hands.items()
        }
        # Instants of the robot's commands that had a sample of each hand.
        self._seen = dict.fromkeys(self.hands, -math.inf)
        self._clock = CommandClock()

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @exclusively
    def map_samples(
        self,
        samples: Mapping[Side, HumanSample],
        *,
        dt: When | None = None,
        arrival: float | None = None,
    ) -> RobotStep:
        """Map one sample of each hand that has one; errors as of `Follower`.

        A hand without a sample goes on to its last request. The robot takes the time since its last
        command, whichever hand that was for.

        Args:
            samples: The samples by side.
            dt: Time since the robot's last command [s], or the instant of this one on the robot's
                clock; by the time stamps if omitted. A sample whose stamp is not later than that
                of the last command takes (nearly) no time.
            arrival: When the samples arrived, on a monotonic clock [s]: to check the rate of the
                time stamps, to relate hands whose senders have different clocks, and to tell a
                pause from another clock. Without it, a robot stands still for a sample that is
                more than 10 s later than its last command.
        """
        expect(
            isinstance(samples, Mapping),
            "samples",
            "a HumanSample of each hand by side",
            value=samples,
        )
        followed: dict[Side, RequestStep] = {}
        mapper = self.mapper
        clock = self._clock
        when: When | None = dt
        # The followers of the hands reject what is no sample.
        stamps = {
            side: sample.time
            for side, sample in samples.items()
            if isinstance(sample, HumanSample)
        }
        if dt is None and stamps:
            clock, when = clock.advance(stamps, mapper.time, arrival)

        def follow(side: Side) -> RequestStep:
            since = None if dt is None else mapper.time_since_sample(side, dt)
            followed[side] = self.hands[side].map_sample(
                samples[side], dt=since, arrival=arrival
            )
            return followed[side]

        try:
            step = mapper.step(samples, follow, when)
        except HandmapError:
            # The hand whose sample was refused is as it was before by itself.
            for side, step in followed.items():
                self.hands[side].forget(step)
            raise
        self._clock = clock
        now = mapper.time
        self._seen |= dict.fromkeys(samples, now)
        for side, time in self._seen.items():
            if now - time > _SILENCE:
                mapper.stay(side, Verdict("missing", True, False, 0.0, math.nan))
        return step
