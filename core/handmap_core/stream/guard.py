"""`StreamGuard`: which samples of a tracker make sense, by named rules.

Trackers lose the hand, find it elsewhere, confuse palm and back, repeat old data and report zeros.
The guard compares every sample with the person's hand and with the sample before, and says whether
the robot may follow it. A sample that it rejects never moves the robot; `stream.follower` leads
back to the hand afterwards.

Time stamps jitter, repeat, arrive in disorder, and jump when the tracker's clock is set.
`SampleClock` says what they mean, and all the rest counts in the time that it gives, never in
samples. The compiled core decides (`handmap/stream_clock.hpp`, `handmap/guard.hpp`);
`human.sample.RULES` has its rules in words.
"""

from __future__ import annotations

from typing import Any

from handmap_core.core import core
from handmap_core.errors import expect
from handmap_core.hands import Hand, Side
from handmap_core.human import (
    Finding,
    HumanSample,
    Recording,
    Verdict,
    landmarks_at_rest,
)
from handmap_core.human.sample import VerdictNumbers
from handmap_core.ik import BEHIND as BEHIND
from handmap_core.models import GuardModel, encode
from handmap_core.se3 import Array
from handmap_core.trackers.orders import KnownOrders

GAP: float = core.GAP
"""A longer time between stamps is a gap: samples are missing, or the clock was set [s]."""
FROZEN_AFTER: float = core.FROZEN_AFTER
"""Landmarks that repeat exactly for longer are frozen, and not those of a slow tracker [s]."""
SETTLING: float = core.SETTLE_TIME
"""Time that samples must make sense before they are followed again, after a fault [s]."""

SampleClock = core.SampleClock
"""State of a stream's clock after a sample; `advance(stamp)` returns the next one."""
ArrivalCredit = core.ArrivalCredit
"""Time that the next samples may account for, by the times at which they arrive."""


class StreamGuard:
    """Judges the samples of one hand, one after the other.

    Args:
        human: The human hand, scaled to the person.
        orders: Orders that landmarks may be in by mistake.

    Attributes:
        core: The guard of the compiled core.

    Raises:
        HandError: If the hand has no landmarks.
    """

    def __init__(self, human: Hand, orders: KnownOrders) -> None:
        self._side: Side = human.side
        self._orders = orders
        self._landmarks = landmarks_at_rest(human)
        self.core = self._new_core()

    def _new_core(self) -> core.StreamGuard:
        model = GuardModel(side=self._side, landmarks=self._landmarks)
        return core.StreamGuard(encode(model), self._orders.core)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy continues from."""
        return vars(self) | {"core": self.core.save()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue from the state of another one."""
        vars(self).update(state)
        self.core = self._new_core()
        self.core.restore(state["core"])

    def forget(self) -> None:
        """Forget the sample that was judged last, but not what it said about the input."""
        self.core.forget()

    def check(self, sample: HumanSample, *, arrival: float | None = None) -> Verdict:
        """Judge the next sample of the stream.

        Args:
            sample: The sample.
            arrival: When it arrived, on a monotonic clock [s]; None for a recording.

        Returns:
            Whether the robot may follow it, and what is wrong with it.

        Raises:
            InvalidInputError: If it is of the other hand.
            MapperBusyError: If another thread works on the guard.
        """
        self.check_side(sample)
        numbers = self.core.check(
            sample.time,
            sample.landmarks,
            sample.wrist,
            bool(sample.valid),
            sample.confidence,
            arrival,
        )
        return self.verdict_of(numbers)

    def verdict_of(self, numbers: VerdictNumbers) -> Verdict:
        """Return the verdict that the core gives as numbers."""
        rule, is_held, is_return, dt, consistency, found, lost, time = numbers
        finding = found and Finding.of_core(found, self._side, self._orders.names)
        return Verdict(rule, is_held, is_return, dt, consistency, finding, lost, time)

    def is_own(self, sample: HumanSample) -> bool:
        """Return whether something is a sample, and of this hand."""
        return type(sample) is HumanSample and sample.side == self._side

    def check_side(
        self, samples: HumanSample | Recording, kind: type = HumanSample
    ) -> None:
        """Reject samples of the other hand, and what is not of their kind."""
        if not isinstance(samples, kind):
            expect(False, "sample", f"a {kind.__name__}", value=samples)
        if samples.side != self._side:
            expect(
                False,
                "side",
                f"samples of a {self._side} hand",
                value=samples.side,
                got=f"one of a {samples.side} hand",
            )

    def holds(self, recording: Recording) -> Array:
        """Tell which samples of a recording the robot may not follow, wrists apart, shape (T,)."""
        valid = recording.valid
        return self.core.holds(
            core.Samples(
                recording.time, recording.landmarks, valid, recording.confidence
            )
        )
