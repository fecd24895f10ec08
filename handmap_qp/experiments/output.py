"""Files that are written all together or not at all."""

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
    """A new folder beside `directory` to write into.

    What is in it takes its place there if the block succeeds.

    Args:
        directory: Where the files shall be at the end; made if it does not exist, and files of the
            same names in it are replaced.

    Yields:
        The folder to write to.

    Raises:
        InvalidInputError: If it cannot be written.
    """
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        if directory.exists() and not (directory.is_dir() and os.access(directory, os.W_OK)):
            raise InvalidInputError(
                f"{directory}: expected a folder that can be written, or a new name",
                value=directory,
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
            f"{directory}: cannot be written: {error.strerror or error}", value=directory
        ) from error
