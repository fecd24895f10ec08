"""`StreamGuard`: which samples of a tracker make sense, by named rules.

Trackers lose the hand, find it elsewhere, confuse palm and back, repeat old data and report zeros.
The guard compares every sample with the person's hand and with the sample before, and says whether
the robot may follow it. It counts in the time of the stamps. A sample that it rejects never moves
the robot; `mapping.rejoin` leads back to the hand afterwards.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import Side
from handmap_qp.human.landmarks import PALM, PalmShape, landmarks_at_rest, palm_sizes
from handmap_qp.human.sample import HumanSample
from handmap_qp.stream.clock import RateCheck, SampleClock, Tick
from handmap_qp.stream.motion import (
    FINGER_LIMITS,
    PALM_LIMITS,
    TURN_LIMITS,
    Change,
    Sight,
    Track,
    change_between,
    first_track,
    fixed_lengths,
    is_same_hand,
    is_zero,
)
from handmap_qp.trackers.plausibility import Finding, InputCheck

Rule = Literal[
    "",
    "missing",
    "zero",
    "size",
    "outlier",
    "jump",
    "flip",
    "frozen",
    "gap",
    "settling",
    "duplicate",
    "disorder",
    "clock_jump",
    "time",
    "unit",
    "order",
    "side",
    "flexion",
    "wrist",
    "unproven",
]
"""Name of what is wrong with a sample; empty if nothing is."""

RULES: dict[Rule, str] = {
    "missing": "the tracker did not see the hand, or its confidence is 0",
    "zero": "landmarks lie in one place or at the origin, as trackers send when they see no hand",
    "size": "the palm is less than half or more than twice as large as the person's, or the hand's "
    "size changed for a while",
    "outlier": "one landmark left its place on the hand: lengths of bones changed at once",
    "jump": "the hand moved faster, or from one speed to another, than hands do",
    "flip": "the hand turned over or became its mirror image from one sample to the next",
    "frozen": "the landmarks have repeated exactly for 0.25 s, or one finger for a while",
    "gap": "no sample came for more than 0.25 s; it is followed where the hand has not moved",
    "settling": "the samples make sense again, but not yet for long enough",
    "duplicate": "the time stamp is the same as that of the sample before",
    "disorder": "the time stamp is earlier than that of the sample before",
    "clock_jump": "the tracker's clock was set; the hand is where it was and is followed",
    "time": "for a while: time stamps are not in seconds, or do not run as samples arrive",
    "unit": "for a while: landmarks are not in metres",
    "order": "for a while: landmarks are in another order",
    "side": "for a while: landmarks are those of the other hand, or of a mirrored world",
    "flexion": "for a while: fingers bend backwards",
    "wrist": "for a while: the wrist's orientation does not follow the palm of the landmarks",
    "unproven": "the wrist has not followed a palm that turned yet; it is followed at a quarter of "
    "the speed limits",
}
"""The rules, in words."""

UNPROVEN_SPEED = 0.25
"""Share of the speed limits at which the robot follows a wrist that is not proven yet."""
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


class Verdict(NamedTuple):
    """What the guard says about one sample.

    Attributes:
        rule: What is wrong with it; empty if nothing is.
        is_held: The robot must hold: the sample is not to be followed.
        is_return: The first sample to follow after a hold, a gap, or samples that came too late.
        dt: Time that the sample accounts for [s].
        consistency: RMS difference of the distances that cannot change (bones, and neighbours in
            the palm) from the person's [m]; NaN if there are no landmarks.
        finding: What the input is instead of what it says, in words, where the last samples agree
            that it is something else (`trackers.plausibility`).
    """

    rule: Rule
    is_held: bool
    is_return: bool
    dt: float
    consistency: float
    finding: Finding | None = None

    @property
    def speed(self) -> float:
        """Share of the robot's speed limits at which the sample may be followed."""
        return UNPROVEN_SPEED if self.rule == "unproven" else 1.0


class _Usual(NamedTuple):
    """Running medians of the changes between samples: of palm, turn, fingers and lengths."""

    palm: float = PALM_LIMITS.usual
    turn: float = TURN_LIMITS.usual
    fingers: float = FINGER_LIMITS.usual
    lengths: float = _BONE_USUAL


