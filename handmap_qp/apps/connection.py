"""Connect to the mapping service, and find a session there to watch."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from handmap_core.errors import HandmapError, InvalidInputError, MissingExtraError
from .addresses import service_address

try:
    import msgspec
    import zmq

    from handmap_core.client import Client, KeyFiles, ServiceError, ServiceTimeoutError
except ModuleNotFoundError as missing:
    raise MissingExtraError(str(missing.name), "service") from missing

GONE = ServiceTimeoutError, zmq.ZMQError
"""Errors of a client whose service has gone."""
FAILURES = *GONE, ServiceError, msgspec.MsgspecError, OSError, ValueError, TypeError
"""Errors of a client whose service has gone, refuses a request or is another program."""
TIMEOUT = 3.0
"""Longest wait for an answer of the service [s]."""


@contextmanager
def connected(
    option: str, host: str, keys: KeyFiles | None, *, refused: str
) -> Iterator[Client]:
    """Connect to the service, and close the connection if the block fails.

    A failure of the service in the block is an error of an option.

    Args:
        option: The option that names the service.
        host: `HOST`, `HOST:PORT` or `tcp://HOST:PORT` of the service's requests.
        keys: Files `NAME.key_secret` and `server.key` of an encrypted service.
        refused: The option at fault if the service refuses the request.

    Yields:
        The client.

    Raises:
        InvalidInputError: If the service cannot be reached or refuses the request.
    """
    address = service_address(option, host)
    with ExitStack() as closing:
        try:
            client = Client(address, timeout=TIMEOUT, keys=keys)
            closing.callback(client.close)
            yield client
        except HandmapError:
            raise
        except ServiceTimeoutError as error:
            raise InvalidInputError(
                f"no service answers at {address}",
                argument=option,
                advice="start one with handmap serve",
            ) from error
        except ServiceError as error:
            problem = f"the service refused the session: {error}"
            raise InvalidInputError(problem, argument=refused) from error
        except FAILURES as error:
            raise InvalidInputError(str(error), argument=option) from error
        closing.pop_all()


def only_session(
    client: Client, session: str | None, argument: str = "--session"
) -> str:
    """Return the name of the session to watch: the given one, or the only open one, or empty.

    Args:
        client: A client of the service.
        session: The name that was given; None without one.
        argument: The argument that gives it.

    Raises:
        InvalidInputError: If several are open and none was given.
    """
    names = (session,) if session else client.status().names
    if len(names) > 1:
        raise InvalidInputError(
            f"several sessions are open: {', '.join(names)}",
            argument=argument,
            advice=f"name one as {argument}",
        )
    return "".join(names)
