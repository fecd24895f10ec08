"""Files that commands write: checked before the work, and replaced only by a complete one."""

from __future__ import annotations

import glob
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from handmap_qp.errors import InvalidInputError


def check_output(argument: str, path: Path, suffixes: tuple[str, ...]) -> Path:
    """Check that a file can be written, before any work is done.

    Args:
        argument: The command-line option that names it, such as `--out`.
        path: The file.
        suffixes: Allowed suffixes, the usual one first.

    Returns:
        The same path.

    Raises:
        InvalidInputError: If the suffix is another, the folder does not exist, or the path is a
            folder.
    """
    if path.suffix not in suffixes:
        raise InvalidInputError(
            argument=argument, expected=f"a file that ends in {suffixes[0]}", value=str(path)
        )
    if not path.parent.is_dir():
        raise InvalidInputError(
            argument=argument, problem=f"there is no folder {path.parent}", value=str(path)
        )
    if path.is_dir():
        raise InvalidInputError(argument=argument, problem=f"{path} is a folder", value=str(path))
    return path


_PART = ".part"
"""Suffix of a file that is being written; its name begins with a dot."""


def remove_torn(path: Path) -> None:
    """Remove what `replaced_file` leaves behind if its process is killed.

    Args:
        path: The file that was to be written.
    """
    # `mkstemp` puts eight characters between.
    for torn in path.parent.glob(f".{glob.escape(path.name)}.????????{_PART}"):
        torn.unlink(missing_ok=True)


@contextmanager
def replaced_file(path: Path, argument: str) -> Iterator[IO[bytes]]:
    """Open a file that takes the place of `path` when the block has succeeded.

    If the block fails, an earlier file stays as it was. If the process is killed, a hidden file is
    left beside it (`remove_torn`).

    Args:
        path: The file; its folder must exist.
        argument: Argument or option that names it.

    Yields:
        The file to write to.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    try:
        handle, name = tempfile.mkstemp(_PART, f".{path.name}.", path.parent)
        temporary = Path(name)
        try:
            with os.fdopen(handle, "wb") as file:
                yield file
            temporary.chmod(0o644)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InvalidInputError(
            argument=argument,
            problem=f"{path}: cannot be written: {error.strerror or error}",
            value=str(path),
        ) from error
