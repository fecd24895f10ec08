"""What a timer of calls costs itself; for workers in any environment."""

from __future__ import annotations

import time


def timer_cost() -> int:
    """Return what two readings of the timer are apart with nothing between them [ns]."""
    found = []
    for _ in range(2001):
        started = time.thread_time_ns()
        found.append(time.thread_time_ns() - started)
    return sorted(found)[1000]
