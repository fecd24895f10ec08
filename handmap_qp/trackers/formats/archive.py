"""Recordings as `.npz`: arrays by name, of one hand or of both; `.npy`; and reading any archive.

Every damage becomes one `RecordingError`. The size of an archive is bounded before it is read, and
nothing in it is unpickled, but by a reader that the caller gives.
"""

import warnings
import zipfile
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.lib import format as npy

from handmap_core.errors import InvalidInputError
from handmap_core.se3 import Array, Arrays, as_floats
from handmap_qp.hands import Names, Side, Values
from handmap_qp.human import LANDMARK_COUNT, Recording, regular_time
from handmap_qp.output_files import replaced_file
from .base import (
    COLUMNS,
    SIDES,
    TIME_UNITS,
    WORDS,
    Entry,
    RecordingFormat,
    build_recording,
    has,
    reading,
    seconds,
    side_of,
    time_in,
)

LARGEST_ARCHIVE = 1 << 30
"""Most that an archive may hold [bytes]; landmarks of an hour at 90 Hz are 163 MB."""
LANDMARK_ARRAYS = ("landmarks", "keypoints", "pred_keypoints_3d", "arr_0")
"""Names that landmarks have in archives, ours first.

`pred_keypoints_3d` is that of HaMeR and WiLoR, `arr_0` that of an array that was saved without one.
"""
OF_MANO = ("joints", "pose", "hand_pose")
"""Arrays of which an archive of the MANO hand model has one for each sample."""
_SIDE_ARRAYS = ("handedness", "side")
_OF_VIDEO = ("right", "is_right", "pred_cam_t_full", "cam_t")
"""Arrays beside `pred_keypoints_3d` that say which hands these are, and where."""
_READ_VIDEO = "install packages/hamer, which reads it, and give --fps (docs/files.md)"
_KNOWN = (*COLUMNS, *WORDS, "wrist_pose")
_EXPECTED = f"landmarks of one hand, shape (T, {LANDMARK_COUNT}, 3)"


class _Header(NamedTuple):
    """What an array is, known without reading it."""

    shape: tuple[int, ...]
    dtype: np.dtype


class NpzFormat(RecordingFormat):
    """The package's own form, lossless, and archives of others that have landmarks.

    Arrays: `time (T,)` [s], `landmarks (T, 21, 3)` or (T, 63) [m] and `handedness`; and where they
    are known `valid (T,)`, `confidence (T,)`, `wrist (T, 4, 4)` or `wrist_pose (T, 7)` (position
    [m], then a quaternion in the order w, x, y, z), `object_pose (T, 4, 4)` of an object, and the
    words `object_shape`, `source` and `upright`. A file with both hands has the same names with
    `left_` and `right_` before them, without `handedness`.

    Landmarks may have another name of `LANDMARK_ARRAYS`, and time one of `TIME_UNITS`, or be given
    by `fps ()`; both hands may share it. Without time or side, `with_hints` says them.
    """

    name = "npz"
    suffixes = (".npz",)

    def recognises(self, path: Path) -> bool:
        """Tell whether the archive has landmarks, or no arrays of another form."""
        if not path.is_file():
            return False
        names = member_names(path)
        has_landmarks = not names.isdisjoint(LANDMARK_ARRAYS)
        return has_landmarks or names.isdisjoint({"rhand", *OF_MANO})

    def entries(self, path: Path) -> Sequence[Entry]:
        """List the one hand, or both."""
        names = member_names(path)
        arrays = {side: _landmark_array(names, f"{side}_") for side in SIDES}
        sided = [
            Entry(side, side, _samples_in(path, array))
            for side, array in arrays.items()
            if array
        ]
        if sided:
            return sided
        count = _samples_in(path, _needed_landmark_array(names))
        return [Entry("", self._side_of(path, names), count)]

    def _side_of(self, path: Path, names: Container[str]) -> Side:
        """Return the side that a file of one hand names, or the user's."""
        array = _first(_SIDE_ARRAYS, names)
        if not array:
            return self.hints.side_of_file()
        return side_of(read_archive(path, {array})[array], array)

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one hand; samples with numbers that are not finite are not valid."""
        prefix = f"{entry.name}_" if entry.name else ""
        array = _landmark_array(member_names(path), prefix)
        own = {prefix + name for name in _KNOWN}
        times = {before + name for before in (prefix, "") for name in TIME_UNITS}
        found = read_archive(path, {array, "fps"} | own | times)
        fields: Values = {
            name: found[prefix + name] for name in _KNOWN if prefix + name in found
        }
        fields |= {name: str(fields.get(name, "")) for name in WORDS}
        fields["landmarks"] = found[array]
        fields["time"] = self._time_of(found, prefix, entry.samples)
        if self.hints.fps is None and "fps" in found and not times & found.keys():
            fields["time_source"] = (
                f"{float(found['fps']):g} samples/s, as the file says"
            )
        return build_recording(path, entry, **fields, prefix=prefix)

    def _time_of(self, arrays: Arrays, prefix: str, count: int) -> Array:
        """Return the instants of one hand: by the user's rate, of the file, or by its rate [s]."""
        if self.hints.fps is not None:
            return self.hints.time_of_file(count)
        own = {name: arrays.get(prefix + name, arrays.get(name)) for name in TIME_UNITS}
        given = {name: array for name, array in own.items() if array is not None}
        if found := time_in(given):
            values, unit = found
            # Our own files are read back exactly.
            return values if unit == 1.0 else seconds(values, unit)
        if given:
            # An array that is none of instants: `Recording` says what is wrong with it.
            return next(iter(given.values()))
        if "fps" in arrays:
            rate = as_floats(arrays["fps"], "fps", shape=())
            return regular_time(count, float(rate))
        return self.hints.time_of_file(count)

    def unread(self, path: Path) -> Names:
        """Name the arrays that a recording cannot hold."""
        taken = (*_KNOWN, *LANDMARK_ARRAYS, *TIME_UNITS)
        known = {before + name for before in ("", "left_", "right_") for name in taken}
        return tuple(sorted(member_names(path) - known - {*_SIDE_ARRAYS, "fps"}))

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


