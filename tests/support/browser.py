"""A headless Chromium for the tests of the view, controlled by its DevTools protocol."""

from __future__ import annotations

import base64
import inspect
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from http.server import SimpleHTTPRequestHandler
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from patience import wait_until

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
)

FRAME = 0.5
"""Time between two frames of a page [s].

Software draws a frame of hands in tens of milliseconds on all cores, and a page asks for the next
one at once.
"""
# The browser calls back when it can draw. A page that draws by a timer alone gets ahead of it on a
# busy machine, and a screenshot waits behind all frames that are not drawn yet.
_SELDOM = f"""
(() => {{
    const request = window.requestAnimationFrame.bind(window);
    window.requestAnimationFrame = (draw) =>
        setTimeout(() => request(draw), {1e3 * FRAME:g});
    window.cancelAnimationFrame = clearTimeout;
}})();
"""
DRAWING = 180.0
"""Timeout for a page rendered in software on a busy machine [s]."""


def find_chromium() -> str | None:
    """Return the browser named by `HANDMAP_CHROMIUM`, or one on the path."""
    named = os.environ.get("HANDMAP_CHROMIUM")
    return named or next(
        filter(
            None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))
        ),
        None,
    )


def light_simply(server: Any) -> None:
    """Leave out the environment map and the shadows of a `viser.ViserServer`: hands are darker.

    Without them, software rendering takes a third of the time to load a page.
    """
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(cast_shadow=False)


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves the files of a folder, and prints nothing."""

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of a request."""


class Browser:
    """One page of a headless Chromium; a context manager.

    Args:
        program: The browser's executable.
        size: Width and height of the page [px].
        draws_seldom: Whether the page draws every `FRAME` only.
    """

    def __init__(
        self,
        program: str,
        size: tuple[int, int] = (1400, 900),
        *,
        draws_seldom: bool = True,
    ) -> None:
        self._program = program
        self._size = size
        self._draws_seldom = draws_seldom

    def __enter__(self) -> Browser:
        """Start the browser."""
        self._folder = tempfile.mkdtemp(prefix="chromium-")
        size = f"--window-size={self._size[0]},{self._size[1]}"
        words = [
            self._program,
            *FLAGS,
            size,
            f"--user-data-dir={self._folder}",
            "about:blank",
        ]
        self._process = subprocess.Popen(
            words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            self._attach(Path(self._folder) / "DevToolsActivePort")
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the browser and remove its files."""
        self._socket.close()
        self._end()

    def _attach(self, port_file: Path) -> None:
        """Open a page and attach to it."""
        from websockets.sync.client import connect

        # Before websockets 15 there is no proxy to leave out, and nothing is pinged. On a busy
        # machine a browser may take long to answer a ping.
        is_new = "proxy" in inspect.signature(connect).parameters
        settings: dict[str, Any] = (
            {"proxy": None, "ping_interval": None} if is_new else {}
        )
        self._wait(
            lambda: port_file.is_file() and port_file.read_text().count("\n") >= 1,
            "Chromium does not start",
        )
        port, path = port_file.read_text().split("\n")[:2]
        self._socket = connect(
            f"ws://127.0.0.1:{port}{path}",
            max_size=None,
            **settings,
        )
        self._number = 0
        self.errors: list[str] = []
        target = self._call("Target.createTarget", url="about:blank")
        attached = self._call(
            "Target.attachToTarget", targetId=target["targetId"], flatten=True
        )
        self._session = attached["sessionId"]
        for domain in ("Runtime", "Page", "Network"):
            self.call(f"{domain}.enable")
        if self._draws_seldom:
            self.call("Page.addScriptToEvaluateOnNewDocument", source=_SELDOM)
        self.resize(*self._size)

    def resize(self, width: int, height: int) -> None:
        """Resize the page [px]."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def open(self, address: str, *, offline: bool = False) -> None:
        """Load a page."""
        self.call(
            "Network.emulateNetworkConditions",
            offline=offline,
            latency=0,
            downloadThroughput=-1,
            uploadThroughput=-1,
        )
        self.call("Page.navigate", url=address)

    def evaluate(self, code: str) -> Any:
        """Return the value of a JavaScript expression in the page."""
        answer = self.call(
            "Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in answer:
            raise RuntimeError(
                answer["exceptionDetails"]
                .get("exception", {})
                .get("description", "exception in the page")
            )
        return answer["result"].get("value")

    def wait_for(self, code: str) -> None:
        """Wait until a JavaScript expression is true."""
        self._wait(
            lambda: bool(self.evaluate(code)), f"the page never satisfies {code}"
        )

    def press(self, key: str, code: int) -> None:
        """Press and release a key in the element that has the focus."""
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                code=key,
                windowsVirtualKeyCode=code,
            )

    def click(self, x: float, y: float) -> None:
        """Click with the left button."""
        for kind in ("mousePressed", "mouseReleased"):
            self.call(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="left",
                clickCount=1,
            )

    def click_on(self, selector: str) -> None:
        """Click in the middle of an element that is enabled, as a user does.

        The page may move the element after its place was read, so look whether the click reached
        it.

        Args:
            selector: Selector of the element, in CSS.
        """
        element = f"document.querySelector({json.dumps(selector)})"
        self.evaluate(
            "window.wasClicked = false;"
            f"{element}.addEventListener('click', () => {{ window.wasClicked = true; }},"
            " { capture: true, once: true }); 0"
        )

        def is_clicked() -> bool:
            if self.evaluate(f"{element}.disabled"):
                return False
            x, y = self.evaluate(
                f"(() => {{ const element = {element};"
                "element.scrollIntoView({block: 'center'});"
                "const box = element.getBoundingClientRect();"
                "return [box.x + box.width / 2, box.y + box.height / 2]; })()"
            )
            self.click(x, y)
            return bool(self.evaluate("window.wasClicked"))

        self._wait(is_clicked, f"no click reaches {selector}")

    def screenshot(self) -> tuple[bytes, np.ndarray]:
        """Return the page as the bytes of a PNG file and as pixels, shape (height, width, 3)."""
        from PIL import Image

        png = base64.b64decode(
            self.call("Page.captureScreenshot", format="png")["data"]
        )
        return png, np.asarray(Image.open(BytesIO(png)).convert("RGB"))

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command of the DevTools protocol to the page."""
        return self._call(method, self._session, **parameters)

    def _call(
        self, method: str, session: str | None = None, **parameters: Any
    ) -> dict[str, Any]:
        self._number += 1
        message: dict[str, Any] = {
            "id": self._number,
            "method": method,
            "params": parameters,
        }
        if session is not None:
            message["sessionId"] = session
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=DRAWING))
            if answer.get("method") == "Runtime.exceptionThrown":
                self.errors.append(json.dumps(answer["params"])[:500])
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def _wait(self, is_done: Callable[[], bool], complaint: str) -> None:
        def is_done_or_dead() -> bool:
            assert self._process.poll() is None, complaint
            return is_done()

        wait_until(is_done_or_dead, complaint, DRAWING)

    def _end(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(timeout=10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)
