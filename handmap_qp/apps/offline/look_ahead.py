"""Smooth a whole recording with look-ahead: zero lag, and short gaps filled.

A Whittaker-Henderson smoother (Whittaker 1923; Eilers, Anal. Chem. 75 (2003) 3631): for each column
y over the instants t,

    min  sum_i w_i (x_i - y_i)^2 dt_i  +  (2 pi f)^-4  integral of (x'')^2 dt

with w_i = 0 where the hand was not seen. It passes a motion of frequency f at half its amplitude,
slower ones unchanged, and has no phase: it looks as far ahead as back. In a gap it is the cubic
spline between both sides. The palm's motion and the landmarks in the palm are smoothed apart, so
that the hand keeps its size while it turns.

A long stretch is smoothed block by block, each with `_MARGIN` on both sides: what is farther away
has no effect, up to rounding, because the response falls by exp(-2 pi f t / sqrt(2)). So a
recording is smoothed by parts of any size, with the same numbers.

The smooth recording is mapped as any other, with the costs of speed and acceleration that go with
smoothing (`SMOOTH_IK`).
"""

from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np

from handmap_core.se3 import (
    Array,
    affine,
    inverse_pose,
    rigid_fit,
    rotation_from_quat_wxyz,
    transform_points,
)
from handmap_qp.hands import Values
from handmap_qp.human import PALM, Recording, RecordingPart
from .trajectory import held_samples

CUTOFF = 6.0
"""Frequency that is passed at half its amplitude [Hz]."""
LONGEST_GAP = 0.5
"""Gaps up to this time are filled [s]; in longer ones the robot holds."""
_BLOCK = 4096
"""Samples of a stretch that are smoothed at once."""
_MARGIN = 4.0
"""Time before and after a block that is smoothed with it [s]."""


def look_ahead(recording: Recording) -> Recording:
    """Smooth a recording forwards and backwards in time, and fill its short gaps.

    Samples in filled gaps are valid. Wrist poses and confidences of the tracker are left out,
    because the filled samples have none.
    """
    parts = list(look_ahead_parts(iter([recording])))
    return replace(
        recording,
        landmarks=np.concatenate([part.landmarks for part in parts]),
        valid=np.concatenate([part.valid for part in parts]),
        wrist=None,
        confidence=None,
    )


def look_ahead_parts(parts: Iterator[Recording]) -> Iterator[Recording]:
    """Smooth a recording as `look_ahead`, by parts.

    Args:
        parts: Consecutive parts of the recording, of any size.

    Yields:
        Consecutive parts of the smooth recording, each as soon as it is known.
    """
    smoother = _Smoother()
    for part in parts:
        smoother.add(part)
        yield from smoother.smoothed(is_last=False)
    yield from smoother.smoothed(is_last=True)


def smooth_poses(time: Array, poses: Array, valid: Array) -> Array:
    """Smooth poses forwards and backwards in time, and fill gaps of any length.

    Args:
        time: Instants, strictly increasing [s], shape (T,), T >= 3.
        poses: Poses, shape (T, 4, 4); ignored where not valid.
        valid: Poses to use, at least two of them, shape (T,).

    Returns:
        The smoothed poses, shape (T, 4, 4).
    """
    held = poses[held_samples(valid)]
    rows = np.hstack([continuous_quats(held[:, :3, :3]), held[:, :3, 3]])
    smooth = whittaker(time, rows, valid, CUTOFF)
    return affine(rotation_from_quat_wxyz(smooth[:, :4], "poses"), smooth[:, 4:])


