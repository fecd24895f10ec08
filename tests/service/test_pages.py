"""The page for headsets as the service sends it: its files, its headers, and nothing else."""

from __future__ import annotations

import http.client
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from service_tools import PATIENCE, WEB, serving, token_file

import handmap_qp.apps.service
from handmap_qp.apps.service.server import Server

FILES = Path(handmap_qp.apps.service.__file__).with_name("webxr")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    # The page itself needs no token: the page's connection does.
    token = token_file(tmp_path_factory.mktemp("token"), "a-token-of-the-tests")
    with serving(**WEB, web_token_file=token) as server:
        yield server


def get(server: Server, path: str) -> tuple[http.client.HTTPResponse, bytes]:
    connection = http.client.HTTPConnection(
        "127.0.0.1", server.ports["web"], timeout=PATIENCE
    )
    try:
        connection.request("GET", path)
        response = connection.getresponse()
        return response, response.read()
    finally:
        connection.close()


def test_every_file_is_served_with_its_type(server: Server) -> None:
    kinds = {
        ".html": "text/html",
        ".css": "text/css",
        ".js": "text/javascript",
        ".json": "application/json",
    }
    files = list(FILES.iterdir())
    assert {file.suffix for file in files} == set(kinds)
    for file in files:
        response, body = get(server, f"/{file.name}")
        assert response.status == 200
        assert body == file.read_bytes()
        assert (
            response.headers["Content-Type"] == f"{kinds[file.suffix]}; charset=utf-8"
        )
        assert "default-src 'none'" in response.headers["Content-Security-Policy"]
        assert response.headers["X-Content-Type-Options"] == "nosniff"
    assert (
        get(server, "/")[1]
        == get(server, "/?right=hey5")[1]
        == get(server, "/index.html")[1]
    )


@pytest.mark.parametrize(
    "path",
    [
        "/favicon.ico",
        "/../pages.py",
        "/%2e%2e/pages.py",
        "/page.js/",
        "//page.js",
        "/x" * 99,
    ],
)
def test_nothing_else_is_served(server: Server, path: str) -> None:
    response, body = get(server, path)
    assert response.status == 404
    assert body == b"not found\n"


def test_files_name_each_other_and_nothing_outside() -> None:
    names = {file.name for file in FILES.iterdir()}
    for file in FILES.iterdir():
        text = file.read_text(encoding="utf-8")
        assert (
            set(re.findall(r"""(?:from|src=|href=) ?["'](?:\./)?([^"']+)["']""", text))
            <= names
        )
        # Addresses in the page's advice name no host but localhost.
        assert set(re.findall(r"https?://(\w*)", text)) <= {"", "localhost"}
        assert "innerHTML" not in text
