"""What the service answers to HTTP requests: the page for a headset's browser, metrics and health.

The page makes no external requests.
"""

import json
from collections.abc import Callable
from functools import cache
from http import HTTPStatus
from pathlib import Path

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from handmap_qp.apps.addresses import names_loopback
from handmap_qp.hands import Values
from .logs import Metrics, websocket_log

_FOLDER = Path(__file__).with_name("webxr")
_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".json": "application/json",
}
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Permissions-Policy": "xr-spatial-tracking=(self)",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
}
_READ_TIMEOUT = 2.0


def page_response(request: Request) -> Response | None:
    """Answer a request of a browser for the page or one of its files.

    The files are the same for everyone and hold no secrets, so they need no token.

    Args:
        request: A request; None is returned for a handshake of a WebSocket.

    Returns:
        The file, or 404 where there is none.
    """
    if "Upgrade" in request.headers:
        return None
    found = _files().get(request.path.partition("?")[0])
    if found is None:
        return _response(HTTPStatus.NOT_FOUND, b"not found\n")
    return _response(HTTPStatus.OK, *found)


async def serve_metrics(
    port: int,
    metrics: Metrics,
    health: Callable[[], Values],
) -> Server:
    """Answer `GET /metrics`, and `GET /health` as JSON.

    Args:
        port: Port at 127.0.0.1; 0 lets the system choose.
        metrics: The counters.
        health: Returns the result of the health check; its `status` is `ok` or an error.
    """

    def respond(_: ServerConnection, request: Request) -> Response:
        # Prevent DNS rebinding: an attacker's name that resolves to 127.0.0.1 in a browser.
        if not all(map(names_loopback, request.headers.get_all("Host"))):
            return _response(HTTPStatus.MISDIRECTED_REQUEST, b"ask for localhost\n")
        path = request.path.partition("?")[0]
        if path == "/metrics":
            kind = "text/plain; version=0.0.4; charset=utf-8"
            return _response(HTTPStatus.OK, metrics.render().encode(), kind)
        if path == "/health":
            state = health()
            is_well = state["status"] == "ok"
            status = HTTPStatus.OK if is_well else HTTPStatus.SERVICE_UNAVAILABLE
            return _response(status, json.dumps(state).encode(), "application/json")
        return _response(HTTPStatus.NOT_FOUND, b"there are /metrics and /health\n")

    async def never(_: ServerConnection) -> None:
        """Serve no WebSocket, because every request has a response."""

    return await serve(
        never,
        "127.0.0.1",
        port,
        process_request=respond,
        logger=websocket_log,
        compression=None,
        open_timeout=_READ_TIMEOUT,
    )


@cache
def _files() -> dict[str, tuple[bytes, str]]:
    """Return content and type of every file of the page, by its path in requests."""
    files = {
        f"/{file.name}": (file.read_bytes(), f"{_TYPES[file.suffix]}; charset=utf-8")
        for file in _FOLDER.iterdir()
        if file.suffix in _TYPES
    }
    return files | {"/": files["/index.html"]}


def _response(
    status: HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8"
) -> Response:
    own = {
        "Content-Type": kind,
        "Content-Length": str(len(body)),
        "Connection": "close",
    }
    return Response(status.value, status.phrase, Headers(_HEADERS | own), body)