def whittaker(
    time: Array,
    values: Array,
    weight: Array,
    cutoff: float,
) -> Array:
    """Smooth columns by a penalty on their second derivative.

    Args:
        time: Instants, strictly increasing [s], shape (T,), T >= 3.
        values: Columns, shape (T, n); ignored where the weight is 0.
        weight: Weight of each sample, >= 0, at least two of them > 0, shape (T,); or whether it
            counts.
        cutoff: Frequency that is passed at half its amplitude [Hz].

    Returns:
        The smoothed columns, shape (T, n).
    """
    # Imported when used: it takes a quarter of the start of a worker, and most look at the past.
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    before = np.diff(time)[:-1]
    after = np.diff(time)[1:]
    span = before + after
    # Second derivative by divided differences: rows of three factors over three samples.
    factors = 2.0 / (before * span), -2.0 / (before * after), 2.0 / (after * span)
    second = diags_array(factors, offsets=(0, 1, 2), shape=(len(span), len(time)))
    penalty = diags_array(0.5 * span * (2.0 * np.pi * cutoff) ** -4)
    weights = weight * np.gradient(time)
    matrix = diags_array(weights) + second.T @ penalty @ second
    known = np.where(weight[:, None] > 0.0, values, 0.0)
    return splu(matrix.tocsc()).solve(weights[:, None] * known)


def continuous_quats(rotations: Array) -> Array:
    """Return quaternions wxyz of rotations (T, 3, 3) without jumps of sign, shape (T, 4)."""
    # Imported when used: it takes a quarter of the start of a worker, and most look at the past.
    from scipy.spatial.transform import Rotation

    # A copy: SciPy before 1.16 takes no array that is read-only.
    turns = Rotation.from_matrix(rotations.copy())
    quats = turns.as_quat(canonical=True, scalar_first=True)
    flips = np.vecdot(quats[1:], quats[:-1]) < 0.0
    quats[1:][np.cumsum(flips) % 2 == 1] *= -1.0
    return quats


