"""The motion from one sample of landmarks to the next, by which `stream.guard` judges samples."""

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


BELIEVED = np.array([60.0, 600.0, 150.0, 0.008])
"""Changes between two samples that are always believed: of the velocity of the palm [m/s^2], of its
angular velocity [rad/s^2], of landmarks in palm axes [m/s^2], and of lengths [m]."""
USUAL = np.array([8.0, 80.0, 12.0, 0.0015])
"""First guess of the tracker's usual changes."""
FASTEST = np.array([6.0, 40.0, 6.0])
"""Speeds that are never believed: of the palm [m/s], of its turn [rad/s], and of landmarks in palm
axes [m/s]. Recordings of free motion reach 1.5 m/s, 22 rad/s and 3.8 m/s."""
ALONE = 3.0
"""A landmark that leaves its place alone is this many times as fast as the next one."""


class Track(NamedTuple):
    """A sample and the motion that led to it; velocities are zero for a first sample.

    Attributes:
        time: Its instant, in the time of the clock [s].
        points: Landmarks from the palm's centre [m], shape (21, 3).
        centre: Centre of the palm [m], shape (3,).
        lengths: The distances that cannot change [m], shape (23,).
        velocity: Of the centre [m/s], shape (3,).
        turning: Angular velocity of the palm [rad/s], shape (3,).
        bending: Velocities of the landmarks in palm axes [m/s], shape (21, 3).
        dt: Time between this sample and the one before [s]; 0 for a first one.
    """

    time: float
    points: np.ndarray
    centre: np.ndarray
    lengths: np.ndarray
    velocity: np.ndarray
    turning: np.ndarray
    bending: np.ndarray
    dt: float = 0.0


class Change(NamedTuple):
    """Motion from a track to a sample.

    Attributes:
        track: The sample with the motion that led to it.
        sizes: Change of the palm's velocity [m/s^2], and of its angular velocity [rad/s^2]; largest
            change of a landmark's velocity in palm axes [m/s^2], and of a distance that cannot
            change [m]. Shape (4,), as `BELIEVED`.
        is_turned: The hand turned by more than 60 degrees, or became its mirror image.
        is_alone: One landmark changed its velocity far more than all others.
        is_too_fast: A speed is above what hands reach.
    """

    track: Track
    sizes: np.ndarray
    is_turned: bool
    is_alone: bool
    is_too_fast: bool


def is_zero(landmarks: np.ndarray) -> bool:
    """Tell whether landmarks (21, 3) lie in one place, or all but one at the origin."""
    # One landmark may be the origin of the tracker's world.
    seen = landmarks.any(axis=-1).sum()
    return bool(palm_sizes(landmarks[PALM]) < ZERO_SIZE or seen < len(landmarks) - 1)


def first_track(now: float, landmarks: np.ndarray) -> Track:
    """Return landmarks (21, 3) [m] at a time [s] as a sample without motion."""
    centre = landmarks[PALM].mean(axis=0)
    points, still = landmarks - centre, np.zeros(3)
    fixed = fixed_lengths(landmarks)
    return Track(now, points, centre, fixed, still, still, np.zeros_like(points))


def is_same_hand(before: Track, sample: Track) -> bool:
    """Tell whether two samples have exactly the same landmarks."""
    is_same = (before.points == sample.points).all()
    return bool(is_same and (before.centre == sample.centre).all())


def change_between(
    track: Track,
    sample: Track,
    dt: float,
) -> Change:
    """Measure the motion from a track to a sample, dt [s] later."""
    # Kabsch: the rotation that takes the palm before to the palm now.
    rotation = nearest_rotation(sample.points[PALM].T @ track.points[PALM])
    angle, turn = _angle(rotation)
    in_former_axes = (sample.points @ rotation - track.points) / dt
    moved = sample._replace(
        velocity=(sample.centre - track.centre) / dt,
        turning=turn / dt,
        bending=in_former_axes @ rotation.T,
        dt=dt,
    )
    # No motion is known before a first sample: speeds decide.
    is_known = track.dt > 0.0
    span = 0.5 * (dt + track.dt) if is_known else dt
    changes = [
        moved.velocity - track.velocity,
        moved.turning - track.turning,
        *(in_former_axes - track.bending),
    ]
    palm, turned, *slips = (is_known * lengths(np.array(changes)) / span).tolist()
    second, fingers = sorted(slips)[-2:]
    stretch = np.abs(moved.lengths - track.lengths).max()
    speeds = np.array(
        [
            lengths(moved.velocity),
            angle / dt,
            lengths(in_former_axes).max(),
        ]
    )
    return Change(
        moved,
        np.array([palm, turned, fingers, stretch]),
        is_turned=angle > FLIP or _is_mirrored(track.points, moved.points),
        is_alone=fingers > ALONE * second,
        is_too_fast=bool((speeds > FASTEST).any()),
    )


def _is_mirrored(before: np.ndarray, points: np.ndarray) -> bool:
    """Tell whether a reflection lays one hand better on the other than any rotation does."""
    covariance = points.T @ before
    if np.linalg.det(covariance) >= 0.0:
        return False
    return bool(np.linalg.svd(covariance, compute_uv=False)[2] > MIRROR)


def fixed_lengths(landmarks: np.ndarray) -> np.ndarray:
    """Return the distances that cannot change [m], shape (23,), of landmarks (21, 3)."""
    return lengths(landmarks[_ENDS] - landmarks[_STARTS])


def _angle(rotation: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the angle of a rotation, and its rotation vector; only the angle near 180 degrees."""
    axis = 0.5 * (rotation[_LAST, _NEXT] - rotation[_NEXT, _LAST])
    sine = math.sqrt(axis @ axis)
    angle = math.atan2(sine, 0.5 * (np.trace(rotation) - 1.0))
    return angle, axis * (angle / sine if sine > 1e-6 else 1.0)


_NEXT = np.array([1, 2, 0])
_LAST = np.array([2, 0, 1])
