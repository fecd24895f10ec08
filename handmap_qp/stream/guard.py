"""`StreamGuard`: which samples of a tracker make sense, by named rules.

Trackers lose the hand, find it elsewhere, confuse palm and back, repeat old data and report zeros.
The guard compares every sample with the person's hand and with the sample before, and says whether
the robot may follow it. A sample that it rejects never moves the robot; `stream.follower` leads
back to the hand afterwards.

Time stamps jitter, repeat, arrive in disorder, and jump when the tracker's clock is set.
`SampleClock` says what they mean, and all the rest counts in the time that it gives, never in
samples. `change_between` measures how a hand has moved in that time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.errors import expect
from handmap_qp.hands import Hand
from handmap_qp.human import (
    PALM,
    Finding,
    HumanSample,
    PalmShape,
    Recording,
    Rule,
    Verdict,
    landmarks_at_rest,
    palm_sizes,
    sample_columns,
)
from handmap_qp.ik import BEHIND as BEHIND
from handmap_qp.ik import LONGEST_STEP, Compiled, in_core
from handmap_qp.se3 import Array, lengths, nearest_rotation
from handmap_qp.trackers import (
    BONES,
    NEIGHBOURS,
    InputCheck,
    change_rate,
    learnt_noise,
    noise_of,
)

# -- time

GAP = 0.25
"""A longer time between stamps is a gap: samples are missing, or the clock was set [s]."""
# A stamp earlier by more than this is of a clock that was set back, not of a late sample [s].
_SET_BACK = 1.0
_SET_FORWARD = (
    10.0  # a stamp later by more than this is of a clock that was set forward [s]
)
# Late samples in a row that increase among themselves: the clock was set back a little.
_LATE_SAMPLES = 5
_PERIOD_SHARE = 0.05  # share of a new interval in the usual period
# Least interval that speeds are computed from, over the usual period: stamps jitter.
_SHORTEST_STEP = 0.5

_RATE_WINDOW = 0.5  # time of arrival between two comparisons of the clocks [s]
# Drift of stamps against arrival that a clock or a growing delay may have [s/s].
_LARGEST_DRIFT = 0.3
# Time that samples may account for in a second of arrival [s/s]: clocks of computers differ by far
# less.
_CREDIT_RATE = 1.02


class SampleClock(NamedTuple):
    """State of the clock after a sample; `advance` returns the next one.

    Attributes:
        stamp: Stamp of the last sample that counted [s]; None before the first.
        period: Usual time between samples [s].
        late_stamp: Stamp of the last late sample [s].
        late_count: Late samples in a row.
        rule: What is unusual about the sample's stamp: `duplicate`, `disorder`, `gap`, `clock_jump`
            or nothing.
        elapsed: Time since the last sample that counted [s]; the usual one after a clock jump.
        dt: Time that the sample accounts for [s], from 0 to `LONGEST_STEP` periods; one period at
            most after a sample that brought nothing new, for its command has taken the time.
        passed: Time by the stamps since the last sample that counted [s]; 0 where they go back.
    """

    stamp: float | None = None
    period: float = 1.0 / 60.0
    late_stamp: float = 0.0
    late_count: int = 0
    rule: Rule = ""
    elapsed: float = 0.0
    dt: float = 0.0
    passed: float = 0.0

    @property
    def is_idle(self) -> bool:
        """Whether the sample brings nothing new."""
        return self.rule in ("duplicate", "disorder")

    @property
    def is_set_back(self) -> bool:
        """Whether the sample's stamp is earlier than one before, and counts all the same."""
        return not self.is_idle and self.passed == 0.0

    def advance(self, stamp: float) -> SampleClock:
        """Return the clock after a sample of a time stamp [s], with what that says."""
        period = self.period
        usual = SampleClock(stamp, period, elapsed=period, dt=period, passed=period)
        if self.stamp is None:
            return usual
        step = stamp - self.stamp
        idle = self._replace(rule="duplicate", elapsed=0.0, dt=0.0, passed=0.0)
        if step == 0.0:
            return idle
        if -_SET_BACK <= step < 0.0:
            count = 1 + (self.late_count if stamp > self.late_stamp else 0)
            if count < _LATE_SAMPLES:
                return idle._replace(
                    rule="disorder", late_stamp=stamp, late_count=count
                )
        usual = usual._replace(passed=max(step, 0.0))
        if step < 0.0 or step > _SET_FORWARD:
            return usual._replace(rule="clock_jump")
        if step > GAP:
            return usual._replace(rule="gap", elapsed=step)
        longest = period if self.is_idle else LONGEST_STEP * period
        period += _PERIOD_SHARE * (step - period)
        return SampleClock(
            stamp, period, elapsed=step, dt=min(step, longest), passed=step
        )

    @property
    def shortest(self) -> float:
        """Least time that speeds are computed over [s]: jitter of stamps is not speed."""
        return _SHORTEST_STEP * self.period


