"""What an operator sees of the service: logs, the audit log, and metrics.

Logs are JSON lines: one object per line, with `time`, `level`, `event` and the event's data.

The audit log says who opened, changed, stopped and closed which session. Its lines have `time`
(UTC, ISO 8601), `event`, `session`, `by` and the data of the event. `by` is `NAME@ADDRESS` of an
admitted client, its address where connections are not encrypted, or `server`. The file is only
appended to. A flood of events of one client is cut: one line then says how many were left out.
"""

import json
import logging
import os
import resource
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import accumulate
from pathlib import Path
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)

from handmap_qp.apps.refusals import naming
from .fairness import AccountBuckets
from .safety import Bucket

log = logging.getLogger("handmap_qp.apps.service")
"""Logger of the service; `report` writes to it."""
websocket_log = logging.getLogger(f"{log.name}.websocket")
# Connections that send no handshake would fill the log with tracebacks.
websocket_log.setLevel(logging.CRITICAL)
_RATE = 20.0
_BURST = 400.0
"""Lines of one client in the audit log per second, and at once."""
_BUCKETS = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 5e-2)
"""Upper edges of the histogram of step times [s]."""
_COUNTERS = {
    "requests": "Messages received.",
    "steps": "Samples mapped.",
    "replaced": "Streamed samples replaced by a newer one before they were mapped.",
    "watchdog": "Holds that the watchdog started.",
    "not_following": "Holds because joints did not follow.",
    "opened": "Sessions opened.",
    "dropped": "Replies lost by slow readers.",
    "workers_lost": "Worker processes that ended unasked.",
}
_GAUGES = {
    "sessions": "Open sessions.",
    "lag_seconds": "Longest delay of the event loop in its last 200 turns, 1 to 4 s [s].",
    "load": "Share of the last second in which the event loop worked; NaN if not measured.",
    "samples_per_second": "Samples mapped in the last second [1/s].",
    "wait_seconds": "Mean time that samples of the last second waited to be mapped [s].",
    "shed_sessions": "Sessions whose samples are answered busy.",
    "busy_seconds": "Longest CPU time of the process between two of these turns [s].",
    "workers": "Worker processes that serve.",
    "resident_bytes": "Resident memory of the process, and of its workers.",
    "uptime_seconds": "Time since the start [s].",
}


def report(
    level: int,
    event: str,
    *,
    failure: BaseException | None = None,
    **data: Any,
) -> None:
    """Log an event with its data, and with the traceback of a failure."""
    log.log(level, event, exc_info=failure, extra={"data": data})


class JsonLines(logging.Formatter):
    """Format a record as one JSON object, which also escapes text from clients.

    Args:
        **common: Data of each line.
    """

    def __init__(self, **common: Any) -> None:
        super().__init__()
        self._common = common

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        line = {
            "time": round(record.created, 6),
            "level": record.levelname.lower(),
            "event": record.getMessage(),
            **self._common,
        } | getattr(record, "data", {})
        if record.exc_info:
            line["error"] = repr(record.exc_info[1])
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


@contextmanager
def logs_on_stderr(level: str, **common: Any) -> Iterator[None]:
    """Write the service's logs to stderr as JSON lines, until the context ends.

    Args:
        level: Lowest level to log.
        **common: Data of each line.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines(**common))
    log.addHandler(handler)
    log.propagate = False
    log.setLevel(level.upper())
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.propagate = True
        log.setLevel(logging.NOTSET)


class Throttle(Bucket):
    """A rate limit of reports, which counts those left out."""

    _left_out = 0

    def report(self, level: int, event: str, **data: Any) -> None:
        """Log an event as `report`, with the number of those left out before it."""
        if not self.take():
            self._left_out += 1
            return
        report(level, event, **data, swallowed=self._left_out)
        self._left_out = 0


class AuditLog:
    """Writes the audit log.

    Args:
        path: The file, made if it does not exist, readable for its owner only; None for none.

    Raises:
        InvalidInputError: If the file cannot be written.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._file = -1
        # For each client, so that a flood hides no events of others.
        self._rates = AccountBuckets(_RATE, _BURST)
        self._omitted = 0
        if path:
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
            with naming(path, "cannot be written"):
                self._file = os.open(path, flags, 0o600)

    def note(self, event: str, by: object, *, session: str = "", **data: Any) -> None:
        """Write one event.

        Without a file, nothing is written. An emergency stop is never left out.

        Args:
            event: `started`, `opened`, `configure`, `engage`, `disengage`, `reset`, `stop`,
                `clear`, `closed` or `ended`; `clutch` or `release` if a client asked for it by its
                former name.
            by: Who caused it.
            session: Public name of the session; empty for the server as a whole.
            **data: What else is to be kept.
        """
        if self._file < 0:
            return
        client = str(by)
        if not (self._rates.take(client) or event == "stop"):
            self._omitted += 1
            return
        if self._omitted:
            self._write({"event": "omitted", "count": self._omitted})
            self._omitted = 0
        self._write({"event": event, "session": session, "by": client, **data})

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


