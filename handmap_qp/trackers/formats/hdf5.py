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

from handmap_qp.errors import RecordingError, require
from handmap_qp.output_files import replaced_path
from handmap_qp.trackers.formats.archive import LARGEST_ARCHIVE, damages

SUFFIXES = (".hdf5", ".h5")
_OVERHEAD = 1 << 20
"""Room for names, attributes and tables of what `check_room` is asked for [bytes]."""


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a file for reading, and turn what h5py raises inside the block into `RecordingError`.

    Yields:
        The `h5py.File`.

    Raises:
        RecordingError: If the file is damaged.
        MissingExtraError: If h5py is not installed.
    """
    h5py = require("h5py", "files")
    with damages(path, "cannot be read as HDF5"), h5py.File(path, "r") as file:
        yield file


def has_group(path: Path, name: str) -> bool:
    """Tell whether a path is an HDF5 file that has a group."""
    if not path.is_file():
        return False
    with opened(path) as file:
        return name in file


def numbers(
    path: Path,
    group: Any,
    name: str,
    shape: tuple[int, ...],
) -> np.ndarray:
    """Read an array of numbers.

    Args:
        path: The file, for errors.
        group: The group that holds it.
        name: Its name there.
        shape: Its shape.

    Raises:
        RecordingError: If it is missing, of another shape or type, or impossibly large.
    """
    item = group.get(name)
    place = f"{group.name.rstrip('/')}/{name}"
    if not hasattr(item, "dtype"):
        shown = ", ".join(sorted(group)[:6]) + (", ..." if len(group) > 6 else "")
        raise RecordingError(
            f"is missing; there are {shown or 'none'}",
            file=path,
            array=place,
        )
    if item.shape != shape or item.dtype.kind not in "biuf":
        sizes = ", ".join(map(str, shape))
        problem = f"expected numbers of shape ({sizes}), got {item.dtype} of shape {item.shape}"
        raise RecordingError(
            problem,
            file=path,
            array=place,
        )
    if math.prod(shape) * item.dtype.itemsize > LARGEST_ARCHIVE:
        problem = f"is larger than the {LARGEST_ARCHIVE >> 20} MB that are read"
        raise RecordingError(
            problem,
            file=path,
            array=place,
        )
    return item[()].astype(float, copy=False)


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
    h5py = require("h5py", "files")
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
