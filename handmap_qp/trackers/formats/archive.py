"""Read `.npz` archives of plain arrays: every damage becomes one `RecordingError`.

numpy's own reader raises a dozen kinds of errors on a damaged file, and allocates as much memory as
a header asks for. Here the size of every member is bounded before it is read.
"""

from __future__ import annotations

import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Container, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from handmap_qp.errors import RecordingError

LARGEST_ARCHIVE = 1 << 30
"""Most that an archive may hold [bytes]; landmarks of an hour at 90 Hz are 163 MB."""
DAMAGES = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    NotImplementedError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What zipfile, zlib and numpy's header parser raise on damaged files."""


class _DamageError(Exception):
    """A damage of one member that was found here, in words."""

    def __init__(self, member: str, problem: str) -> None:
        super().__init__(member, problem)
        self.member = member
        self.problem = problem


def member_names(file: Path) -> set[str]:
    """Return the names of the arrays of an `.npz` file.

    Raises:
        RecordingError: If the file cannot be read or is not an archive.
    """
    with _opened(file) as archive:
        return {_name(member) for member in archive.infolist()}


def read_archive(file: Path, names: Container[str] | None = None) -> dict[str, np.ndarray]:
    """Read arrays of an `.npz` file.

    Args:
        file: The file.
        names: Names of those to read; all if omitted. Those that the file lacks are left out.

    Returns:
        Arrays by name.

    Raises:
        RecordingError: If the file cannot be read, is not an archive of plain arrays, is damaged,
            or holds more than `LARGEST_ARCHIVE`. `array` names the member at fault.
    """
    with _opened(file) as archive:
        members = [m for m in archive.infolist() if names is None or _name(m) in names]
        if (size := sum(member.file_size for member in members)) > LARGEST_ARCHIVE:
            most = f"{LARGEST_ARCHIVE >> 20} MB"
            raise _DamageError("", f"holds {size >> 20} MB, more than the {most} that are read")
        return {_name(member): _read_member(archive, member) for member in members}


@contextmanager
def _opened(file: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive, and turn every error inside the block into `RecordingError`."""
    try:
        # Opened here, because zipfile leaves a damaged file open.
        with file.open("rb") as stream, zipfile.ZipFile(stream) as archive:
            yield archive
    except _DamageError as error:
        raise RecordingError(error.problem, file=file, array=error.member) from error
    except DAMAGES as error:
        if isinstance(error, OSError) and error.errno is not None:
            problem = f"cannot be read: {error.strerror or error}"
            raise RecordingError(problem, file=file) from error
        problem = f"is not an .npz file of plain arrays: {' '.join(str(error).split())}"
        raise RecordingError(problem.rstrip(": "), file=file) from error


def _name(member: zipfile.ZipInfo) -> str:
    return member.filename.removesuffix(".npy")


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Read one array, whose header must agree with the size of the member."""
    name = _name(member)
    if member.flag_bits & 0x1:
        raise _DamageError(name, "is encrypted")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise _DamageError(name, f"has the unknown compression {member.compress_type}")
    try:
        with archive.open(member) as stream:
            shape, is_fortran, dtype = _read_header(stream, name)
            count = 1
            for length in shape:
                count *= length
            size = count * dtype.itemsize
            # A header may ask for anything; this takes what is there, at most `member.file_size`.
            content = stream.read(size)
            # Reading on to the end verifies the checksum.
            if len(content) != size or stream.read(1):
                raise _DamageError(name, f"is torn: its header tells of {size} bytes")
        array = np.frombuffer(content, dtype=dtype, count=count)
        return array.reshape(shape, order="F" if is_fortran else "C")
    except DAMAGES as error:
        problem = f"is not a plain array: {' '.join(str(error).split())}".rstrip(": ")
        raise _DamageError(name, problem) from error


def _read_header(stream: IO[bytes], name: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Read the header of an array: shape, order and type."""
    version = npy.read_magic(stream)
    with warnings.catch_warnings():
        # numpy warns of headers that Python 2 wrote.
        warnings.simplefilter("ignore")
        if version == (1, 0):
            shape, is_fortran, dtype = npy.read_array_header_1_0(stream)
        elif version == (2, 0):
            shape, is_fortran, dtype = npy.read_array_header_2_0(stream)
        else:
            raise _DamageError(name, f"has the unknown version {version} of numpy's format")
    if dtype.hasobject:
        raise _DamageError(name, "holds Python objects, which are not read")
    if min(shape, default=0) < 0:
        raise _DamageError(name, f"has the impossible shape {shape}")
    return shape, is_fortran, dtype
