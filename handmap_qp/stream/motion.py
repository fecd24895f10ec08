"""The motion from one sample of landmarks to the next, by which `stream.guard` judges samples.

All of it holds for samples of any number, along the same leading axes of all arrays: of none for a
live sample, of time for a recording.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from handmap_qp.human.landmarks import PALM, palm_sizes
from handmap_qp.se3 import lengths, nearest_rotation

FLIP = math.radians(60.0)
"""A turn by more than this between two samples is a flip."""
ZERO_SIZE = 0.001
"""A hand whose palm has a smaller RMS radius is no hand but a point [m]."""
MIRROR = 1e-4
"""Smallest part of the squared landmark spread that must speak for a mirror image [m^2]."""

_STARTS = np.array(
    [0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19, 5, 9, 13]
)
_ENDS = np.array(
    [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 9, 13, 17]
)
"""Pairs of landmarks whose distance does not change: bones, and neighbours in the palm."""


class Limits(NamedTuple):
    """Bounds of one measure of motion.

    Attributes:
        acceleration: Change of speed between two samples that is always believed [m/s^2, rad/s^2].
        speed: Speed that is never believed [m/s, rad/s].
        usual: First guess of the tracker's usual change of speed.
    """

    acceleration: float
    speed: float
    usual: float


PALM_LIMITS = Limits(60.0, 6.0, 8.0)
"""Translation of the palm. Recordings of free motion reach 1.5 m/s."""
TURN_LIMITS = Limits(600.0, 40.0, 80.0)
"""Rotation of the palm. Recordings reach 22 rad/s."""
FINGER_LIMITS = Limits(150.0, 6.0, 12.0)
"""Landmarks in palm axes. Recordings reach 3.8 m/s."""
ALONE = 3.0
"""A landmark that leaves its place alone is this many times as fast as the next one."""


class Track(NamedTuple):
    """A sample and the motion that led to it; velocities are zero for a first sample.

    Shapes are those of one sample.

    Attributes:
        time: Its instant, in the time of the clock [s].
        points: Landmarks from the palm's centre [m], shape (21, 3).
        centre: Centre of the palm [m], shape (3,).
        velocity: Of the centre [m/s], shape (3,).
        turning: Angular velocity of the palm [rad/s], shape (3,).
        bending: Velocities of the landmarks in palm axes [m/s], shape (21, 3).
        dt: Time between this sample and the one before [s]; 0 for a first one.
        lengths: The distances that cannot change [m], shape (23,).
    """

    time: np.ndarray
    points: np.ndarray
    centre: np.ndarray
    velocity: np.ndarray
    turning: np.ndarray
    bending: np.ndarray
    dt: np.ndarray
    lengths: np.ndarray


class Change(NamedTuple):
    """Motion from a track to a sample.

    Attributes:
        track: The sample with the motion that led to it.
        palm: Change of the palm's velocity [m/s^2].
        turn: Change of its angular velocity [rad/s^2].
        fingers: Largest change of a landmark's velocity in palm axes [m/s^2].
        lengths: Largest change of a distance that cannot change [m].
        is_turned: The hand turned by more than 60 degrees, or became its mirror image.
        is_alone: One landmark changed its velocity far more than all others.
        is_too_fast: A speed is above what hands reach.
    """

    track: Track
    palm: np.ndarray
    turn: np.ndarray
    fingers: np.ndarray
    lengths: np.ndarray
    is_turned: np.ndarray
    is_alone: np.ndarray
    is_too_fast: np.ndarray


class Sight(NamedTuple):
    """What a sample shows by itself, and against the sample before it.

    Attributes:
        size: RMS radius of the palm [m].
        is_zero: Landmarks lie in one place or at the origin.
        fresh: The sample without motion.
        before: The sample before with the motion that led to it; None for the first.
        change: Motion from `before` to this sample.
        is_same: Both have exactly the same landmarks.
    """

    size: float
    is_zero: bool
    fresh: Track
    before: Track | None = None
    change: Change | None = None
    is_same: bool = False

    def is_after(self, last: Track | None) -> bool:
        """Tell whether `before` is a track, by their times."""
        if self.before is None or last is None:
            return self.before is last
        return bool(self.before.time == last.time and self.before.dt == last.dt)


def measure(
    last: Track | None, times: np.ndarray, landmarks: np.ndarray, shortest: np.ndarray
) -> list[Sight]:
    """Measure samples, each against the one before it.

    Args:
        last: The sample before the first; None if there is none.
        times: Instants, in the time of the clock [s], shape (T,).
        landmarks: Landmarks [m], shape (T, 21, 3).
        shortest: Least time that speeds are computed over [s], shape (T,).
    """
    sizes, columns = palm_sizes(landmarks[:, PALM]), first_track(times, landmarks)
    zeros, fresh = is_zero(sizes, landmarks), _rows(columns)
    found = [
        Sight(*own) for own in zip(sizes.tolist(), zeros.tolist(), fresh, strict=True)
    ]
    first = 0 if last is not None else 1
    if len(found) == first:
        return found
    start = last or fresh[0]
    now = Track(*(column[first:] for column in columns))
    before = _shifted(start, now)
    moved, *turns = motion_between(
        before, now, np.maximum(now.time - before.time, shortest[first:])
    )
    changes = change_of(_shifted(start, moved), moved, *turns)
    numbers = zip(*(column.tolist() for column in changes[1:]), strict=True)
    rows = zip(_rows(moved), numbers, is_same_hand(before, now).tolist(), strict=True)
    for i, (track, values, is_same) in enumerate(rows, start=first):
        change = Change(track, *values)
        found[i] = found[i]._replace(before=start, change=change, is_same=is_same)
        start = track
    return found


def _shifted(start: Track, columns: Track) -> Track:
    """Return the track before each one of many: `start` before the first."""
    pairs = zip(start, columns, strict=True)
    return Track(
        *(np.concatenate([np.asarray(own)[None], column[:-1]]) for own, column in pairs)
    )


def _rows(columns: Track) -> list[Track]:
    return [Track(*row) for row in zip(*columns, strict=True)]


def is_zero(size: float | np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Tell whether landmarks (..., 21, 3) lie in one place, or all but one at the origin, (...)."""
    # One landmark may be the origin of the tracker's world.
    seen = landmarks.any(axis=-1).sum(axis=-1)
    return (np.asarray(size) < ZERO_SIZE) | (seen < landmarks.shape[-2] - 1)


