"""Records of where sessions left their robots, for sessions that ask to be restored.

Records are in memory, and by option in a database (SQLite) that outlives the server. Each is
written before its command leaves, without waiting for the disk: it survives a kill of the process,
and a power cut may damage the file. A server does not start with a damaged file, so that nobody
overlooks that emergency stops are lost. A single record that cannot be read counts as stopped.

Names are counted for each owner, so that one client cannot push out the records of others: see
`PostureStore`.
"""

import sqlite3
import time
from itertools import islice
from logging import ERROR, WARNING
from pathlib import Path
from typing import Self

import msgspec
import numpy as np

from handmap_core.errors import InvalidInputError, RefusedError, reason_of
from handmap_core.se3 import Array
from .fairness import largest_account
from .logs import Throttle, report
from .settings import MOST_SESSIONS

Posture = tuple[Array, Array | None]
"""Joint angles (n,) [rad] and the pose of the wrist (4, 4), None if it is not known."""
_KIND = 0x686D7170
"""Identifies the database as one of the service."""
_LARGEST = 4096
"""Bytes of a record to reserve."""
MOST_NAMES = MOST_SESSIONS
"""Names of one owner that are kept: all sessions that it may have open."""
MOST_RECORDS = 8 * MOST_NAMES
"""Names of all owners that are kept."""
# One server at a time; no waiting for the disk; the log starts again before it grows.
_SETTINGS = """
    PRAGMA locking_mode = EXCLUSIVE; PRAGMA journal_mode = WAL; PRAGMA synchronous = OFF;
    PRAGMA wal_autocheckpoint = 100
"""
_WRITE = "INSERT OR REPLACE INTO postures (name, record) VALUES (?, ?)"


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a session left its robot.

    Attributes:
        name: Name of the session.
        robot: Name of the robot hand; empty for a record that could not be read.
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
    def posture(self) -> Posture:
        """Where the robot was left."""
        wrist = np.reshape(self.wrist, (4, 4)) if self.wrist else None
        return np.array(self.q), wrist

    @property
    def account(self) -> str:
        """Whose names this one is counted with, see `names_account`."""
        return names_account(self.owner)


