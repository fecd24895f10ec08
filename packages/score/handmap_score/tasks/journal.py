"""The journal of a run: every attempt is kept as it comes, so that a stopped run can go on.

One line of JSON an attempt, in `attempts.jsonl` of the folder of --out. The first line names the
versions that made the others.
"""

import io
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple, Self

import msgspec
import numpy as np

from handmap_qp.errors import InvalidInputError
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
    """Outcomes of a run, by keys, in a file that grows.

    Args:
        file: The journal.
        versions: What the attempts depend on beside their keys.
        resume: Whether outcomes that are in the file already count; else it is begun again.

    Raises:
        InvalidInputError: If the file was made by other versions, or is not a journal.
    """

    def __init__(self, file: Path, versions: str, *, resume: bool) -> None:
        self._found: dict[str, Line] = {}
        self._versions = versions
        lines = file.read_bytes().splitlines() if file.exists() else []
        if lines and resume:
            self._read(lines, file)
        elif lines:
            # A forgotten --resume must not cost the attempts.
            file.replace(file.with_suffix(".before.jsonl"))
        self._file = file
        self._open: IO[bytes] | None = None

    def __enter__(self) -> Self:
        # Written again without a last line that was cut off.
        self._open = self._file.open("wb")
        self._write(Head(self._versions))
        for line in self._found.values():
            self._write(line)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._open is not None:
            self._open.close()

    def __len__(self) -> int:
        """Return how many outcomes there are."""
        return len(self._found)

    def get(self, key: str) -> Line | None:
        """Return the outcome of a key, or None if there is none yet."""
        return self._found.get(key)

    def add(self, line: Line) -> None:
        """Keep an outcome; it is in the file when this returns."""
        self._found[line.key] = line
        self._write(line)

    def _read(self, lines: list[bytes], file: Path) -> None:
        head, *rest = lines
        try:
            versions = msgspec.json.decode(head, type=Head).versions
        except msgspec.MsgspecError as error:
            raise InvalidInputError(
                argument="--resume", expected="a journal of attempts", got=str(file)
            ) from error
        if versions != self._versions:
            raise InvalidInputError(
                argument="--resume",
                expected=f"attempts of {self._versions}",
                got=f"{file} of {versions}; run without --resume to begin again",
            )
        for raw in rest:
            try:
                line = msgspec.json.decode(raw, type=Line)
            except msgspec.MsgspecError:
                # The run was stopped while it wrote this line.
                continue
            self._found[line.key] = line

    def _write(self, line: Head | Line) -> None:
        if self._open is None:
            raise RuntimeError("the journal is not open")
        self._open.write(msgspec.json.encode(line) + b"\n")
        self._open.flush()


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
