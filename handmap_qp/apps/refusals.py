"""What the system refuses, such as a port or a file, as errors of arguments."""

from collections.abc import Iterator
from contextlib import contextmanager

from handmap_core.errors import InvalidInputError, reason_of


@contextmanager
def naming(argument: object = "", problem: str = "", **more: str) -> Iterator[None]:
    """Raise what the system refuses as an error of an argument.

    Args:
        argument: Name of the argument, or the file; that of the system's error if omitted.
        problem: What cannot be done, before the system's reason.
        **more: Further fields of the error.

    Raises:
        InvalidInputError: In place of OSError.
    """
    try:
        yield
    except OSError as error:
        reason = ": ".join(filter(None, (problem, reason_of(error))))
        raise InvalidInputError(
            reason, argument=str(argument or error.filename), **more
        ) from error
