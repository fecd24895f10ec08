"""The web server of the view, which only its own page may talk to."""

from __future__ import annotations

import contextlib
import http
import io
import socket
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from handmap_qp.addresses import is_loopback, names_loopback
from handmap_qp.errors import InvalidInputError, MissingExtraError

if TYPE_CHECKING:
    import viser


@contextlib.contextmanager
def serving(host: str = "127.0.0.1", port: int = 0) -> Iterator[viser.ViserServer]:
    """A viser server for as long as the block runs, without its banner, for its own page alone.

    Args:
        host: Address to listen on.
        port: Port; the next free one where it is taken, any free one for 0.

    Yields:
        The server, running in a thread of its own.

    Raises:
        InvalidInputError: If there is no such address on this machine.
        MissingExtraError: If viser is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingExtraError("viser", "view") from error
    if not host.strip():
        raise InvalidInputError(
            "--host: expected an address; nothing stands for all of this machine's", value=host
        )
    # viser takes every refusal for a port in use, and would try the next thousand without a word.
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise InvalidInputError(
            f"--host {host}: cannot be served on: {error.strerror or error}", value=host
        ) from error
    with _own_pages_only(host), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label="handmap view", verbose=False)
    server.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


@contextlib.contextmanager
def drawing() -> Iterator[None]:
    """While a picture is drawn: let it be where viser stumbles, for the next one.

    viser 1.1 wakes its own thread by an `asyncio.Event` that it sets in ours. If that thread begins
    to wait at the same moment, `set` finds its list of those who wait changed. What was to be drawn
    has been noted by then.
    """
    try:
        yield
    except RuntimeError as error:
        if "mutated during iteration" not in str(error):
            raise


@contextlib.contextmanager
def _own_pages_only(host: str) -> Iterator[None]:
    """While a viser server starts.

    Let it take connections from the page that it serves, and from no other.

    A page that some web site has put into the user's browser reaches loopback too, and could press
    the view's buttons. viser takes all that comes and has no setting for it, so that the check goes
    in where it starts listening.
    """
    from websockets.asyncio import server as listener

    serve = listener.serve

    def serve_own_pages(handler: Any, *where: Any, process_request: Any, **settings: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if is_own_page(
                host, request.headers.get("Host", ""), request.headers.get_all("Origin")
            ):
                return process_request(connection, request)
            return connection.respond(
                http.HTTPStatus.FORBIDDEN, "pages of other sites may not use the view\n"
            )

        return serve(handler, *where, process_request=check, **settings)

    listener.serve = serve_own_pages  # type: ignore[assignment]
    try:
        yield
    finally:
        listener.serve = serve  # type: ignore[misc]


def is_own_page(host: str, asked: str, origins: list[str]) -> bool:
    """Whether a request comes from the page that this server gave out, or from no page at all.

    Args:
        host: Address that the server listens on.
        asked: The request's `Host`, which on loopback has to be a name of that.
        origins: Its `Origin`, which browsers set and pages cannot.
    """
    return (names_loopback(asked) or not is_loopback(host)) and all(
        urlsplit(origin).netloc == asked for origin in origins
    )
