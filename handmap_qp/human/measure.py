"""A person's hand, measured in a recording, and the human hand scaled to it."""

import math
from functools import cache

import numpy as np

from handmap_qp.errors import expect
from handmap_qp.hands import LARGEST_ROLL, Hand, HumanLengths, load_hand
from handmap_qp.ik.core import core
from handmap_qp.se3 import (
    Array,
    as_floats,
    lengths,
    rigid_fit,
    transform_points,
)
from .recording import Recording
from .sample import (
    LANDMARK_COUNT,
    PALM,
    expect_hand_length,
    finger_chains,
    human_name,
    landmarks_at_rest,
)

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


def check_length(landmarks: Array) -> Array:
    """Reject landmarks that are not a plausible hand in metres.

    Args:
        landmarks: Of one sample or more [m], shape (T, 21, 3).

    Returns:
        Bone lengths, the median over the samples [m], shape (5, 3).

    Raises:
        InvalidInputError: On a wrong shape, anything but finite numbers, or a length outside
            `HAND_LENGTHS`.
    """
    shape = ("T", LANDMARK_COUNT, 3)
    landmarks = as_floats(landmarks, "landmarks", shape=shape, is_finite=True)
    bones = lengths(np.diff(finger_chains(landmarks), axis=2))
    segments = np.median(bones, axis=0)
    palm = np.median(lengths(landmarks[:, 9] - landmarks[:, 0]))
    expect_hand_length(palm + segments[2].sum(), "landmarks")
    return segments


def measure_hand(recording: Recording) -> HumanLengths:
    """Measure a person's hand: medians of bones, palm and rolls over the valid samples.

    Args:
        recording: The recording.

    Returns:
        Lengths in the coordinates of a right hand, whichever hand was recorded. The palm's axes
        are those that lay its shape best on the standard hand's.

    Raises:
        InvalidInputError: If the landmarks are not a plausible hand in metres.
    """
    expect(
        isinstance(recording, Recording), "recording", "a Recording", value=recording
    )
    landmarks = recording.landmarks[recording.valid]
    segments = check_length(landmarks)
    if recording.side == "left":
        landmarks = landmarks * (-1.0, 1.0, 1.0)
    bases, rolls, little_weight = measure_shape(landmarks, _standard_palm())
    palm_weights = np.append(np.ones(4), little_weight)
    return HumanLengths(bases, segments, rolls, palm_weights=palm_weights)


def measure_shape(landmarks: Array, palm: Array) -> tuple[Array, Array, float]:
    """Measure the palm and the rolls of a right hand.

    Args:
        landmarks: Samples [m], shape (T, 21, 3).
        palm: The palm's landmarks of the standard hand [m], shape (5, 3).

    Returns:
        `HumanLengths.bases` and `rolls`, and the little finger's of `palm_weights`.
    """
    if core is not None:
        return core.measure_shape(landmarks, palm)
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


def scaled_human(
    recording: Recording,
    *,
    points: str | None = None,
    lengths: HumanLengths | None = None,
) -> Hand:
    """Load the human hand of a recording's side, scaled to the person.

    Args:
        recording: The recording.
        points: Name of a set of reference points; the hand's own if omitted.
        lengths: The person's lengths; measured in the recording if omitted.

    Raises:
        InvalidInputError: If the landmarks are not those of a hand in metres.
        HandError: If there is no such set.
    """
    lengths = lengths or measure_hand(recording)
    return load_hand(human_name(recording.side), points=points, lengths=lengths)


@cache
def _standard_palm() -> Array:
    """Return the palm's landmarks of the standard right hand [m], shape (5, 3)."""
    return landmarks_at_rest(load_hand("human"))[PALM]
