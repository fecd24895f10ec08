"""`StreamGuard`: which samples of a tracker make sense, by named rules.

Trackers lose the hand, find it elsewhere, confuse palm and back, repeat old data and report zeros.
The guard compares every sample with the person's hand and with the sample before, and says whether
the robot may follow it. It counts in the time of the stamps. A sample that it rejects never moves
the robot; `stream.follower` leads back to the hand afterwards.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import Side
from handmap_qp.human.landmarks import PalmShape, landmarks_at_rest
from handmap_qp.human.sample import HumanSample
from handmap_qp.human.verdict import Finding, Rule, Verdict
from handmap_qp.stream.clock import RateCheck, SampleClock, Tick
from handmap_qp.stream.motion import (
    BELIEVED,
    USUAL,
    Change,
    Track,
    change_between,
    first_track,
    fixed_lengths,
    is_same_hand,
    is_zero,
)
from handmap_qp.trackers.plausibility import InputCheck

FROZEN_AFTER = 0.25
"""Landmarks that repeat exactly for longer are frozen [s]."""
SETTLING = 0.1
"""Time that samples must make sense before they are followed again, after a fault [s]."""
_LONG_SETTLING = 0.5
"""The same after a flip or an outlier, which can last [s]."""
_BRIEF = 0.1
"""Holds up to this end at once when the hand is where it can have moved to meanwhile [s]."""
_EXCESS = np.array([12.0, 12.0, 12.0, 15.0])
"""A change is not a hand's if it is this many times the tracker's usual one."""
_RATE = 0.05
"""Share by which an estimate of a usual change moves with each sample.

It falls no lower than where it has an effect, so that it rises within half a second when noise
begins.
"""


class GuardState(NamedTuple):
    """What the guard remembers; replaced as a whole.

    Attributes:
        clock: The clock of the stream.
        now: Time of the stream [s]: the sum of the time steps.
        good: The last sample that was followed.
        last: The last sample that could be a hand's.
        usual: Running medians of the changes between samples, shape (4,), as `motion.BELIEVED`.
        cause: The rule that began the present hold; empty if there is none.
        steady_since: Time since which samples make sense [s].
        same_since: Time since which the landmarks are exactly the same [s].
    """

    clock: SampleClock = SampleClock()
    now: float = 0.0
    good: Track | None = None
    last: Track | None = None
    usual: np.ndarray = USUAL
    cause: Rule = ""
    steady_since: float = 0.0
    same_since: float = 0.0


class StreamGuard:
    """Judges the samples of one hand, one after the other.

    Args:
        human: The human hand, scaled to the person.

    Attributes:
        state: What it remembers. Put a former one back to forget the samples since then.

    Raises:
        HandError: If the hand has no landmarks.
    """

    def __init__(self, human: Hand) -> None:
        self.state = GuardState()
        self._side: Side = "left" if human.side == "left" else "right"
        self._input = InputCheck(self._side)
        self._rate = RateCheck()
        self._palm = PalmShape(human)
        self._lengths = fixed_lengths(landmarks_at_rest(human))

    def check(self, sample: HumanSample, *, arrival: float | None = None) -> Verdict:
        """Judge the next sample of the stream.

        Args:
            sample: The sample.
            arrival: When it arrived, on a monotonic clock [s]; None for a recording.

        Returns:
            Whether the robot may follow it, and what is wrong with it.

        Raises:
            InvalidInputError: If it is of the other hand.
        """
        if sample.side != self._side:
            raise InvalidInputError(
                argument="side",
                expected=f"samples of a {self._side} hand",
                value=sample.side,
                got=f"one of a {sample.side} hand",
            )
        before = self.state
        tick, clock = before.clock.advance(sample.time)
        state = before._replace(clock=clock, now=before.now + tick.elapsed)
        held = Verdict(tick.rule, True, False, tick.dt, math.nan)
        if tick.rule in ("duplicate", "disorder"):
            self.state = state
            return held
        rule, finding = self._input_fault(sample, arrival)
        if rule:
            self.state = _holding(state, rule)
            return held._replace(rule=rule, finding=finding)
        was_late = before.clock.late_count > 0
        verdict, self.state = self._follow(sample, state, tick, was_late)
        if self.state.cause and not state.cause:
            self._input.alert()
        if sample.wrist is None or self._input.is_wrist_proven or verdict.is_held:
            return verdict
        return verdict._replace(rule="unproven")

    def _input_fault(
        self, sample: HumanSample, arrival: float | None
    ) -> tuple[Rule, Finding | None]:
        """Return what makes a sample unusable by itself; empty if nothing does."""
        rate = None if arrival is None else self._rate.update(sample.time, arrival)
        if rate is not None:
            problem = (
                f"time stamps run at {rate:.3g} times the speed at which samples arrive"
            )
            advice = "give the time of the tracker's clock in seconds"
            return "time", Finding("time", problem, advice)
        if not sample.valid or sample.confidence == 0.0:
            return "missing", None
        if is_zero(sample.landmarks):
            return "zero", None
        finding = self._input.update(sample.time, sample.landmarks, sample.wrist)
        if finding is not None:
            return finding.kind, finding
        return ("" if self._palm.fits(sample.landmarks) else "size"), None

    def _follow(
        self,
        sample: HumanSample,
        state: GuardState,
        tick: Tick,
        was_late: bool,
    ) -> tuple[Verdict, GuardState]:
        """Judge landmarks that could be a hand's by how they follow the ones before."""
        fresh = first_track(state.now, sample.landmarks)
        last = state.last
        consistency = math.sqrt(np.square(fresh.lengths - self._lengths).mean())
        verdict = Verdict("", False, False, tick.dt, consistency)
        if last is None or not is_same_hand(last, fresh):
            state = state._replace(same_since=state.now)
        if last is None:
            first = state._replace(
                good=fresh,
                last=fresh,
                cause="",
            )
            return verdict._replace(is_return=state.cause != ""), first
        held = verdict._replace(is_held=True)
        if state.now - state.same_since >= FROZEN_AFTER:
            return held._replace(rule="frozen"), _holding(state, "frozen")
        rule, state = _moved(state, last, fresh, is_gap=tick.rule == "gap")
        was_held = state.cause != ""
        if was_held and not self._has_returned(fresh, rule, state):
            return held._replace(rule=rule or "settling"), state
        is_return = was_held or tick.rule == "gap" or was_late
        state = state._replace(good=state.last, cause="")
        return verdict._replace(rule=tick.rule, is_return=is_return), state

    def _has_returned(
        self,
        fresh: Track,
        rule: Rule,
        state: GuardState,
    ) -> bool:
        """Tell whether a hold is over: the hand is near where it was, or steady where it is."""
        good, now = state.good, state.now
        if good is None:
            return not rule
        since_good = max(now - good.time, state.clock.shortest)
        if since_good <= _BRIEF:
            return not _named(change_between(good, fresh, since_good), state.usual)
        if rule:
            return False
        settling = SETTLING
        if state.cause in ("flip", "outlier"):
            # The hand may still be turned, mirrored or of other lengths.
            change = change_between(good, fresh, 1.0)
            if change.is_turned or _excess(change, state.usual)[3]:
                settling = _LONG_SETTLING
        return now - state.steady_since >= settling


