"""What each process of a server does at its start, the server's own and the workers'."""

import asyncio
import gc
import importlib
import sys
from collections.abc import Callable, Coroutine

from .load import TimedSelector

_SWITCH_INTERVAL = 5e-4
"""Interval after which a thread that loads a hand yields to the one that answers [s]."""


def run_timed(serve: Callable[[TimedSelector], Coroutine[None, None, None]]) -> None:
    """Run an event loop whose selector adds up the time in which there is nothing to do.

    Args:
        serve: What runs in the loop.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL)
    selector = TimedSelector()
    # `asyncio.run` would make a selector of its own.
    with asyncio.Runner(
        loop_factory=lambda: asyncio.SelectorEventLoop(selector)
    ) as runner:
        runner.run(serve(selector))


def import_early() -> None:
    """Import what the first hand with meshes would, which delays running sessions."""
    importlib.import_module("scipy.spatial")


def keep_objects() -> None:
    """Exclude the objects that exist now from garbage collection: they stay."""
    gc.collect()
    gc.freeze()