class ArrivalCredit(NamedTuple):
    """Time that the next samples may account for, by the times at which they arrive.

    Attributes:
        left: That time [s].
        arrival: When the last sample arrived [s]; NaN before the first one.
    """

    left: float = GAP
    arrival: float = math.nan

    def spend(self, dt: float, arrival: float) -> tuple[ArrivalCredit, float]:
        """Bound the time of the next sample by the time that has passed at its arrival.

        Samples that arrive at once behind a stall of up to `GAP` keep their time.

        Args:
            dt: What the sample accounts for by its stamp [s].
            arrival: When it arrived, on a monotonic clock [s].

        Returns:
            The credit after the sample, and the time that is granted: at most `dt`, so that samples
            account for no more time than has passed since any of them arrived, and 2 % of it and
            `GAP` more [s].
        """
        passed = arrival - self.arrival
        # `not >` also takes the NaN before the first sample for no time.
        passed = passed if passed > 0.0 else 0.0
        left = min(self.left + _CREDIT_RATE * passed, GAP)
        granted = min(dt, left)
        return ArrivalCredit(left - granted, arrival), granted


class RateCheck:
    """Compares the time of a stream with the time at which its samples arrive.

    `update` tells every half second whether the stream runs as fast. Two in a row must drift the
    same way: a stall, the burst behind it and a clock set do not. `grant` bounds what samples may
    account for in the meantime, whatever their stamps say.
    """

    _start = _former = _lead = math.nan
    _drift = 0.0
    _rate: float | None = None
    _credit = ArrivalCredit()

    def grant(self, dt: float, arrival: float) -> float:
        """Return the time that the next sample may account for; see `ArrivalCredit.spend`."""
        self._credit, granted = self._credit.spend(dt, arrival)
        return granted

    def update(self, stamp: float, arrival: float) -> float | None:
        """Take the next sample; return seconds of the stream in a second of arrival.

        Args:
            stamp: Time of the stream [s]: that of `SampleClock`, where a clock that is set back
                again and again goes on.
            arrival: When the sample arrived, on a monotonic clock [s].

        Returns:
            None if no two half seconds in a row differ from 1 by more than 30 %.
        """
        elapsed = arrival - self._start
        # NaN: at the first sample, a half second begins; without a former one, drift is not known.
        if not elapsed < _RATE_WINDOW:
            drift = (self._lead - self._former) / elapsed
            both = self._drift, drift
            is_off = min(both) > _LARGEST_DRIFT or max(both) < -_LARGEST_DRIFT
            self._rate = 1.0 + drift if is_off else None
            self._start = arrival
            self._former = self._lead
            self._drift = drift
        self._lead = stamp - arrival
        return self._rate


# -- motion

ZERO_SIZE = 0.001
"""A hand whose palm has a smaller RMS radius is no hand but a point [m]."""
MIRROR = 1e-4
"""Smallest part of the squared landmark spread that must speak for a mirror image [m^2]."""

_STARTS, _ENDS = np.array(BONES + NEIGHBOURS).T
"""Pairs of landmarks whose distance does not change: bones, and neighbours in the palm."""

