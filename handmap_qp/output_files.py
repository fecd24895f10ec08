"""Files that commands write: checked before the work, and replaced only by a complete one.

A file is on the disk before its name is: it is synchronised, renamed, and then its folder is
synchronised. What is written after it, such as a line about it, can rely on it.
"""

import errno
import fcntl
import glob
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from handmap_core.errors import DiskFullError, InvalidInputError, expect


def check_output(argument: str, path: Path, suffixes: tuple[str, ...]) -> Path:
    """Check that a file can be written, before any work is done.

    Args:
        argument: The command-line option that names it, such as `--out`.
        path: The file.
        suffixes: Allowed suffixes, the usual one first.

    Returns:
        The same path.

    Raises:
        InvalidInputError: If the suffix is another, the folder does not exist or cannot be written,
            or the path is a folder.
    """
    expect(
        path.name.endswith(suffixes),
        argument,
        f"a file that ends in {suffixes[0]}",
        value=str(path),
    )
    problem = f"{path} is a folder" if path.is_dir() else ""
    if not path.parent.is_dir():
        problem = f"there is no folder {path.parent}"
    elif not os.access(path.parent, os.W_OK):
        problem = f"the folder {path.parent} cannot be written"
    if problem:
        raise InvalidInputError(problem, argument=argument, value=str(path))
    return path


def check_new(
    argument: str,
    path: Path,
    *,
    overwrite: bool = False,
    advice: str = "give --overwrite to replace it",
) -> None:
    """Reject a file that exists, unless it may be replaced.

    Raises:
        InvalidInputError: If it exists; `advice` says what to do.
    """
    if path.exists() and not overwrite:
        raise InvalidInputError(
            f"{path} exists already", argument=argument, value=str(path), advice=advice
        )


_PART = ".part"
"""Suffix of a file that is being written; its name begins with a dot."""


def remove_torn(path: Path) -> None:
    """Remove what `replaced_file` leaves behind if its process is killed.

    Args:
        path: The file that was to be written.
    """
    # `replaced_path` puts eight characters between.
    for torn in path.parent.glob(f".{glob.escape(path.name)}.????????{_PART}"):
        torn.unlink(missing_ok=True)


@contextmanager
def writing(path: Path, argument: str) -> Iterator[None]:
    """Turn every `OSError` inside the block into an error that names the file.

    Args:
        path: The file or folder that is written.
        argument: Argument or option that names it.

    Raises:
        DiskFullError: If the disk is full.
        InvalidInputError: If the file cannot be written for another reason.
    """
    try:
        yield
    except OSError as error:
        # h5py's own text has a line of details.
        reason = os.strerror(error.errno) if error.errno else error
        problem = f"{path}: cannot be written: {reason}"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            advice = "make room, and run the same command again"
            raise DiskFullError(problem, argument=argument, advice=advice) from error
        raise InvalidInputError(problem, argument=argument) from error


def sync(path: Path) -> None:
    """Return when the content of a file, or the names in a folder, are on the disk.

    Raises:
        OSError: If they cannot be written.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        # File systems that cannot synchronise a folder say so by EINVAL.
        if error.errno != errno.EINVAL:
            raise
    finally:
        os.close(handle)


def sync_all(files: Sequence[Path]) -> None:
    """Return when files and then their names are on the disk.

    Raises:
        OSError: If they cannot be written.
    """
    # At once: the file system then writes its journal for many of them together, which takes a
    # third to a sixth of the time on a busy disk.
    with ThreadPoolExecutor(16) as threads:
        list(threads.map(sync, files))
        list(threads.map(sync, {file.parent for file in files}))


def make_folder(path: Path, argument: str) -> None:
    """Make a folder and those above it, unless they exist; their names are then on the disk.

    Args:
        path: The folder.
        argument: Argument or option that names it.

    Raises:
        InvalidInputError: If it cannot be made.
    """
    if path.is_dir():
        return
    with writing(path, argument):
        missing = [folder for folder in (path, *path.parents) if not folder.exists()]
        path.mkdir(parents=True, exist_ok=True)
        for folder in missing:
            sync(folder.parent)


@contextmanager
def locked_file(path: Path, argument: str, command: str) -> Iterator[IO[bytes]]:
    """Open a file to read it and to append to it, in one process at a time.

    The kernel removes the lock when the process ends, however it ends. Nothing is buffered, so that
    nothing that could not be written is written again at the end.

    Args:
        path: The file, which is made if it does not exist.
        argument: Argument or option that names it.
        command: The command that writes such files, as users call it.

    Raises:
        InvalidInputError: If the file cannot be opened, or another process writes to it.
    """
    with ExitStack() as opened:
        with writing(path, argument):
            stream = opened.enter_context(path.open("a+b", buffering=0))
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                problem = f"{path}: another {command} writes to it"
                raise InvalidInputError(problem, argument=argument) from error
        yield stream


def append(stream: IO[bytes], content: bytes) -> None:
    """Write to the end of a `locked_file`.

    Raises:
        OSError: If the disk does not take all of it.
    """
    if stream.write(content) < len(content):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextmanager
def replaced_path(
    path: Path, argument: str, *, is_synced: bool = True
) -> Iterator[Path]:
    """Name a file that takes the place of `path` when the block has succeeded.

    If the block fails, an earlier file stays as it was. If the process is killed, a hidden file is
    left beside it (`remove_torn`).

    Args:
        path: The file; its folder must exist.
        argument: Argument or option that names it.
        is_synced: False for one of many files, which are synchronised together (`sync_all`).

    Yields:
        The file to write, which exists and is empty.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    with writing(path, argument):
        temporary = path.with_name(f".{path.name}.{os.urandom(4).hex()}{_PART}")
        temporary.touch(exist_ok=False)
        try:
            yield temporary
            temporary.chmod(0o644)
            if is_synced:
                sync(temporary)
            temporary.replace(path)
            if is_synced:
                sync(path.parent)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


@contextmanager
def replaced_file(
    path: Path, argument: str, *, is_synced: bool = True
) -> Iterator[IO[bytes]]:
    """Open a file that takes the place of `path` when the block has succeeded: `replaced_path`."""
    with (
        replaced_path(path, argument, is_synced=is_synced) as file,
        file.open("wb") as stream,
    ):
        yield stream


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
        expect(
            not out.exists() or (out.is_dir() and os.access(out, os.W_OK)),
            "out",
            "a folder that can be written, or a new name",
            got=str(out),
        )
        with TemporaryDirectory(
            prefix=".handmap-", dir=out.parent, ignore_cleanup_errors=True
        ) as temporary:
            yield Path(temporary)
            out.mkdir(exist_ok=True)
            for file in Path(temporary).iterdir():
                file.replace(out / file.name)
