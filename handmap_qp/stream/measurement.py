"""A person's hand and contact gap, from the samples of recordings that the guard lets pass."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from handmap_core.errors import expect
from handmap_core.se3 import Array
from handmap_qp.hands import HumanLengths
from handmap_qp.human import (
    LANDMARK_COUNT,
    Person,
    Recording,
    clipped_gap,
    measure_contact_gap,
    measure_hand,
    measure_right_hand,
    mirrored,
    scaled_human,
    smallest_gap,
)
from .guard import StreamGuard


def measure_person(*recordings: Recording) -> Person:
    """Measure a person's hand and contact gap in one recording or more.

    Bones, palm and gap are medians and percentiles over all samples that make sense: the guard of
    live streams leaves out jumps, flips, outliers and the like first.

    Args:
        *recordings: Recordings of one person, of either hand; thumb and fingers should touch in
            them now and then. The person gets the name of the first.

    Raises:
        InvalidInputError: If there is no recording, or the landmarks are not a plausible hand in
            metres.
    """
    expect(recordings, "recordings", "at least one", got="none")
    measured = [measure_hand(recording) for recording in recordings]
    sound = [*map(_sound_samples, recordings, measured)]
    first = recordings[0]
    if len(recordings) == 1:
        if sound[0] is first.valid:
            # A recording without faults was measured before.
            return Person(first.name, measured[0], measure_contact_gap(first))
        # One copy, which a left hand is mirrored in: an hour has 54 MB.
        landmarks = first.landmarks[sound[0]]
        gap = clipped_gap(smallest_gap(first.time[sound[0]], landmarks))
        if first.side == "left":
            landmarks *= (-1.0, 1.0, 1.0)
        return Person(first.name, measure_right_hand(landmarks), gap)
    time, landmarks = _joined(recordings, sound)
    lengths = measure_right_hand(landmarks)
    return Person(first.name, lengths, clipped_gap(smallest_gap(time, landmarks)))


def _sound_samples(recording: Recording, lengths: HumanLengths) -> Array:
    """Return which samples the guard lets pass, shape (T,).

    If it lets fewer than half pass, all valid samples count, since rules that reject most samples
    do not know this tracker. If all that are valid count, it is `Recording.valid` itself.

    Args:
        recording: The recording.
        lengths: Lengths of the hand in it.
    """
    human = scaled_human(recording, lengths=lengths)
    valid = recording.valid & ~StreamGuard(human).holds(recording)
    if 2 * valid.sum() < recording.valid.sum() or (valid == recording.valid).all():
        return recording.valid
    return valid


def _joined(
    recordings: Sequence[Recording], sound: Sequence[Array]
) -> tuple[Array, Array]:
    """Put samples of recordings behind each other, as of a right hand.

    Args:
        recordings: The recordings.
        sound: Which samples to take of each.

    Returns:
        Instants [s], shape (T,), and landmarks [m], shape (T, 21, 3).
    """
    time = np.cumsum(np.concatenate([each.steps for each in recordings]))
    # An hour of both hands has 100 MB: no more copies than there must be.
    landmarks = np.empty((sum(int(each.sum()) for each in sound), LANDMARK_COUNT, 3))
    start = 0
    for recording, taken in zip(recordings, sound, strict=True):
        right = recording
        if recording.side == "left":
            # Objects do not count, and those of some shapes have no mirror image.
            right = mirrored(replace(recording, object_shape=""))
        stop = start + int(taken.sum())
        np.compress(taken, right.landmarks, axis=0, out=landmarks[start:stop])
        start = stop
    return time[np.concatenate(sound)], landmarks
