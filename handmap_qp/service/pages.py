"""The page for a headset's browser, served beside the WebSocket; it makes no external requests."""

from __future__ import annotations

import http
from functools import cache
from pathlib import Path

from websockets.datastructures import Headers
from websockets.http11 import Request, Response

_FOLDER = Path(__file__).with_name("webxr")
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
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
    path = request.path.partition("?")[0]
    found = _files().get(path)
    if found is None:
        return _response(http.HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", b"not found\n")
    return _response(http.HTTPStatus.OK, *found)


@cache
def _files() -> dict[str, tuple[str, bytes]]:
    """Return type and content of every file of the page, by its path in requests."""
    files = {
        f"/{file.name}": (_TYPES[file.suffix], file.read_bytes())
        for file in sorted(_FOLDER.iterdir())
        if file.suffix in _TYPES
    }
    return files | {"/": files["/index.html"]}


def _response(status: http.HTTPStatus, kind: str, body: bytes) -> Response:
    headers = Headers(_HEADERS)
    headers["Content-Type"] = kind
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, body)
