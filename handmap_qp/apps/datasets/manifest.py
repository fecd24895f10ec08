"""The manifest of a batch: a line of JSON for each thing that happened, appended, never changed.

The last line of a key says how it stands. A line that was being written when the power failed is
cut off at the next start, and its recording is mapped again.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

import msgspec

from handmap_qp.apps.refusals import naming
from handmap_qp.output_files import append, locked_file, sync, writing
from handmap_qp.trackers import SEPARATOR

Status = Literal["listed", "done", "failed", "killed"]
Shard = tuple[int, int]
"""Which part of how many, counted from 1."""
WHOLE: Shard = 1, 1
MOST_KILLS = 3
"""A recording that kills its worker this often is left alone."""


class Line(msgspec.Struct, frozen=True, omit_defaults=True):
    """What is known of one recording, and what happened to it.

    Attributes:
        key: File and recording, `FILE::NAME`. FILE is its path below the folder that was named,
            with `/`, or its own name if it was named; NAME is empty where it holds one recording.
        status: `listed`, never written; `done`; `failed`, with an error; or `killed`: the worker
            died, and it is tried again unless `kills` is `MOST_KILLS`.
        path: The file.
        size: Its size, of all files of a folder together [bytes].
        mtime_ns: Its last change, of all files of a folder the last [ns].
        options: Digest of robot and options.
        entries: How many recordings the file has.
        side: Which hand, or `both` of a robot with two.
        robot: Robot, by name or path.
        frames: Number of samples.
        cpu_s: CPU time [s].
        kills: How often the worker died over it.
        task: What is done, in words, where the recording says it.
        metrics: Numbers about the episode, by name (`episodes.MEASURES`).
        out: The file written, below the folder of the batch.
        sha256: Its digest, as `sha256sum` prints it; empty in manifests up to version 0.2.
        error: Why it failed.
        hints: What is unusual about the recordings, such as fingers that are too slow for people
            because the time is in another unit (`trackers.hints`). It is mapped all the same.
    """

    key: str
    status: Status
    path: str
    size: int
    mtime_ns: int
    options: str
    entries: int = 1
    side: str = ""
    robot: str = ""
    frames: int = 0
    cpu_s: float = 0.0
    kills: int = 0
    task: str = ""
    metrics: dict[str, float | None] = {}
    out: str = ""
    sha256: str = ""
    error: str = ""
    hints: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The file, and the recording's name if it has one, for people."""
        return self.key.removesuffix(SEPARATOR)

    @property
    def place(self) -> tuple[str, str]:
        """FILE and NAME of the key."""
        file, _, entry = self.key.rpartition(SEPARATOR)
        return file, entry

    @property
    def source(self) -> str:
        """What `read_recording` reads it from."""
        return SEPARATOR.join(filter(None, (self.path, self.place[1])))

    @property
    def version(self) -> tuple[int, int, str]:
        """What differs where a file or an option has changed: the recording is mapped again."""
        return self.size, self.mtime_ns, self.options


@contextmanager
def open_manifest(
    folder: Path, shard: Shard = WHOLE
) -> Iterator[Callable[[Line], None]]:
    """Open the manifest of one process or shard for appending.

    Args:
        folder: Folder of the batch.
        shard: Which part of how many; each part has a file of its own.

    Yields:
        A function that appends a line, and returns when it is on the disk. It raises
        `InvalidInputError` if the line cannot be written, as where the disk is full.

    Raises:
        InvalidInputError: If the file cannot be opened, or another process writes to it.
    """
    part, parts = shard
    name = "manifest.jsonl" if parts == 1 else f"manifest-{part}-of-{parts}.jsonl"
    file = folder / name
    with locked_file(file, "--out", "handmap batch") as stream:
        with writing(file, "--out"):
            # Cut off what follows the last line break.
            if file.stat().st_size:
                stream.truncate(file.read_bytes().rfind(b"\n") + 1)
            sync(file.parent)

        def add(line: Line) -> None:
            with writing(file, "--out"):
                append(stream, msgspec.json.encode(line) + b"\n")
                os.fsync(stream.fileno())

        yield add


def read_manifests(folder: Path) -> dict[str, Line]:
    """Read all manifests of a folder.

    Args:
        folder: Folder of a batch.

    Returns:
        The last line of every key; `done` lines before others of the same key and file, where
        several shards have one. Lines that are torn or not of this form are left out, so their
        recordings are mapped again.

    Raises:
        InvalidInputError: If a manifest cannot be read.
    """
    state: dict[str, Line] = {}
    for file in sorted(folder.glob("manifest*.jsonl")):
        done = {key: line for key, line in state.items() if line.status == "done"}
        with naming("DIR", f"{file}: cannot be read"), file.open("rb") as stream:
            for text in stream:
                # Without a line break, it was being written when the process was killed.
                with suppress(msgspec.DecodeError, UnicodeDecodeError):
                    whole = text if text.endswith(b"\n") else b""
                    line = msgspec.json.decode(whole, type=Line)
                    state[line.key] = line
        state |= done
    return state
