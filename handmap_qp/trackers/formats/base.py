"""The seam of file formats: what a format of recordings offers, and what all of them share."""

import abc
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from handmap_core.errors import (
    DiskFullError,
    HandmapError,
    InvalidInputError,
    RecordingError,
    expect,
    reason_of,
)
from handmap_core.se3 import Array, affine, as_floats, pose_from_xyz_quat
from handmap_qp.hands import SIDES as SIDES
from handmap_qp.hands import Names, Side
from handmap_qp.human import (
    LANDMARK_COUNT,
    LANDMARK_NAMES,
    Recording,
    as_flags,
    finite_samples,
    regular_time,
)
from .long import LongRecording, in_memory, in_pieces

COLUMNS: dict[str, Names] = {
    "time": ("time",),
    "landmarks": tuple(f"{name}_{a}" for name in LANDMARK_NAMES for a in "xyz"),
    "valid": ("valid",),
    "confidence": ("confidence",),
    "wrist": tuple(f"wrist_pose_{i}{j}" for i in range(3) for j in range(4)),
    "object_pose": tuple(f"object_pose_{i}{j}" for i in range(3) for j in range(4)),
}
"""Names of the numbers of a sample by the fields of `Recording`, for formats that have columns.

Of poses they are the upper three rows, row by row.
"""


TIME_UNITS = {
    "time": 1.0,
    "time_s": 1.0,
    "t": 1.0,
    "timestamp": 1.0,
    "timestamps": 1.0,
    "time_ms": 1e-3,
    "time_ns": 1e-9,
}
"""Names that arrays and columns of time have in files of others, with their units [s]."""


WORDS = ("source", "upright", "object_shape", "task", "time_source")
"""Fields of `Recording` that are words, and empty where they are not known."""


LOSSES = {
    "wrist": "the wrist's orientation",
    "confidence": "the confidence",
    "source": "the words about the source",
    "upright": "which axes are up and forward",
    "object_pose": "the object",
    "object_shape": "the object's shape",
    "task": "the words about the task",
    "time_source": "that the instants are those of a rate",
    "no wrist": "that the wrist's orientation is unknown",
    "wrist position": "the wrist's position where it is not its landmark",
    "no confidence": "that the confidence is unknown",
    "digits of time": "instants beyond whole nanoseconds",
    "unseen": "landmarks of samples without a hand",
    "digits of wrist": "the last digit of the wrist's rotation, as a quaternion",
}
"""What a format may be unable to hold, in words: a field, or one of `_OTHERS`."""


def _is_apart(recording: Recording) -> bool:
    """Tell whether the wrist's pose is elsewhere than the first landmark in a valid sample."""
    if recording.wrist is None:
        return False
    apart = recording.wrist[:, :3, 3] != recording.landmarks[:, 0]
    return apart[recording.valid].any()


_OTHERS: dict[str, Callable[[Recording], object]] = {
    "no wrist": lambda r: r.wrist is None,
    "wrist position": _is_apart,
    "no confidence": lambda r: r.confidence is None,
    "digits of time": lambda r: True,
    "unseen": lambda r: not r.valid.all(),
    "digits of wrist": lambda r: r.wrist is not None,
}
"""Whether a recording has what is no field."""


def has(recording: Recording, name: str) -> object:
    """Tell whether a recording has what a field, or another one of `LOSSES`, says."""
    if name in _OTHERS:
        return _OTHERS[name](recording)
    value = getattr(recording, name)
    return value is not None and len(value)


class Entry(NamedTuple):
    """One recording inside a file, known without reading its samples.

    Attributes:
        name: Its name in the file, such as `right` or `demo_3/left`; empty where it is the only
            one a file of this format can hold.
        side: Which hand.
        samples: Number of samples.
    """

    name: str
    side: Side
    samples: int


