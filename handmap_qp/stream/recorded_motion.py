"""The motion between the samples of a whole recording, by column.

The guard of live streams measures each sample against the one before. Here all samples are measured
at once, so that the guard can judge whole data sets in a fraction of the time. The numbers are
those of `stream.motion` up to rounding.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.human.landmarks import PALM, palm_sizes
from handmap_qp.human.recording import Recording, recording_samples
from handmap_qp.human.sample import HumanSample
from handmap_qp.stream.clock import SampleClock
from handmap_qp.stream.guard import STRICT, StreamGuard, Verdict, is_odd
from handmap_qp.stream.motion import (
    Change,
    Sight,
    Track,
    change_of,
    first_track,
    fixed_lengths,
    is_same_hand,
    is_zero,
    motion_between,
)
from handmap_qp.trackers.plausibility import examine, recorded_measures


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
        self._motion = _motion_of(recording, self._clock)
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
        return _sights(self._recording, self._motion)

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
        if self._is_calm and np.all(guard.fits_size(self._motion.sizes)):
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
            verdict if math.isnan(verdict.consistency) else verdict._replace(consistency=own)
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
        has_oddities = motion.is_same.any() or is_odd(changes, STRICT).any()
        return not (has_oddities or examine(self._recording).has_doubts)


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


class _Motion(NamedTuple):
    """The samples in which the hand was seen, by column.

    Attributes:
        seen: Their indices, shape (m,).
        sizes: RMS radius of the palm [m], shape (m,).
        is_zero: Where landmarks lie in one place or at the origin, shape (m,).
        fresh: All of them without motion.
        changes: Motion between those that are not zero; None if there are fewer than two.
        is_same: Where it is exactly none.
    """

    seen: np.ndarray
    sizes: np.ndarray
    is_zero: np.ndarray
    fresh: Track
    changes: Change | None = None
    is_same: np.ndarray = np.zeros(0, dtype=bool)


def _motion_of(recording: Recording, clock: _Clock) -> _Motion:
    """Measure all samples of a recording."""
    is_seen = recording.valid
    if recording.confidence is not None:
        is_seen = is_seen & (recording.confidence != 0.0)
    seen = np.flatnonzero(is_seen)
    landmarks = recording.landmarks[seen]
    sizes = palm_sizes(landmarks[:, PALM])
    fresh = first_track(clock.times[seen], landmarks)
    found = _Motion(seen, sizes, is_zero(sizes, landmarks), fresh)
    hands = np.flatnonzero(~found.is_zero)
    if len(hands) < 2:
        return found
    before, after = (Track(*(column[k] for column in fresh)) for k in (hands[:-1], hands[1:]))
    steps = np.maximum(after.time - before.time, clock.shortest[seen[hands[1:]]])
    moved, *turns = motion_between(before, after, steps)
    columns = zip(before, moved, strict=True)
    track = Track(*(np.concatenate([start[:1], own[:-1]]) for start, own in columns))
    changes = change_of(track, moved, *turns)
    return found._replace(changes=changes, is_same=is_same_hand(before, after))


def _sights(recording: Recording, motion: _Motion) -> tuple[Sight | None, ...]:
    """Return the measures of all samples one by one; see `RecordedSamples.sights`."""
    measures = recorded_measures(recording)[motion.seen]
    sights: list[Sight | None] = [None] * len(recording)
    sizes, zeros, changes = motion.sizes.tolist(), motion.is_zero.tolist(), motion.changes
    columns = zip(motion.seen, sizes, zeros, _rows(motion.fresh), measures, strict=True)
    for i, size, zero, track, row in columns:
        sights[i] = Sight(size, zero, track, measures=row)
    hands = [(i, sight) for i, sight in enumerate(sights) if sight and not sight.is_zero]
    if changes is None:
        return tuple(sights)
    before = hands[0][1].fresh
    numbers = zip(*(column.tolist() for column in (*changes[1:], motion.is_same)), strict=True)
    moves = zip(hands[1:], _rows(changes.track), numbers, strict=True)
    for (i, sight), track, (*values, is_same) in moves:
        change = Change(track, *values)
        sights[i] = sight._replace(before=before, change=change, is_same=is_same)
        before = track
    return tuple(sights)


def _rows(tracks: Track) -> list[Track]:
    """Return the tracks of samples by themselves."""
    return [Track(*row) for row in zip(*tracks, strict=True)]
