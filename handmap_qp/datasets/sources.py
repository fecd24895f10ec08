"""The tasks of a batch: every recording of every input file, with its robot and its output."""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.hands.spec import Side
from handmap_qp.trackers.formats import (
    FORMATS,
    SEPARATOR,
    Source,
    known_suffixes,
    list_sources,
)


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
        key: Name of the file, `::`, and of the recording in it: its identity in the manifest.
        file: The file.
        source: The recording in it; None where the file could not be listed.
        side: Which hand; None where the file could not be listed.
        frames: Number of samples.
        entries: How many recordings the file has.
        error: Why the file could not be listed; empty if it could.
    """

    key: str
    file: InputFile
    source: Source | None = None
    side: Side | None = None
    frames: int = 0
    entries: int = 1
    error: str = ""

    @property
    def out(self) -> str:
        """File to write, below the folder of the batch, with `/`."""
        entry = self.source.entry.name if self.source is not None else ""
        tail = f".{entry.replace('/', '_')}" if entry else ""
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
    own = None if out is None else _identity(out)
    seen = {own}

    def is_new(path: Path) -> bool:
        key = _identity(path)
        if key in seen:
            repeated.extend([path] if key != own else [])
            return False
        seen.add(key)
        return True

    for given in inputs:
        before = len(files) + len(repeated)
        for file in _files_of(given, is_new):
            if file.name in files:
                raise InvalidInputError(
                    argument="INPUT",
                    expected="files of different names",
                    got=f"{file.name} twice",
                    advice="name the folder above both",
                )
            files[file.name] = file
        if len(files) + len(repeated) == before:
            raise InvalidInputError(
                argument="INPUT", problem=f"{given}: has no files of a known form"
            )
    return tuple(files[name] for name in sorted(files)), tuple(repeated)


def tasks_of(
    files: Sequence[InputFile],
    shard: tuple[int, int] = (1, 1),
    progress: Callable[[int], None] | None = None,
) -> list[Task]:
    """List the recordings of files, the longest first.

    Args:
        files: The files.
        shard: Which part of how many, counted from 1. A part has the files whose names fall to it,
            so that parts do not depend on each other.
        progress: Called with the number of files listed.

    Returns:
        The tasks. A file that cannot be listed is a task with an error.
    """
    part, parts = shard
    tasks = []
    for i, file in enumerate(files):
        if zlib.crc32(file.name.encode()) % parts == part - 1:
            tasks += _tasks_of_file(file)
        if progress is not None:
            progress(i + 1)
    return sorted(tasks, key=lambda task: (-task.frames, task.key))


def _tasks_of_file(file: InputFile) -> list[Task]:
    try:
        sources = list_sources(file.path)
    except HandmapError as error:
        return [Task(key=f"{file.name}{SEPARATOR}", file=file, error=" ".join(str(error).split()))]
    return [
        Task(
            key=f"{file.name}{SEPARATOR}{source.entry.name}",
            file=file,
            source=source,
            side=source.entry.side,
            frames=source.entry.samples,
            entries=len(sources),
        )
        for source in sources
    ]


def _files_of(given: Path, is_new: Callable[[Path], bool]) -> Iterator[InputFile]:
    if not given.exists():
        raise InvalidInputError(argument="INPUT", problem=f"{given}: no such file or folder")
    suffixes = known_suffixes()
    # Links come last, so that they do not change the names of the files they lead to.
    waiting, links = deque([given]), deque[Path]()
    while waiting or links:
        path = (waiting or links).popleft()
        is_folder = path.is_dir() and not _is_set(path)
        is_file = path is given or path.is_dir() or path.suffix.lower() in suffixes
        if not (is_folder or is_file) or not is_new(path):
            continue
        if is_folder:
            for inside in sorted(path.iterdir()):
                if not inside.name.startswith("."):
                    (links if inside.is_symlink() else waiting).append(inside)
        else:
            name = given.name if path is given else path.relative_to(given).as_posix()
            yield _stamped(name, path)


def _identity(path: Path) -> object:
    """Return what all names of a file or folder share; links that lead nowhere share nothing."""
    if not path.exists():
        return path
    stat = path.stat()
    return stat.st_dev, stat.st_ino


def _is_set(folder: Path) -> bool:
    """Tell whether a folder is a data set, not a folder of files."""
    return any(form.recognises(folder) for form in FORMATS.values())


def _stamped(name: str, path: Path) -> InputFile:
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    stats = [file.stat() for file in files]
    return InputFile(
        name=name,
        path=path,
        size=sum(stat.st_size for stat in stats),
        mtime_ns=max((stat.st_mtime_ns for stat in stats), default=0),
    )
