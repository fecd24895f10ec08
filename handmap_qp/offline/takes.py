"""A recording as every method of a comparison gets it, and what the human did in it: `Take`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.spec import Side
from handmap_qp.human.fit import fit_recording
from handmap_qp.human.landmarks import human_name
from handmap_qp.human.person import Person
from handmap_qp.human.recording import Recording, mirrored
from handmap_qp.offline.fidelity import SETTLING
from handmap_qp.offline.finger_traces import HandTrace, trace_human
from handmap_qp.se3 import inverse_pose
from handmap_qp.stream.measurement import measure_person


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """One recording of a human hand, on the robot's side.

    Attributes:
        recording: The recording; mirrored if the robot is a hand of the other side.
        is_mirrored: Whether it is.
        has_wrist: Whether the palm is the tracker's; otherwise it is fitted to its landmarks.
        human: The human hand, scaled to the person.
        trace: What the human did, by the raw landmarks. Samples that are not valid hold the one
            before.
        wrist: Pose of the human model's wrist frame in the world, shape (T, 4, 4).
        q: The human's joint angles, fitted for the jerk alone [rad], shape (T, 20).
        contact_gap: Distance of thumb and finger landmarks where the skin touches [m].
    """

    recording: Recording
    is_mirrored: bool
    has_wrist: bool
    human: Hand
    trace: HandTrace
    wrist: np.ndarray
    q: np.ndarray
    contact_gap: float

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.recording.name


def prepare_take(
    recording: Recording,
    side: Side = "right",
    progress: Callable[[int], None] | None = None,
    *,
    person: Person | None = None,
) -> Take:
    """Describe what the human did in a recording.

    Args:
        recording: Landmarks of a hand, and the tracker's wrist poses if it gave any.
        side: Side of the robot; a recording of the other hand is mirrored.
        progress: Called after each sample with the number of samples done.
        person: The person; measured in the recording if omitted.

    Returns:
        The take.

    Raises:
        InvalidInputError: If the landmarks are not those of a hand in metres, or no sample is valid
            after the first half second.
    """
    seen = recording.valid & (recording.time >= recording.time[0] + SETTLING)
    if not seen.any():
        raise InvalidInputError(
            argument=recording.name,
            expected="valid samples after the first half second",
            got="none",
        )
    is_mirrored = recording.side != side
    if is_mirrored:
        recording = mirrored(recording)
    held, wrist_poses = held_samples(recording.valid), recording.wrist
    person = person or measure_person(recording)
    lengths = person.lengths
    human = load_hand(human_name(side), lengths=lengths)
    trace = trace_human(
        recording.landmarks[held],
        lengths,
        side,
        None if wrist_poses is None else wrist_poses[held],
    )
    return Take(
        recording=recording,
        is_mirrored=is_mirrored,
        has_wrist=wrist_poses is not None,
        human=human,
        trace=trace,
        wrist=trace.palm @ inverse_pose(human.wrist_to_palm),
        q=fit_recording(recording, progress, lengths=lengths).q,
        contact_gap=person.contact_gap,
    )


def held_samples(valid: np.ndarray) -> np.ndarray:
    """Return for every sample the index of the last valid one, at the start of the first, (T,)."""
    index = np.maximum.accumulate(np.where(valid, np.arange(len(valid)), -1))
    return np.where(index < 0, int(np.argmax(valid)), index)
