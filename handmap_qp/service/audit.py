"""The audit log: who opened, changed, stopped and closed which session, one JSON line each.

Each line has `time` (UTC, ISO 8601), `event`, `session`, `by` and the data of the event. `by` is
`NAME@ADDRESS` of an admitted client, its address where connections are not encrypted, or `server`.
The file is only appended to. A flood of events is cut: one line then says how many were left out.
"""

from __future__ import annotations

import json
import os
import time
from datetime import UTC, datetime
from logging import ERROR
from pathlib import Path
from typing import Any

from handmap_qp.errors import InvalidInputError
from handmap_qp.service.caps import Bucket
from handmap_qp.service.logs import report
from handmap_qp.service.states import Caller

_RATE, _BURST = 20.0, 400.0
"""Lines per second, and at once."""


class AuditLog:
    """Writes the audit log.

    Args:
        path: The file, made if it does not exist, readable for its owner only; None for none.

    Raises:
        InvalidInputError: If the file cannot be written.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._file = -1
        self._bucket, self._omitted = Bucket(_RATE, time.monotonic(), _BURST), 0
        if path is not None:
            try:
                flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
                self._file = os.open(path, flags, 0o600)
            except OSError as error:
                problem = f"cannot be written: {error.strerror}"
                raise InvalidInputError(argument=str(path), problem=problem) from error

    def note(self, event: str, by: Caller | str, *, session: str = "", **data: Any) -> None:
        """Write one event.

        Without a file, nothing is written. An emergency stop is never left out.

        Args:
            event: `started`, `opened`, `configure`, `clutch`, `release`, `reset`, `stop`, `clear`,
                `closed` or `ended`.
            by: Who caused it.
            session: Public name of the session; empty for the server as a whole.
            **data: What else is to be kept.
        """
        if self._file < 0:
            return
        if not (self._bucket.take(time.monotonic()) or event == "stop"):
            self._omitted += 1
            return
        if self._omitted:
            omitted, self._omitted = self._omitted, 0
            self._write({"event": "omitted", "count": omitted})
        self._write({"event": event, "session": session, "by": str(by), **data})

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _write(self, entry: dict[str, Any]) -> None:
        stamp = datetime.now(UTC).isoformat(timespec="microseconds")
        line = json.dumps({"time": stamp, **entry}, default=str) + "\n"
        try:
            # One write per line: lines of a process that is killed are whole.
            os.write(self._file, line.encode())
        except OSError as error:
            report(ERROR, "audit_unwritten", error=error.strerror, entry=entry)
