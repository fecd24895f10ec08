"""The seam of file formats: what a format of recordings offers, and what all of them share."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from handmap_qp.errors import InvalidInputError, MissingExtraError, RecordingError
from handmap_qp.hands.spec import Side
from handmap_qp.human.recording import Recording

SIDES: tuple[Side, ...] = ("left", "right")


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


class RecordingFormat(Protocol):
    """A file format of recordings.

    All methods raise `RecordingError` with the file, and the row or array at fault, on a damaged
    file, and `MissingExtraError` where the format needs a package that is not installed.
    """

    @property
    def name(self) -> str:
        """Short name, as of `handmap convert --format`."""
        ...

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Suffixes of its files, the usual one first; empty for folders."""
        ...

    @property
    def about(self) -> str:
        """What it is, in one line."""
        ...

    def recognises(self, path: Path) -> bool:
        """Tell whether an existing file with one of the suffixes, or a folder, is of this form."""
        ...

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the recordings of a file, in its order."""
        ...

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one recording."""
        ...

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name what a file holds besides what `Recording` can hold."""
        ...

    def losses(self, recordings: Sequence[Recording]) -> tuple[str, ...]:
        """Name what of these recordings the format cannot hold."""
        ...

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write recordings to one file; an earlier file stays as it was if this fails.

        Raises:
            InvalidInputError: If the format cannot hold them together, or the file cannot be
                written.
        """
        ...


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


def entry_stem(path: Path, entry: Entry) -> str:
    """Return the name of a recording: that of its file, and of its entry if it has one."""
    words = [path.stem, *entry.name.split("/")] if entry.name else [path.stem]
    return "_".join(words)


def check_one_per_hand(recordings: Sequence[Recording], format_name: str) -> None:
    """Reject recordings that are not of one hand, or of a left and a right hand.

    Raises:
        InvalidInputError: If there is none, or a hand occurs twice.
    """
    sides = [recording.side for recording in recordings]
    if not sides or len(set(sides)) < len(sides):
        got = ", ".join(sides) or "none"
        raise InvalidInputError(
            argument="recordings",
            expected=f"one recording of each hand in a file of the form {format_name}",
            got=got if len(got) < 40 else f"{len(sides)} recordings",
            advice="use lerobot, robomimic, or one file for each",
        )