class _Smoother:
    """Smooths the samples of a recording, which come in parts.

    Places of samples count from the first one that is kept.
    """

    def __init__(self) -> None:
        self._first: Recording | None = None
        self._columns: dict[str, Array] = {}
        # Landmarks, held where the hand is not seen.
        self._held = np.empty((0, 0, 0))
        # Whether samples are in a stretch, known of those before `_decided`.
        self._filled = np.empty(0, dtype=bool)
        self._decided = 0
        self._last_seen: int | None = None
        # Next sample to yield, and the start of the stretch that it is in, which may be before the
        # first sample that is kept.
        self._next = 0
        self._start: int | None = None
        # The palm's landmarks at the start of the stretch, around their middle.
        self._palm = np.empty((0, 3))

    def add(self, part: Recording) -> None:
        """Take the next samples."""
        self._first = self._first or part
        arrays = {
            field.name: value
            for field in fields(part)
            if field.name not in ("wrist", "confidence")
            if isinstance(value := getattr(part, field.name), Array)
        }
        before = self._columns or {name: array[:0] for name, array in arrays.items()}
        start = len(before["time"])
        self._columns = {
            name: np.concatenate([before[name], array])
            for name, array in arrays.items()
        }
        valid = self._columns["valid"]
        landmarks = self._columns["landmarks"]
        # Outside of stretches nothing is held, and nothing is asked. Inside them, the sample that
        # was seen last is kept.
        seen = np.where(valid, np.arange(len(valid)), -1)
        newest = np.maximum.accumulate(seen)[start:]
        held = landmarks[newest]
        self._held = np.concatenate([self._held, held]) if start else held
        self._filled = np.concatenate([self._filled, part.valid])

    def smoothed(self, *, is_last: bool) -> Iterator[Recording]:
        """Yield the samples that are known.

        Args:
            is_last: Whether no samples follow.
        """
        if not self._columns:
            return
        self._decide(is_last=is_last)
        while self._next < self._decided:
            stop = self._stretch_stop()
            is_closed = stop < self._decided or is_last
            if not self._filled[self._next]:
                self._start = None
                yield self._part(self._next, self._unseen_stop(), None)
                continue
            if self._start is None:
                self._begin()
            block = self._block(stop, is_closed=is_closed)
            if block is None:
                break
            yield block
        self._forget()

    def _decide(self, *, is_last: bool) -> None:
        """Find which samples are in a stretch: those that are seen, and short gaps between them."""
        time = self._columns["time"]
        seen = self._decided + np.flatnonzero(self._columns["valid"][self._decided :])
        if self._last_seen is not None:
            seen = np.append(self._last_seen, seen)
        if len(seen):
            is_short = np.diff(time[seen]) <= LONGEST_GAP
            for k in np.flatnonzero(is_short & (np.diff(seen) > 1)):
                self._filled[seen[k] : seen[k + 1]] = True
            self._last_seen = int(seen[-1])
            self._decided = self._last_seen + 1
        is_long = self._last_seen is None or (
            time[-1] - time[self._last_seen] > LONGEST_GAP
        )
        if is_last or is_long:
            self._decided = len(time)
            self._last_seen = None

    def _stretch_stop(self) -> int:
        """Return where the stretch ends, as far as it is known."""
        inside = self._filled[self._next : self._decided]
        return self._next + (
            int(np.argmin(inside)) if not inside.all() else len(inside)
        )

    def _unseen_stop(self) -> int:
        """Return where the samples outside of stretches end, as far as it is known."""
        inside = self._filled[self._next : self._decided]
        return self._next + (int(np.argmax(inside)) if inside.any() else len(inside))

    def _begin(self) -> None:
        """Begin a stretch."""
        self._start = self._next
        points = self._held[self._next, PALM]
        self._palm = points - points.mean(axis=0)

    def _block(self, stop: int, *, is_closed: bool) -> Recording | None:
        """Return the next block of the stretch; None if it needs samples that are to come.

        Args:
            stop: Where the stretch ends, as far as it is known.
            is_closed: Whether it ends there.
        """
        assert self._start is not None
        time = self._columns["time"]
        begin = self._next
        end = begin + _BLOCK - (begin - self._start) % _BLOCK
        if is_closed:
            end = min(end, stop)
        elif end >= stop or time[stop - 1] <= time[end - 1] + _MARGIN:
            return None
        first = int(np.searchsorted(time, time[begin] - _MARGIN, "left"))
        first = max(first, self._start)
        last = int(np.searchsorted(time, time[end - 1] + _MARGIN, "right"))
        last = min(last, stop)
        window = slice(first, last)
        valid = self._columns["valid"][window]
        if first == self._start and last == stop and valid.sum() < 3:
            self._filled[window] &= valid
            return self._part(begin, end, None)
        points = _smoothed(time[window], self._held[window], valid, self._palm)
        return self._part(begin, end, points[begin - first : end - first])

    def _part(self, begin: int, end: int, landmarks: Array | None) -> Recording:
        """Return samples, with smooth landmarks if they are given, and go on behind them."""
        assert self._first is not None
        own = slice(begin, end)
        columns: Values = {name: array[own] for name, array in self._columns.items()}
        columns["valid"] = self._filled[own]
        if landmarks is not None:
            columns["landmarks"] = landmarks
        words: Values = {
            field.name: value
            for field in fields(self._first)
            if isinstance(value := getattr(self._first, field.name), str)
        }
        self._next = end
        return RecordingPart(**words, **columns)

    def _forget(self) -> None:
        """Forget the samples that no later block needs."""
        time = self._columns["time"]
        newest = time[min(self._next, len(time) - 1)]
        count = int(np.searchsorted(time, newest - _MARGIN, "left"))
        count = min(count, self._next)
        if self._last_seen is not None:
            count = min(count, self._last_seen)
            self._last_seen -= count
        if self._start is not None:
            self._start -= count
        self._columns = {name: array[count:] for name, array in self._columns.items()}
        self._held = self._held[count:]
        self._filled = self._filled[count:]
        self._decided -= count
        self._next -= count


def _smoothed(time: Array, held: Array, valid: Array, palm: Array) -> Array:
    """Smooth landmarks: the palm's motion, and what moves in the palm.

    Args:
        time: Instants [s], shape (T,).
        held: Landmarks, held where the hand is not seen [m], shape (T, 21, 3).
        valid: Whether the hand is seen, shape (T,).
        palm: Landmarks of a palm around their middle [m], shape (p, 3).

    Returns:
        The smooth landmarks, shape (T, 21, 3).
    """
    palms = rigid_fit(palm, held[:, PALM])
    local = transform_points(inverse_pose(palms), held)
    inside = whittaker(time, local.reshape(len(time), -1), valid, CUTOFF)
    poses = smooth_poses(time, palms, valid)
    return transform_points(poses, inside.reshape(local.shape))
