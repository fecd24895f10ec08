"""`StreamGuard`: which samples of a tracker make sense, by named rules.

Trackers lose the hand, find it elsewhere, confuse palm and back, repeat old data and report zeros.
The guard compares every sample with the person's hand and with the sample before, and says whether
the robot may follow it. It counts in the time of the stamps. A sample that it rejects never moves
the robot; `mapping.rejoin` leads back to the hand afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import Side
from handmap_qp.human.landmarks import PalmShape, landmarks_at_rest
from handmap_qp.human.sample import LANDMARK_COUNT, HumanSample
from handmap_qp.human.verdict import Finding, Rule, Verdict
from handmap_qp.stream.clock import RateCheck, SampleClock, Tick
from handmap_qp.stream.motion import (
    FINGER_LIMITS,
    PALM_LIMITS,
    TURN_LIMITS,
    Change,
    Sight,
    Track,
    change_between,
    fixed_lengths,
    measure,
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
BONE_STEP, _BONE_USUAL = 0.008, 0.0015
"""Change of a length that is always believed, and the first guess of the usual one [m]."""
_EXCESS = 12.0
"""A change of speed is a jump if it is this many times the tracker's usual one."""
_BONE_EXCESS = 15.0
_RATE = 0.05
"""Share by which an estimate of a usual change moves with each sample.

It falls no lower than where it has an effect, so that it rises within half a second when noise
begins.
"""


class _Usual(NamedTuple):
    """Running medians of the changes between samples: of palm, turn, fingers and lengths."""

    palm: float = PALM_LIMITS.usual
    turn: float = TURN_LIMITS.usual
    fingers: float = FINGER_LIMITS.usual
    lengths: float = _BONE_USUAL


class GuardState(NamedTuple):
    """What the guard remembers; replaced as a whole.

    Attributes:
        clock: The clock of the stream.
        now: Time of the stream [s]: the sum of the time steps.
        good: The last sample that was followed.
        last: The last sample that could be a hand's.
        usual: How much samples usually change.
        cause: The rule that began the present hold; empty if there is none.
        held_since: Time of its begin [s].
        steady_since: Time since which samples make sense [s].
        same_since: Time since which the landmarks are exactly the same [s].
    """

    clock: SampleClock = SampleClock()
    now: float = 0.0
    good: Track | None = None
    last: Track | None = None
    usual: _Usual = _Usual()
    cause: Rule = ""
    held_since: float = 0.0
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
        return self._check(sample, arrival)

    def judge(self, samples: Sequence[HumanSample]) -> list[Verdict]:
        """Judge the next samples, as `check` does; their motion is measured all at once.

        Args:
            samples: The samples.

        Raises:
            InvalidInputError: If one is of the other hand.
        """
        clock, now, clocks = self.state.clock, self.state.now, []
        for sample in samples:
            tick, clock = clock.advance(sample.time)
            now += tick.elapsed
            clocks.append((now, clock.shortest))
        seen = [i for i, sample in enumerate(samples) if _is_seen(sample)]
        times, shortest = np.array([clocks[i] for i in seen]).reshape(-1, 2).T
        landmarks = np.array([samples[i].landmarks for i in seen]).reshape(
            -1, LANDMARK_COUNT, 3
        )
        sights = measure(self.state.last, times, landmarks, shortest) if seen else []
        known = dict(zip(seen, sights, strict=True))
        return [
            self._check(sample, None, known.get(i)) for i, sample in enumerate(samples)
        ]

    def _check(
        self, sample: HumanSample, arrival: float | None, sight: Sight | None = None
    ) -> Verdict:
        self.check_side(sample.side)
        before = self.state
        tick, clock = before.clock.advance(sample.time)
        state = before._replace(clock=clock, now=before.now + tick.elapsed)
        if tick.rule in ("duplicate", "disorder"):
            self.state = state
            return Verdict(tick.rule, True, False, tick.dt, math.nan)
        if _is_seen(sample):
            sight = _measured(sample, sight, state)
        rule, finding = self._input_fault(sample, sight, arrival)
        if rule or sight is None:
            self.state = _holding(state, rule)
            return Verdict(rule, True, False, tick.dt, math.nan, finding)
        verdict, self.state = self._follow(
            sight, state, tick, before.clock.late_count > 0
        )
        if self.state.cause and not state.cause:
            self._input.alert()
        if sample.wrist is None or self._input.is_wrist_proven or verdict.is_held:
            return verdict
        return verdict._replace(rule="unproven")

    def check_side(self, side: Side) -> None:
        """Reject samples of the other hand.

        Raises:
            InvalidInputError: If the side is not the person's.
        """
        if side != self._side:
            raise InvalidInputError(
                argument="side",
                expected=f"samples of a {self._side} hand",
                value=side,
                got=f"one of a {side} hand",
            )

    def _input_fault(
        self, sample: HumanSample, sight: Sight | None, arrival: float | None
    ) -> tuple[Rule, Finding | None]:
        """Return what makes a sample unusable by itself; empty if nothing does."""
        rate = None if arrival is None else self._rate.update(sample.time, arrival)
        if rate is not None:
            problem = (
                f"time stamps run at {rate:.3g} times the speed at which samples arrive"
            )
            advice = "give the time of the tracker's clock in seconds"
            return "time", Finding("time", problem, advice)
        if sight is None:
            return "missing", None
        if sight.is_zero:
            return "zero", None
        finding = self._input.update(sample.time, sample.landmarks, sample.wrist)
        if finding is not None:
            return finding.kind, finding
        return ("" if self._palm.fits_size(sight.size) else "size"), None

    def _follow(
        self, sight: Sight, state: GuardState, tick: Tick, was_late: bool
    ) -> tuple[Verdict, GuardState]:
        """Judge landmarks that could be a hand's by how they follow the ones before."""
        fresh, last, change = sight.fresh, state.last, sight.change
        consistency = math.sqrt(np.square(fresh.lengths - self._lengths).mean())
        verdict = Verdict("", False, False, tick.dt, consistency)
        if not sight.is_same:
            state = state._replace(same_since=state.now)
        if last is None or change is None:
            first = state._replace(good=fresh, last=fresh, cause="")
            return verdict._replace(is_return=state.cause != ""), first
        if state.now - state.same_since >= FROZEN_AFTER:
            return verdict._replace(rule="frozen", is_held=True), _holding(
                state, "frozen"
            )
        rule = _named(change, state.usual)
        if tick.rule == "gap" and _named(
            change_between(last, fresh, state.clock.period), state.usual
        ):
            rule = "gap"
        state = state._replace(
            last=change.track, usual=_learnt(state.usual, change, last)
        )
        if rule:
            state = _holding(state._replace(last=fresh), rule)
        was_held = state.cause != ""
        if was_held and not self._has_returned(fresh, rule, state):
            return verdict._replace(rule=rule or "settling", is_held=True), state
        info: Rule = tick.rule if tick.rule in ("clock_jump", "gap") else ""
        is_return = was_held or tick.rule == "gap" or was_late
        state = state._replace(good=state.last, cause="")
        return verdict._replace(rule=info, is_return=is_return), state

    def _has_returned(self, fresh: Track, rule: Rule, state: GuardState) -> bool:
        """Tell whether a hold is over: the hand is near where it was, or steady where it is."""
        good, now = state.good, state.now
        if good is None:
            return not rule
        since_good = max(now - good.time, state.clock.shortest)
        if since_good <= _BRIEF:
            near = change_between(good, fresh, since_good)
            return not _named(near, state.usual)
        if rule:
            return False
        is_doubtful = state.cause in ("flip", "outlier") and _is_other(
            good, fresh, state.usual
        )
        return now - state.steady_since >= (_LONG_SETTLING if is_doubtful else SETTLING)


