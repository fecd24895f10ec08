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
from typing import Any

import numpy as np

from handmap_qp.errors import InvalidInputError, RecordingError
from handmap_qp.hands.spec import Side
from handmap_qp.human.recording import Recording
from handmap_qp.trackers.formats.base import SIDES, Entry, check_one_per_hand, entry_stem, reading
from handmap_qp.trackers.formats.columns import finite_samples
from handmap_qp.trackers.formats.hdf5 import SUFFIXES, created, numbers, opened
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


class EgoDexFormat:
    """Both hands as poses of ARKit's joints.

    A sample is valid where all 21 poses are finite and the wrist's confidence is above 0. Its
    confidence is the mean over the 21 joints. Files of this package have the tracker's instants in
    a further array `time (N,)`; others have 30 frames a second.
    """

    name = "egodex"
    suffixes = SUFFIXES
    about = "EgoDex's HDF5, poses of ARKit's joints; one recording of each hand"

    def recognises(self, path: Path) -> bool:
        """Tell whether the file has poses of joints."""
        if not path.is_file():
            return False
        with opened(path) as file:
            return "transforms" in file

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the hands whose wrist the file has."""
        with opened(path) as file:
            group = file["transforms"]
            found: list[Side] = [side for side in SIDES if f"{side}Hand" in group]
            if not found:
                problem = "has neither 'leftHand' nor 'rightHand'"
                raise RecordingError(problem, file=path, array="transforms")
            return tuple(Entry(side, side, len(group[f"{side}Hand"])) for side in found)

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one hand."""
        names = joint_names(entry.side)
        with opened(path) as file:
            group = file["transforms"]
            poses = [numbers(path, group, name, (entry.samples, 4, 4)) for name in names]
            shares = self._confidences(path, file, names, entry.samples)
            time = np.arange(entry.samples) / RATE
            if "time" in file:
                time = numbers(path, file, "time", (entry.samples,))
        landmarks = np.stack([pose[:, :3, 3] for pose in poses], axis=1)
        valid = finite_samples(landmarks) & finite_samples(poses[0])
        if shares is not None:
            valid &= shares[:, 0] > 0.0
        with reading(path, f"{entry.side} hand: "):
            return Recording(
                name=entry_stem(path, entry),
                time=time,
                landmarks=landmarks,
                valid=valid,
                side=entry.side,
                source="EgoDex",
                wrist=poses[0],
                confidence=None if shares is None else shares.mean(axis=1),
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
        lost = ["the words about the source"] if any(r.source for r in recordings) else []
        if any(r.wrist is None for r in recordings):
            lost.append("that the wrist's orientation is unknown")
        if any(_is_apart(r) for r in recordings):
            lost.append("the wrist's position where it is not its landmark")
        if any(r.confidence is None for r in recordings):
            lost.append("that the confidence is unknown")
        return tuple(lost)

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write one hand or both; the fingers' joints have no orientation of their own.

        Where the tracker gave no wrist pose, the wrist's orientation is that of the palm.
        """
        check_one_per_hand(recordings, self.name)
        if len({recording.time.tobytes() for recording in recordings}) > 1:
            raise InvalidInputError(
                argument="recordings",
                expected="both hands at the same instants, as EgoDex has them",
                got="others",
                advice="write one file for each hand",
            )
        with created(path) as file:
            file["time"] = recordings[0].time
            for recording in recordings:
                self._write_hand(recording, file)

    @staticmethod
    def _confidences(path: Path, file: Any, names: Sequence[str], count: int) -> np.ndarray | None:
        """Return the confidence of every joint, shape (N, 21); None where the file has none."""
        if "confidences" not in file:
            return None
        group = file["confidences"]
        return np.stack([numbers(path, group, name, (count,)) for name in names], axis=1)

    @staticmethod
    def _write_hand(recording: Recording, file: Any) -> None:
        count = len(recording)
        given = np.ones(count) if recording.confidence is None else recording.confidence
        share = np.where(recording.valid, given, 0.0)
        for i, name in enumerate(joint_names(recording.side)):
            poses = np.tile(np.eye(4), (count, 1, 1))
            if i == 0:
                poses[:, :3, :3] = _wrist_rotations(recording)
            poses[:, :3, 3] = recording.landmarks[:, i]
            file[f"transforms/{name}"] = poses
            file[f"confidences/{name}"] = share


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
    places = recording.wrist[recording.valid, :3, 3]
    return bool((places != recording.landmarks[recording.valid, 0]).any())
