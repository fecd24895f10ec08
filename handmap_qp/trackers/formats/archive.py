"""Recordings as `.npz`: arrays by name, of one hand or of both; and reading any such archive.

Every damage becomes one `RecordingError`. The size of an archive is bounded before it is read, and
nothing in it is unpickled, but by a reader that the caller gives.
"""

import warnings
import zipfile
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands import Names, Values
from handmap_qp.human import Recording
from handmap_qp.output_files import replaced_file
from handmap_qp.se3 import Arrays
from .base import (
    COLUMNS,
    SIDES,
    WORDS,
    Entry,
    RecordingFormat,
    build_recording,
    has,
    reading,
    side_of,
)

LARGEST_ARCHIVE = 1 << 30
"""Most that an archive may hold [bytes]; landmarks of an hour at 90 Hz are 163 MB."""
OF_MANO = ("joints", "pose", "hand_pose")
"""Arrays of which an archive of the MANO hand model has one for each sample."""
_KNOWN = (*COLUMNS, *WORDS, "wrist_pose")
_OF_VIDEO = "install examples/hamer, which reads it, and give --fps (docs/files.md)"
"""What to do with keypoints that HaMeR or WiLoR has predicted."""


class NpzFormat(RecordingFormat):
    """The package's own form, lossless.

    Arrays: `time (T,)` [s], `landmarks (T, 21, 3)` [m] and `handedness`; and where they are known
    `valid (T,)`, `confidence (T,)`, `wrist (T, 4, 4)` or `wrist_pose (T, 7)` (position [m], then a
    quaternion in the order w, x, y, z), `object_pose (T, 4, 4)` of an object, and the words
    `object_shape`, `source` and `upright`. A file with both hands has the same names with `left_`
    and `right_` before them, without `handedness`.
    """

    name = "npz"
    suffixes = (".npz",)

    def recognises(self, path: Path) -> bool:
        """Tell whether the archive has no arrays of another form."""
        if not path.is_file():
            return False
        names = member_names(path)
        return "landmarks" in names or names.isdisjoint({"rhand", *OF_MANO})

    def entries(self, path: Path) -> Sequence[Entry]:
        """List the one hand, or both."""
        names = member_names(path)
        sides = [side for side in SIDES if f"{side}_landmarks" in names]
        if not sides:
            arrays = _read(path, ("time", "handedness"))
            side = side_of(arrays["handedness"], "handedness")
            return [Entry("", side, np.size(arrays["time"]))]
        times = _read(path, [f"{side}_time" for side in sides])
        return [Entry(s, s, np.size(times[f"{s}_time"])) for s in sides]

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one hand; samples with numbers that are not finite are not valid."""
        prefix = f"{entry.name}_" if entry.name else ""
        own: Values = _read(path, ("time", "landmarks"), _KNOWN, prefix)
        own |= {name: str(own.get(name, "")) for name in WORDS}
        return build_recording(path, entry, **own, prefix=prefix)

    def unread(self, path: Path) -> Names:
        """Name the arrays that a recording cannot hold."""
        known = {before + name for before in ("", "left_", "right_") for name in _KNOWN}
        return tuple(sorted(member_names(path) - known - {"handedness"}))

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write one hand or both."""
        self.check_one_per_hand(recordings)
        arrays: Arrays = {}
        for recording in recordings:
            prefix = f"{recording.side}_" if len(recordings) > 1 else ""
            arrays |= {
                prefix + name: np.asarray(getattr(recording, name))
                for name in (*COLUMNS, *WORDS)
                if has(recording, name)
            }
            if not prefix:
                arrays["handedness"] = np.asarray(recording.side)
        save_npz(path, arrays)


def _read(
    path: Path,
    needed: Iterable[str],
    names: Iterable[str] = (),
    prefix: str = "",
) -> Arrays:
    """Read arrays that are needed, and others if the file has them, without a prefix of names."""
    found = read_archive(path, {prefix + name for name in (*needed, *names)})
    for name in needed:
        if prefix + name not in found:
            known = ", ".join(sorted(member_names(path))) or "none"
            problem = f"has no array {prefix + name!r}; it has {known}"
            advice = _OF_VIDEO * ("pred_keypoints_3d" in known)
            raise InvalidInputError(problem, advice=advice)
    return {name.removeprefix(prefix): array for name, array in found.items()}


def member_names(file: Path) -> set[str]:
    """Return the names of the arrays of an `.npz` file.

    Raises:
        RecordingError: If the file cannot be read or is not an archive.
    """
    with _opened(file) as (_, members):
        return set(members)


def read_archive(
    file: Path,
    names: Container[str] | None = None,
    read: Callable[[Any], Any] = npy.read_array,
) -> dict[str, Any]:
    """Read arrays of an `.npz` file.

    Args:
        file: The file.
        names: Names of those to read; all if omitted. Those that the file lacks are left out.
        read: Reads one of them; refuses pickles if omitted.

    Raises:
        RecordingError: If the file cannot be read, is not an archive of plain arrays, is damaged,
            or holds more than `LARGEST_ARCHIVE`. `array` names the member at fault.
    """
    with _opened(file) as (archive, members):
        chosen = {n: m for n, m in members.items() if names is None or n in names}
        size = sum(member.file_size for member in chosen.values())
        if size > LARGEST_ARCHIVE:
            most = f"{LARGEST_ARCHIVE >> 20} MB"
            problem = f"holds {size >> 20} MB, more than the {most} that are read"
            raise InvalidInputError(problem)
        arrays = {}
        for name, member in chosen.items():
            with (
                reading(file, "is not a plain array", name),
                archive.open(member) as stream,
                warnings.catch_warnings(),
            ):
                # numpy warns of headers that Python 2 wrote.
                warnings.simplefilter("ignore")
                arrays[name] = read(stream)
        return arrays


def save_npz(path: Path, arrays: Arrays) -> None:
    """Write arrays to an `.npz` file atomically: an earlier file stays if writing fails.

    Args:
        path: The file; its folder must exist.
        arrays: Arrays by name.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    with replaced_file(path, "path") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


@contextmanager
def _opened(
    file: Path,
) -> Iterator[tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo]]]:
    """Yield an archive, and its members by the names of arrays; errors become `RecordingError`."""
    # Opened here, because zipfile leaves a damaged file open.
    with (
        reading(file, "is not an .npz file of plain arrays"),
        file.open("rb") as stream,
        zipfile.ZipFile(stream) as archive,
    ):
        yield archive, {m.filename.removesuffix(".npy"): m for m in archive.infolist()}
