"""Logs as JSON lines.

One object a line, with `time`, `level`, `event` and what belongs to the event.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from typing import Any

log = logging.getLogger("handmap_qp.service")
"""Where the service logs; `report` writes to it."""


def report(level: int, event: str, *, failure: BaseException | None = None, **data: Any) -> None:
    """Log an event with its data, and with the traceback of a failure."""
    log.log(level, event, exc_info=failure, extra={"data": data})


class JsonLines(logging.Formatter):
    """Formats a record as one JSON object; texts of clients are escaped by that."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
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
    """Lets one report through in a while, with the number of those that were swallowed before it.

    Args:
        period: Time between two [s].
    """

    def __init__(self, period: float = 1.0) -> None:
        self._period = period
        self._next = 0.0
        self._swallowed = 0

    def report(
        self, level: int, event: str, *, failure: BaseException | None = None, **data: Any
    ) -> None:
        """Log an event, with the traceback of a failure, or count it."""
        now = time.monotonic()
        if now < self._next:
            self._swallowed += 1
            return
        report(level, event, failure=failure, **data, swallowed=self._swallowed)
        self._next, self._swallowed = now + self._period, 0