def _is_seen(sample: HumanSample) -> bool:
    return sample.valid and sample.confidence != 0.0


def _measured(sample: HumanSample, sight: Sight | None, state: GuardState) -> Sight:
    """Return what a sample shows after the last one; what is known of it, if that holds."""
    if sight is not None and sight.is_after(state.last):
        return sight
    times, shortest = np.array([[state.now], [state.clock.shortest]])
    return measure(state.last, times, sample.landmarks[None], shortest)[0]


def _holding(state: GuardState, rule: Rule) -> GuardState:
    """Begin a hold, or go on with it; samples must make sense again from now on."""
    if state.cause:
        return state._replace(steady_since=state.now)
    return state._replace(cause=rule, held_since=state.now, steady_since=state.now)


def _is_other(before: Track, sample: Track, usual: _Usual) -> bool:
    """Tell whether a sample shows the hand turned, mirrored or of other lengths than before."""
    change = change_between(before, sample, 1.0)
    return bool(change.is_turned) or bool(_is_stretched(change, usual))


def _is_stretched(change: Change, usual: _Usual) -> np.ndarray:
    return change.lengths > max(BONE_STEP, _BONE_EXCESS * usual.lengths)


def _is_odd(change: Change, usual: _Usual) -> np.ndarray:
    """Tell which changes no hand makes, shape (...), given the tracker's usual ones."""
    return (
        change.is_turned
        | _is_stretched(change, usual)
        | (change.palm > max(PALM_LIMITS.acceleration, _EXCESS * usual.palm))
        | (change.turn > max(TURN_LIMITS.acceleration, _EXCESS * usual.turn))
        | (change.fingers > max(FINGER_LIMITS.acceleration, _EXCESS * usual.fingers))
        | change.is_too_fast
    )


def _named(change: Change, usual: _Usual) -> Rule:
    """Name a change that no hand makes; empty if hands do."""
    if not _is_odd(change, usual):
        return ""
    if change.is_turned:
        return "flip"
    return "outlier" if change.is_alone or _is_stretched(change, usual) else "jump"


def _learnt(usual: _Usual, change: Change, before: Track) -> _Usual:
    """Move the running medians by a fixed share: a single fault hardly counts."""
    lengths = _median(usual.lengths, change.lengths, BONE_STEP / _BONE_EXCESS)
    if before.dt <= 0.0:
        return usual._replace(lengths=lengths)
    return _Usual(
        _median(usual.palm, change.palm, PALM_LIMITS.acceleration / _EXCESS),
        _median(usual.turn, change.turn, TURN_LIMITS.acceleration / _EXCESS),
        _median(usual.fingers, change.fingers, FINGER_LIMITS.acceleration / _EXCESS),
        lengths,
    )


def _median(estimate: float, value: np.ndarray, least: float) -> float:
    return max(least, estimate * (1.0 + _RATE if value > estimate else 1.0 - _RATE))
