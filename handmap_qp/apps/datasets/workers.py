"""Processes that work for a batch: what they do when they start, and calls with a time limit."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from handmap_core.errors import InvalidInputError

CONTEXT = multiprocessing.get_context("spawn")
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
"""Environment of a worker, read by its BLAS when it starts."""
MOST_STARTS = 10
"""Pools in a row whose first worker dies before it begins; after that, none is started."""


def start_worker() -> None:
    """Prepare a worker: it leaves Ctrl-C to its parent, and ends when the parent has died."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent has: it would wait for jobs for ever (CPython 111873)."""
    parent = multiprocessing.parent_process()
    if parent:
        parent.join()
        os._exit(1)


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """End a worker whose block takes longer, as libhdf5 may; a kill is counted and tried again."""
    is_worker = multiprocessing.parent_process() is not None
    if is_worker:
        signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        if is_worker:
            signal.setitimer(signal.ITIMER_REAL, 0.0)


@contextmanager
def started_pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """Start spawned workers with one thread each.

    Raises:
        InvalidInputError: If the first worker dies before it begins, several times in a row: memory
            is short, or a script starts processes without a guard.
    """
    before = dict(os.environ)
    os.environ.update(ONE_THREAD)
    try:
        for _ in range(MOST_STARTS):
            pool = ProcessPoolExecutor(
                count, mp_context=CONTEXT, initializer=start_worker
            )
            try:
                # One that dies here has no recording to blame.
                if not pool.submit(os.getpid).exception():
                    yield pool
                    return
            finally:
                pool.shutdown(cancel_futures=True)
    finally:
        os.environ.clear()
        os.environ.update(before)
    raise InvalidInputError(
        argument="--workers",
        expected="processes that start",
        got=f"{MOST_STARTS} in a row that died before they began",
        advice="take fewer if memory is short, or 0 to map in this process; in a script, "
        "call it below `if __name__ == '__main__':`",
    )


def each_apart(call: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """Call a function on each item in a process of its own, which an item may crash or hold.

    Args:
        call: The function; it must not raise. `time_limit` ends one that takes too long.
        items: What to call it on.

    Returns:
        The results in order; None for an item on which the process died.

    Raises:
        InvalidInputError: If the process does not start.
    """
    found = []
    while len(found) < len(items):
        with started_pool(1) as pool:
            try:
                for item in items[len(found) :]:
                    found.append(pool.submit(call, item).result())
            except BrokenProcessPool:
                found.append(None)
    return found
