"""Read `.npz` archives of plain arrays: every damage becomes one `RecordingError`.

The size of an archive is bounded before it is read, and nothing in it is unpickled.
"""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Container, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from handmap_qp.errors import HandmapError, InvalidInputError, RecordingError

LARGEST_ARCHIVE = 1 << 30
"""Most that an archive may hold [bytes]; landmarks of an hour at 90 Hz are 163 MB."""


def member_names(file: Path) -> set[str]:
    """Return the names of the arrays of an `.npz` file.

    Raises:
        RecordingError: If the file cannot be read or is not an archive.
    """
    with _opened(file) as archive:
        return {_name(member) for member in archive.infolist()}


def read_archive(
    file: Path, names: Container[str] | None = None
) -> dict[str, np.ndarray]:
    """Read arrays of an `.npz` file.

    Args:
        file: The file.
        names: Names of those to read; all if omitted. Those that the file lacks are left out.

    Raises:
        RecordingError: If the file cannot be read, is not an archive of plain arrays, is damaged,
            or holds more than `LARGEST_ARCHIVE`. `array` names the member at fault.
    """
    with _opened(file) as archive:
        members = [m for m in archive.infolist() if names is None or _name(m) in names]
        if (size := sum(member.file_size for member in members)) > LARGEST_ARCHIVE:
            most = f"{LARGEST_ARCHIVE >> 20} MB"
            problem = f"holds {size >> 20} MB, more than the {most} that are read"
            raise InvalidInputError(problem)
        return {
            _name(member): _read_member(file, archive, member) for member in members
        }


def _name(member: zipfile.ZipInfo) -> str:
    return member.filename.removesuffix(".npy")


@contextmanager
def _opened(file: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive, and turn every error inside the block into `RecordingError`."""
    # Opened here, because zipfile leaves a damaged file open.
    with (
        reading(file, "is not an .npz file of plain arrays"),
        file.open("rb") as stream,
        zipfile.ZipFile(stream) as archive,
    ):
        yield archive


def _read_member(
    file: Path,
    archive: zipfile.ZipFile,
    member: zipfile.ZipInfo,
) -> np.ndarray:
    with (
        reading(file, "is not a plain array", _name(member)),
        archive.open(member) as stream,
        warnings.catch_warnings(),
    ):
        # numpy warns of headers that Python 2 wrote.
        warnings.simplefilter("ignore")
        return npy.read_array(stream, allow_pickle=False)


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
        RecordingError: For every other error of the block.
    """
    try:
        yield
    except InvalidInputError as error:
        array += error.argument
        problem = f"{error.what}: {error.advice}" if error.advice else error.what
        line = table and table.line_num
        raise RecordingError(problem, file=file, array=array, line=line) from error
    except HandmapError:
        raise
    except Exception as error:
        text = " ".join(str(error).split())[:160]
        if isinstance(error, OSError) and error.strerror:
            problem, text = "cannot be read", error.strerror
        problem = f"{problem}: {text}".rstrip(": ")
        line = table and table.line_num
        raise RecordingError(problem, file=file, array=array, line=line) from error
