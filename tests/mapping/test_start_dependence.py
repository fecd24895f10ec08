"""Where a stream begins does not decide in which posture a pinch is held."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from handmap_qp import HandMapper, load_hand, read_recording
from handmap_qp.human import scaled_human
from handmap_qp.stream import measure_person

CUTS = (33, 58, 75, 100, 117, 134)
"""Samples of the recording in which thumb and index finger are held together."""
LATER = 1.0
"""Time from a cut on after which postures are compared [s]."""
APART = np.radians(5.0)


def test_a_pinch_is_held_in_one_posture_wherever_the_stream_begins(
    recordings: Path,
) -> None:
    recording = read_recording(recordings / "leap_pinch_move_right.npz")
    lengths = measure_person(recording).lengths
    human = scaled_human(recording, points="landmarks", lengths=lengths)
    robot = load_hand("leap_right")

    def mapped_from(cut: int) -> np.ndarray:
        """Return the joints of all samples from a cut on; the robot starts at rest."""
        mapper = HandMapper(human, robot)
        part = recording.part(slice(cut, len(recording)))
        samples = zip(part.landmarks, part.time.tolist(), strict=True)
        return np.array([mapper.map_landmarks(x, time=t).command.q for x, t in samples])

    whole = mapped_from(0)
    apart = []
    for cut in CUTS:
        is_later = recording.time[cut:] >= recording.time[cut] + LATER
        away = np.abs(mapped_from(cut) - whole[cut:])[is_later]
        apart += (away.max(axis=1) > APART).tolist()
    # Tips that have passed each other on the way stay so in a small part of them.
    assert np.mean(apart) < 0.2
