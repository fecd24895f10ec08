"""What the HDF5 forms share: opening files, and errors of damaged ones."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp.errors import InvalidInputError, RecordingError
from handmap_qp.output_files import replaced_path
from handmap_qp.trackers.formats.archive import DAMAGES, LARGEST_ARCHIVE
from handmap_qp.trackers.formats.base import require

SUFFIXES = (".hdf5", ".h5")
_OVERHEAD = 1 << 20
"""Room for names, attributes and tables of what `check_room` is asked for [bytes]."""


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a file for reading, and turn what h5py raises inside the block into `RecordingError`.

    Args:
        path: The file.

    Yields:
        The `h5py.File`.

    Raises:
        RecordingError: If the file is damaged.
        MissingExtraError: If h5py is not installed.
    """
    h5py = require("h5py")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (RecordingError, InvalidInputError):
        raise
    except DAMAGES as error:
        text = " ".join(str(error).split())
        raise RecordingError(f"cannot be read as HDF5: {text[:160]}", file=path) from error


def numbers(path: Path, group: Any, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Read an array of numbers.

    Args:
        path: The file, for errors.
        group: The group that holds it.
        name: Its name there.
        shape: Its shape; None stands for any length.

    Raises:
        RecordingError: If it is missing, of another shape or type, or impossibly large.
    """
    h5py = require("h5py")
    try:
        # The low-level call takes a third of the time of h5py's `group[name]`, and files of poses
        # have many arrays.
        item = h5py.h5d.open(group.id, name.encode())
    except (KeyError, TypeError):
        names = sorted(group)
        shown = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
        problem = f"is missing; there are {shown or 'none'}"
        raise RecordingError(problem, file=path, array=_place(group, name)) from None
    # These properties are looked up in the file each time.
    dtype, found = item.dtype, item.shape
    fits = len(found) == len(shape) and all(
        wanted is None or length == wanted for length, wanted in zip(found, shape, strict=True)
    )
    if not fits or dtype.kind not in "biuf":
        sizes = ", ".join("T" if length is None else str(length) for length in shape)
        problem = f"expected numbers of shape ({sizes}), got {dtype} of shape {found}"
        raise RecordingError(problem, file=path, array=_place(group, name))
    if math.prod(found) * dtype.itemsize > LARGEST_ARCHIVE:
        problem = f"is larger than the {LARGEST_ARCHIVE >> 20} MB that are read"
        raise RecordingError(problem, file=path, array=_place(group, name))
    array = np.empty(found, dtype)
    item.read(h5py.h5s.ALL, h5py.h5s.ALL, array)
    return array.astype(float, copy=False)


def _place(group: Any, name: str) -> str:
    return f"{group.name.rstrip('/')}/{name}"


@contextmanager
def created(path: Path, argument: str = "path") -> Iterator[Any]:
    """Open a file for writing that takes the place of `path` when the block has succeeded.

    Args:
        path: The file; its folder must exist.
        argument: Argument or option that names it.

    Yields:
        The `h5py.File`; it keeps no times, so that the same content is the same bytes.

    Raises:
        InvalidInputError: If the file cannot be written.
        MissingExtraError: If h5py is not installed.
    """
    h5py = require("h5py")
    with replaced_path(path, argument) as temporary, h5py.File(temporary, "w") as file:
        yield file


def check_room(file: Any, size: int) -> None:
    """See that the disk has room for what is written next: libhdf5 crashes where it is full.

    Args:
        file: The `h5py.File`, open for writing.
        size: Most that is written until the next call [bytes].

    Raises:
        OSError: If the disk is full.
    """
    file.flush()
    with tempfile.TemporaryFile(dir=Path(file.filename).parent) as room:
        os.posix_fallocate(room.fileno(), 0, size + _OVERHEAD)
