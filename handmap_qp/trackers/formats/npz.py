"""Recordings as `.npz`: arrays by name, of one hand or of both."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from handmap_qp.errors import RecordingError
from handmap_qp.hands.spec import Side
from handmap_qp.human.recording import Recording, as_flags
from handmap_qp.output_files import replaced_file
from handmap_qp.se3 import as_floats, poses_from_quats
from handmap_qp.trackers.formats.archive import member_names, read_archive
from handmap_qp.trackers.formats.base import (
    SIDES,
    Entry,
    RecordingFormat,
    build_recording,
    finite_samples,
    reading,
    side_of,
)

_NEEDED = ("time", "landmarks", "handedness")
_KNOWN = (*_NEEDED, "valid", "wrist", "wrist_pose", "confidence", "source")


class NpzFormat(RecordingFormat):
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
        if not path.is_file():
            return False
        names = member_names(path)
        return "landmarks" in names or not {"pose", "hand_pose", "joints"} & names

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the one hand, or both."""
        names = member_names(path)
        sides: list[Side] = [side for side in SIDES if f"{side}_landmarks" in names]
        _check_has(path, names, [f"{side}_time" for side in sides] or _NEEDED)
        arrays = read_archive(
            path, {"time", "handedness", *(f"{side}_time" for side in sides)}
        )
        if sides:
            return tuple(
                Entry(side, side, np.size(arrays[f"{side}_time"])) for side in sides
            )
        side = side_of(arrays["handedness"], path, "handedness")
        return (Entry("", side, np.size(arrays["time"])),)

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one hand; samples with numbers that are not finite are not valid."""
        prefix = f"{entry.name}_" if entry.name else ""
        arrays = read_archive(path, {prefix + name for name in _KNOWN})
        _check_has(path, arrays, [prefix + name for name in ("time", "landmarks")])
        own = {name.removeprefix(prefix): array for name, array in arrays.items()}
        wrist = own.get("wrist")
        if wrist is None and "wrist_pose" in own:
            with reading(path, prefix):
                wrist = _poses(own["wrist_pose"], own["landmarks"], own.get("valid"))
        return build_recording(
            path,
            entry,
            own["time"],
            own["landmarks"],
            prefix=prefix,
            valid=own.get("valid"),
            source=str(own.get("source", "")),
            wrist=wrist,
            confidence=own.get("confidence"),
        )

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name the arrays that a recording cannot hold."""
        known = {*_KNOWN, *(f"{side}_{name}" for side in SIDES for name in _KNOWN)}
        return tuple(sorted(member_names(path) - known))

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write one hand or both."""
        self.check_one_per_hand(recordings)
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
            arrays |= {
                prefix + name: array for name, array in own.items() if array is not None
            }
        with replaced_file(path, "path") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)


def _check_has(path: Path, arrays: Iterable[str], names: Sequence[str]) -> None:
    arrays = sorted(arrays)
    for name in names:
        if name not in arrays:
            problem = f"has no array {name!r}; it has {', '.join(arrays) or 'none'}"
            raise RecordingError(problem, file=path)


def _poses(
    values: np.ndarray, landmarks: np.ndarray, valid: np.ndarray | None
) -> np.ndarray | None:
    """Return poses of seven numbers; None if a valid sample has none."""
    seen = finite_samples(as_floats(landmarks, "landmarks"))
    if valid is not None:
        seen &= as_flags(valid, "valid", len(seen))
    rows = as_floats(values, "wrist_pose", shape=(len(seen), 7))
    if not np.isfinite(rows[seen]).all():
        return None
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[seen] = poses_from_quats(rows[seen, :3], rows[seen, 3:], "wrist_pose")
    return poses