class FileHints(NamedTuple):
    """What the user says about a file that may not say it.

    Attributes:
        side: Which hand a file without a side is of; None if not known.
        fps: Samples a second, in place of the file's time; None to take the file's.
    """

    side: Side | None = None
    fps: float | None = None

    def side_of_file(self) -> Side:
        """Return the side of a file that names none.

        Raises:
            InvalidInputError: If the user has not said it.
        """
        if self.side is None:
            raise InvalidInputError(
                "does not say which hand it is of",
                advice="give --side right or left (side= in Python)",
            )
        return self.side

    def time_of_file(self, count: int) -> Array:
        """Return the instants of a file that has none, or none that count [s], shape (count,).

        Raises:
            InvalidInputError: If the user has given no rate.
        """
        if self.fps is None:
            raise InvalidInputError(
                "has no time stamps", advice="give --fps (fps= in Python)"
            )
        return regular_time(count, self.fps)


class RecordingFormat(abc.ABC):
    """A file format of recordings.

    Other packages add theirs by entry points of the group `handmap_qp.formats`, each of which names
    an object of a subclass.

    On a damaged file, methods raise `RecordingError` with the array or line at fault, or any other
    error, which becomes one. They raise `MissingExtraError` where the format needs a package that
    is not installed.

    Attributes:
        name: Short name, as in `handmap convert --format`.
        suffixes: Suffixes of its files, the usual one first; empty for folders.
        named: Suffixes of files that are read where a user names them, and not looked for.
        lacks: What of a recording it cannot hold: names of `LOSSES`.
        left_out: What all its files hold besides what is read, in words.
        hints: What the user says about files that lack a side or a time; see `with_hints`.
    """

    name: str
    suffixes: Names
    named: Names = ()
    lacks: ClassVar[Names] = ()
    left_out: ClassVar[Names] = ()
    hints: FileHints = FileHints()

    def with_hints(self, hints: FileHints) -> Self:
        """Return a copy that reads files which lack a side or a time as the user says.

        A format whose files always say both has no use for it.
        """
        hinted = copy(self)
        hinted.hints = hints
        return hinted

    def recognises(self, path: Path) -> bool:
        """Tell whether an existing file with one of the suffixes, or a folder, is of this form."""
        return path.is_file()

    @abc.abstractmethod
    def entries(self, path: Path) -> Sequence[Entry]:
        """List the recordings of a file, in its order."""

    @abc.abstractmethod
    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one recording."""

    def open_long(self, path: Path, entry: Entry) -> LongRecording | None:
        """Open one recording to read it by pieces; None if it has to be read as a whole.

        Recordings that cannot be read have to be read as a whole too, which says what is wrong.
        """
        return None

    def unread(self, path: Path) -> Names:
        """Name what a file holds besides what `Recording` can hold."""
        return self.left_out

    def losses(self, recordings: Sequence[Recording]) -> Names:
        """Name what of these recordings the format cannot hold."""
        return tuple(
            LOSSES[name]
            for name in self.lacks
            if any(has(each, name) for each in recordings)
        )

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write recordings to one file; an earlier file stays as it was if this fails.

        Raises:
            InvalidInputError: If the format cannot hold them together or is read only, or the file
                cannot be written.
        """
        raise InvalidInputError("is read and not written", argument=self.name)

    def write_long(self, recordings: Sequence[LongRecording], path: Path) -> None:
        """Write recordings that may be too long for the memory, as `write` does.

        Forms that write by pieces override it (`WrittenByPieces`). Others need all samples at once.

        Raises:
            InvalidInputError: As `write`.
        """
        self.write([each.whole() for each in recordings], path)

    def in_order(self, losses: Collection[str]) -> Names:
        """Return what `losses` named for parts of recordings in the order of all of them."""
        known = [LOSSES[name] for name in self.lacks if LOSSES[name] in losses]
        return (*known, *sorted(set(losses).difference(known)))

    def check_one_per_hand(
        self, recordings: Sequence[Recording | LongRecording]
    ) -> None:
        """Reject recordings that are not of one hand, or of a left and a right hand.

        Raises:
            InvalidInputError: If there is none, or a hand occurs twice.
        """
        sides = [in_memory(recording).side for recording in recordings]
        expect(
            sides and len(set(sides)) == len(sides),
            "recordings",
            f"one recording of each hand in a file of the form {self.name}",
            got=first_of(sides, 4) or "none",
            advice="use lerobot, robomimic, or one file for each",
        )


