"""Logs as JSON lines: one object per line, with `time`, `level`, `event` and the event's data.

The audit log says who opened, changed, stopped and closed which session. Its lines have `time`
(UTC, ISO 8601), `event`, `session`, `by` and the data of the event. `by` is `NAME@ADDRESS` of an
admitted client, its address where connections are not encrypted, or `server`. The file is only
appended to. A flood of events is cut: one line then says how many were left out.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from handmap_qp.apps.service.rate_limit import Bucket
from handmap_qp.apps.service.states import Caller
from handmap_qp.errors import InvalidInputError

log = logging.getLogger("handmap_qp.apps.service")
"""Logger of the service; `report` writes to it."""
websocket_log = logging.getLogger(f"{log.name}.websocket")
# Connections that send no handshake would fill the log with tracebacks.
websocket_log.setLevel(logging.CRITICAL)
_RATE, _BURST = 20.0, 400.0
"""Lines of the audit log per second, and at once."""


def report(
    level: int, event: str, *, failure: BaseException | None = None, **data: Any
) -> None:
    """Log an event with its data, and with the traceback of a failure."""
    log.log(level, event, exc_info=failure, extra={"data": data})


class JsonLines(logging.Formatter):
    """Format a record as one JSON object, which also escapes text from clients."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        line = {
            "time": round(record.created, 6),
            "level": record.levelname.lower(),
            "event": record.getMessage(),
        }
        line.update(getattr(record, "data", {}))
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def log_to_stderr(level: str) -> None:
    """Send the service's logs to stderr as JSON lines."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    log.handlers = [handler]
    log.propagate = False
    log.setLevel(level.upper())


class Throttle:
    """Pass one report per period, with the number of reports suppressed before it.

    Args:
        period: Shortest time between two reports [s].
    """

    def __init__(self, period: float = 1.0) -> None:
        self._period = period
        self._next = 0.0
        self._suppressed = 0

    def report(
        self,
        level: int,
        event: str,
        *,
        failure: BaseException | None = None,
        **data: Any,
    ) -> None:
        """Log an event, with the traceback of a failure; only count it within the period."""
        now = time.monotonic()
        if now < self._next:
            self._suppressed += 1
            return
        report(level, event, failure=failure, **data, swallowed=self._suppressed)
        self._next, self._suppressed = now + self._period, 0


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

    def note(
        self, event: str, by: Caller | str, *, session: str = "", **data: Any
    ) -> None:
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
            report(logging.ERROR, "audit_unwritten", error=error.strerror, entry=entry)
