"""Measures of people and episodes by numpy and scipy, as an oracle of the compiled core."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import median_filter

from handmap_core.human.recording import Recording
from handmap_core.human.sample import PALM, finger_chains
from handmap_qp.apps.offline.trajectory import Trajectory, rms_derivative
from handmap_qp.hands.human import LARGEST_ROLL
from handmap_qp.human.contact_gap import tip_gaps
from handmap_qp.se3 import Array, lengths, rigid_fit, transform_points

_BENT = math.sin(math.radians(15.0))
"""Sine of the angle between proximal bone and the line from PIP to tip, above which a finger spans
a plane."""
_FEWEST_BENT = 20
"""Bent samples that a finger's roll needs."""
_STEADY = 5e-4
"""Spread that landmarks of a palm have at least: they are not told apart below it [m]."""
_LEAST_WEIGHT = 0.02
_ROUNDS = 5
_FEW = 64
"""Samples that the spread of knuckles is measured in, at most."""
_MEDIAN_TIME = 0.1
"""Time over which gaps are medians [s]."""


def measure_shape(landmarks: Array, palm: Array) -> tuple[Array, Array, float]:
    """Return `HumanLengths.bases` and `rolls`, and the little finger's of `palm_weights`.

    Args:
        landmarks: Samples of a right hand [m], shape (T, 21, 3).
        palm: The palm's landmarks of the standard hand [m], shape (5, 3).
    """
    palms = landmarks[:, PALM]
    weights = np.ones(len(PALM))
    palm = _common_shape(palms, palm, weights)
    for _ in range(_ROUNDS):
        weight = _little_weight(palms, palm, weights)
        if weight == weights[-1]:
            break
        weights[-1] = weight
        palm = _common_shape(palms, palm, weights)
    laid = transform_points(rigid_fit(palms, palm, weights), landmarks)
    # The bones of a bent finger span a plane whose normal is its flexion axis. Abduction turns it
    # about the axis that rolls with it, so that the ratio of its x and z parts is that of the roll.
    # The thumb's bones bend about two axes.
    bases, joints, _, tips = np.moveaxis(finger_chains(laid), 2, 0)
    proximal = joints - bases
    beyond = tips - joints
    normals = np.cross(proximal, beyond)
    angles = np.arctan2(normals[..., 2], -normals[..., 0])
    is_bent = lengths(normals) > _BENT * lengths(proximal) * lengths(beyond)
    is_bent &= is_bent.sum(axis=0) >= _FEWEST_BENT
    bent = np.ma.array(angles, mask=~is_bent)
    rolls = np.ma.median(bent, axis=0).filled(0.0)
    rolls[0] = 0.0
    rolls = np.clip(rolls, -LARGEST_ROLL, LARGEST_ROLL)
    return np.median(bases, axis=0), rolls, float(weights[-1])


def _common_shape(palms: Array, palm: Array, weights: Array) -> Array:
    """Return the shape that palms (T, 5, 3) have in common, from a first guess, shape (5, 3).

    Generalised Procrustes analysis: lay every sample on the median shape, then take the median
    again. Three rounds are enough to converge.
    """
    for _ in range(3):
        laid = transform_points(rigid_fit(palms, palm, weights), palms)
        palm = np.median(laid, axis=0)
        palm = palm - palm[0]
    return palm


def _little_weight(palms: Array, palm: Array, weights: Array) -> float:
    """Return the weight of the little finger's knuckle in the fit of the palm.

    The fifth metacarpal moves on the palm, the second does not, and noise moves both knuckles
    alike. So the weight falls where the little finger's knuckle moves more than the index finger's,
    seen from all other landmarks.
    """
    some = palms[:: -(-len(palms) // _FEW)]
    index, little = (_spread(some, palm, weights, k) for k in (1, len(PALM) - 1))
    ratio = (index + _STEADY) / (little + _STEADY)
    return float(np.clip(ratio**4, _LEAST_WEIGHT, 1.0))


def _spread(palms: Array, palm: Array, weights: Array, landmark: int) -> float:
    """Return how far a landmark moves on palms that are laid by their other landmarks [m]."""
    others = weights.copy()
    others[landmark] = 0.0
    places = transform_points(rigid_fit(palms, palm, others), palms)[:, landmark]
    off = lengths(places - np.median(places, axis=0))
    return float(np.sqrt(np.mean(off**2)))


def smallest_gap(time: Array, landmarks: Array) -> float:
    """Return the 1st percentile of the smallest gap, of gaps that are medians over 0.1 s [m]."""
    gaps = tip_gaps(landmarks)
    period = np.median(np.diff(time)) if len(time) > 1 else _MEDIAN_TIME
    width = 2 * round(0.5 * _MEDIAN_TIME / max(period, 1e-6)) + 1
    size = (min(width, len(gaps)), 1)
    smooth = median_filter(gaps, size, mode="nearest")
    return float(np.percentile(smooth.min(axis=1), 1.0))


def measure_episode(recording: Recording, trajectory: Trajectory) -> dict[str, float]:
    """Return all measures of an episode but those of surfaces, by name."""
    seen = trajectory.valid
    errors = 1e3 * trajectory.point_error[seen]
    fingers = finger_chains(recording.landmarks[recording.valid])
    bones = lengths(np.diff(fingers, axis=2))
    # The longest time between valid samples, beyond the usual step.
    whole = recording.time
    times = whole[recording.valid]
    inside = np.diff(times).max(initial=0.0) - np.median(recording.steps)
    gap = max(inside, times[0] - whole[0], whole[-1] - times[-1])
    return {
        "valid": recording.valid.mean(),
        "longest_gap_s": gap,
        "bone_variation": (bones.std(axis=0) / bones.mean(axis=0)).mean(),
        "reach_mm": errors.mean(),
        "reach_p95_mm": np.percentile(errors, 95),
        "saturation": trajectory.at_limit[seen].mean(),
        "speed_limited": trajectory.at_speed_limit[seen].any(axis=1).mean(),
        "jerk": rms_derivative(trajectory.q, trajectory.time, seen, order=3),
    }
