"""Failures of the mapping service, reported as errors of the options of a command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from handmap_qp.errors import HandmapError, InvalidInputError, MissingExtraError

try:
    import zmq

    from handmap_qp.client import ServiceError, ServiceTimeoutError
except ModuleNotFoundError as missing:
    raise MissingExtraError(str(missing.name), "service") from missing

TIMEOUT = 3.0
"""Longest wait for an answer of the service [s]."""


@contextmanager
def reported_as(option: str, address: str, *, refused: str) -> Iterator[None]:
    """Report a failure of a block that calls the service as an error of an option.

    Args:
        option: The option that names the service.
        address: Address of the service.
        refused: The option at fault if the service refuses the request.

    Raises:
        InvalidInputError: If the service cannot be reached or refuses the request.
    """
    try:
        yield
    except HandmapError:
        # Names its option already.
        raise
    except ServiceTimeoutError as error:
        raise InvalidInputError(
            argument=option,
            problem=f"no service answers at {address}",
            advice="start one with handmap serve",
        ) from error
    except ServiceError as error:
        raise InvalidInputError(
            argument=refused, problem=f"the service refused the session: {error}"
        ) from error
    except (zmq.ZMQError, OSError, ValueError) as error:
        raise InvalidInputError(argument=option, problem=str(error)) from error
