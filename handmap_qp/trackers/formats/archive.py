"""Recordings as `.npz`: arrays by name, of one hand or of both; `.npy`; and reading any archive.

Every damage becomes one `RecordingError`. The size of an archive is bounded before it is read, and
nothing in it is unpickled, but by a reader that the caller gives.
"""

import math
import warnings
import zipfile
from collections.abc import (
    Callable,
    Container,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.lib import format as npy

from handmap_core.errors import InvalidInputError, expect
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
    WrittenByPieces,
    build_recording,
    has,
    reading,
    seconds,
    side_of,
    time_in,
)
from .disk_columns import DiskColumn, write_npz
from .long import LongRecording, pieces_of
from .pieces import columns_on_disk, recording_parts

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
_STREAMED = ("wrist", "wrist_pose", "object_pose")
"""Arrays of many numbers for a sample, besides the landmarks."""
_EXPECTED = f"landmarks of one hand, shape (T, {LANDMARK_COUNT}, 3)"


class ArrayHeader(NamedTuple):
    """What an array is, known without reading it.

    Attributes:
        shape: Its shape.
        dtype: Type of its numbers.
        is_by_rows: Whether its rows follow each other in the file.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    is_by_rows: bool


class NpzFormat(WrittenByPieces):
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
        prefix = _prefix(entry)
        array = _landmark_array(member_names(path), prefix)
        streamed = {prefix + name for name in _STREAMED}
        found, fields = self._fields(path, entry, {array} | streamed)
        fields |= {
            name: found[prefix + name] for name in _STREAMED if prefix + name in found
        }
        return build_recording(
            path, entry, **fields, landmarks=found[array], prefix=prefix
        )

    def open_long(self, path: Path, entry: Entry) -> LongRecording | None:
        """Open one hand of an archive, unless it has an object or poses as quaternions."""
        prefix = _prefix(entry)
        array = _landmark_array(member_names(path), prefix)
        members = {"landmarks": array} | {name: prefix + name for name in _STREAMED}
        headers = read_headers(path, set(members.values()))
        members = {name: m for name, m in members.items() if m in headers}
        is_plain = all(
            header.is_by_rows
            and not header.dtype.hasobject
            and header.shape[:1] == (entry.samples,)
            for header in headers.values()
        )
        # Whether quaternions count is decided by all of them.
        if "wrist_pose" in members or not is_plain:
            return None
        _, fields = self._fields(path, entry, set())
        if fields["object_shape"]:
            return None
        if self.hints.fps is not None:
            fields["time_source"] = f"{self.hints.fps:g} samples/s, as given"
        archive = _LongArchive(path, entry, fields, members)
        return LongRecording.opened(archive.parts, archive.count)

    def _fields(
        self, path: Path, entry: Entry, others: set[str]
    ) -> tuple[Arrays, Values]:
        """Read what an archive says of one hand, but for `_STREAMED` and its landmarks.

        Args:
            path: The archive.
            entry: The hand.
            others: Arrays that are read too.

        Returns:
            The arrays by name, and what `build_recording` takes.
        """
        prefix = _prefix(entry)
        known = [name for name in _KNOWN if name not in ("landmarks", *_STREAMED)]
        own = {prefix + name for name in known}
        times = {before + name for before in (prefix, "") for name in TIME_UNITS}
        found = read_archive(path, {"fps"} | own | times | others)
        fields: Values = {
            name: found[prefix + name] for name in known if prefix + name in found
        }
        fields |= {name: str(fields.get(name, "")) for name in WORDS}
        fields["time"] = self._time_of(found, prefix, entry.samples)
        if self.hints.fps is None and "fps" in found and not times & found.keys():
            fields["time_source"] = (
                f"{float(found['fps']):g} samples/s, as the file says"
            )
        return found, fields

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

    def write_long(self, recordings: Sequence[LongRecording], path: Path) -> None:
        """Write one hand or both; samples that are not in the memory by way of the disk."""
        self.check_one_per_hand(recordings)
        arrays: dict[str, Array | DiskColumn] = {}
        with ExitStack() as opened:
            for recording in recordings:
                head = recording.overview
                prefix = f"{head.side}_" if len(recordings) > 1 else ""
                arrays |= {
                    prefix + name: np.asarray(getattr(head, name))
                    for name in (*COLUMNS, *WORDS)
                    if has(head, name)
                }
                if not recording.has_all:
                    columns = opened.enter_context(columns_on_disk(recording, path))
                    arrays |= {prefix + name: rows for name, rows in columns.items()}
                if not prefix:
                    arrays["handedness"] = np.asarray(head.side)
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


def _prefix(entry: Entry) -> str:
    """Return what the names of the arrays of one hand begin with."""
    return f"{entry.name}_" if entry.name else ""


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
    headers = read_headers(path, {array})
    return _count_samples(headers[array], array)


def _read_header(stream: IO[bytes]) -> ArrayHeader:
    """Read what an array is, and leave its numbers unread."""
    version = npy.read_magic(stream)
    is_first = version == (1, 0)
    read = npy.read_array_header_1_0 if is_first else npy.read_array_header_2_0
    shape, is_fortran, dtype = read(stream)
    return ArrayHeader(shape, dtype, not is_fortran or len(shape) < 2)


def _count_samples(header: ArrayHeader, name: str = "") -> int:
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


def read_headers(
    file: Path, names: Container[str] | None = None
) -> dict[str, ArrayHeader]:
    """Read what arrays of an archive are, however large they are.

    Args:
        file: The archive.
        names: Names of the arrays; all if omitted. Those that the file lacks are left out.

    Raises:
        RecordingError: If the file cannot be read, or is not an archive of plain arrays.
    """
    with _opened(file) as (archive, members):
        headers = {}
        for name in members:
            if names is not None and name not in names:
                continue
            with _reading_array(file, name), archive.open(members[name]) as stream:
                headers[name] = _read_header(stream)
        return headers


def array_shapes(file: Path, names: set[str]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of arrays of an archive, without reading them; of those that it has.

    Raises:
        RecordingError: If the file cannot be read, or is not an archive of plain arrays.
    """
    return {name: header.shape for name, header in read_headers(file, names).items()}


