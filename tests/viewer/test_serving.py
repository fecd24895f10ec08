"""The view's server accepts its own page, and clients that are not pages."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

import viser
from patience import PATIENCE, wait_until
from websockets.asyncio import server as websocket_server
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from handmap_qp import InvalidInputError
from handmap_qp.apps.viewer.serving import is_own_page, serving


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    with serving() as running:
        yield running


@pytest.mark.parametrize(
    ("origin", "is_accepted"),
    [
        (None, True),
        ("http://127.0.0.1:{port}", True),
        ("https://somewhere.example", False),
        ("http://127.0.0.1:1", False),
        ("null", False),
    ],
)
def test_pages_of_other_sites_are_refused(
    server: Any, origin: str | None, is_accepted: bool
) -> None:
    port, page = server.get_port(), Subprotocol(f"viser-v{viser.__version__}")
    said = None if origin is None else Origin(origin.format(port=port))

    def open_connection() -> None:
        with connect(
            f"ws://127.0.0.1:{port}", origin=said, subprotocols=[page], max_size=None
        ) as connection:
            connection.recv(timeout=PATIENCE)

    if is_accepted:
        open_connection()
        wait_until(lambda: not server.get_clients())
    else:
        with pytest.raises(InvalidStatus, match="403"):
            open_connection()


@pytest.mark.parametrize(
    ("name", "status"), [("localhost", 200), ("somewhere.example", 403)]
)
def test_foreign_host_names_are_refused_on_loopback(
    server: Any, name: str, status: int
) -> None:
    connection = http.client.HTTPConnection(
        "127.0.0.1", server.get_port(), timeout=PATIENCE
    )
    connection.request("GET", "/", headers={"Host": f"{name}:{server.get_port()}"})
    assert connection.getresponse().status == status
    connection.close()


@pytest.mark.parametrize(
    ("host", "asked", "origins", "expected"),
    [
        ("127.0.0.1", "localhost:9000", ["http://localhost:9000"], True),
        ("::1", "[::1]:8080", ["http://[::1]:8080"], True),
        ("127.0.0.1", "", [], False),
        ("127.0.0.1", "[::1:8080", [], False),
        ("0.0.0.0", "lab-pc:8080", ["http://lab-pc:8080"], True),
        ("0.0.0.0", "lab-pc:8080", ["http://somewhere.example"], False),
        (
            "127.0.0.1",
            "localhost:8080",
            ["http://localhost:8080", "https://somewhere.example"],
            False,
        ),
    ],
)
def test_own_page_is_told_by_host_and_origin(
    host: str, asked: str, origins: list[str], expected: bool
) -> None:
    assert is_own_page(host, asked, origins) is expected


def test_websockets_is_restored_after_starting(server: Any) -> None:
    assert websocket_server.serve.__module__.startswith("websockets")
    with (
        pytest.raises(InvalidInputError, match="cannot listen on"),
        serving("192.0.2.1"),
    ):
        pass
    assert websocket_server.serve.__module__.startswith("websockets")