def _lost(name: str) -> Record:
    """Return what stands for a record that cannot be read: nobody knows whether it was stopped.

    It has no robot and no posture, but an emergency stop, which somebody must clear.
    """
    # A number that no session has had; see `Session.stop`.
    return Record(name, "", (), None, 0, stop=time.time_ns() // 1000)


def names_account(owner: str) -> str:
    """Return whose names a session is counted with: its owner's key; without keys, all are one.

    Secrets do not tell owners apart, because a client may make as many as it likes.

    Args:
        owner: Owner of the session; empty if its record is older than owners.
    """
    return owner if owner.startswith("key:") else ""


class PostureStore:
    """Records by session name.

    The least recently updated record of an owner that has more than `MOST_NAMES` is evicted. If
    there are more than `MOST_RECORDS` in all, it is one of the owner that has most. A record with
    an emergency stop in force is never evicted; `Sessions` bounds their number when sessions are
    opened.

    Args:
        path: The file, made if it does not exist, for one server at a time; None for memory alone.

    Attributes:
        records: The records by name, the least recently updated first.
        is_persistent: Whether they are in a file, where they outlive the server.

    Raises:
        InvalidInputError: If the file cannot be used, is another kind of file, or is in use.
    """

    def __init__(self, path: Path | None) -> None:
        self.records: dict[str, Record] = {}
        # Names by account, the least recently updated first.
        self._names: dict[str, dict[str, None]] = {}
        self.is_persistent = path is not None
        self._database = None
        self._failures = Throttle()
        if path:
            try:
                # Only the owner may read it.
                path.touch(0o600)
                self._database = database = sqlite3.connect(
                    path, timeout=0.0, isolation_level=None, check_same_thread=False
                )
                _prepare(database)
                # In the order of their last updates.
                query = "SELECT name, record FROM postures ORDER BY rowid"
                rows = database.execute(query).fetchall()
            except (OSError, sqlite3.Error) as error:
                self.close()
                raise _unusable(path, error) from error
            damaged = 0
            for name, encoded in rows:
                try:
                    record = msgspec.msgpack.decode(encoded, type=Record)
                except msgspec.MsgspecError:
                    damaged += 1
                    record = _lost(name)
                self._keep(record, name)
            if damaged:
                report(WARNING, "state_damaged", file=str(path), postures_lost=damaged)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def note(self, record: Record) -> None:
        """Keep a record in place of an earlier one of the same session."""
        self._keep(record, record.name)
        evicted = self._evict(record.account)
        if not self._database:
            return
        try:
            self._database.execute(
                _WRITE, (record.name, msgspec.msgpack.encode(record))
            )
            for name in evicted:
                self._database.execute("DELETE FROM postures WHERE name = ?", (name,))
        except sqlite3.Error as error:
            self._failures.report(ERROR, "state_unwritten", error=str(error))

    def find(self, name: str, robot: str, joints: int) -> Record | None:
        """Return the record of the last session of a name, if there is one that can be read.

        Raises:
            RefusedError: If it is of another robot.
        """
        record = self.records.get(name)
        if record and not record.robot:
            return None
        if record and (record.robot != robot or len(record.q) != joints):
            raise RefusedError(
                "invalid",
                f"the last session {name!r} moved {record.robot}, not {robot}",
                field="restore",
            )
        return record

    def stopped(self, account: str) -> set[str]:
        """Return the names of an account with an emergency stop in force."""
        names = self._names.get(account, {})
        return {name for name in names if self.records[name].stop}

    def close(self) -> None:
        """Write the file and release its lock."""
        if self._database:
            self._database.close()

    def _keep(self, record: Record, name: str) -> None:
        """Keep a record under a name, as the last one to be evicted."""
        self._forget(name)
        self.records[name] = record
        self._names.setdefault(record.account, {})[name] = None

    def _forget(self, name: str) -> None:
        """Remove the record of a name, if there is one."""
        if record := self.records.pop(name, None):
            names = self._names[record.account]
            del names[name]
            if not names:
                del self._names[record.account]

    def _evict(self, account: str) -> list[str]:
        """Forget a name if an account, or all together, have more than they may.

        Returns:
            The names that were forgotten.
        """
        evicted: list[str] = []
        if len(self._names[account]) > MOST_NAMES:
            evicted = self._oldest(account)
        elif len(self.records) > MOST_RECORDS:
            free = [each.account for each in self.records.values() if not each.stop]
            evicted = self._oldest(largest_account(free)) if free else []
        for name in evicted:
            self._forget(name)
        return evicted

    def _oldest(self, account: str) -> list[str]:
        """Return the least recently updated name of an account, unless all have stops."""
        free = (name for name in self._names[account] if not self.records[name].stop)
        return [*islice(free, 1)]


def _prepare(database: sqlite3.Connection) -> None:
    """Reserve the space of a database of records; leave other kinds of files unchanged."""
    (kind,) = database.execute("PRAGMA application_id").fetchone()
    # A start that failed leaves a database without tables.
    if kind != _KIND and database.execute("SELECT name FROM sqlite_master").fetchone():
        raise sqlite3.DatabaseError
    database.executescript(_SETTINGS)
    database.execute("BEGIN IMMEDIATE")
    database.execute(f"PRAGMA application_id = {_KIND}")
    database.execute(
        "CREATE TABLE IF NOT EXISTS postures (name TEXT UNIQUE, record BLOB)"
    )
    # A disk that fills up later must not lose postures: pages of rows that are deleted are used
    # again, in the database and in its log.
    unused = [(f" {i}", bytes(_LARGEST)) for i in range(MOST_RECORDS)]
    database.executemany(_WRITE, unused)
    database.execute("DELETE FROM postures WHERE name LIKE ' %'")
    database.execute("COMMIT")


def _unusable(path: Path, error: OSError | sqlite3.Error) -> InvalidInputError:
    """Return why a file cannot be used for records."""
    problem = f"cannot be used: {reason_of(error)}"
    if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_BUSY:
        problem = "another server uses it"
    if not isinstance(error, OSError | sqlite3.OperationalError):
        return InvalidInputError(
            argument=str(path),
            expected="a state file of handmap",
            got="another, a damaged or a former one",
            advice="name another file, and stop again what must not move",
        )
    return InvalidInputError(problem, argument=str(path))