BELIEVED = np.array([60.0, 600.0, 150.0, 0.008, 6.0, 40.0, 6.0, math.radians(60.0)])
"""Sizes of `Change` that are believed of a tracker without noise.

Recordings of free motion reach 1.5 m/s, 22 rad/s and 3.8 m/s.
"""
NOISY = np.array([6.0, 150.0, 20.0, 25.0, 4.0, 100.0, 8.0, 50.0])
"""What noise adds to them, over the noise [m] and `Change.rates`: twice what white noise does."""
FIRST_NOISE = 0.002
"""Noise of a tracker before it is known: that of a poor one [m]."""
ALONE = 3.0
"""A landmark that leaves its place alone is this many times as fast as the next one."""


_STILL = np.zeros(3)


class Track(NamedTuple):
    """A sample and the motion that led to it; velocities are zero for a first sample.

    Attributes:
        time: Its instant, in the time of the clock [s].
        points: Landmarks from the palm's centre [m], shape (21, 3).
        centre: Centre of the palm [m], shape (3,).
        lengths: The distances that cannot change [m], shape (23,).
        velocity: Of the centre [m/s], shape (3,).
        turning: Angular velocity of the palm [rad/s], shape (3,).
        bending: Velocities of the landmarks in palm axes [m/s], shape (21, 3); of a first sample
            one for all, shape (3,).
        dt: Time between this sample and the one before [s]; 0 for a first one.
    """

    time: float
    points: Array
    centre: Array
    lengths: Array
    velocity: Array = _STILL
    turning: Array = _STILL
    bending: Array = _STILL
    dt: float = 0.0


class Change(NamedTuple):
    """Motion from a track to a sample.

    Attributes:
        track: The sample with the motion that led to it.
        sizes: Change of the palm's velocity [m/s^2], and of its angular velocity [rad/s^2]; largest
            change of a landmark's velocity in palm axes [m/s^2], and of a distance that cannot
            change [m]; speeds likewise [m/s, rad/s, m/s]; angle of the turn [rad]. Shape (8,).
            The first three are 0 if no motion before is known.
        rates: How noise [m] adds to the sizes: by one over time, or over time squared, shape (8,).
        noise: Noise of the landmarks in palm axes [m]; 0 likewise.
        is_mirrored: The hand became its mirror image.
        is_alone: One landmark changed its velocity far more than all others.
    """

    track: Track
    sizes: Array
    rates: Array
    noise: float
    is_mirrored: bool
    is_alone: bool


def is_zero(landmarks: Array) -> bool:
    """Tell whether landmarks (21, 3) lie in one place, or all but one at the origin."""
    # One landmark may be the origin of the tracker's world.
    seen = landmarks.any(axis=-1).sum()
    return bool(palm_sizes(landmarks[PALM]) < ZERO_SIZE or seen < len(landmarks) - 1)


def first_track(now: float, landmarks: Array) -> Track:
    """Return landmarks (21, 3) [m] at a time [s] as a sample without motion."""
    centre = landmarks[PALM].mean(axis=0)
    return Track(now, landmarks - centre, centre, fixed_lengths(landmarks))


def change_between(track: Track, sample: Track, dt: float) -> Change:
    """Measure the motion from a track to a sample, dt [s] later."""
    # Kabsch: the rotation that takes the palm before to the palm now.
    rotation = nearest_rotation(sample.points[PALM].T @ track.points[PALM])
    whole = sample.points.T @ track.points
    turn = pin.log3(rotation)
    angle = lengths(turn)
    in_former_axes = (sample.points @ rotation - track.points) / dt
    moved = sample._replace(
        velocity=(sample.centre - track.centre) / dt,
        turning=turn / dt,
        bending=in_former_axes @ rotation.T,
        dt=dt,
    )
    # No motion is known before a first sample: speeds decide.
    former = track.dt or dt
    span = 0.5 * (dt + former)
    rate = change_rate(dt, former)
    changes = [
        moved.velocity - track.velocity,
        moved.turning - track.turning,
        *(in_former_axes - track.bending),
    ]
    palm, turned, *slips = (bool(track.dt) * lengths(np.array(changes))).tolist()
    second, fingers = sorted(slips)[-2:]
    stretch = np.abs(moved.lengths - track.lengths).max()
    speeds = [lengths(moved.velocity), angle / dt, lengths(in_former_axes).max()]
    return Change(
        moved,
        np.array([palm / span, turned / span, fingers / span, stretch, *speeds, angle]),
        np.repeat([rate / span, 1.0, 1.0 / dt, 1.0], [3, 1, 3, 1]),
        noise_of(np.array(slips), rate),
        # A reflection lays one hand better on the other than any rotation does.
        is_mirrored=np.linalg.det(whole) < 0.0
        and np.linalg.svd(whole, compute_uv=False)[2] > MIRROR,
        is_alone=fingers > ALONE * second,
    )


