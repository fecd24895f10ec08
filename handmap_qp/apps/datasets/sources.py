"""The tasks of a batch: every recording of every input file."""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import filterfalse
from pathlib import Path

from handmap_qp.apps.datasets.workers import each_apart
from handmap_qp.errors import HandmapError, InvalidInputError, expect, reason_of
from handmap_qp.hands.spec import Side
from handmap_qp.trackers.formats import (
    FORMATS,
    SEPARATOR,
    Source,
    hdf5,
    known_suffixes,
    list_sources,
)

PATIENCE = 30.0
"""Longest time for listing an HDF5 file [s]."""


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file or data set to map.

    Attributes:
        name: Its path below the folder that was named, with `/`; its own name if it was named.
        path: Where it is.
        size: Size, of all files of a folder together [bytes].
        mtime_ns: Time of the last change, of all files of a folder the last [ns].
    """

    name: str
    path: Path
    size: int
    mtime_ns: int


@dataclass(frozen=True, slots=True)
class Task:
    """One recording of one hand.

    Attributes:
        file: The file.
        source: The recording in it; None where the file could not be listed.
        entry: Name of the recording in its file; empty where the file holds only one.
        side: Which hand; None where the file could not be listed.
        frames: Number of samples.
        entries: How many recordings the file has.
        error: Why the file could not be listed; empty if it could.
    """

    file: InputFile
    source: Source | None = None
    entry: str = ""
    side: Side | None = None
    frames: int = 0
    entries: int = 1
    error: str = ""

    @property
    def key(self) -> str:
        """Name of the file, `::`, and of the recording: its identity in the manifest."""
        return f"{self.file.name}{SEPARATOR}{self.entry}"

    @property
    def out(self) -> str:
        """File to write, below the folder of the batch, with `/`."""
        tail = f".{self.entry.replace('/', '_')}" if self.entry else ""
        return f"episodes/{self.file.name}{tail}.npz"


def find_files(
    inputs: Sequence[Path], out: Path | None = None
) -> tuple[tuple[InputFile, ...], tuple[Path, ...]]:
    """Find the files to map: those named, and those of a known form below folders that are named.

    Args:
        inputs: Files, data sets and folders.
        out: Folder of the batch, which is left out where it is below a folder of these.

    Returns:
        The files, by name, and the paths left out because they lead to files or folders that are
        among them already, by links or because they were named twice.

    Raises:
        InvalidInputError: If an input does not exist, a folder has no recordings, or two files have
            the same name below different folders.
    """
    files: dict[str, InputFile] = {}
    repeated: list[Path] = []
    own = out and _identity(out)
    seen: set[object] = set()
    for given in inputs:
        before = len(files) + len(repeated)
        for path in _paths_of(given, own, seen, repeated):
            name = given.name if path is given else path.relative_to(given).as_posix()
            expect(
                name not in files,
                "INPUT",
                "files of different names",
                got=f"{name} twice",
                advice="name the folder above both",
            )
            stats = [p.stat() for p in (path, *path.rglob("*")) if p.is_file()]
            latest = max((stat.st_mtime_ns for stat in stats), default=0)
            size = sum(stat.st_size for stat in stats)
            files[name] = InputFile(name, path, size, latest)
        if len(files) + len(repeated) == before:
            raise InvalidInputError(
                f"{given}: has no files of a known form", argument="INPUT"
            )
    return tuple(map(files.__getitem__, sorted(files))), tuple(repeated)


def tasks_of(files: Sequence[InputFile], shard: tuple[int, int] = (1, 1)) -> list[Task]:
    """List the recordings of files, the longest first.

    HDF5 files are listed in another process: on some damaged ones the library crashes, or loops for
    ever.

    Args:
        files: The files.
        shard: Which part of how many, counted from 1. A part has the files whose names fall to it,
            so that parts do not depend on each other.

    Returns:
        The tasks. A file that cannot be listed is a task with an error.
    """
    part, parts = shard
    own = [file for file in files if zlib.crc32(file.name.encode()) % parts == part - 1]
    risky = [file.path for file in own if file.path.suffix.lower() in hdf5.SUFFIXES]
    listings = dict(zip(risky, each_apart(_listing, risky, PATIENCE), strict=True))
    tasks = []
    for file in own:
        found = listings[file.path] if file.path in listings else _listing(file.path)
        if isinstance(found, tuple):
            tasks += [Task(file, one, *one.entry, len(found)) for one in found]
        else:
            error = f"{file.path}: cannot be read: listing it crashed, or took {PATIENCE:.0f} s"
            tasks.append(Task(file, error=found or error))
    return sorted(tasks, key=lambda task: (-task.frames, task.key))


def _listing(path: Path) -> tuple[Source, ...] | str:
    """Return the recordings of a file, or why it cannot be listed."""
    try:
        return list_sources(path)
    except HandmapError as error:
        return reason_of(error)


def _paths_of(
    given: Path,
    own: object,
    seen: set[object],
    repeated: list[Path],
) -> Iterator[Path]:
    """Yield the path itself, or the files and data sets below it.

    Args:
        given: The path.
        own: Identity of a folder to leave out.
        seen: Identities of the paths found, which are added to.
        repeated: Paths whose identity was seen before, which are added to.
    """
    if not given.exists():
        raise InvalidInputError(f"{given}: no such file or folder", argument="INPUT")
    # Links come last, so that they do not change the names of the files they lead to.
    waiting = deque([given])
    links = deque[Path]()
    while waiting or links:
        path = (waiting or links).popleft()
        identity = _identity(path)
        is_known = path.is_dir() or path.suffix.lower() in known_suffixes()
        if identity == own or not (path is given or is_known):
            continue
        if identity in seen:
            repeated.append(path)
        elif not path.is_dir() or any(
            form.recognises(path) for form in FORMATS.values()
        ):
            yield path
        else:
            inside = sorted(path.glob("[!.]*"))
            links.extend(filter(Path.is_symlink, inside))
            waiting.extend(filterfalse(Path.is_symlink, inside))
        seen.add(identity)


def _identity(path: Path) -> object:
    """Return what all names of a file or folder share; links that lead nowhere share nothing."""
    if not path.exists():
        return path
    stat = path.stat()
    return stat.st_dev, stat.st_ino
