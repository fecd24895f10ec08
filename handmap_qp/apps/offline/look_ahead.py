"""Smooth a whole recording with look-ahead: zero lag, and short gaps filled.

A Whittaker-Henderson smoother (Whittaker 1923; Eilers, Anal. Chem. 75 (2003) 3631): for each column
y over the instants t,

    min  sum_i w_i (x_i - y_i)^2 dt_i  +  (2 pi f)^-4  integral of (x'')^2 dt

with w_i = 0 where the hand was not seen. It passes a motion of frequency f at half its amplitude,
slower ones unchanged, and has no phase: it looks as far ahead as back. In a gap it is the cubic
spline between both sides. The palm's motion and the landmarks in the palm are smoothed apart, so
that the hand keeps its size while it turns.

The smooth recording is mapped as any other, with the costs of speed and acceleration that go with
smoothing (`SMOOTH_IK`).
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from handmap_core.se3 import (
    Array,
    affine,
    inverse_pose,
    rigid_fit,
    rotation_from_quat_wxyz,
    transform_points,
)
from handmap_qp.human import PALM, Recording
from .trajectory import held_samples, stretches

CUTOFF = 6.0
"""Frequency that is passed at half its amplitude [Hz]."""
LONGEST_GAP = 0.5
"""Gaps up to this time are filled [s]; in longer ones the robot holds."""


def look_ahead(recording: Recording) -> Recording:
    """Smooth a recording forwards and backwards in time, and fill its short gaps.

    Samples in filled gaps are valid. Wrist poses and confidences of the tracker are left out,
    because the filled samples have none.
    """
    time = recording.time
    valid = recording.valid
    filled = valid.copy()
    for last, following in pairwise(np.flatnonzero(valid)):
        if time[following] - time[last] <= LONGEST_GAP:
            filled[last:following] = True
    landmarks = recording.landmarks.copy()
    for part in stretches(filled):
        if valid[part].sum() < 3:
            filled[part] &= valid[part]
        else:
            landmarks[part] = _smoothed(recording.part(part))
    return replace(
        recording, landmarks=landmarks, valid=filled, wrist=None, confidence=None
    )


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


def _smoothed(recording: Recording) -> Array:
    """Smooth landmarks, shape (T, 21, 3): the palm's motion, and what moves in the palm."""
    time = recording.time
    valid = recording.valid
    held = recording.landmarks[held_samples(valid)]
    points = held[:, PALM]
    palms = rigid_fit(points[0] - points[0].mean(axis=0), points)
    local = transform_points(inverse_pose(palms), held)
    inside = whittaker(time, local.reshape(len(time), -1), valid, CUTOFF)
    poses = smooth_poses(time, palms, valid)
    return transform_points(poses, inside.reshape(local.shape))