def fixed_lengths(landmarks: Array) -> Array:
    """Return the distances that cannot change [m], shape (23,), of landmarks (21, 3)."""
    return lengths(landmarks[_ENDS] - landmarks[_STARTS])


# -- rules

FROZEN_AFTER = 0.5
"""Landmarks that repeat exactly for longer are frozen, and not those of a slow tracker [s]."""
SETTLING = 0.1
"""Time that samples must make sense before they are followed again, after a fault [s]."""
_LONG_SETTLING = 0.5  # the same after a flip or an outlier, which can last [s]
# Holds up to this end at once when the hand is where it can have moved to meanwhile [s].
_BRIEF = 0.12


@dataclass
class GuardState:
    """What the guard remembers.

    Attributes:
        clock: The clock of the stream.
        now: Time of the stream [s]: the sum of the time steps.
        time: Likewise, of the times by the stamps, which the robot's commands go by.
        good: The last sample that was followed.
        last: The last sample that could be a hand's, at the first time that it came.
        noise: Running estimate of the landmarks' noise [m].
        cause: The rule that began the present hold; empty if there is none.
        steady_since: Time since which samples make sense [s].
    """

    clock: SampleClock
    now: float = 0.0
    time: float = 0.0
    good: Track | None = None
    last: Track | None = None
    noise: float = FIRST_NOISE
    cause: Rule = ""
    steady_since: float = 0.0

    @property
    def lost(self) -> float:
        """Time without a sample where that is brief, and nothing else is wrong [s]; or infinite."""
        good, now = self.good, self.now
        is_brief = self.cause == "missing" and good and now - good.time <= _BRIEF
        return now - good.time if is_brief else math.inf

    def hold(self, rule: Rule) -> None:
        """Begin a hold, or go on with it.

        Samples must make sense from now on, but for brief losses.
        """
        last = self.last
        if rule != "missing" or last is None or self.now - last.time > _BRIEF:
            self.steady_since = self.now
        self.cause = self.cause or rule

    def move(self, last: Track, fresh: Track) -> Rule:
        """Name what no hand does from one sample to the next, and learn the noise."""
        since = max(self.now - last.time, self.clock.shortest)
        change = change_between(last, fresh, since)
        is_gap = since > GAP
        if last.dt and not is_gap:
            self.noise = learnt_noise(self.noise, change.noise)
        rule = _named(change, self.noise)
        usual = self.clock.period
        if is_gap and _named(change_between(last, fresh, usual), self.noise):
            rule = "settling" if self.cause else "gap"
        self.last = fresh if rule else change.track
        if rule:
            self.hold(rule)
        return rule

    def has_returned(self, fresh: Track, rule: Rule, since_last: float) -> bool:
        """Tell whether a hold is over: the hand is near where it was, or steady where it is."""
        good = self.good
        # Nothing is known of the time of a gap.
        if good is None or since_last > GAP:
            return not rule
        since_good = max(self.now - good.time, self.clock.shortest)
        if since_good <= _BRIEF:
            return not _named(change_between(good, fresh, since_good), self.noise)
        settling = SETTLING
        # The hand may still be turned, mirrored or of other lengths.
        slow = self.cause in ("flip", "outlier")
        if slow and _named(change_between(good, fresh, 1.0), self.noise):
            settling = _LONG_SETTLING
        return not rule and self.now - self.steady_since >= settling


