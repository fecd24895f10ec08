"""`RobotFollower`: a robot follows the samples of both hands of a person that make sense.

Each hand has the guard, the return and the smoothing of a `Follower`; the robot moves once for all.
Hands may come together, in turns, and at rates of their own. Filters of a hand count in the time
since its own last sample, and the robot's limits in the time since the robot's last command, which
`CommandClock` reads from the time stamps of all hands.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from copy import deepcopy
from typing import NamedTuple

import numpy as np

from handmap_core.errors import HandmapError, expect
from handmap_core.mapping.exclusive import exclusively
from handmap_core.stream.hand_follower import HandFollower
from handmap_core.stream.rejoin import RejoinKind
from handmap_core.stream.smoothing import Smoothing
from handmap_qp.hands import Side
from handmap_qp.human import HumanSample, Recording, Verdict, sample_columns
from handmap_qp.ik import SHORTEST_DT, Instant, When
from handmap_qp.mapping import RequestStep, RobotMapper, RobotStep
from .guard import BEHIND, GAP, ArrivalCredit, SampleClock, StreamGuard

_SILENCE = 0.25
"""Time without a sample after which a hand is held [s]."""
_AHEAD = 10.0
"""A sample that is later than its arrival allows by more is of another clock [s].

Without times of arrival, a sample that is later than the robot's last command by more may be.
"""
_LONGEST_PAUSE = 86400.0
"""Without times of arrival, a sample that is later by more is of another clock [s]."""


class CommandClock(NamedTuple):
    """The clocks of all hands of a robot, and when its commands are.

    Hands whose stamps can be of one clock are taken to have one. Where a stamp cannot be, because a
    clock was set back or a hand has a sender of its own, the times of arrival say how much time has
    passed since the robot's last command. Without them, that is not known, and the sample takes
    (nearly) none. Stamps that run faster than the times of arrival do not move the robot's clock
    either.

    A stamp that is much later is taken to be right, whichever hand it is of, unless the times of
    arrival contradict it: all hands may have paused. Without times of arrival, it may also be of
    another clock. So the robot's clock goes by the stamp, but the robot stands still for that
    command. Its displacement and its velocity are then zero, however much time has passed.

    Attributes:
        offsets: The robot's clock minus the stamps of each hand, by side [s].
        stamps: The clock of each hand's own stamps, by side: it tells a late sample from a clock
            that was set back.
        rate: Judges gaps between commands, and knows their usual period.
        arrival: When the samples of the last command arrived [s]; None if that is not known.
        credit: The time that the next samples may account for by their arrival.
    """

    offsets: Mapping[Side, float] = {}
    stamps: Mapping[Side, SampleClock] = {}
    rate: SampleClock = SampleClock()
    arrival: float | None = None
    credit: ArrivalCredit = ArrivalCredit()

    def advance(
        self, stamps: Mapping[Side, float], now: float, arrival: float | None
    ) -> tuple[CommandClock, Instant]:
        """Return the clock after samples, and the instant of the robot's command for them.

        Args:
            stamps: Time stamps of the samples by side, in the clocks of their senders [s].
            now: Instant of the robot's last command, on its clock [s].
            arrival: When the samples arrived, on a monotonic clock [s]; None if that is not known.
        """
        is_known = arrival is not None and self.arrival is not None
        waited = max(arrival - self.arrival, 0.0) if is_known else 0.0
        farthest = waited + _AHEAD if is_known else _LONGEST_PAUSE
        if not self.offsets:
            waited = self.rate.period
        offsets = dict(self.offsets)
        clocks = dict(self.stamps)
        for side, stamp in stamps.items():
            clocks[side] = clocks.get(side, SampleClock()).advance(stamp)
            # A clock that was set back by less than `BEHIND` fits its former offset, and that of a
            # hand with the same clock that had no sample since.
            earliest = -GAP if clocks[side].is_set_back else -BEHIND
            # Its own clock first, then those of the other hands.
            candidates = [offsets[side]] if side in offsets else []
            candidates += offsets.values()
            fitting = (
                offset
                for offset in candidates
                if earliest <= stamp + offset - now <= farthest
            )
            offsets[side] = next(fitting, now + waited - stamp)
        time = max(stamp + offsets[side] for side, stamp in stamps.items())
        rate = self.rate.advance(time)
        granted, credit = rate.dt, self.credit
        if arrival is not None:
            credit, granted = credit.spend(rate.dt, arrival)
        if granted < rate.dt:
            # These stamps outrun arrival. Hands may share a clock, so all of them lag behind.
            excess = max(time - now - granted, 0.0)
            time -= excess
            rate = rate.at(time)
            offsets = {side: offset - excess for side, offset in offsets.items()}
        if time - now > _AHEAD and not is_known:
            # A pause, or another clock: only a robot that stands still is slow enough for both.
            granted = 0.0
        instant = Instant(time, max(granted, SHORTEST_DT))
        return CommandClock(offsets, clocks, rate, arrival, credit), instant


class RobotFollower:
    """Lets a robot follow the samples of a tracker of both hands.

    A hand whose sample makes no sense, or that has been without one for a quarter
    of a second, holds its side of the robot; the other one is followed.

    Args:
        mapper: Maps the samples; its human hands must be scaled to the person.
        rejoin: As of `Follower`.
        smoothing: Likewise.

    Attributes:
        mapper: As given.
        hands: The follower of each hand, by side.
    """

    def __init__(
        self,
        mapper: RobotMapper,
        *,
        rejoin: RejoinKind = "glide",
        smoothing: Smoothing | None = Smoothing(),
    ) -> None:
        self.mapper = mapper
        self.work = mapper.work
        self.hands = {
            side: HandFollower(
                hand,
                StreamGuard(hand.source.human),
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
            clock, when = clock.advance(stamps, mapper.point_ik.gate.time, arrival)

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
        now = mapper.point_ik.gate.time
        self._seen |= dict.fromkeys(samples, now)
        for side, time in self._seen.items():
            if now - time > _SILENCE:
                mapper.stay(side, Verdict("missing", True, False, 0.0, math.nan))
        return step


def paired(recordings: Mapping[Side, Recording]) -> Iterator[dict[Side, HumanSample]]:
    """Yield the samples of both hands at the instants of the one that has most.

    The other one's are the newest at each instant, and used once. At the first instant, one that is
    more than `BEHIND` older is left out: it would say that the hands have different clocks.
    """
    leading = max(recordings.values(), key=len)
    columns = {side: sample_columns(each) for side, each in recordings.items()}
    stale = leading.time[0] - BEHIND
    before = {
        side: np.searchsorted(each.time, stale, "left") - 1
        for side, each in columns.items()
    }
    for time in leading.time:
        newest = {
            side: np.searchsorted(each.time, time, "right") - 1
            for side, each in columns.items()
        }
        yield {s: columns[s].sample(k) for s, k in newest.items() if k > before[s]}
        before = newest
