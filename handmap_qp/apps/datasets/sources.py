"""The jobs of a batch: every recording of every input file, with the options of all."""

import zlib
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import msgspec

from handmap_core.errors import HandmapError, InvalidInputError, reason_of
from handmap_qp.apps.arguments import MappingArguments, check_names
from handmap_qp.apps.refusals import naming
from handmap_qp.hands import load_whole, urdf_path
from handmap_qp.trackers.formats import (
    FORMATS,
    SEPARATOR,
    Source,
    hdf5,
    known_suffixes,
    list_sources,
)
from .manifest import WHOLE, Line, Shard
from .workers import each_apart, time_limit

PATIENCE = 30.0
"""Longest time for listing an HDF5 file [s]."""
BOTH = "both"
"""The side of a robot with two hands."""


@dataclass(frozen=True)
class JobOptions:
    """What all jobs of a batch have in common.

    Attributes:
        robots: Name of the robot hand for each human hand, or of the robot for `BOTH`.
        arguments: Reference points and options of the mapping.
        look_ahead: Use the whole recording to smooth and to fill gaps, with arguments that are
            `smooth`; False for a mapping that knows the past only, as online.
    """

    robots: dict[str, str]
    arguments: MappingArguments = MappingArguments()
    look_ahead: bool = False

    @property
    def digest(self) -> str:
        """A short text that changes if the robots, their URDFs or the options do."""
        digest = sha256(repr((self.arguments, self.look_ahead or None)).encode())
        files = [self.arguments.options] if self.arguments.options else []
        for side, name in sorted(self.robots.items()):
            robot = load_whole(name, self.arguments.robot_points)
            for hand in robot.hands:
                digest.update(
                    side.encode() + msgspec.json.encode(hand.spec, enc_hook=str)
                )
                files.append(urdf_path(hand.spec))
            if robot.parts:
                # What hands stand on, and joints that they lock, are in it alone.
                digest.update(robot.urdf_text.encode())
        for file in files:
            with naming("--options", f"{file}: cannot be read"):
                digest.update(file.read_bytes())
        return digest.hexdigest()[:16]


@dataclass(frozen=True)
class Job:
    """One recording of one hand to map, or a file with both hands.

    Attributes:
        line: What is known of it; `error` says why its file could not be listed, and `kills` how
            often its worker has died.
        source: The recording in its file, or the first of both; None where the file could not be
            listed.
        options: What it has in common with the others.
        folder: Folder of the batch.
    """

    line: Line
    source: Source | None
    options: JobOptions
    folder: Path

    @property
    def out(self) -> str:
        """File to write, below the folder of the batch, with `/`."""
        file, entry = self.line.place
        return ".".join(
            filter(None, (f"episodes/{file}", entry.replace("/", "_"), "npz"))
        )


def find_files(
    inputs: Sequence[Path], out: Path | None = None
) -> tuple[dict[str, Path], tuple[Path, ...]]:
    """Find the files to map: those named, and those of a known form below folders that are named.

    Args:
        inputs: Files, data sets and folders.
        out: Folder of the batch, which is left out where it is below a folder of these.

    Returns:
        The files by name (FILE of `Line.key`), sorted, and the paths left out because they lead to
        files or folders that are among them already, by links or because they were named twice.

    Raises:
        InvalidInputError: If an input does not exist, a folder has no recordings, or two files have
            the same name below different folders.
    """
    found = []
    repeated: list[Path] = []
    own = out and _identity(out)
    seen = set[object]()
    for given in inputs:
        before = len(found) + len(repeated)
        found += [
            (given.name if path is given else path.relative_to(given).as_posix(), path)
            for path in _paths_of(given, own, seen, repeated)
        ]
        if len(found) + len(repeated) == before:
            raise InvalidInputError(
                f"{given}: has no files of a known form", argument="INPUT"
            )
    check_names(
        "INPUT",
        [name for name, _ in found],
        "files of different names",
        advice="name the folder above both",
    )
    return dict(sorted(found)), tuple(repeated)


def list_jobs(
    files: Mapping[str, Path],
    folder: Path,
    options: JobOptions,
    shard: Shard = WHOLE,
) -> list[Job]:
    """List the recordings of files, the longest first.

    HDF5 files are listed in another process: on some damaged ones the library crashes, or loops for
    ever.

    Args:
        files: The files by name.
        folder: Folder of the batch.
        options: What all jobs have in common.
        shard: Which part of how many, counted from 1. A part has the files whose names fall to it,
            so that parts do not depend on each other.

    Returns:
        The jobs. A file that cannot be listed is one without a source.
    """
    part, parts = shard
    own = {
        name: path
        for name, path in files.items()
        if zlib.crc32(name.encode()) % parts == part - 1
    }
    risky = [path for path in own.values() if path.suffix.lower() in hdf5.SUFFIXES]
    listings = dict(zip(risky, each_apart(_listing, risky), strict=True))
    jobs = []
    digest = options.digest
    is_whole = BOTH in options.robots
    for name, path in own.items():
        stats = [p.stat() for p in (path, *path.rglob("*")) if p.is_file()]
        problem = (
            f"{path}: cannot be read: listing it crashed, or took {PATIENCE:.0f} s"
        )
        found = listings[path] if path in listings else _listing(path)
        sources, error = found or ((), problem)
        for source in sources[: 1 if is_whole else None] or (None,):
            entry, side, frames = source.entry if source else ("", "", 0)
            if is_whole:
                entry, side = "", BOTH
            line = Line(
                f"{name}{SEPARATOR}{entry}",
                "listed",
                str(path),
                size=sum(stat.st_size for stat in stats),
                mtime_ns=max((stat.st_mtime_ns for stat in stats), default=0),
                options=digest,
                entries=max(1, len(sources)),
                side=side,
                robot=options.robots.get(side, ""),
                frames=frames,
                error=error,
            )
            jobs.append(Job(line, source, options, folder))
    return sorted(jobs, key=lambda job: (-job.line.frames, job.line.key))


@time_limit(PATIENCE)
def _listing(path: Path) -> tuple[tuple[Source, ...], str]:
    """Return the recordings of a file, and why it cannot be listed."""
    try:
        return list_sources(path), ""
    except HandmapError as error:
        return (), reason_of(error)


def _paths_of(
    given: Path, own: object, seen: set[object], repeated: list[Path]
) -> Iterator[Path]:
    """Yield the path itself, or the files and data sets below it, except the folder `own`.

    Adds identities of paths to `seen`, and paths whose identity was there to `repeated`.
    """
    if not given.exists():
        raise InvalidInputError(f"{given}: no such file or folder", argument="INPUT")
    # Links come last, so that they do not change the names of the files they lead to.
    waiting = deque([given])
    links = deque[Path]()
    while waiting or links:
        path = (waiting or links).popleft()
        identity = _identity(path)
        is_known = path.is_dir() or path.name.lower().endswith(known_suffixes())
        if identity == own or not (path is given or is_known):
            continue
        if identity in seen:
            repeated.append(path)
        elif not path.is_dir() or any(
            form.recognises(path) for form in FORMATS.values()
        ):
            yield path
        else:
            for each in sorted(path.glob("[!.]*")):
                (links if each.is_symlink() else waiting).append(each)
        seen.add(identity)


def _identity(path: Path) -> object:
    """Return what all names of a file or folder share; links that lead nowhere share nothing."""
    if not path.exists():
        return path
    stat = path.stat()
    return stat.st_dev, stat.st_ino