class StreamGuard(Compiled):
    """Judges the samples of one hand, one after the other.

    Args:
        human: The human hand, scaled to the person.

    Raises:
        HandError: If the hand has no landmarks.
    """

    def __init__(self, human: Hand) -> None:
        self._state = self._former = GuardState(SampleClock())
        self._side = human.spec.side
        self._input = InputCheck(self._side)
        self._rate = RateCheck()
        self._palm = PalmShape(human)
        self._lengths = fixed_lengths(landmarks_at_rest(human))

    @in_core
    def forget(self) -> None:
        """Forget the sample that was judged last, but not what it said about the input."""
        self._state = self._former

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
        self.check_side(sample)
        if self.core:
            return self.core.check(sample, arrival)
        former = self._former = self._state
        clock = former.clock.advance(sample.time)
        now = former.now + clock.elapsed
        dt, passed = clock.dt, clock.passed
        if arrival is not None:
            dt = self._rate.grant(clock.dt, arrival)
            if dt < clock.dt:
                # Stamps that outrun arrival do not move the robot's clock either.
                passed = min(passed, dt)
        time = former.time + passed
        state = self._state = replace(former, clock=clock, now=now, time=time)
        held = Verdict(clock.rule, True, False, dt, math.nan, time=time)
        if clock.is_idle:
            return held
        rule, finding = self._input_fault(sample, arrival)
        if rule:
            state.hold(rule)
            return held._replace(rule=rule, finding=finding)
        verdict = self._follow(sample.landmarks, held)
        if state.cause and not former.cause:
            self._input.alert()
        if sample.wrist is None or self._input.is_wrist_proven or verdict.is_held:
            return verdict
        return verdict._replace(rule="unproven")

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

    @in_core
    def holds(self, recording: Recording) -> Array:
        """Tell which samples of a recording the robot may not follow, wrists apart, shape (T,)."""
        samples = sample_columns(recording)
        return np.array([self.check(sample).is_held for sample in samples])

    def _input_fault(
        self, sample: HumanSample, arrival: float | None
    ) -> tuple[Rule, Finding | None]:
        """Return what makes a sample unusable by itself; empty if nothing does."""
        now = self._state.now
        rate = None if arrival is None else self._rate.update(now, arrival)
        if rate is not None:
            return "time", _off_rate(rate)
        if not sample.valid or sample.confidence == 0.0:
            return "missing", None
        if is_zero(sample.landmarks):
            return "zero", None
        finding = self._input.update(sample.time, sample.landmarks, sample.wrist)
        if finding:
            return finding.kind, finding
        return ("" if self._palm.fits(sample.landmarks) else "size"), None

    def _follow(self, landmarks: Array, held: Verdict) -> Verdict:
        """Judge landmarks that could be a hand's by how they follow the ones before."""
        state = self._state
        last = state.last
        fresh = first_track(state.now, landmarks)
        consistency = math.sqrt(np.square(fresh.lengths - self._lengths).mean())
        judged = held._replace(rule="", consistency=consistency)
        if last is None:
            first = judged._replace(is_held=False, is_return=state.cause != "")
            state.good = state.last = fresh
            state.cause = ""
            return first
        since_last = state.now - last.time
        rule: Rule = ""
        # A tracker that is slower than its samples repeats landmarks exactly, which is no motion.
        if not all(map(np.array_equal, last[1:3], fresh[1:3])):
            rule = state.move(last, fresh)
        elif since_last >= FROZEN_AFTER:
            state.hold("frozen")
            return judged._replace(rule="frozen")
        if state.cause and not state.has_returned(fresh, rule, since_last):
            return judged._replace(rule=rule or "settling")
        lost = state.lost
        # Whether the robot has stood still for longer than one sample accounts for.
        has_paused = lost / state.clock.period > LONGEST_STEP + _SHORTEST_STEP
        followed = judged._replace(
            rule=held.rule,
            is_held=False,
            is_return=held.rule == "gap"
            or self._former.clock.late_count > 0
            or (state.cause != "" and has_paused),
            lost=lost,
        )
        state.good = state.last
        state.cause = ""
        return followed


def _off_rate(rate: float) -> Finding:
    return Finding(
        "time",
        f"time stamps run at {rate:.3g} times the speed at which samples arrive",
        "give the time of the tracker's clock in seconds",
    )


def _named(change: Change, noise: float) -> Rule:
    """Name a change that no hand makes, with some noise [m]; empty if hands do."""
    excess = change.sizes > BELIEVED + noise * NOISY * change.rates
    if excess[7] or change.is_mirrored:
        return "flip"
    if not excess.any():
        return ""
    return "outlier" if change.is_alone or excess[3] else "jump"
