"""The task that drives the watchdogs of a server, and measures the delay of its event loop."""

import asyncio
import time
from collections import deque
from collections.abc import Callable
from logging import ERROR, WARNING

from .logs import Throttle

TICK = 0.005
"""Least time between checks of the watchdogs [s]."""
_LONGEST = 0.02
"""Longest time between them, and between checks of the sockets [s]."""
_TICKS = 200
_LATE = 0.1
"""Checks that delays are measured over, and the delay of one that is logged [s]."""


class Watchdogs:
    """Drives the watchdogs.

    Args:
        tick: Runs the watchdogs; returns the time until one may act next [s].
    """

    def __init__(self, tick: Callable[[], float]) -> None:
        self._tick = tick
        self._lags = deque([0.0], _TICKS)
        self._loads = deque([0.0], _TICKS)
        self._bugs = Throttle()

    @property
    def lag(self) -> float:
        """Longest delay of the event loop in its last checks [s]."""
        return max(self._lags)

    @property
    def busy(self) -> float:
        """Longest CPU time of the process between two of them [s]."""
        return max(self._loads)

    async def run(self) -> None:
        """Run until cancelled."""
        spent = time.process_time()
        late = Throttle()
        pause = TICK
        while True:
            wanted = time.monotonic() + pause
            await asyncio.sleep(pause)
            lag = time.monotonic() - wanted
            before = spent
            spent = time.process_time()
            self._lags.append(max(0.0, lag))
            self._loads.append(spent - before)
            if lag > _LATE:
                late.report(WARNING, "late", seconds=round(lag, 4))
            pause = TICK
            try:
                # A turn of the event loop takes as long as a third of an answer.
                pause = min(max(TICK, self._tick()), _LONGEST)
            except Exception as error:
                self._bugs.report(ERROR, "failed", failure=error)
