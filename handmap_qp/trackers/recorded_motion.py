"""The motion between the samples of a whole recording, by column.

The guard of live streams measures each sample against the one before. Here all samples are measured
at once, so that the guard can judge whole data sets in a fraction of the time. The numbers are
those of `trackers.motion` up to rounding.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.trackers.clock import SampleClock
from handmap_qp.trackers.guard import BONE_STEP, StreamGuard, Verdict
from handmap_qp.trackers.landmarks import PALM, palm_sizes
from handmap_qp.trackers.motion import (
    ALONE,
    FINGER_LIMITS,
    FLIP,
    MIRROR,
    PALM_LIMITS,
    STILL,
    TURN_LIMITS,
    UNBENT,
    ZERO_SIZE,
    Change,
    Sight,
    Track,
    fixed_lengths,
)
from handmap_qp.trackers.plausibility import examine, recorded_measures
from handmap_qp.trackers.recording import Recording, recording_samples
from handmap_qp.trackers.sample import LANDMARK_COUNT, HumanSample
from handmap_qp.transform import nearest_rotations


class RecordedSamples:
    """The samples of a recording, measured by column.

    Args:
        recording: The recording.

    Attributes:
        landmarks: Landmarks of its samples [m], shape (T, 21, 3); zeros where the hand was not
            seen.
        confidence: The tracker's confidence in each, shape (T,).
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.landmarks = np.where(recording.valid[:, None, None], recording.landmarks, 0.0)
        share = 1.0 if recording.confidence is None else recording.confidence
        self.confidence = np.where(recording.valid | (recording.confidence is None), share, 0.0)
        self._lengths = fixed_lengths(self.landmarks)
        self._clock = _clock_columns(recording.time)
        self._motion = _motion_of(recording, self._lengths, self._clock)
        self._verdicts: dict[tuple[str, bytes], list[Verdict]] = {}

    @cached_property
    def samples(self) -> list[HumanSample]:
        """The samples, as a tracker would send them."""
        return recording_samples(self._recording)

    @cached_property
    def sights(self) -> tuple[Sight | None, ...]:
        """What each sample shows, measured against the one before that shows a hand.

        None where the hand was not seen.
        """
        return _sights(self._recording, self._lengths, self._clock, self._motion)

    def judged(self, human: Hand) -> list[Verdict]:
        """Judge all samples as a live stream.

        Args:
            human: The human hand, scaled to the person.

        Returns:
            What the guard says about each sample.

        Raises:
            HandError: If the hand has no landmarks.
            InvalidInputError: If the recording is of the other hand.
        """
        guard = StreamGuard(human)
        guard.check_side(self._recording.side)
        off = self._lengths - guard.lengths
        consistency = np.sqrt(np.einsum("ti,ti->t", off, off) / off.shape[1]).tolist()
        if self._is_calm and all(map(guard.fits_size, self._motion.range_of_sizes)):
            return [
                Verdict("", False, False, dt, own)
                for dt, own in zip(self._clock.dt, consistency, strict=True)
            ]
        fits = bytes(sight is not None and guard.fits_size(sight.size) for sight in self.sights)
        key = (human.side, fits)
        known = self._verdicts.get(key)
        if known is None:
            pairs = zip(self.samples, self.sights, strict=True)
            verdicts = [guard.check(sample, sight) for sample, sight in pairs]
            self._verdicts[key] = verdicts
            return verdicts
        # Of another person, whose palm is as large, the lengths of the bones alone differ.
        return [
            verdict
            if math.isnan(verdict.consistency)
            else Verdict(*verdict[:4], own, verdict.finding)
            for verdict, own in zip(known, consistency, strict=True)
        ]

    @cached_property
    def _is_calm(self) -> bool:
        """Whether the guard follows every sample, however little its tracker usually trembles.

        Each sample shows the hand, no time between two is a gap, no change is larger than what is
        always believed, none is exactly none, and nothing else seems wrong with the input.
        """
        motion = self._motion
        changes = motion.changes
        is_seen = len(motion.seen) == len(self._recording) and not motion.is_zero.any()
        if not is_seen or changes is None or self._clock.has_rules:
            return False
        return not (
            changes.is_same.any()
            or changes.is_turned.any()
            or changes.is_too_fast.any()
            or (changes.lengths > BONE_STEP).any()
            or (changes.palm > PALM_LIMITS.acceleration).any()
            or (changes.turn > TURN_LIMITS.acceleration).any()
            or (changes.fingers > FINGER_LIMITS.acceleration).any()
            or examine(self._recording).has_doubts
        )


