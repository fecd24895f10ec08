"""The motion between the samples of a whole recording, by column.

The guard of live streams measures each sample against the one before. Here all samples are measured
at once, so that the guard can judge whole data sets in a fraction of the time. The numbers are
those of `trackers.motion` up to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.trackers.clock import SampleClock
from handmap_qp.trackers.guard import StreamGuard, Verdict
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
from handmap_qp.trackers.plausibility import recorded_measures
from handmap_qp.trackers.recording import Recording, recording_samples
from handmap_qp.trackers.sample import LANDMARK_COUNT
from handmap_qp.transform import nearest_rotations


class RecordedSamples:
    """The samples of a recording, measured by column.

    Args:
        recording: The recording.

    Attributes:
        samples: Its samples, as a tracker would send them.
        landmarks: Their landmarks [m], shape (T, 21, 3); zeros where the hand was not seen.
        confidence: The tracker's confidence in each, shape (T,).
        sights: What each sample shows, measured against the one before that shows a hand; None
            where the hand was not seen.
    """

    def __init__(self, recording: Recording) -> None:
        self.samples = recording_samples(recording)
        self.landmarks = np.where(recording.valid[:, None, None], recording.landmarks, 0.0)
        self.confidence = np.array([sample.confidence for sample in self.samples])
        self.sights = _sights(recording)
        self._lengths = fixed_lengths(self.landmarks)
        self._verdicts: dict[tuple[str, bytes], list[Verdict]] = {}

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
        fits = bytes(sight is not None and guard.fits(sight) for sight in self.sights)
        key = (human.side, fits)
        known = self._verdicts.get(key)
        if known is None:
            pairs = zip(self.samples, self.sights, strict=True)
            verdicts = [guard.check(sample, sight) for sample, sight in pairs]
            self._verdicts[key] = verdicts
            return verdicts
        # Of another person, whose palm is as large, the lengths of the bones alone differ.
        off = self._lengths - guard.lengths
        other = np.sqrt(np.einsum("ti,ti->t", off, off) / off.shape[1]).tolist()
        return [
            verdict
            if math.isnan(verdict.consistency)
            else Verdict(*verdict[:4], consistency, verdict.finding)
            for verdict, consistency in zip(known, other, strict=True)
        ]


# A recording is judged twice: while its person is measured, and while it is mapped.
@lru_cache(maxsize=1)
def recorded_samples(recording: Recording) -> RecordedSamples:
    """Return the samples of a recording; those of the last one are kept."""
    return RecordedSamples(recording)


def _sights(recording: Recording) -> tuple[Sight | None, ...]:
    """Measure all samples of a recording; see `RecordedSamples.sights`."""
    is_seen = recording.valid
    if recording.confidence is not None:
        is_seen = is_seen & (recording.confidence != 0.0)
    seen = np.flatnonzero(is_seen)
    landmarks = recording.landmarks[seen]
    times, shortest = _clock_times(recording.time)
    palms = landmarks[:, PALM]
    sizes, centres = palm_sizes(palms), palms.mean(axis=1)
    points, lengths = landmarks - centres[:, None], fixed_lengths(landmarks)
    count = np.count_nonzero(landmarks.any(axis=2), axis=1)
    is_zero = (sizes < ZERO_SIZE) | (count < LANDMARK_COUNT - 1)
    measures = recorded_measures(recording)
    fresh = [
        Track(time, own, centre, STILL, STILL, UNBENT, 0.0, fixed)
        for time, own, centre, fixed in zip(
            times[seen].tolist(), points, centres, lengths, strict=True
        )
    ]
    sights: list[Sight | None] = [None] * len(recording)
    for i, size, zero, track in zip(seen, sizes.tolist(), is_zero.tolist(), fresh, strict=True):
        sights[i] = Sight(size, zero, track, measures=measures[i])
    hands = np.flatnonzero(~is_zero)
    if len(hands) > 1:
        tracks, index = [fresh[k] for k in hands], seen[hands]
        steps = np.maximum(np.diff(times[index]), shortest[index[1:]])
        moved = zip(index[1:], _changes(tracks, points[hands], centres[hands], steps), strict=True)
        before = tracks[0]
        for i, (change, is_same) in moved:
            sights[i] = sights[i]._replace(before=before, change=change, is_same=is_same)
            before = change.track
    return tuple(sights)


def _clock_times(stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return time and least time step [s] of the guard's clock at every sample, (T,) each."""
    clock, now, times, shortest = SampleClock(), 0.0, [], []
    for stamp in stamps.tolist():
        tick, clock = clock.advance(stamp)
        now += tick.elapsed
        times.append(now)
        shortest.append(clock.shortest)
    return np.array(times), np.array(shortest)


def _changes(
    tracks: list[Track], points: np.ndarray, centres: np.ndarray, dt: np.ndarray
) -> Iterator[tuple[Change, bool]]:
    """Measure the motion of every sample but the first as `change_between`, and if it is none.

    Args:
        tracks: The samples without motion.
        points: Their landmarks from the palm's centre [m], shape (n, 21, 3).
        centres: The centres [m], shape (n, 3).
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
    is_turned = (angles > FLIP) | _are_mirrored(before, after)
    lengths = np.array([track.lengths for track in tracks])
    is_same = (before == after).all(axis=(1, 2)) & (centres[:-1] == centres[1:]).all(axis=1)
    columns = (
        palm,
        turn,
        most,
        np.abs(np.diff(lengths, axis=0)).max(axis=1),
        is_turned,
        most > ALONE * next_most,
        is_too_fast,
    )
    scalars = zip(*(column.tolist() for column in columns), strict=True)
    motions = zip(velocity, turning, bent, dt.tolist(), strict=True)
    for track, motion, numbers, same in zip(
        tracks[1:], motions, scalars, is_same.tolist(), strict=True
    ):
        moved = Track(track.time, track.points, track.centre, *motion, track.lengths)
        yield Change(moved, *numbers), same


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
