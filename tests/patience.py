"""How the tests wait for other threads and processes: as long as it takes, and no longer."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

PATIENCE = 30.0
"""More than anything takes that works at all [s], also on a busy machine."""
T = TypeVar("T")


def wait_until(
    see: Callable[[], T | None], complaint: str = "nothing happens", patience: float = PATIENCE
) -> T:
    """Look again and again for what others are to bring about.

    Args:
        see: Looks; what it gives is true once it is there.
        complaint: What to say if it does not come.
        patience: How long to look [s].

    Returns:
        What was seen.
    """
    end = time.monotonic() + patience
    while not (seen := see()):
        assert time.monotonic() < end, complaint
        time.sleep(0.005)
    return seen
