"""Counters of the service in Prometheus' text format."""

from __future__ import annotations

import resource
import sys
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import accumulate
from pathlib import Path

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)

BUCKETS = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 5e-2)
"""Upper edges of the histogram of step times [s]."""
_COUNTERS = {
    "requests": "Messages received.",
    "steps": "Samples mapped.",
    "replaced": "Streamed samples replaced by a newer one before they were mapped.",
    "watchdog": "Holds that the watchdog started.",
    "opened": "Sessions opened.",
    "dropped": "Replies lost by slow readers.",
}
_GAUGES = {
    "sessions": "Open sessions.",
    "lag_seconds": "Longest delay of the event loop in the last second [s].",
    "busy_seconds": "Longest CPU time of the process between two turns of its event loop in the "
    "last second [s].",
    "resident_bytes": "Resident memory of the process.",
    "uptime_seconds": "Time since the start [s].",
}


class Metrics:
    """Counters, gauges and a histogram of step times."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.refusals: Counter[str] = Counter()
        self.gauges: dict[str, Callable[[], float]] = {"resident_bytes": resident_bytes}
        self._step_counts, self._step_total = [0] * (len(BUCKETS) + 1), 0.0
        self._registry = CollectorRegistry()
        self._registry.register(self)

    def observe_step(self, seconds: float) -> None:
        """Count a step and its time [s]."""
        self.counts["steps"] += 1
        self._step_counts[bisect_left(BUCKETS, seconds)] += 1
        self._step_total += seconds

    def collect(self) -> Iterator[Metric]:
        """Yield all values; the registry asks for them."""
        for name, about in _COUNTERS.items():
            yield CounterMetricFamily(f"handmap_{name}", about, self.counts[name])
        about = "Messages refused, by code; also failed handshakes."
        refusals = CounterMetricFamily("handmap_refusals", about, labels=["code"])
        for code, count in sorted(self.refusals.items()):
            refusals.add_metric([code], count)
        yield refusals
        for name, gauge in self.gauges.items():
            yield GaugeMetricFamily(f"handmap_{name}", _GAUGES[name], gauge())
        steps = zip(
            map(str, (*BUCKETS, "+Inf")), accumulate(self._step_counts), strict=True
        )
        about = "Time from a sample to its command [s]."
        yield HistogramMetricFamily(
            "handmap_step_seconds", about, list(steps), self._step_total
        )

    def render(self) -> str:
        """Return all values in the text format 0.0.4."""
        return generate_latest(self._registry).decode()


def resident_bytes() -> float:
    """Return the resident memory of this process; its peak if the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * resource.getpagesize()
    except (OSError, ValueError, IndexError):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak * (1 if sys.platform == "darwin" else 1024)
