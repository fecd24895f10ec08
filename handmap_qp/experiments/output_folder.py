"""Write several files atomically: all of them, or none."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from handmap_qp.errors import InvalidInputError


@contextmanager
def output_folder(directory: Path) -> Iterator[Path]:
    """Yield a temporary folder, and move its files into `directory` if the block succeeds.

    Args:
        directory: Final folder of the files; created if it does not exist. Files of the same names
            are replaced.

    Yields:
        The folder to write to.

    Raises:
        InvalidInputError: If `directory` cannot be written.
    """
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        if directory.exists() and not (directory.is_dir() and os.access(directory, os.W_OK)):
            raise InvalidInputError(
                argument="directory",
                expected="a folder that can be written, or a new name",
                got=str(directory),
            )
        temporary = Path(tempfile.mkdtemp(prefix=".handmap-", dir=directory.parent))
        try:
            yield temporary
            directory.mkdir(exist_ok=True)
            for file in temporary.iterdir():
                file.replace(directory / file.name)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise InvalidInputError(
            argument="directory",
            problem=f"{directory} cannot be written: {error.strerror or error}",
            value=directory,
        ) from error
