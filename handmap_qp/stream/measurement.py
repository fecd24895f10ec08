"""A person's hand and contact gap, from the samples of recordings that the guard lets pass."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from handmap_core.errors import expect
from handmap_qp.hands import HumanLengths
from handmap_qp.human import (
    Person,
    Recording,
    measure_contact_gap,
    measure_hand,
    mirrored,
    scaled_human,
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
    joined = _joined([*map(without_faults, recordings, measured)])
    # A recording without faults was measured before.
    lengths = measured[0] if joined is recordings[0] else measure_hand(joined)
    return Person(joined.name, lengths, measure_contact_gap(joined))


def without_faults(
    recording: Recording, lengths: HumanLengths | None = None
) -> Recording:
    """Return a recording in which only samples are valid that the guard lets pass.

    If it lets fewer than half pass, the recording stays as it is, since rules that reject most
    samples do not know this tracker.

    Args:
        recording: The recording.
        lengths: Lengths of the hand in it; measured if omitted.

    Raises:
        InvalidInputError: If the landmarks are not a plausible hand in metres.
    """
    human = scaled_human(recording, lengths=lengths)
    valid = recording.valid & ~StreamGuard(human).holds(recording)
    if 2 * valid.sum() < recording.valid.sum() or (valid == recording.valid).all():
        return recording
    return replace(recording, valid=valid)


def _joined(recordings: Sequence[Recording]) -> Recording:
    """Put recordings behind each other, as of a right hand."""
    if len(recordings) == 1:
        return recordings[0]
    # Objects do not count, and those of some shapes have no mirror image.
    alone = [
        replace(each, object_shape="") if each.object_shape else each
        for each in recordings
    ]
    right = [each if each.side == "right" else mirrored(each) for each in alone]
    steps, landmarks, valid = (
        np.concatenate([getattr(each, name) for each in right])
        for name in ("steps", "landmarks", "valid")
    )
    return Recording(right[0].name, np.cumsum(steps), landmarks, valid, "right")