class WrittenByPieces(RecordingFormat):
    """A format that writes the samples of a recording in parts, whether or not it is long."""

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write recordings that are in the memory: see `write_long`."""
        self.write_long([in_pieces(each) for each in recordings], path)

    @abc.abstractmethod
    def write_long(self, recordings: Sequence[LongRecording], path: Path) -> None:
        """Write recordings to one file; an earlier file stays as it was if this fails.

        `LongRecording.overview` tells words and columns. All parts have the same columns.

        Raises:
            InvalidInputError: As `RecordingFormat.write`.
        """


@contextmanager
def reading(
    file: Path,
    problem: str = "cannot be read",
    array: str = "",
    *,
    table: Any = None,
) -> Iterator[None]:
    """Turn what is wrong with a file or with a value of it into `RecordingError`.

    Args:
        file: The file.
        problem: What is wrong, to be followed by the words of a reader, which may raise anything on
            a damaged file. What is wrong with a value is told by `InvalidInputError`.
        array: The array that is read, put before the name of the value at fault.
        table: A `csv.reader`, whose line is at fault.

    Raises:
        DiskFullError: As the block.
        RecordingError: For every other error of the block.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, DiskFullError):
            raise
        if isinstance(error, InvalidInputError):
            array += error.argument
            problem = f"{error.what}: {error.advice}" if error.advice else error.what
        elif isinstance(error, HandmapError):
            raise
        else:
            if isinstance(error, OSError) and error.strerror:
                problem = "cannot be read"
            problem = f"{problem}: {reason_of(error)[:160]}".rstrip(": ")
        line = table and table.line_num
        raise RecordingError(problem, file=file, array=array, line=line) from error


def side_of(value: object, array: str) -> Side:
    """Return the side that a value of a file names.

    Raises:
        InvalidInputError: If it names none.
    """
    text = str(value).strip().lower()
    if text == "left" or text == "right":
        return text
    got = f"{text[:20]!r}"
    raise InvalidInputError(argument=array, expected="right or left", got=got)


def seconds(values: Array, unit: float) -> Array:
    """Return instants of any unit as seconds since the first one, shape (T,).

    Counters of whole numbers may wrap around. A stamp earlier than the one before it stays earlier,
    also where the numbers have no sign.
    """
    if values.dtype.kind == "f":
        return (values - values[:1]).astype(float) * unit
    # The difference of two counts is right modulo its width, so the nearer one is meant. Whole
    # numbers are added because nanoseconds since 1970 have more digits than a float.
    steps = np.diff(values, prepend=values[:1])
    signed = steps.view(f"i{values.dtype.itemsize}")
    return np.cumsum(signed, dtype=np.int64).astype(float) * unit


def time_in(
    arrays: Mapping[str, Array], units: Mapping[str, float] = TIME_UNITS
) -> tuple[Array, float] | None:
    """Return the first array of time by its name, and its unit [s]; None if there is none."""
    for name, unit in units.items():
        values = arrays.get(name)
        if values is not None and values.ndim == 1 and values.dtype.kind in "fiu":
            return values, unit
    return None


def first_of(names: Sequence[object], most: int) -> str:
    """Return the first few of some names as text, and dots where there are more."""
    return ", ".join(map(str, names[:most])) + ", ..." * (len(names) > most)


def entry_stem(path: Path, entry: Entry) -> str:
    """Return the name of a recording: that of its file, and of its entry if it has one."""
    return "_".join([path.stem, *filter(None, entry.name.split("/"))])


