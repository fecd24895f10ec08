"""Counters of the service, served over HTTP on loopback.

`/metrics` is in Prometheus' text format 0.0.4, `/health` is JSON.
"""

from __future__ import annotations

import asyncio
import json
import resource
import sys
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from handmap_qp.addresses import names_loopback

BUCKETS = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 5e-2)
"""Upper edges of the histogram of step times [s]."""
_HELP = {
    "requests": ("counter", "Messages received."),
    "steps": ("counter", "Samples mapped."),
    "replaced": ("counter", "Streamed samples replaced by a newer one before they were mapped."),
    "refusals": ("counter", "Messages refused, by code; also failed handshakes."),
    "watchdog": ("counter", "Holds that the watchdog started."),
    "opened": ("counter", "Sessions opened."),
    "dropped": ("counter", "Replies lost by slow readers."),
    "sessions": ("gauge", "Open sessions."),
    "lag_seconds": ("gauge", "Longest delay of the event loop in the last second [s]."),
    "busy_seconds": (
        "gauge",
        "Longest CPU time of the process between two turns of its event loop in the last second "
        "[s].",
    ),
    "resident_bytes": ("gauge", "Resident memory of the process."),
    "uptime_seconds": ("gauge", "Time since the start [s]."),
}
_MOST_CLIENTS = 16
_READ_TIMEOUT = 2.0


class Metrics:
    """Counters, gauges and a histogram of step times."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.refusals: Counter[str] = Counter()
        self.gauges: dict[str, Callable[[], float]] = {"resident_bytes": resident_bytes}
        self._step_counts = [0] * (len(BUCKETS) + 1)
        self._step_total = 0.0

    def observe_step(self, seconds: float) -> None:
        """Count a step and its time [s]."""
        self.counts["steps"] += 1
        self._step_counts[bisect_left(BUCKETS, seconds)] += 1
        self._step_total += seconds

    def render(self) -> str:
        """Return all values in Prometheus' text format."""
        lines = []
        for name, (kind, text) in _HELP.items():
            full = f"handmap_{name}" + ("_total" if kind == "counter" else "")
            lines += [f"# HELP {full} {text}", f"# TYPE {full} {kind}"]
            if name == "refusals":
                lines += [
                    f'{full}{{code="{code}"}} {count}'
                    for code, count in sorted(self.refusals.items())
                ]
            elif kind == "counter":
                lines.append(f"{full} {self.counts[name]}")
            elif name in self.gauges:
                lines.append(f"{full} {self.gauges[name]():.9g}")
        full = "handmap_step_seconds"
        lines += [
            f"# HELP {full} Time from a sample to its command [s].",
            f"# TYPE {full} histogram",
        ]
        total = 0
        for edge, count in zip((*map(str, BUCKETS), "+Inf"), self._step_counts, strict=True):
            total += count
            lines.append(f'{full}_bucket{{le="{edge}"}} {total}')
        lines += [f"{full}_sum {self._step_total:.9g}", f"{full}_count {total}"]
        return "\n".join(lines) + "\n"


def resident_bytes() -> float:
    """Return the resident memory of this process; its peak if the system does not report it."""
    try:
        return (
            int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
            * resource.getpagesize()
        )
    except (OSError, ValueError, IndexError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
            1 if sys.platform == "darwin" else 1024
        )


async def serve_metrics(
    host: str, port: int, metrics: Metrics, health: Callable[[], dict[str, Any]]
) -> asyncio.Server:
    """Answer `GET /metrics` and `GET /health`.

    Args:
        host: Loopback address to listen on.
        port: Port; 0 lets the system choose.
        metrics: The counters.
        health: Returns the result of the health check; its `status` is `ok` or an error.

    Returns:
        The listening server.
    """
    clients = 0

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal clients
        clients += 1
        try:
            if clients <= _MOST_CLIENTS:
                async with asyncio.timeout(_READ_TIMEOUT):
                    head = await reader.readuntil(b"\r\n\r\n")
                    writer.write(_response(head, metrics, health))
                    await writer.drain()
        except (
            TimeoutError,
            asyncio.IncompleteReadError,
            asyncio.LimitOverrunError,
            ConnectionError,
        ):
            pass
        finally:
            clients -= 1
            writer.close()

    return await asyncio.start_server(answer, host, port, limit=8192)


def _response(head: bytes, metrics: Metrics, health: Callable[[], dict[str, Any]]) -> bytes:
    method, _, rest = head.partition(b"\r\n")[0].partition(b" ")
    path = rest.partition(b" ")[0].partition(b"?")[0]
    if method != b"GET":
        return _page("405 Method Not Allowed", "text/plain", "GET only\n")
    if not _is_for_loopback(head):
        # Prevent DNS rebinding: an attacker's name that resolves to 127.0.0.1 in a browser.
        return _page("421 Misdirected Request", "text/plain", "ask for localhost\n")
    if path == b"/metrics":
        return _page("200 OK", "text/plain; version=0.0.4; charset=utf-8", metrics.render())
    if path == b"/health":
        state = health()
        return _page(
            "200 OK" if state["status"] == "ok" else "503 Service Unavailable",
            "application/json",
            json.dumps(state),
        )
    return _page("404 Not Found", "text/plain", "there are /metrics and /health\n")


def _is_for_loopback(head: bytes) -> bool:
    """Return whether the Host header, if there is one, names this machine."""
    for line in head.split(b"\r\n")[1:]:
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"host":
            return names_loopback(value.strip().decode("latin-1"))
    return True


def _page(status: str, kind: str, body: str) -> bytes:
    content = body.encode()
    lines = (
        f"HTTP/1.1 {status}",
        f"Content-Type: {kind}",
        f"Content-Length: {len(content)}",
        "Connection: close",
        "\r\n",
    )
    return "\r\n".join(lines).encode() + content
