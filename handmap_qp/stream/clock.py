"""`SampleClock`: what the time stamps of a stream say about a sample.

Stamps jitter, repeat, arrive in disorder, and jump when the tracker's clock is set. Everything else
that looks at the stream counts in the time that this clock gives, and never in samples.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

TimeRule = Literal["", "duplicate", "disorder", "gap", "clock_jump"]
"""What is unusual about a time stamp; empty if nothing is."""

LONGEST_STEP = 3.0
"""Longest time that one sample accounts for, in usual periods.

After a longer one the robot has stood still, and must not make up for it in one command.
"""
GAP = 0.25
"""A longer time between stamps is a gap: samples are missing, or the clock was set [s]."""
_SET_BACK = 1.0
"""A stamp earlier by more than this is of a clock that was set back, not of a late sample [s]."""
_SET_FORWARD = 10.0
"""A stamp later by more than this is of a clock that was set forward [s]."""
_LATE_SAMPLES = 5
"""Late samples in a row that increase among themselves: the clock was set back a little."""
_SHARE = 0.05
"""Share of a new interval in the usual period."""
_SHORTEST = 0.5
"""Least interval that speeds are computed from, over the usual period: stamps jitter."""

_RATE_WINDOW = 0.5
"""Time of arrival between two comparisons of the clocks [s]."""
_LARGEST_DRIFT = 0.3
"""Drift of stamps against arrival that a clock or a growing delay may have [s/s]."""


class Tick(NamedTuple):
    """What a time stamp says.

    Attributes:
        rule: What is unusual about it. Samples of `duplicate` and `disorder` bring nothing new.
        elapsed: Time since the last sample that counted [s]; the usual one after a clock jump.
        dt: Time that this sample accounts for [s], from 0 to `LONGEST_STEP` periods; one period at
            most after a sample that brought nothing new, for its command has taken the time.
    """

    rule: TimeRule
    elapsed: float
    dt: float


class SampleClock(NamedTuple):
    """State of the clock after a sample; `advance` returns the next one.

    Attributes:
        stamp: Stamp of the last sample that counted [s]; None before the first.
        period: Usual time between samples [s].
        late_stamp: Stamp of the last late sample [s].
        late_count: Late samples in a row.
        is_idle: Whether the last sample brought nothing new.
    """

    stamp: float | None = None
    period: float = 1.0 / 60.0
    late_stamp: float = 0.0
    late_count: int = 0
    is_idle: bool = False

    def advance(self, stamp: float) -> tuple[Tick, SampleClock]:
        """Judge the time stamp of a sample.

        Args:
            stamp: Time stamp [s]; only differences of it have a meaning.

        Returns:
            What it says, and the clock after it.
        """
        period = self.period
        if self.stamp is None:
            return Tick("", period, period), self._replace(stamp=stamp)
        step = stamp - self.stamp
        if step == 0.0:
            return Tick("duplicate", 0.0, 0.0), self._replace(is_idle=True)
        if -_SET_BACK <= step < 0.0:
            count = 1 + (self.late_count if stamp > self.late_stamp else 0)
            if count < _LATE_SAMPLES:
                late = self._replace(
                    late_stamp=stamp,
                    late_count=count,
                    is_idle=True,
                )
                return Tick("disorder", 0.0, 0.0), late
        if step < 0.0 or step > _SET_FORWARD:
            return Tick("clock_jump", period, period), SampleClock(stamp, period)
        if step > GAP:
            return Tick("gap", step, period), SampleClock(stamp, period)
        usual = period + _SHARE * (step - period)
        longest = period if self.is_idle else LONGEST_STEP * period
        return Tick("", step, min(step, longest)), SampleClock(stamp, usual)

    @property
    def shortest(self) -> float:
        """Least time that speeds are computed over [s]: jitter of stamps is not speed."""
        return _SHORTEST * self.period


class RateCheck:
    """Tells whether time stamps run as fast as their samples arrive.

    The clocks are compared each half second, by the last sample before. Two in a row must drift the
    same way: a stall of the network, the burst behind it and a clock that is set do not.
    """

    def __init__(self) -> None:
        self._start = self._former = math.nan
        self._lead = self._drift = 0.0
        self._rate: float | None = None

    def update(self, stamp: float, arrival: float) -> float | None:
        """Take the next sample.

        Args:
            stamp: Its time stamp [s].
            arrival: When it arrived, on a monotonic clock [s].

        Returns:
            Seconds of stamps in a second of arrival, if two half seconds in a row differ from it by
            more than 30 %; None otherwise.
        """
        self._start = arrival if math.isnan(self._start) else self._start
        elapsed = arrival - self._start
        if elapsed >= _RATE_WINDOW:
            # NaN, before there is a former half second, is no drift.
            drift = (self._lead - self._former) / elapsed
            before = self._drift
            is_off = (
                drift * before > 0.0 and min(abs(drift), abs(before)) > _LARGEST_DRIFT
            )
            self._rate = 1.0 + drift if is_off else None
            self._start = arrival
            self._former = self._lead
            self._drift = drift
        self._lead = stamp - arrival
        return self._rate