def build_recording(
    path: Path,
    entry: Entry,
    time: Any,
    landmarks: Any,
    *,
    prefix: str = "",
    valid: Any = None,
    wrist: Any = None,
    wrist_pose: Any = None,
    object_pose: Any = None,
    confidence: Any = None,
    name: str = "",
    kind: type[Recording] = Recording,
    **words: str,
) -> Recording:
    """Build a recording from the arrays of a file; samples that are not finite are not valid.

    Args:
        path: The file.
        entry: Its place there.
        time: Instants [s], shape (T,).
        landmarks: Coordinates [m], shape (T, 21, 3) or (T, 63).
        prefix: Put before the name of an array at fault.
        valid: Whether the hand was seen, shape (T,); where the landmarks are finite if omitted.
        wrist: Poses, shape (T, 4, 4), or their upper three rows, shape (T, 12), where an array of
            NaN counts as none.
        wrist_pose: Without `wrist`, position [m] and quaternion in the order w, x, y, z, shape
            (T, 7); it counts as none if one is not finite in a valid sample.
        object_pose: As `wrist`, of an object.
        confidence: As in `Recording`; an array of NaN counts as none.
        name: As in `Recording`; `entry_stem` if empty.
        kind: What to build: a `RecordingPart` of some of the samples.
        words: Those of `WORDS`.

    Raises:
        RecordingError: If `Recording` does not take them.
    """
    with reading(path, array=prefix):
        points = as_floats(landmarks, "landmarks")
        if points.shape[1:] == (3 * LANDMARK_COUNT,):
            points = points.reshape(-1, LANDMARK_COUNT, 3)
        seen = finite_samples(points)
        if valid is not None:
            seen &= as_flags(valid, seen.size)
        poses = _poses(wrist, "wrist")
        if wrist is None and wrist_pose is not None:
            sevens = as_floats(wrist_pose, "wrist_pose", shape=(len(seen), 7))[seen]
            if np.isfinite(sevens).all():
                poses = np.tile(np.eye(4), (len(seen), 1, 1))
                poses[seen] = pose_from_xyz_quat(sevens, "wxyz", "wrist_pose")
        return kind(
            name or entry_stem(path, entry),
            time,
            points,
            seen,
            entry.side,
            wrist=poses,
            object_pose=_poses(object_pose, "object_pose"),
            confidence=_if_known(confidence, "confidence"),
            **words,
        )


def known_columns(*recordings: Recording) -> list[str]:
    """Return those of `COLUMNS` that one of the recordings has."""
    return [name for name in COLUMNS if any(has(each, name) for each in recordings)]


def column(recording: Recording, name: str) -> Array:
    """Return one of `COLUMNS` for all samples, NaN if there is none, shape (T, n); (T,) for one."""
    values = getattr(recording, name)
    count = len(COLUMNS[name])
    shape = (len(recording), count) if count > 1 else (len(recording),)
    if values is None:
        return np.full(shape, np.nan)
    return (values[:, :3] if count == 12 else values).reshape(shape)


def _if_known(values: Any, name: str) -> Array | None:
    """Return an array; None if there is none, or all of it is NaN."""
    numbers = as_floats(np.nan if values is None else values, name)
    return None if np.isnan(numbers).all() else numbers


def _poses(values: Any, name: str) -> Array | None:
    """Return poses, (T, 4, 4), of their upper three rows, (T, 12), too; None as `_if_known`."""
    poses = _if_known(values, name)
    return None if poses is None else whole_poses(poses)


def whole_poses(poses: Array) -> Array:
    """Return poses, (T, 4, 4), of their upper three rows, (T, 12), too."""
    if poses.shape[1:] != (12,):
        return poses
    rows = poses.reshape(-1, 3, 4)
    return affine(rows[..., :3], rows[..., 3])
