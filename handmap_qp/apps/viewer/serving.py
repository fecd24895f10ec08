"""The web server of the view, which accepts its own page only, and the loop that draws frames."""

import http
import io
import socket
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from handmap_core.errors import expect, require
from handmap_qp.apps.addresses import is_loopback, names_loopback, url_host
from handmap_qp.apps.refusals import naming

if TYPE_CHECKING:
    from viser import ViserServer
else:
    ViserServer = Any
    """Type of the server, for annotations: viser is imported when it is used."""

FRAME_PERIOD = 1.0 / 30.0
"""Least time between two frames [s]."""
# Largest time step passed to a frame [s]: playback pauses while a long recording is mapped.
_LONGEST_STEP = 0.2


@contextmanager
def serving(host: str = "127.0.0.1", port: int = 0) -> Iterator[ViserServer]:
    """Run a viser server while the block runs; it prints no banner and refuses foreign pages.

    Args:
        host: Address to listen on.
        port: Port; the next free one if it is taken; 0 takes any free port.

    Yields:
        The server, running in a thread of its own.

    Raises:
        InvalidInputError: If the host is empty or no address of this machine.
        MissingExtraError: If viser is not installed.
    """
    make_server = require("viser", "view").ViserServer
    advice = "an empty host would listen on all interfaces"
    expect(host.strip(), "--host", "an address", value=host, advice=advice)
    # viser treats every bind error as a port in use and silently tries the next thousand, so bind
    # once here to report the real reason.
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with (
        naming("--host", f"cannot listen on {host}", value=host),
        socket.socket(family) as probe,
    ):
        probe.bind((host, 0))
    with _own_pages_only(host), redirect_stdout(io.StringIO()):
        server = make_server(host=host, port=port, label="handmap view", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    try:
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


@contextmanager
def showing(host: str, port: int, *, opens: bool) -> Iterator[ViserServer]:
    """Serve until Ctrl-C, as `serving`; print the address, and open the browser if requested."""
    with serving(host, port) as server:
        address = f"http://{url_host(server.get_host())}:{server.get_port()}"
        print(f"open {address} in a browser (Ctrl-C ends the view)", flush=True)
        if opens:
            webbrowser.open(address)
        with suppress(KeyboardInterrupt):
            yield server


@contextmanager
def _own_pages_only(host: str) -> Iterator[None]:
    """Make a viser server that starts in this block accept its own page only.

    Any page in the browser could press the view's buttons: wrap the `serve` that viser calls.
    """
    from websockets.asyncio import server as websocket_server

    serve = websocket_server.serve

    def serve_own_pages(
        handler: Any, *where: Any, process_request: Any, **settings: Any
    ) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if is_own_page(
                host, request.headers.get("Host", ""), request.headers.get_all("Origin")
            ):
                return process_request(connection, request)
            return connection.respond(
                http.HTTPStatus.FORBIDDEN, "pages of other sites cannot use the view\n"
            )

        return serve(handler, *where, process_request=check, **settings)

    websocket_server.serve = serve_own_pages  # ty: ignore[invalid-assignment]
    try:
        yield
    finally:
        websocket_server.serve = serve


def is_own_page(host: str, requested: str, origins: list[str]) -> bool:
    """Return whether a request comes from the page of this server, or from no page at all.

    Args:
        host: Address that the server listens on.
        requested: `Host` header; on loopback it must name loopback.
        origins: `Origin` headers; browsers set them and pages cannot change them.
    """
    return (names_loopback(requested) or not is_loopback(host)) and all(
        urlsplit(origin).netloc == requested for origin in origins
    )


def run_frames(
    draw: Callable[[float], None], is_over: Callable[[], bool] = lambda: False
) -> None:
    """Draw frames at most 30 times a second.

    Args:
        draw: Draws one frame; called with the time since the previous one [s], at most 0.2.
        is_over: Checked before each frame; ends the loop.
    """
    before = time.monotonic()
    while not is_over():
        now = time.monotonic()
        with skip_wakeup_race():
            draw(min(now - before, _LONGEST_STEP))
        before = now
        time.sleep(max(0.0, FRAME_PERIOD - (time.monotonic() - now)))


@contextmanager
def skip_wakeup_race() -> Iterator[None]:
    """Drop a frame in which viser's wake-up fails; the next frame draws the same state.

    viser 1.1 wakes its own thread with an `asyncio.Event` that it sets in the calling thread. If
    that thread starts to wait at the same moment, `set` fails because its list of waiters changes.
    By then the update itself has been queued.
    """
    try:
        yield
    except RuntimeError as error:
        if "mutated during iteration" not in str(error):
            raise
