"""Recordings as `.npz`: arrays by name, of one hand or of both."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from handmap_qp.errors import RecordingError
from handmap_qp.hands.spec import Side, check_side
from handmap_qp.human.recording import Recording, as_flags
from handmap_qp.human.sample import LANDMARK_COUNT
from handmap_qp.output_files import replaced_file
from handmap_qp.se3 import as_floats, poses_from_quats
from handmap_qp.trackers.formats.archive import member_names, read_archive
from handmap_qp.trackers.formats.base import (
    SIDES,
    Entry,
    check_one_per_hand,
    entry_stem,
    reading,
)

_NEEDED = ("time", "landmarks", "handedness")
_KNOWN = (*_NEEDED, "valid", "wrist", "wrist_pose", "confidence", "source")


class NpzFormat:
    """The package's own form, lossless.

    Arrays: `time (T,)` [s], `landmarks (T, 21, 3)` [m] and `handedness`; and where they are known
    `valid (T,)`, `confidence (T,)`, `wrist (T, 4, 4)` or `wrist_pose (T, 7)` (position [m], then a
    quaternion in the order w, x, y, z), and `source`. A file with both hands has the same names
    with `left_` and `right_` before them, without `handedness`.
    """

    name = "npz"
    suffixes = (".npz",)
    about = "arrays of numpy by name; lossless, one recording of each hand"

    def recognises(self, path: Path) -> bool:
        """Tell whether the archive has no arrays of another form."""
        names = member_names(path) if path.is_file() else {"joints"}
        return "landmarks" in names or not {"pose", "hand_pose", "joints"} & names

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the one hand, or both."""
        names = member_names(path)
        sides: list[Side] = [side for side in SIDES if f"{side}_landmarks" in names]
        if sides:
            arrays = read_archive(path, {f"{side}_time" for side in sides})
            for side in sides:
                _check_has(path, arrays, f"{side}_", ("time",))
            return tuple(Entry(side, side, np.size(arrays[f"{side}_time"])) for side in sides)
        arrays = read_archive(path, {"time", "handedness"})
        _check_has(path, names, "", _NEEDED)
        side = _side(path, arrays["handedness"])
        return (Entry("", side, np.size(arrays["time"])),)

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one hand; samples with numbers that are not finite are not valid."""
        prefix = f"{entry.name}_" if entry.name else ""
        arrays = read_archive(path, {prefix + name for name in _KNOWN})
        _check_has(path, arrays, prefix, ("time", "landmarks"))
        own = {name.removeprefix(prefix): array for name, array in arrays.items()}
        with reading(path, prefix):
            landmarks = as_floats(own["landmarks"], "landmarks", shape=("T", LANDMARK_COUNT, 3))
            is_finite = np.isfinite(landmarks).all(axis=(1, 2))
            valid = as_flags(own.get("valid", is_finite), "valid", len(landmarks)) & is_finite
            wrist = own.get("wrist")
            if wrist is None and "wrist_pose" in own:
                wrist = _poses(own["wrist_pose"], valid)
            return Recording(
                name=entry_stem(path, entry),
                time=own["time"],
                landmarks=landmarks,
                valid=valid,
                side=entry.side,
                source=str(own.get("source", "")),
                wrist=wrist,
                confidence=own.get("confidence"),
            )

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name the arrays that a recording cannot hold."""
        known = {*_KNOWN, *(f"{side}_{name}" for side in SIDES for name in _KNOWN)}
        return tuple(sorted(member_names(path) - known))

    def losses(self, recordings: Sequence[Recording]) -> tuple[str, ...]:
        """Name nothing: the form is lossless."""
        return ()

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write one hand or both."""
        check_one_per_hand(recordings, self.name)
        arrays: dict[str, np.ndarray] = {}
        for recording in recordings:
            prefix = f"{recording.side}_" if len(recordings) > 1 else ""
            own = {
                "time": recording.time,
                "landmarks": recording.landmarks,
                "valid": recording.valid,
                "wrist": recording.wrist,
                "confidence": recording.confidence,
                "source": np.array(recording.source) if recording.source else None,
                "handedness": None if prefix else np.array(recording.side),
            }
            arrays |= {prefix + name: array for name, array in own.items() if array is not None}
        with replaced_file(path, "path") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)


def _check_has(path: Path, arrays: Iterable[str], prefix: str, names: Sequence[str]) -> None:
    arrays = sorted(arrays)
    for name in names:
        if prefix + name not in arrays:
            problem = f"has no array {prefix + name!r}; it has {', '.join(arrays) or 'none'}"
            raise RecordingError(problem, file=path)


def _side(path: Path, handedness: np.ndarray) -> Side:
    """Return the text in an array without dimensions."""
    is_text = handedness.shape == () and handedness.dtype.kind == "U"
    text = str(handedness).lower() if is_text else handedness
    with reading(path):
        check_side(text)
    return next(side for side in SIDES if side == text)


def _poses(values: np.ndarray, valid: np.ndarray) -> np.ndarray | None:
    """Return poses of seven numbers; None if a valid sample has none."""
    rows = as_floats(values, "wrist_pose", shape=(len(valid), 7))
    if not np.isfinite(rows[valid]).all():
        return None
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[valid] = poses_from_quats(rows[valid, :3], rows[valid, 3:], "wrist_pose")
    return poses
