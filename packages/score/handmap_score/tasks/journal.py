"""The journal of a run: every attempt is kept as it comes, so that a stopped run can go on.

One line of JSON an attempt, in `attempts.jsonl` of the folder of --out. The first line names the
versions that made the others. One run at a time has the file open.
"""

import io
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple, Self

import msgspec
import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.output_files import append, locked_file, writing
from .attempt import Attempt
from .task import Record

FILE = "attempts.jsonl"
"""Name of the journal in the folder of a run."""


class Fields(NamedTuple):
    """Fields of an `Attempt` but its record, in their order."""

    seed: int
    is_success: bool
    time: float
    tries: int
    drops: int
    force: float
    cause: str
    steps: int


class Head(msgspec.Struct, frozen=True):
    """First line of a journal.

    Attributes:
        versions: What made the attempts.
    """

    versions: str


class Line(msgspec.Struct, frozen=True):
    """One attempt of a journal.

    Attributes:
        key: All that the outcome depends on.
        outcome: Fields of the attempt but its record.
        is_recounted: Whether the second judge recounted it.
        is_contradicted: Whether that judge saw it otherwise.
        record: The physics, as a compressed npz; None if it was not kept.
    """

    key: str
    outcome: Fields
    is_recounted: bool
    is_contradicted: bool
    record: bytes | None

    @classmethod
    def of(
        cls, key: str, one: Attempt, *, is_recounted: bool, is_contradicted: bool
    ) -> Self:
        """Return the line of an attempt."""
        record = None if one.record is None else _packed(one.record)
        return cls(key, Fields(*one[:-1]), is_recounted, is_contradicted, record)

    @property
    def attempt(self) -> Attempt:
        """The attempt."""
        record = None if self.record is None else _unpacked(self.record)
        return Attempt(*self.outcome, record)


class Kept:
    """Outcomes of a run, by keys, in a file that grows while the block of `with` lasts.

    Args:
        file: The journal.
        versions: What the attempts depend on beside their keys.
        resume: Whether outcomes that are in the file already count; else it is begun again.

    Raises:
        InvalidInputError: At the block's begin, if another run has the file open, or if it was made
            by other versions or is not a journal.
    """

    def __init__(self, file: Path, versions: str, *, resume: bool) -> None:
        self._found: dict[str, Line] = {}
        self._versions = versions
        self._file = file
        self._is_resumed = resume
        self._opened = ExitStack()
        self._stream: IO[bytes] | None = None

    def __enter__(self) -> Self:
        with ExitStack() as opening:
            stream = opening.enter_context(
                locked_file(self._file, "--out", "handmap score")
            )
            stream.seek(0)
            content = stream.read()
            if content and self._is_resumed:
                self._read(content.splitlines())
            with writing(self._file, "--out"):
                self._begin(stream, content)
            self._opened = opening.pop_all()
        self._stream = stream
        return self

    def _begin(self, stream: IO[bytes], content: bytes) -> None:
        """Leave the lines in the file that count, and nothing behind them to append to."""
        if content and self._is_resumed:
            # A last line that was cut off.
            stream.truncate(content.rfind(b"\n") + 1)
            return
        if content:
            # A forgotten --resume must not cost the attempts.
            self._file.with_suffix(".before.jsonl").write_bytes(content)
        stream.truncate(0)
        append(stream, _encoded(Head(self._versions)))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stream = None
        self._opened.close()

    def __len__(self) -> int:
        """Return how many outcomes there are."""
        return len(self._found)

    def get(self, key: str) -> Line | None:
        """Return the outcome of a key, or None if there is none yet."""
        return self._found.get(key)

    def add(self, line: Line) -> None:
        """Keep an outcome; it is in the file when this returns.

        Raises:
            InvalidInputError: If the file cannot be written, as where the disk is full.
        """
        if self._stream is None:
            raise RuntimeError("the journal is not open")
        self._found[line.key] = line
        with writing(self._file, "--out"):
            append(self._stream, _encoded(line))

    def _read(self, lines: list[bytes]) -> None:
        """Take the outcomes that are in the file already."""
        head, *rest = lines
        try:
            versions = msgspec.json.decode(head, type=Head).versions
        except msgspec.MsgspecError as error:
            raise InvalidInputError(
                argument="--resume",
                expected="a journal of attempts",
                got=str(self._file),
            ) from error
        if versions != self._versions:
            raise InvalidInputError(
                argument="--resume",
                expected=f"attempts of {self._versions}",
                got=f"{self._file} of {versions}; run without --resume to begin again",
            )
        for raw in rest:
            try:
                line = msgspec.json.decode(raw, type=Line)
            except msgspec.MsgspecError:
                # The run was stopped while it wrote this line.
                continue
            self._found[line.key] = line


def _encoded(line: Head | Line) -> bytes:
    return msgspec.json.encode(line) + b"\n"


def _packed(record: Record) -> bytes:
    """Return a record as a compressed npz."""
    file = io.BytesIO()
    np.savez_compressed(file, **record._asdict())
    return file.getvalue()


def _unpacked(content: bytes) -> Record:
    with np.load(io.BytesIO(content)) as arrays:
        return Record(
            int(arrays["seed"]),
            arrays["times"],
            arrays["qpos"],
            arrays["body_pos"],
            arrays["site_pos"],
        )
