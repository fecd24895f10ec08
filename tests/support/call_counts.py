"""Counts calls, which measure the cost of Python code exactly, whatever the load of the machine."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from types import FrameType


def count_calls(function: Callable[[], object]) -> int:
    """Count the calls that the interpreter makes while a function runs, in this thread.

    A call is what `sys.setprofile` reports as `call` (a Python function, a generator that goes on)
    or as `c_call` (a builtin, or a function or method of an extension module). What C and C++ call
    among themselves does not count, nor does the call of `function` itself. Garbage collection is
    paused, because finalizers of other objects would count too.

    Call the function once before, so that imports and caches of the process do not count. Use the
    result as an upper bound: versions of Python and numpy differ by a few calls.

    Args:
        function: What is measured.

    Returns:
        Number of calls.
    """
    calls = 0

    def note(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    was_collecting = gc.isenabled()
    gc.disable()
    previous = sys.getprofile()
    sys.setprofile(note)
    try:
        function()
    finally:
        sys.setprofile(previous)
        if was_collecting:
            gc.enable()
    # The call of the function itself, and that of `sys.setprofile`.
    return calls - 2