def first_track(now: float | np.ndarray, landmarks: np.ndarray) -> Track:
    """Return landmarks (..., 21, 3) [m] at times (...) [s] as samples without motion."""
    centre = landmarks[..., PALM, :].mean(axis=-2)
    points = landmarks - centre[..., None, :]
    still, dt = np.zeros_like(centre), np.zeros(centre.shape[:-1])
    unbent, fixed = np.zeros_like(points), fixed_lengths(landmarks)
    return Track(np.asarray(now), points, centre, still, still, unbent, dt, fixed)


def is_same_hand(before: Track, sample: Track) -> np.ndarray:
    """Tell whether two samples have exactly the same landmarks, shape (...)."""
    is_same = (before.points == sample.points).all(axis=(-2, -1))
    return is_same & (before.centre == sample.centre).all(axis=-1)


def change_between(track: Track, sample: Track, dt: float | np.ndarray) -> Change:
    """Measure the motion from a track to a sample, dt [s] later."""
    return change_of(track, *motion_between(track, sample, dt))


def motion_between(
    track: Track, sample: Track, dt: float | np.ndarray
) -> tuple[Track, np.ndarray, np.ndarray]:
    """Return the sample with its motion, its bending in former axes, and the palm's turn [rad]."""
    dt = np.asarray(dt)
    # Kabsch: the rotation that takes the palm before to the palm now.
    palms = sample.points[..., PALM, :], track.points[..., PALM, :]
    rotation = nearest_rotation(palms[0].swapaxes(-1, -2) @ palms[1])
    angle, turn = _angle(rotation)
    bending = (sample.points @ rotation - track.points) / dt[..., None, None]
    moved = sample._replace(
        velocity=(sample.centre - track.centre) / dt[..., None],
        turning=turn / dt[..., None],
        bending=bending @ rotation.swapaxes(-1, -2),
        dt=dt,
    )
    return moved, bending, angle


def change_of(
    track: Track, moved: Track, bending: np.ndarray, angle: np.ndarray
) -> Change:
    """Compare the motion of `motion_between` with the one before it, which led to the track."""
    # No motion is known before a first sample: speeds decide.
    is_known = np.asarray(track.dt) > 0.0
    span = np.where(is_known, 0.5 * (moved.dt + track.dt), moved.dt)
    slips = lengths(bending - track.bending) * is_known[..., None]
    order = np.partition(slips, -2, axis=-1)
    fingers = order[..., -1] / span
    return Change(
        moved,
        is_known * lengths(moved.velocity - track.velocity) / span,
        is_known * lengths(moved.turning - track.turning) / span,
        fingers,
        np.abs(moved.lengths - track.lengths).max(axis=-1),
        is_turned=(angle > FLIP) | _is_mirrored(track.points, moved.points),
        is_alone=fingers > ALONE * order[..., -2] / span,
        is_too_fast=(lengths(moved.velocity) > PALM_LIMITS.speed)
        | (angle / moved.dt > TURN_LIMITS.speed)
        | (lengths(bending).max(axis=-1) > FINGER_LIMITS.speed),
    )


def _is_mirrored(before: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Tell whether a reflection lays one hand better on the other than any rotation does."""
    covariance = points.swapaxes(-1, -2) @ before
    found = np.linalg.det(covariance) < 0.0
    if found.any():
        found &= np.linalg.svd(covariance, compute_uv=False)[..., 2] > MIRROR
    return found


def fixed_lengths(landmarks: np.ndarray) -> np.ndarray:
    """Return the distances that cannot change [m], shape (..., 23), of landmarks (..., 21, 3)."""
    spans = landmarks[..., _ENDS, :] - landmarks[..., _STARTS, :]
    return np.sqrt(np.einsum("...ij,...ij->...i", spans, spans))


def _angle(rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the angle of a rotation, and its rotation vector; only the angle near 180 degrees."""
    axis = 0.5 * (rotation[..., _LAST, _NEXT] - rotation[..., _NEXT, _LAST])
    sine = lengths(axis)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1.0))
    return angle, axis * np.where(sine > 1e-6, angle / np.maximum(sine, 1e-6), 1.0)[
        ..., None
    ]


_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
