"""`CommandClock`: when the commands of a robot are, by the time stamps of all its hands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from handmap_core.hands import Side
from handmap_core.ik import SHORTEST_DT, Instant
from .guard import BEHIND, GAP, ArrivalCredit, SampleClock

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
