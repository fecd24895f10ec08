"""The frame loop that the views of a recording and of a running mapping share."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

FRAME_PERIOD = 1.0 / 30.0
"""Least time between two frames [s]."""
GAUGES_PERIOD = 0.1
"""Least time between two updates of plots and joint bars [s]; they cost more than poses."""
# Largest time step passed to a frame [s]: playback pauses while a long recording is mapped.
_LONGEST_STEP = 0.2


class Throttle:
    """Limit how often something is done.

    Args:
        period: Least time between two calls of `is_due` that return True [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._last = -float("inf")

    def is_due(self) -> bool:
        """Return whether the period has passed, and if so start the next one."""
        now = time.monotonic()
        if now - self._last < self._period:
            return False
        self._last = now
        return True


def run_frames(draw: Callable[[float], None], is_over: Callable[[], bool] = lambda: False) -> None:
    """Draw frames at most 30 times a second.

    Args:
        draw: Draws one frame; called with the time since the previous one [s], at most 0.2.
        is_over: Checked before each frame; ends the loop.
    """
    before = time.monotonic()
    while not is_over():
        now = time.monotonic()
        with skip_wakeup_race():
            draw(min(now - before, _LONGEST_STEP))
        before = now
        time.sleep(max(0.0, FRAME_PERIOD - (time.monotonic() - now)))


@contextlib.contextmanager
def skip_wakeup_race() -> Iterator[None]:
    """Drop a frame in which viser's wake-up fails; the next frame draws the same state.

    viser 1.1 wakes its own thread with an `asyncio.Event` that it sets in the calling thread. If
    that thread starts to wait at the same moment, `set` fails because its list of waiters changes.
    By then the update itself has been queued.
    """
    try:
        yield
    except RuntimeError as error:
        if "mutated during iteration" not in str(error):
            raise