# A recording is judged twice: while its person is measured, and while it is mapped.
@lru_cache(maxsize=1)
def recorded_samples(recording: Recording) -> RecordedSamples:
    """Return the samples of a recording; those of the last one are kept."""
    return RecordedSamples(recording)


class _Clock(NamedTuple):
    """The guard's clock at every sample.

    Attributes:
        times: Time [s], shape (T,).
        shortest: Least time step [s], shape (T,).
        dt: Time that each sample accounts for [s], T of them.
        has_rules: Whether a stamp is unusual.
    """

    times: np.ndarray
    shortest: np.ndarray
    dt: list[float]
    has_rules: bool


def _clock_columns(stamps: np.ndarray) -> _Clock:
    clock, now, times, shortest, ticks = SampleClock(), 0.0, [], [], []
    for stamp in stamps.tolist():
        tick, clock = clock.advance(stamp)
        now += tick.elapsed
        times.append(now)
        shortest.append(clock.shortest)
        ticks.append(tick)
    rules = any(tick.rule for tick in ticks)
    return _Clock(np.array(times), np.array(shortest), [tick.dt for tick in ticks], rules)


class _Changes(NamedTuple):
    """Columns of `Change`, and of the `Track` after it, of n samples but the first."""

    velocity: np.ndarray
    turning: np.ndarray
    bending: np.ndarray
    dt: np.ndarray
    palm: np.ndarray
    turn: np.ndarray
    fingers: np.ndarray
    lengths: np.ndarray
    is_turned: np.ndarray
    is_alone: np.ndarray
    is_too_fast: np.ndarray
    is_same: np.ndarray


class _Motion(NamedTuple):
    """The samples in which the hand was seen, by column.

    Attributes:
        seen: Their indices, shape (m,).
        sizes: RMS radius of the palm [m], shape (m,).
        centres: Centre of the palm [m], shape (m, 3).
        points: Landmarks from there [m], shape (m, 21, 3).
        is_zero: Where landmarks lie in one place or at the origin, shape (m,).
        changes: Motion between those that are not zero; None if there are fewer than two.
    """

    seen: np.ndarray
    sizes: np.ndarray
    centres: np.ndarray
    points: np.ndarray
    is_zero: np.ndarray
    changes: _Changes | None

    @property
    def range_of_sizes(self) -> tuple[float, float]:
        """Least and largest size [m]."""
        return float(self.sizes.min()), float(self.sizes.max())


def _motion_of(recording: Recording, lengths: np.ndarray, clock: _Clock) -> _Motion:
    """Measure all samples of a recording."""
    is_seen = recording.valid
    if recording.confidence is not None:
        is_seen = is_seen & (recording.confidence != 0.0)
    seen = np.flatnonzero(is_seen)
    landmarks = recording.landmarks[seen]
    palms = landmarks[:, PALM]
    sizes, centres = palm_sizes(palms), palms.mean(axis=1)
    points = landmarks - centres[:, None]
    count = np.count_nonzero(landmarks.any(axis=2), axis=1)
    is_zero = (sizes < ZERO_SIZE) | (count < LANDMARK_COUNT - 1)
    hands, changes = np.flatnonzero(~is_zero), None
    if len(hands) > 1:
        index = seen[hands]
        steps = np.maximum(np.diff(clock.times[index]), clock.shortest[index[1:]])
        changes = _changes(points[hands], centres[hands], lengths[index], steps)
    return _Motion(seen, sizes, centres, points, is_zero, changes)


