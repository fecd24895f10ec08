"""Write several files atomically: all of them, or none."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from handmap_qp.errors import InvalidInputError
from handmap_qp.output_files import make_folder, writing


@contextmanager
def output_folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder, and move its files into `out` if the block succeeds.

    Args:
        out: Final folder of the files; created if it does not exist. Files of the same names are
            replaced.

    Yields:
        The folder to write to.

    Raises:
        InvalidInputError: If `out` cannot be written.
    """
    make_folder(out.parent, "out")
    with writing(out, "out"):
        if out.exists() and not (out.is_dir() and os.access(out, os.W_OK)):
            raise InvalidInputError(
                argument="out",
                expected="a folder that can be written, or a new name",
                got=str(out),
            )
        with TemporaryDirectory(
            prefix=".handmap-", dir=out.parent, ignore_cleanup_errors=True
        ) as temporary:
            yield Path(temporary)
            out.mkdir(exist_ok=True)
            for file in Path(temporary).iterdir():
                file.replace(out / file.name)
