"""Logs as JSON lines: one object per line, with `time`, `level`, `event` and the event's data."""

from __future__ import annotations

import json
import logging
import sys
import time
from typing import Any

log = logging.getLogger("handmap_qp.service")
"""Logger of the service; `report` writes to it."""


def report(level: int, event: str, *, failure: BaseException | None = None, **data: Any) -> None:
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
        self, level: int, event: str, *, failure: BaseException | None = None, **data: Any
    ) -> None:
        """Log an event, with the traceback of a failure; only count it within the period."""
        now = time.monotonic()
        if now < self._next:
            self._suppressed += 1
            return
        report(level, event, failure=failure, **data, swallowed=self._suppressed)
        self._next, self._suppressed = now + self._period, 0
