"""EgoDex's HDF5 files: both hands of a person in poses of named joints.

Written from its documentation (Hoque et al. 2025, arXiv 2505.11709, and the README of
apple/ml-egodex): `transforms/NAME (N, 4, 4)` has the pose of a joint in the world of the session
[m], `confidences/NAME (N,)` its confidence from 0 to 1, and a frame is 1/30 s. Names are those of
ARKit: `leftHand` is the wrist, `leftIndexFingerKnuckle` the MCP joint, `...IntermediateBase` the
PIP and `...IntermediateTip` the DIP joint; the thumb's knuckle is its CMC joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from handmap_qp.errors import RecordingError, expect
from handmap_qp.hands.spec import Side
from handmap_qp.human.recording import Recording
from handmap_qp.trackers.formats.base import (
    SIDES,
    Entry,
    RecordingFormat,
    build_recording,
    finite_samples,
)
from handmap_qp.trackers.formats.hdf5 import (
    SUFFIXES,
    created,
    has_group,
    numbers,
    opened,
)
from handmap_qp.trackers.wrist_axes import palm_axes

RATE = 30.0
"""Frames per second of all files."""
_LINKS = ("Knuckle", "IntermediateBase", "IntermediateTip", "Tip")
_FINGERS = ("Thumb", "IndexFinger", "MiddleFinger", "RingFinger", "LittleFinger")


def joint_names(side: Side) -> tuple[str, ...]:
    """Return the names of the 21 landmarks of a hand."""
    return (
        f"{side}Hand",
        *(f"{side}{finger}{link}" for finger in _FINGERS for link in _LINKS),
    )


class EgoDexFormat(RecordingFormat):
    """Both hands as poses of ARKit's joints.

    A sample is valid where all 21 poses are finite and the wrist's confidence is above 0. Its
    confidence is the mean over the 21 joints. Files of this package have the tracker's instants in
    a further array `time (N,)`; others have 30 frames a second.
    """

    name = "egodex"
    suffixes = SUFFIXES
    about = "EgoDex's HDF5, poses of ARKit's joints; one recording of each hand"
    lacks = ("source",)

    def recognises(self, path: Path) -> bool:
        """Tell whether the file has poses of joints."""
        return has_group(path, "transforms")

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the hands whose wrist the file has."""
        with opened(path) as file:
            group = file["transforms"]
            found = [side for side in SIDES if f"{side}Hand" in group]
            if not found:
                problem = "has neither 'leftHand' nor 'rightHand'"
                raise RecordingError(
                    problem,
                    file=path,
                    array="transforms",
                )
            return tuple(Entry(side, side, len(group[f"{side}Hand"])) for side in found)

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one hand."""
        names = joint_names(entry.side)
        with opened(path) as file:
            group = file["transforms"]
            count = entry.samples
            poses = [numbers(path, group, name, (count, 4, 4)) for name in names]
            shares = None
            if "confidences" in file:
                given = file["confidences"]
                rows = [numbers(path, given, name, (count,)) for name in names]
                shares = np.array(rows)
            time = np.arange(count) / RATE
            if "time" in file:
                time = numbers(path, file, "time", (count,))
        is_seen = finite_samples(poses[0])
        return build_recording(
            path,
            entry,
            time,
            np.stack([pose[:, :3, 3] for pose in poses], axis=1),
            prefix=f"{entry.side} hand: ",
            valid=is_seen if shares is None else is_seen & (shares[0] > 0.0),
            source="EgoDex",
            wrist=poses[0],
            confidence=None if shares is None else shares.mean(axis=0),
        )

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name the joints and groups that a recording cannot hold."""
        with opened(path) as file:
            known = {name for side in SIDES for name in joint_names(side)}
            others = len(set(file["transforms"]) - known)
            rest = sorted(set(file) - {"transforms", "confidences", "time"})
        poses = (f"{others} other poses",) if others else ()
        return (*poses, *rest, "orientations of the fingers' joints")

    def losses(self, recordings: Sequence[Recording]) -> tuple[str, ...]:
        """Name what the poses of joints cannot say."""
        lost = {
            "that the wrist's orientation is unknown": lambda r: r.wrist is None,
            "the wrist's position where it is not its landmark": _is_apart,
            "that the confidence is unknown": lambda r: r.confidence is None,
        }
        found = [words for words, holds in lost.items() if any(map(holds, recordings))]
        return (*super().losses(recordings), *found)

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write one hand or both; the fingers' joints have no orientation of their own.

        Where the tracker gave no wrist pose, the wrist's orientation is that of the palm.
        """
        self.check_one_per_hand(recordings)
        expect(
            len({recording.time.tobytes() for recording in recordings}) == 1,
            "recordings",
            "both hands at the same instants, as EgoDex has them",
            got="others",
            advice="write one file for each hand",
        )
        with created(path) as file:
            file["time"] = recordings[0].time
            for recording in recordings:
                given = 1.0 if recording.confidence is None else recording.confidence
                poses = np.tile(np.eye(4), (21, len(recording), 1, 1))
                poses[:, :, :3, 3] = recording.landmarks.transpose(1, 0, 2)
                poses[0, :, :3, :3] = _wrist_rotations(recording)
                for name, pose in zip(joint_names(recording.side), poses, strict=True):
                    file[f"transforms/{name}"] = pose
                    file[f"confidences/{name}"] = np.where(recording.valid, given, 0.0)


def _wrist_rotations(recording: Recording) -> np.ndarray:
    """Return the wrist's rotations, the tracker's or those of the palm's landmarks, (T, 3, 3)."""
    if recording.wrist is not None:
        return recording.wrist[:, :3, :3]
    rotations = np.tile(np.eye(3), (len(recording), 1, 1))
    seen = recording.valid
    sign = 1.0 if recording.side == "right" else -1.0
    rotations[seen] = palm_axes(recording.landmarks[seen], sign)
    return rotations


def _is_apart(recording: Recording) -> bool:
    """Tell whether the wrist's pose is elsewhere than the first landmark in a valid sample."""
    if recording.wrist is None:
        return False
    apart = recording.wrist[:, :3, 3] != recording.landmarks[:, 0]
    return bool(apart[recording.valid].any())
