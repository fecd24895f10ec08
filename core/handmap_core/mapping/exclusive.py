"""One thread at a time works on a mapper: another one gets an error at once.

The compiled core maps recordings without the interpreter's lock, and a mapper has one motion: two
threads on it would write into each other's numbers. To let them wait would hide that, and give
commands that belong to neither.
"""

import threading
from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, Protocol, TypeVar

from handmap_core.errors import MapperBusyError

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class WorkLock:
    """Lets one thread at a time in; the same thread may enter again. A copy is free.

    Attributes:
        lock: What a thread holds while it works.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()

    def __reduce__(self) -> tuple[type["WorkLock"], tuple[()]]:
        return WorkLock, ()


class HasWork(Protocol):
    """What one thread at a time works on."""

    work: WorkLock


Owner = TypeVar("Owner", bound=HasWork)


def exclusively(
    method: Callable[Concatenate[Owner, Arguments], Result],
) -> Callable[Concatenate[Owner, Arguments], Result]:
    """Let a method of an object raise `MapperBusyError` while another thread works on the object.

    Args:
        method: The method, whose object has a `WorkLock`.
    """

    @wraps(method)
    def call(self: Owner, *values: Arguments.args, **named: Arguments.kwargs) -> Result:
        lock = self.work.lock
        if not lock.acquire(blocking=False):
            raise MapperBusyError
        try:
            return method(self, *values, **named)
        finally:
            lock.release()

    return call