STRICT = _Usual(0.0, 0.0, 0.0, 0.0)
"""Of a tracker that does not tremble: what is not odd then never is."""


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
        lengths: The person's distances that cannot change [m], shape (23,).

    Raises:
        HandError: If the hand has no landmarks.
    """

    def __init__(self, human: Hand) -> None:
        self.state = GuardState()
        self._side: Side = "left" if human.side == "left" else "right"
        self._input = InputCheck(self._side)
        self._rate = RateCheck()
        self._palm = PalmShape(human)
        self.lengths = fixed_lengths(landmarks_at_rest(human))

    def check(
        self, sample: HumanSample, sight: Sight | None = None, *, arrival: float | None = None
    ) -> Verdict:
        """Judge the next sample of the stream.

        Args:
            sample: The sample.
            sight: What it shows, where that has been measured for a whole recording
                (`stream.recorded_motion`).
            arrival: When it arrived, on a monotonic clock [s]; None for a recording.

        Returns:
            Whether the robot may follow it, and what is wrong with it.

        Raises:
            InvalidInputError: If it is of the other hand.
        """
        self.check_side(sample.side)
        state = self.state
        tick, clock = state.clock.advance(sample.time)
        now = state.now + tick.elapsed
        state = state._replace(clock=clock, now=now)
        if tick.rule in ("duplicate", "disorder"):
            self.state = state
            return Verdict(tick.rule, True, False, tick.dt, math.nan)
        rate = None if arrival is None else self._rate.update(sample.time, arrival)
        if rate is not None:
            self.state = _holding(state, "time")
            problem = f"time stamps run at {rate:.3g} times the speed at which samples arrive"
            finding = Finding("time", problem, "give the time of the tracker's clock in seconds")
            return Verdict("time", True, False, tick.dt, math.nan, finding)
        sight, unusable = self._seen(sample, sight, now)
        if unusable in ("", "size"):
            measures = None if sight is None else sight.measures
            finding = self._input.update(sample.time, sample.landmarks, sample.wrist, measures)
            if finding is not None:
                self.state = _holding(state, finding.kind)
                return Verdict(finding.kind, True, False, tick.dt, math.nan, finding)
        if sight is None or unusable:
            self.state = _holding(state, unusable)
            return Verdict(unusable, True, False, tick.dt, math.nan)
        was_late = self.state.clock.late_count > 0
        verdict, self.state = self._follow(sight, state, tick, was_late)
        if self.state.cause and not state.cause:
            self._input.alert()
        is_unproven = sample.wrist is not None and not self._input.is_wrist_proven
        return verdict._replace(rule="unproven") if is_unproven and not verdict.is_held else verdict

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

    def _seen(
        self, sample: HumanSample, sight: Sight | None, now: float
    ) -> tuple[Sight | None, Rule]:
        """Return what a sample shows, and what makes it unusable by itself."""
        if not sample.valid or sample.confidence == 0.0:
            return None, "missing"
        if sight is None:
            landmarks, size = sample.landmarks, float(palm_sizes(sample.landmarks[PALM]))
            sight = Sight(size, bool(is_zero(size, landmarks)), first_track(now, landmarks))
        if sight.is_zero:
            return sight, "zero"
        return sight, "" if self.fits_size(sight.size) else "size"

    def fits_size(self, size: float | np.ndarray) -> bool | np.ndarray:
        """Tell whether a palm of an RMS radius [m] is about as large as the person's."""
        return self._palm.fits_size(size)

    def consistency(self, sight: Sight) -> float:
        """Return the RMS difference of lengths that cannot change from the person's [m]."""
        off = sight.fresh.lengths - self.lengths
        return math.sqrt(off.dot(off) / len(off))

    def _follow(
        self, sight: Sight, state: GuardState, tick: Tick, was_late: bool
    ) -> tuple[Verdict, GuardState]:
        """Judge landmarks that could be a hand's by how they follow the ones before."""
        fresh = sight.fresh
        consistency = self.consistency(sight)
        last = state.last
        if last is None:
            is_return = state.cause != ""
            state = state._replace(good=fresh, last=fresh, cause="", same_since=state.now)
            return Verdict("", False, is_return, tick.dt, consistency), state
        is_known = last is sight.before and sight.change is not None
        is_same = sight.is_same if is_known else is_same_hand(last, fresh)
        state = state if is_same else state._replace(same_since=state.now)
        if is_same and state.now - state.same_since >= FROZEN_AFTER:
            return Verdict("frozen", True, False, tick.dt, consistency), _holding(state, "frozen")
        change = sight.change if is_known else None
        if change is None:
            change = change_between(last, fresh, max(state.now - last.time, state.clock.shortest))
        rule = _named(change, state.usual)
        if tick.rule == "gap":
            jump = change_between(last, fresh, state.clock.period)
            rule = "gap" if _named(jump, state.usual) else rule
        state = state._replace(last=change.track, usual=_learnt(state.usual, change, last))
        if rule:
            state = _holding(state._replace(last=fresh), rule)
        if not state.cause:
            state = state._replace(good=change.track)
            is_return = tick.rule == "gap" or was_late
            return Verdict(_info(tick), False, is_return, tick.dt, consistency), state
        if self._has_returned(fresh, rule, state):
            state = state._replace(good=state.last, cause="")
            return Verdict(_info(tick), False, True, tick.dt, consistency), state
        return Verdict(rule or "settling", True, False, tick.dt, consistency), state

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
        is_doubtful = state.cause in ("flip", "outlier") and _is_other(good, fresh, state.usual)
        return now - state.steady_since >= (_LONG_SETTLING if is_doubtful else SETTLING)


def _holding(state: GuardState, rule: Rule) -> GuardState:
    """Begin a hold, or go on with it; samples must make sense again from now on."""
    if state.cause:
        return state._replace(steady_since=state.now)
    return state._replace(cause=rule, held_since=state.now, steady_since=state.now)


def _info(tick: Tick) -> Rule:
    """Return what is to be said of a sample that is followed all the same."""
    return tick.rule if tick.rule in ("clock_jump", "gap") else ""


def _is_other(before: Track, sample: Track, usual: _Usual) -> bool:
    """Tell whether a sample shows the hand turned, mirrored or of other lengths than before."""
    change = change_between(before, sample, 1.0)
    return bool(change.is_turned) or bool(_is_stretched(change, usual))


def _is_stretched(change: Change, usual: _Usual) -> np.ndarray:
    return change.lengths > max(BONE_STEP, _BONE_EXCESS * usual.lengths)


def is_odd(change: Change, usual: _Usual) -> np.ndarray:
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
    if not is_odd(change, usual):
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
