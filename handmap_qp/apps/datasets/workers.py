"""Processes that work for a batch: what they do when they start, and calls with a time limit."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import TypeVar

from handmap_qp.errors import InvalidInputError

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

CONTEXT = multiprocessing.get_context("spawn")
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
"""Environment of a worker, read by its BLAS when it starts."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Give workers that start inside the block one thread each."""
    before = dict(os.environ)
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def start_worker() -> None:
    """Prepare a worker: it leaves Ctrl-C to its parent, and ends when the parent has died."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent has: it would wait for jobs for ever (CPython 111873)."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def time_limit(seconds: int) -> Iterator[None]:
    """End a worker whose block takes longer, as libhdf5 may; a kill is counted and tried again."""
    is_worker = multiprocessing.parent_process() is not None
    if is_worker:
        signal.alarm(seconds)
    try:
        yield
    finally:
        if is_worker:
            signal.alarm(0)


def no_start(count: int) -> InvalidInputError:
    """Return the error of workers that do not start: memory, or how a script starts processes."""
    return InvalidInputError(
        argument="--workers",
        expected="processes that start",
        got=f"{count} in a row that died before they began",
        advice="take fewer if memory is short, or 0 to map in this process; in a script, "
        "call it below `if __name__ == '__main__':`",
    )


def each_apart(
    call: Callable[[_Item], _Result], items: Sequence[_Item], patience: float
) -> list[_Result | None]:
    """Call a function on each item in a process of its own, which an item may crash or hold.

    Args:
        call: The function; it must not raise.
        items: What to call it on.
        patience: Longest time for one item [s].

    Returns:
        The results in order; None for an item on which the process died or took longer.

    Raises:
        InvalidInputError: If the process does not start.
    """
    found: list[_Result | None] = []
    while len(found) < len(items):
        results, theirs = CONTEXT.Pipe(duplex=False)
        rest = list(items[len(found) :])
        process = CONTEXT.Process(
            target=_call_each, args=(theirs, call, rest), daemon=True
        )
        with one_thread():
            process.start()
        theirs.close()
        try:
            results.recv()
        except EOFError:
            raise no_start(1) from None
        with suppress(EOFError):
            while len(found) < len(items) and results.poll(patience):
                found.append(results.recv())
        process.kill()
        process.join()
        results.close()
        if len(found) < len(items):
            found.append(None)
    return found


def _call_each(
    results: Connection, call: Callable[[_Item], _Result], items: Sequence[_Item]
) -> None:
    """Send a sign of life, then the result of each item."""
    start_worker()
    results.send(None)
    for item in items:
        results.send(call(item))