@contextmanager
def _reading_array(file: Path, name: str) -> Iterator[None]:
    """Read one array: errors become `RecordingError`."""
    with reading(file, "is not a plain array", name), warnings.catch_warnings():
        # numpy warns of headers that Python 2 wrote.
        warnings.simplefilter("ignore")
        yield


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
            with _reading_array(file, name), archive.open(member) as stream:
                arrays[name] = read(stream)
        return arrays


def read_rows(
    file: Path, names: Sequence[str], count: int
) -> Iterator[tuple[Array, ...]]:
    """Read arrays of an `.npz` file side by side, `PIECE` rows at once.

    Args:
        file: The file.
        names: Names of the arrays, which are stored by rows.
        count: Number of their rows.

    Yields:
        The next rows of each array.

    Raises:
        RecordingError: If the file is damaged. `array` names the member at fault.
    """
    with _opened(file) as (archive, members), ExitStack() as opened:
        streams = [opened.enter_context(archive.open(members[n])) for n in names]
        headers = []
        for name, stream in zip(names, streams, strict=True):
            with _reading_array(file, name):
                headers.append(_read_header(stream))
        for samples in pieces_of(count):
            pieces = []
            for name, stream, header in zip(names, streams, headers, strict=True):
                shape = (samples.stop - samples.start, *header.shape[1:])
                with _reading_array(file, name):
                    data = stream.read(header.dtype.itemsize * math.prod(shape))
                    pieces.append(np.frombuffer(data, header.dtype).reshape(shape))
            yield tuple(pieces)


class _LongArchive:
    """One hand of an archive, whose large arrays are read by pieces.

    Args:
        path: The archive.
        entry: The hand.
        fields: What `build_recording` takes of all samples.
        members: Names of the arrays that are read by pieces, by their fields.
    """

    def __init__(
        self, path: Path, entry: Entry, fields: Values, members: dict[str, str]
    ) -> None:
        self.path = path
        self.count = entry.samples
        self._entry = entry
        self._words = {name: fields[name] for name in WORDS}
        count = self.count
        # As they are in the file: flags take an eighth of the memory of floats.
        self._columns = {
            name: np.asarray(fields[name])
            for name in ("time", "valid", "confidence")
            if name in fields
        }
        for name, values in self._columns.items():
            as_floats(values, name, shape=(count,))
        steps = np.diff(as_floats(self._columns["time"], "time", is_finite=True))
        expect((steps > 0.0).all(), "time", "increasing instants")
        shares = self._columns.get("confidence")
        if shares is not None and np.isnan(as_floats(shares, "confidence")).all():
            del self._columns["confidence"]
        self._members = {
            name: member
            for name, member in members.items()
            if name == "landmarks" or self._is_known(member)
        }

    def _is_known(self, member: str) -> bool:
        """Tell whether an array has a number that is not NaN."""
        return any(
            not np.isnan(rows).all()
            for (rows,) in read_rows(self.path, [member], self.count)
        )

    def parts(self) -> Iterator[Recording]:
        """Read the hand from the first sample on.

        Returns:
            All samples in the order of time, `PIECE` at once.

        Raises:
            RecordingError: If the file is damaged, or a sample is wrong.
        """
        return recording_parts(
            self.path,
            self._entry,
            self._pieces(),
            prefix=_prefix(self._entry),
            **self._words,
        )

    def _pieces(self) -> Iterator[Values]:
        """Read the columns of `PIECE` samples at once."""
        names = tuple(self._members)
        start = 0
        for pieces in read_rows(self.path, [*self._members.values()], self.count):
            stop = start + len(pieces[0])
            columns: Values = {
                name: values[start:stop] for name, values in self._columns.items()
            }
            yield columns | dict(zip(names, pieces, strict=True))
            start = stop


def save_npz(
    path: Path, arrays: Mapping[str, Array | DiskColumn], argument: str = "path"
) -> None:
    """Write arrays to an `.npz` file atomically: an earlier file stays if writing fails.

    Args:
        path: The file; its folder must exist.
        arrays: Arrays by name.
        argument: Argument or option that names the file, for errors.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    with replaced_file(path, argument) as file:
        write_npz(file, arrays, is_compressed=True)


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