@dataclass(frozen=True, slots=True)
class Numbers:
    """Counters of a process.

    Attributes:
        counts: Counts of what happened.
        refusals: Counts of refused messages by code.
        steps: Counts of step times by the buckets of the histogram.
        step_seconds: Sum of the step times [s].
    """

    counts: Counter[str] = field(default_factory=Counter)
    refusals: Counter[str] = field(default_factory=Counter)
    steps: tuple[int, ...] = (0,) * (len(_BUCKETS) + 1)
    step_seconds: float = 0.0

    def plus(self, other: "Numbers") -> "Numbers":
        """Return the sum of the counters of two processes."""
        pairs = zip(self.steps, other.steps, strict=True)
        return Numbers(
            self.counts + other.counts,
            self.refusals + other.refusals,
            tuple(one + two for one, two in pairs),
            self.step_seconds + other.step_seconds,
        )


class Metrics:
    """Counters, gauges and a histogram of step times, in Prometheus' text format.

    Attributes:
        counts: Counts of what happened.
        refusals: Counts of refused messages by code.
        gauges: Functions that return present values.
        others: Returns the counters of other processes, which are added to these; None for none.
    """

    def __init__(self) -> None:
        self.counts = Counter[str]()
        self.refusals = Counter[str]()
        self.gauges: dict[str, Callable[[], float]] = {"resident_bytes": resident_bytes}
        self.others: Callable[[], Numbers] | None = None
        self._registry = CollectorRegistry()
        self._registry.register(self)
        # A histogram of the package takes two locks and eight calls for each sample.
        self._steps = [0] * (len(_BUCKETS) + 1)
        self._step_seconds = 0.0

    def note_step(self, seconds: float) -> None:
        """Count the time from a sample to its command [s]."""
        self._steps[bisect_left(_BUCKETS, seconds)] += 1
        self._step_seconds += seconds

    @property
    def numbers(self) -> Numbers:
        """The counters, with those of other processes."""
        steps = tuple(self._steps)
        own = Numbers(self.counts, self.refusals, steps, self._step_seconds)
        return own.plus(self.others()) if self.others else own

    def collect(self) -> Iterator[Metric]:
        """Yield counters and gauges; the registry asks for them."""
        numbers = self.numbers
        for name, about in _COUNTERS.items():
            yield CounterMetricFamily(f"handmap_{name}", about, numbers.counts[name])
        about = "Messages refused, by code; also failed handshakes."
        refusals = CounterMetricFamily("handmap_refusals", about, labels=["code"])
        for code, count in sorted(numbers.refusals.items()):
            refusals.add_metric([code], count)
        yield refusals
        for name, gauge in self.gauges.items():
            yield GaugeMetricFamily(f"handmap_{name}", _GAUGES[name], gauge())
        edges = [*map(str, _BUCKETS), "+Inf"]
        yield HistogramMetricFamily(
            "handmap_step_seconds",
            "Time from a sample to its command [s].",
            list(zip(edges, accumulate(numbers.steps), strict=True)),
            numbers.step_seconds,
        )

    def render(self) -> str:
        """Return all values in the text format 0.0.4."""
        return generate_latest(self._registry).decode()


def resident_bytes() -> float:
    """Return the resident memory of this process (Linux)."""
    pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    return float(pages) * resource.getpagesize()
