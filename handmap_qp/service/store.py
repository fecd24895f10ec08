"""Records of where sessions left their robots, for sessions that ask to be restored.

Records are in memory, and by option in a file that outlives the server. The file is mapped into
memory, so that a record costs microseconds and survives a kill of the process; a power cut may lose
the last ones. Each session has a slot with two copies, written in turn, each with a checksum: a
kill during a write leaves the other copy valid. All space is reserved at the start, because a disk
that fills up later would kill the server at its next write to the mapped memory.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import struct
import zlib
from logging import WARNING
from pathlib import Path
from typing import Self

import msgspec
import numpy as np

from handmap_qp.errors import InvalidInputError, RefusedError
from handmap_qp.service.caps import MOST_SESSIONS
from handmap_qp.service.logs import report

_MAGIC = b"handmap_qp postures 1\n"
"""Start of the file; the number is the version of the layout."""
_HEAD = struct.Struct("<IIQ")
"""Length and CRC-32 of a record, and the number of the write."""
_COPY = 4096
_SLOTS = MOST_SESSIONS
# The first block holds the magic.
_SIZE = (1 + 2 * _SLOTS) * _COPY


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a session left its robot.

    Attributes:
        name: Name of the session.
        robot: Name of the robot hand.
        q: Joint angles last commanded [rad].
        wrist: Pose of the wrist row by row, 16 numbers; None if it was not known.
        epoch: Epoch of the last command.
        is_released: Whether a client had released the robot.
        stop: Number of the emergency stop in force; 0 for none.
        owner: Its owner, see `Caller.owner`.
    """

    name: str
    robot: str
    q: tuple[float, ...]
    wrist: tuple[float, ...] | None
    epoch: int
    is_released: bool = False
    stop: int = 0
    owner: str = ""

    @property
    def posture(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Joint angles (n,) [rad] and pose of the wrist (4, 4)."""
        return np.array(self.q), None if self.wrist is None else np.array(self.wrist).reshape(4, 4)


class PostureStore:
    """Records by session name, in `records`.

    Args:
        path: The file, made if it does not exist, for one server at a time; None for memory alone.

    Raises:
        InvalidInputError: If the file cannot be used, is another kind of file, or is in use.
    """

    def __init__(self, path: Path | None) -> None:
        self.records: dict[str, Record] = {}
        self._memory: mmap.mmap | None = None
        if path is not None:
            self._open(path)

    def _open(self, path: Path) -> None:
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise InvalidInputError(
                argument=str(path), problem=f"cannot be used: {error.strerror}"
            ) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._reserve(path)
            self._memory = mmap.mmap(self._file, _SIZE)
        except OSError as error:
            os.close(self._file)
            reason = (
                "another server uses it" if isinstance(error, BlockingIOError) else error.strerror
            )
            raise InvalidInputError(argument=str(path), problem=str(reason)) from error
        except InvalidInputError:
            os.close(self._file)
            raise
        self._encode, self._decode = (
            msgspec.msgpack.Encoder().encode,
            msgspec.msgpack.Decoder(Record).decode,
        )
        self._slots: dict[str, int] = {}
        self._written = [0] * _SLOTS
        self._writes = 0
        if damaged := self._load(self._memory):
            report(WARNING, "state_damaged", file=str(path), postures_lost=damaged)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _reserve(self, path: Path) -> None:
        """Initialise a new file and reserve its space; leave other kinds of files unchanged."""
        size = os.fstat(self._file).st_size
        if size and os.pread(self._file, len(_MAGIC), 0) != _MAGIC:
            raise InvalidInputError(
                argument=str(path),
                expected=f"a state file of handmap ({_MAGIC.decode().strip()!r})",
                got="another file",
            )
        try:
            # In this order, a kill in between leaves a file that the next start accepts.
            os.pwrite(self._file, _MAGIC, 0)
            os.posix_fallocate(self._file, 0, _SIZE)
        except OSError as error:
            os.ftruncate(self._file, size)
            raise InvalidInputError(
                argument=str(path),
                problem=f"expected room for {_SIZE} bytes: {error.strerror}",
            ) from error

    @property
    def is_persistent(self) -> bool:
        """Whether records are in a file, where they outlive the server."""
        return self._memory is not None

    def note(self, record: Record) -> None:
        """Keep a record in place of an earlier one of the same session."""
        # Least recently updated first: the one to evict.
        self.records.pop(record.name, None)
        self.records[record.name] = record
        if self._memory is not None:
            self._write(self._memory, record)
        elif len(self.records) > _SLOTS:
            del self.records[next(iter(self.records))]

    def _write(self, memory: mmap.mmap, record: Record) -> None:
        payload = self._encode(record)
        if len(payload) > _COPY - _HEAD.size:
            return
        slot = self._slots.get(record.name)
        if slot is None:
            slot = self._free_slot()
            self._slots[record.name] = slot
        self._writes += 1
        self._written[slot] = self._writes
        first, second = (_HEAD.unpack_from(memory, start)[2] for start in _copies(slot))
        start = _copies(slot)[second < first]
        memory[start + _HEAD.size : start + _HEAD.size + len(payload)] = payload
        _HEAD.pack_into(memory, start, len(payload), zlib.crc32(payload), self._writes)

    def find(self, name: str, robot: str, joints: int) -> Record | None:
        """Return the record of the last session of a name, if there is one.

        Raises:
            RefusedError: If it is of another robot.
        """
        record = self.records.get(name)
        if record is None:
            return None
        if record.robot != robot or len(record.q) != joints:
            raise RefusedError(
                "invalid",
                f"the last session {name!r} moved {record.robot}, not {robot}",
                field="restore",
            )
        return record

    def close(self) -> None:
        """Write the file and release its lock."""
        if self._memory is not None:
            self._memory.flush()
            self._memory.close()
            os.close(self._file)

    def _free_slot(self) -> int:
        """Return an unused slot, or that of the least recently updated name."""
        slot = min(range(_SLOTS), key=lambda i: self._written[i])
        for name in [name for name, used in self._slots.items() if used == slot]:
            del self._slots[name]
            self.records.pop(name, None)
        return slot

    def _load(self, memory: mmap.mmap) -> int:
        """Read the newest valid copy of each slot, and the newest slot of each name.

        Returns:
            The number of slots that were written and have no valid copy.
        """
        found = {slot: self._read(memory, slot) for slot in range(_SLOTS) if _is_used(memory, slot)}
        whole = [(*read, slot) for slot, read in found.items() if read is not None]
        for write, record, slot in sorted(whole, key=lambda each: each[0]):
            self._written[slot] = self._writes = write
            self._slots[record.name], self.records[record.name] = slot, record
        return sum(read is None for read in found.values())

    def _read(self, memory: mmap.mmap, slot: int) -> tuple[int, Record] | None:
        """Return the number of the last write to a slot and its record; None if none is valid."""
        newest = None
        for copy in _copies(slot):
            length, checksum, write = _HEAD.unpack_from(memory, copy)
            payload = memory[
                copy + _HEAD.size : copy + _HEAD.size + min(length, _COPY - _HEAD.size)
            ]
            if (
                length == 0
                or zlib.crc32(payload) != checksum
                or (newest is not None and write <= newest[0])
            ):
                continue
            with contextlib.suppress(msgspec.MsgspecError):
                newest = write, self._decode(payload)
        return newest


def _copies(slot: int) -> tuple[int, int]:
    """Return the offsets of the two copies of a slot."""
    start = (1 + 2 * slot) * _COPY
    return start, start + _COPY


def _is_used(memory: mmap.mmap, slot: int) -> bool:
    """Return whether a slot was ever written; the head of a copy is written last."""
    return any(any(memory[copy : copy + _HEAD.size]) for copy in _copies(slot))