class NpyFormat(RecordingFormat):
    """One array `(T, 21, 3)` or (T, 63) of landmarks [m]; `with_hints` says side and rate."""

    name = "npy"
    suffixes = ()
    # Folders of data sets have many arrays of other things.
    named = (".npy",)

    def recognises(self, path: Path) -> bool:
        """Tell whether it is a file; what is wrong with its array is said when it is listed."""
        return path.is_file()

    def entries(self, path: Path) -> Sequence[Entry]:
        """List the one hand."""
        with _opened_array(path) as stream:
            count = _count_samples(_read_header(stream))
        return [Entry("", self.hints.side_of_file(), count)]

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read the hand; samples with numbers that are not finite are not valid."""
        time = self.hints.time_of_file(entry.samples)
        with _opened_array(path) as stream:
            landmarks = npy.read_array(stream)
        return build_recording(path, entry, time, landmarks)


def _first(names: Iterable[str], among: Container[str]) -> str:
    """Return the first of some names that is among others; empty if none is."""
    return next((name for name in names if name in among), "")


def _landmark_array(names: Container[str], prefix: str = "") -> str:
    """Return the name of the array of landmarks; empty if there is none."""
    return _first((prefix + name for name in LANDMARK_ARRAYS), names)


def _needed_landmark_array(names: set[str]) -> str:
    """Return the name of the array of landmarks of one hand.

    Raises:
        InvalidInputError: If there is none, or other arrays say what they mean.
    """
    array = _landmark_array(names)
    if not array:
        known = ", ".join(sorted(names)) or "none"
        raise InvalidInputError(f"has no array 'landmarks'; it has {known}")
    if array == "pred_keypoints_3d" and (other := _first(_OF_VIDEO, names)):
        problem = f"has {array!r} and {other!r}, of HaMeR or WiLoR"
        raise InvalidInputError(problem, advice=_READ_VIDEO)
    return array


def _samples_in(path: Path, array: str) -> int:
    """Return how many samples an array of landmarks of an archive has, without reading them."""
    headers = read_archive(path, {array}, _read_header)
    return _count_samples(headers[array], array)


def _read_header(stream: IO[bytes]) -> _Header:
    """Read what an array is, and leave its numbers unread."""
    version = npy.read_magic(stream)
    is_first = version == (1, 0)
    read = npy.read_array_header_1_0 if is_first else npy.read_array_header_2_0
    shape, _, dtype = read(stream)
    return _Header(shape, dtype)


def _count_samples(header: _Header, name: str = "") -> int:
    """Return how many samples an array of landmarks has.

    Raises:
        InvalidInputError: If it is not the landmarks of one hand.
    """
    if header.dtype.hasobject:
        raise InvalidInputError(
            "holds Python objects, which are not read", argument=name
        )
    count, *sample = header.shape or (0,)
    if sample in ([LANDMARK_COUNT, 3], [3 * LANDMARK_COUNT]):
        return count
    advice = ""
    if sample[1:] == [LANDMARK_COUNT, 3]:
        advice = (
            "save those of each hand as left_landmarks and right_landmarks of an .npz; "
            f"for hands of HaMeR or WiLoR {_READ_VIDEO}"
        )
    got = f"shape {header.shape}"
    raise InvalidInputError(argument=name, expected=_EXPECTED, got=got, advice=advice)


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


def save_npz(path: Path, arrays: Arrays, argument: str = "path") -> None:
    """Write arrays to an `.npz` file atomically: an earlier file stays if writing fails.

    Args:
        path: The file; its folder must exist.
        arrays: Arrays by name.
        argument: Argument or option that names the file, for errors.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    with replaced_file(path, argument) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


@contextmanager
def _opened_array(file: Path) -> Iterator[IO[bytes]]:
    """Yield the stream of an `.npy` file; errors become `RecordingError`."""
    with (
        reading(file, "is not a plain array"),
        file.open("rb") as stream,
        warnings.catch_warnings(),
    ):
        # numpy warns of headers that Python 2 wrote.
        warnings.simplefilter("ignore")
        yield stream


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
