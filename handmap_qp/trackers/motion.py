"""The motion from one sample of landmarks to the next, by which `trackers.guard` judges samples."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from handmap_qp.trackers.landmarks import PALM
from handmap_qp.transform import determinant, nearest_rotation, svd3

FLIP = math.radians(60.0)
"""A turn by more than this between two samples is a flip."""
ZERO_SIZE = 0.001
"""A hand whose palm has a smaller RMS radius is no hand but a point [m]."""
MIRROR = 1e-4
"""Smallest part of the squared landmark spread that must speak for a mirror image [m^2]."""

_STARTS = np.array([0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19, 5, 9, 13])
_ENDS = np.array([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 9, 13, 17])
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

    time: float
    points: np.ndarray
    centre: np.ndarray
    velocity: np.ndarray
    turning: np.ndarray
    bending: np.ndarray
    dt: float
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
    palm: float
    turn: float
    fingers: float
    lengths: float
    is_turned: bool
    is_alone: bool
    is_too_fast: bool


class Sight(NamedTuple):
    """What a sample shows by itself, and against the sample before it where that is known.

    Attributes:
        size: RMS radius of the palm [m].
        is_zero: Landmarks lie in one place or at the origin.
        fresh: The sample without motion.
        before: The sample before with the motion that led to it; None if it is not known.
        change: Motion from `before` to this sample.
        is_same: Both have exactly the same landmarks.
        measures: Its row of `plausibility.recorded_measures`; None if it is not known.
    """

    size: float
    is_zero: bool
    fresh: Track
    before: Track | None = None
    change: Change | None = None
    is_same: bool = False
    measures: np.ndarray | None = None


def is_zero(size: float, landmarks: np.ndarray) -> bool:
    """Tell whether landmarks (21, 3) lie in one place, or all but one at the origin."""
    # One landmark may be the origin of the tracker's world.
    return size < ZERO_SIZE or int(landmarks.any(axis=1).sum()) < len(landmarks) - 1


def first_track(now: float, landmarks: np.ndarray) -> Track:
    """Return landmarks (21, 3) [m] at a time [s] as a sample without motion."""
    centre = landmarks[PALM].mean(axis=0)
    points = landmarks - centre
    return Track(now, points, centre, STILL, STILL, UNBENT, 0.0, fixed_lengths(landmarks))


def is_same_hand(before: Track, sample: Track) -> bool:
    """Tell whether two samples have exactly the same landmarks."""
    is_same = (before.points == sample.points).all() and (before.centre == sample.centre).all()
    return bool(is_same)


def change_between(track: Track, sample: Track, dt: float) -> Change:
    """Measure the motion from a track to a sample, dt [s] later."""
    # Kabsch: the rotation that takes the palm before to the palm now.
    rotation = nearest_rotation(sample.points[PALM].T.dot(track.points[PALM]))
    angle, turn = _angle(rotation)
    velocity = (sample.centre - track.centre) / dt
    turning = turn / dt
    bending = (sample.points.dot(rotation) - track.points) / dt
    if track.dt > 0.0:
        span = 0.5 * (dt + track.dt)
        palm = _length(velocity - track.velocity) / span
        turned = _length(turning - track.turning) / span
        slips = bending - track.bending
    else:
        # No motion is known before: speeds decide.
        palm = turned = 0.0
        span, slips = dt, np.zeros_like(bending)
    by_landmark = np.einsum("ij,ij->i", slips, slips)
    order = np.partition(by_landmark, -2)
    fingers, next_most = math.sqrt(order[-1]) / span, math.sqrt(order[-2]) / span
    fastest = math.sqrt(np.einsum("ij,ij->i", bending, bending).max())
    is_too_fast = (
        _length(velocity) > PALM_LIMITS.speed
        or angle / dt > TURN_LIMITS.speed
        or fastest > FINGER_LIMITS.speed
    )
    moved = sample._replace(
        velocity=velocity, turning=turning, bending=bending.dot(rotation.T), dt=dt
    )
    return Change(
        moved,
        palm,
        turned,
        fingers,
        float(np.abs(sample.lengths - track.lengths).max()),
        is_turned=angle > FLIP or _is_mirrored(track.points, sample.points),
        is_alone=fingers > ALONE * next_most,
        is_too_fast=is_too_fast,
    )


def _is_mirrored(before: np.ndarray, points: np.ndarray) -> bool:
    """Tell whether a reflection lays one hand better on the other than any rotation does."""
    covariance = points.T.dot(before)
    return determinant(covariance) < 0.0 and bool(svd3(covariance)[1][2] > MIRROR)


def fixed_lengths(landmarks: np.ndarray) -> np.ndarray:
    """Return the distances that cannot change [m], shape (..., 23), of landmarks (..., 21, 3)."""
    spans = landmarks[..., _ENDS, :] - landmarks[..., _STARTS, :]
    return np.sqrt(np.einsum("...ij,...ij->...i", spans, spans))


def _angle(rotation: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the angle of a rotation, and its rotation vector; only the angle near 180 degrees."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    angle = math.acos(min(1.0, max(-1.0, 0.5 * (a + e + i - 1.0))))
    sine = math.sin(angle)
    scale = 0.5 * (angle / sine if sine > 1e-6 else 1.0)
    return angle, scale * np.array([h - f, c - g, d - b])


def _length(vector: np.ndarray) -> float:
    return math.sqrt(vector.dot(vector))


STILL = np.zeros(3)
UNBENT = np.zeros((21, 3))
