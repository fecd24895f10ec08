"""The page of hands, made once for all tests of it, and opened in Chromium."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path

import pytest
from browser import Browser, QuietHandler, find_chromium
from wasm_library import PACKAGE, compiled_library

HANDS = ("allegro_right", "three_finger")


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the page with two hands; skip where it cannot be made."""
    wasm = compiled_library()
    target = tmp_path_factory.mktemp("playground") / "page"
    command = [sys.executable, PACKAGE / "pack.py", target, "--wasm", wasm]
    done = subprocess.run(
        [*command, "--hands", *HANDS],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    if "cannot be fetched" in done.stderr:
        pytest.skip("needs npm's registry, or its archives in build/npm")
    assert done.returncode == 0, done.stderr[-2000:]
    return target


@pytest.fixture(scope="session")
def address(folder: Path) -> Iterator[str]:
    handler = partial(QuietHandler, directory=folder)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.fixture(scope="session")
def page(address: str) -> Iterator[Browser]:
    program = find_chromium()
    if program is None:
        pytest.skip("needs Chromium")
    with Browser(program, size=(640, 420)) as browser:
        browser.open(address)
        browser.wait_for("document.body && document.body.dataset.frames > 0")
        yield browser
        assert not browser.errors