def _sights(
    recording: Recording, lengths: np.ndarray, clock: _Clock, motion: _Motion
) -> tuple[Sight | None, ...]:
    """Return the measures of all samples one by one; see `RecordedSamples.sights`."""
    measures, seen = recorded_measures(recording), motion.seen
    rows = zip(
        clock.times[seen].tolist(), motion.points, motion.centres, lengths[seen], strict=True
    )
    fresh = [
        Track(time, own, centre, STILL, STILL, UNBENT, 0.0, fixed)
        for time, own, centre, fixed in rows
    ]
    sights: list[Sight | None] = [None] * len(recording)
    sizes, zeros = motion.sizes.tolist(), motion.is_zero.tolist()
    for i, size, zero, track in zip(seen, sizes, zeros, fresh, strict=True):
        sights[i] = Sight(size, zero, track, measures=measures[i])
    hands, changes = np.flatnonzero(~motion.is_zero).tolist(), motion.changes
    if changes is None:
        return tuple(sights)
    before = fresh[hands[0]]
    motions = zip(
        changes.velocity, changes.turning, changes.bending, changes.dt.tolist(), strict=True
    )
    numbers = zip(*(column.tolist() for column in changes[4:]), strict=True)
    for k, moves, (*scalars, is_same) in zip(hands[1:], motions, numbers, strict=True):
        track, i = fresh[k], seen[k]
        moved = Track(track.time, track.points, track.centre, *moves, track.lengths)
        sights[i] = Sight(
            sizes[k], False, track, before, Change(moved, *scalars), is_same, measures[i]
        )
        before = moved
    return tuple(sights)


def _changes(
    points: np.ndarray, centres: np.ndarray, lengths: np.ndarray, dt: np.ndarray
) -> _Changes:
    """Measure the motion of every sample but the first as `change_between`, and if it is none.

    Args:
        points: Landmarks from the palm's centre [m], shape (n, 21, 3).
        centres: The centres [m], shape (n, 3).
        lengths: The distances that cannot change [m], shape (n, 23).
        dt: Time steps [s], shape (n - 1,).
    """
    before, after = points[:-1], points[1:]
    rotations = nearest_rotations(after[:, PALM].transpose(0, 2, 1) @ before[:, PALM])
    angles, turns = _angles(rotations)
    velocity, turning = np.diff(centres, axis=0) / dt[:, None], turns / dt[:, None]
    bending = (after @ rotations - before) / dt[:, None, None]
    bent = bending @ rotations.transpose(0, 2, 1)
    # No motion is known before the first change: speeds decide.
    span = np.concatenate([dt[:1], 0.5 * (dt[1:] + dt[:-1])])
    palm, turn = np.zeros(len(dt)), np.zeros(len(dt))
    palm[1:] = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / span[1:]
    turn[1:] = np.linalg.norm(np.diff(turning, axis=0), axis=1) / span[1:]
    slips = np.zeros(bending.shape[:2])
    slips[1:] = np.linalg.norm(bending[1:] - bent[:-1], axis=2)
    most, next_most = np.partition(slips, (-2, -1), axis=1)[:, :-3:-1].T / span
    fastest = np.linalg.norm(bending, axis=2).max(axis=1)
    is_too_fast = (
        (np.linalg.norm(velocity, axis=1) > PALM_LIMITS.speed)
        | (angles / dt > TURN_LIMITS.speed)
        | (fastest > FINGER_LIMITS.speed)
    )
    return _Changes(
        velocity,
        turning,
        bent,
        dt,
        palm,
        turn,
        most,
        np.abs(np.diff(lengths, axis=0)).max(axis=1),
        (angles > FLIP) | _are_mirrored(before, after),
        most > ALONE * next_most,
        is_too_fast,
        (before == after).all(axis=(1, 2)) & (centres[:-1] == centres[1:]).all(axis=1),
    )


def _angles(rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return angles (n,) and rotation vectors (n, 3) of rotations; only the angle near 180 deg."""
    trace = np.trace(rotations, axis1=1, axis2=2)
    angles = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    sines = np.sin(angles)
    scale = np.where(sines > 1e-6, angles / np.where(sines > 1e-6, sines, 1.0), 1.0)
    skew = rotations - rotations.transpose(0, 2, 1)
    return angles, 0.5 * scale[:, None] * np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], 1)


def _are_mirrored(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Tell where a reflection lays one hand better on the other than any rotation does, (n,)."""
    covariances = after.transpose(0, 2, 1) @ before
    found = np.linalg.det(covariances) < 0.0
    found[found] = np.linalg.svd(covariances[found], compute_uv=False)[:, 2] > MIRROR
    return found
