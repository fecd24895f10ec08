"""A person's hand, measured in a recording, and the human hand scaled to it."""

from collections.abc import Callable
from functools import cache

import numpy as np

from handmap_core.core import core
from handmap_core.errors import expect
from handmap_core.human.recording import Recording
from handmap_core.human.sample import (
    LANDMARK_COUNT,
    PALM,
    expect_hand_length,
    finger_chains,
    human_name,
    landmarks_at_rest,
)
from handmap_core.se3 import (
    Array,
    as_floats,
    lengths,
)
from handmap_qp.hands import LARGEST_ROLL, Hand, HumanLengths, load_hand

_AT_ONCE = 10_000
"""Samples that are measured at once."""


class ChosenRows:
    """Some rows of an array, which are copied only when they are read.

    Args:
        rows: The array, shape (T, ...).
        chosen: Indices of the rows, shape (n,).
    """

    def __init__(self, rows: Array, chosen: Array) -> None:
        self._rows = rows
        self._chosen = chosen
        self._is_all = len(chosen) == len(rows)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self._chosen)

    def __getitem__(self, rows: slice) -> Array:
        """Return some of the rows, shape (m, ...)."""
        return self._rows[rows] if self._is_all else self._rows[self._chosen[rows]]


def seen_landmarks(recording: Recording) -> Array:
    """Return the landmarks of the valid samples [m], (n, 21, 3); no copy if all are valid."""
    valid = recording.valid
    return recording.landmarks if valid.all() else recording.landmarks[valid]


def by_parts(measure: Callable[[Array], Array], rows: Array | ChosenRows) -> Array:
    """Measure the samples of a recording by parts of 10,000, and return all of them.

    What is computed on the way of an hour may take more memory than the recording.

    Args:
        measure: Gives each sample of a part its own row.
        rows: The samples, shape (T, ...).
    """
    if len(rows) <= _AT_ONCE:
        return measure(rows[:])
    starts = range(0, len(rows), _AT_ONCE)
    return np.concatenate([measure(rows[start : start + _AT_ONCE]) for start in starts])


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
    bones = by_parts(
        lambda part: lengths(np.diff(finger_chains(part), axis=2)), landmarks
    )
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
    landmarks = seen_landmarks(recording)
    if recording.side == "left":
        landmarks = landmarks * (-1.0, 1.0, 1.0)
    return measure_right_hand(landmarks)


def measure_right_hand(landmarks: Array) -> HumanLengths:
    """Measure a person's right hand as `measure_hand`.

    Args:
        landmarks: Samples in which it was seen [m], shape (T, 21, 3).

    Raises:
        InvalidInputError: If the landmarks are not a plausible hand in metres.
    """
    segments = check_length(landmarks)
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
    return core.measure_shape(landmarks, palm, LARGEST_ROLL)


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