def _moved(
    state: GuardState,
    last: Track,
    fresh: Track,
    *,
    is_gap: bool,
) -> tuple[Rule, GuardState]:
    """Name what no hand does from one sample to the next, and learn what is usual."""
    since = max(state.now - last.time, state.clock.shortest)
    change = change_between(last, fresh, since)
    rule = _named(change, state.usual)
    if is_gap:
        usual_step = change_between(last, fresh, state.clock.period)
        rule = "gap" if _named(usual_step, state.usual) else rule
    state = state._replace(last=change.track, usual=_learnt(state.usual, change, last))
    return rule, _holding(state._replace(last=fresh), rule) if rule else state


def _holding(state: GuardState, rule: Rule) -> GuardState:
    """Begin a hold, or go on with it; samples must make sense again from now on."""
    return state._replace(cause=state.cause or rule, steady_since=state.now)


def _excess(change: Change, usual: np.ndarray) -> np.ndarray:
    """Tell which changes no hand makes, given the tracker's usual ones, shape (4,)."""
    return change.sizes > np.maximum(BELIEVED, _EXCESS * usual)


def _named(change: Change, usual: np.ndarray) -> Rule:
    """Name a change that no hand makes; empty if hands do."""
    excess = _excess(change, usual)
    if change.is_turned:
        return "flip"
    if not excess.any() and not change.is_too_fast:
        return ""
    return "outlier" if change.is_alone or excess[3] else "jump"


def _learnt(
    usual: np.ndarray,
    change: Change,
    before: Track,
) -> np.ndarray:
    """Move the running medians by a fixed share: a single fault hardly counts."""
    rates = np.where(change.sizes > usual, 1.0 + _RATE, 1.0 - _RATE)
    learnt = np.maximum(BELIEVED / _EXCESS, usual * rates)
    if before.dt <= 0.0:
        # After a first sample, only lengths can be compared.
        learnt[:3] = usual[:3]
    return learnt
