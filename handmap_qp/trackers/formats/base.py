"""The seam of file formats: what a format of recordings offers, and what all of them share."""

from __future__ import annotations

import abc
import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from handmap_qp.errors import InvalidInputError, MissingExtraError, RecordingError
from handmap_qp.hands.spec import Side
from handmap_qp.human.recording import Recording, as_flags
from handmap_qp.human.sample import LANDMARK_COUNT, LANDMARK_NAMES
from handmap_qp.se3 import as_floats

SIDES: tuple[Side, ...] = ("left", "right")
LANDMARK_COLUMNS: tuple[str, ...] = tuple(
    f"{name}_{a}" for name in LANDMARK_NAMES for a in "xyz"
)
"""Names of the 63 coordinates of a sample, for formats that have columns."""
POSE_COLUMNS: tuple[str, ...] = tuple(
    f"wrist_pose_{i}{j}" for i in range(3) for j in range(4)
)
"""Names of the upper three rows of the wrist's pose, row by row."""
_WORDS = {
    "wrist": "the wrist's orientation",
    "confidence": "the confidence",
    "source": "the words about the source",
}
"""What a format may be unable to hold of a recording, in words."""


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


class RecordingFormat(abc.ABC):
    """A file format of recordings.

    Other packages add theirs by entry points of the group `handmap_qp.formats`, each of which names
    an object of a subclass.

    All methods raise `RecordingError` with the file, and the row or array at fault, on a damaged
    file, and `MissingExtraError` where the format needs a package that is not installed.

    Attributes:
        name: Short name, as of `handmap convert --format`.
        suffixes: Suffixes of its files, the usual one first; empty for folders.
        about: What it is, in one line.
        lacks: Fields of `Recording` that it cannot hold: some of `wrist`, `confidence`, `source`.
    """

    name: str
    suffixes: tuple[str, ...]
    about: str
    lacks: ClassVar[tuple[str, ...]] = ()

    def recognises(self, path: Path) -> bool:
        """Tell whether an existing file with one of the suffixes, or a folder, is of this form."""
        return path.is_file()

    @abc.abstractmethod
    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the recordings of a file, in its order."""

    @abc.abstractmethod
    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one recording."""

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name what a file holds besides what `Recording` can hold."""
        return ()

    def losses(self, recordings: Sequence[Recording]) -> tuple[str, ...]:
        """Name what of these recordings the format cannot hold."""
        return tuple(
            _WORDS[field]
            for field in self.lacks
            if any(_has(recording, field) for recording in recordings)
        )

    @abc.abstractmethod
    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write recordings to one file; an earlier file stays as it was if this fails.

        Raises:
            InvalidInputError: If the format cannot hold them together, or the file cannot be
                written.
        """

    def check_one_per_hand(self, recordings: Sequence[Recording]) -> None:
        """Reject recordings that are not of one hand, or of a left and a right hand.

        Raises:
            InvalidInputError: If there is none, or a hand occurs twice.
        """
        sides = [recording.side for recording in recordings]
        if not sides or len(set(sides)) < len(sides):
            got = ", ".join(sides) or "none"
            raise InvalidInputError(
                argument="recordings",
                expected=f"one recording of each hand in a file of the form {self.name}",
                got=got if len(got) < 40 else f"{len(sides)} recordings",
                advice="use lerobot, robomimic, or one file for each",
            )


def _has(recording: Recording, field: str) -> bool:
    return (
        bool(recording.source)
        if field == "source"
        else getattr(recording, field) is not None
    )


def require(package: str) -> Any:
    """Import a package of the extra `files`.

    Raises:
        MissingExtraError: If it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise MissingExtraError(package.partition(".")[0], "files") from error


@contextmanager
def reading(file: Path, prefix: str = "") -> Iterator[None]:
    """Turn errors about values that come from a file into `RecordingError`.

    Args:
        file: The file.
        prefix: Put before the name of the array at fault.

    Raises:
        RecordingError: For every `InvalidInputError` of the block.
    """
    try:
        yield
    except InvalidInputError as error:
        name = "handedness" if error.argument == "side" else error.argument
        raise RecordingError(error.what, file=file, array=prefix + name) from error


def side_of(value: object, file: Path, array: str, line: int | None = None) -> Side:
    """Return the side that a value of a file names.

    Raises:
        RecordingError: If it names none.
    """
    text = str(value).strip().lower()
    for side in SIDES:
        if text == side:
            return side
    problem = f"expected right or left, got {text[:20]!r}"
    raise RecordingError(problem, file=file, array=array, line=line)


def entry_stem(path: Path, entry: Entry) -> str:
    """Return the name of a recording: that of its file, and of its entry if it has one."""
    return "_".join([path.stem, *entry.name.split("/")] if entry.name else [path.stem])


def build_recording(
    path: Path,
    entry: Entry,
    time: Any,
    landmarks: Any,
    *,
    prefix: str = "",
    valid: Any = None,
    wrist: Any = None,
    **others: Any,
) -> Recording:
    """Build a recording from the arrays of a file; samples that are not finite are not valid.

    Args:
        path: The file.
        entry: Its place there.
        time: Instants [s], shape (T,).
        landmarks: Coordinates [m], shape (T, 21, 3) or (T, 63).
        prefix: Put before the name of an array at fault.
        valid: Whether the hand was seen, shape (T,); where the landmarks are finite if omitted.
        wrist: Poses, shape (T, 4, 4), or their upper three rows, shape (T, 12); an array of NaN
            counts as none.
        others: Further fields of `Recording`; a confidence of NaN counts as none.

    Raises:
        RecordingError: If `Recording` does not take them.
    """
    with reading(path, prefix):
        points = as_floats(landmarks, "landmarks")
        if points.shape[1:] == (3 * LANDMARK_COUNT,):
            points = points.reshape(-1, LANDMARK_COUNT, 3)
        points = as_floats(points, "landmarks", shape=("T", LANDMARK_COUNT, 3))
        seen = finite_samples(points)
        if valid is not None:
            seen &= as_flags(valid, "valid", len(points))
        if wrist is not None and wrist.shape[1:] == (12,):
            rows = np.isnan(wrist).all()
            wrist = None if rows else _poses_of_rows(wrist)
        confidence = others.pop("confidence", None)
        if (
            confidence is not None
            and np.isnan(as_floats(confidence, "confidence")).all()
        ):
            confidence = None
        name = others.pop("name", "") or entry_stem(path, entry)
        return Recording(
            name,
            time,
            points,
            seen,
            entry.side,
            wrist=wrist,
            confidence=confidence,
            **others,
        )


def finite_samples(points: np.ndarray) -> np.ndarray:
    """Tell of samples (T, ...) whether all their numbers are finite, shape (T,)."""
    return np.asarray(np.isfinite(points).all(axis=tuple(range(1, points.ndim))))


def landmark_rows(recording: Recording) -> np.ndarray:
    """Return the landmarks as rows [m], shape (T, 63)."""
    return recording.landmarks.reshape(len(recording), 3 * LANDMARK_COUNT)


def pose_rows(recording: Recording) -> np.ndarray:
    """Return the upper three rows of the wrist's poses, NaN where there are none, (T, 12)."""
    if recording.wrist is None:
        return np.full((len(recording), 12), np.nan)
    return recording.wrist[:, :3].reshape(-1, 12)


def _poses_of_rows(rows: np.ndarray) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    return poses
