"""Waiting for other threads and processes, with a generous timeout."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

PATIENCE = 180.0
"""Timeout that no working operation exceeds, also where ten programs share a processor [s]."""
T = TypeVar("T")


def wait_until(
    see: Callable[[], T | None],
    complaint: str | Callable[[], str] = "nothing happens",
    patience: float = PATIENCE,
) -> T:
    """Poll until a condition holds.

    Args:
        see: Returns a true value once the condition holds.
        complaint: Message of the assertion error at the timeout, or what returns it then.
        patience: Timeout [s].

    Returns:
        The value that `see` returned.
    """
    end = time.monotonic() + patience
    while not (seen := see()):
        is_over = time.monotonic() >= end
        assert not is_over, complaint if isinstance(complaint, str) else complaint()
        time.sleep(0.005)
    return seen


@contextmanager
def kept_going(act: Callable[[], object], period: float = 0.2) -> Iterator[None]:
    """Call a function repeatedly in a thread.

    Args:
        act: The function.
        period: Time between two calls [s].
    """
    is_over = threading.Event()

    def keep_going() -> None:
        while not is_over.wait(period):
            act()

    thread = threading.Thread(target=keep_going)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
