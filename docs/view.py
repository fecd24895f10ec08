"""Draw the pictures of docs/view.md in a headless Chromium: `python docs/view.py`.

Needs the extras `robots` and `view`, pillow, and Chromium (`HANDMAP_CHROMIUM` names another one).
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent / "tests" / "support"))

from browser import Browser, find_chromium  # noqa: E402
from PIL import Image  # noqa: E402

from handmap_qp.apps.viewer.cli import View  # noqa: E402
from handmap_qp.apps.viewer.replay import ReplayViewer  # noqa: E402
from handmap_qp.apps.viewer.serving import serving  # noqa: E402

ROBOT, RECORDING = "allegro_right", Path("demo")
FRAME = 1.0 / 30.0
CLOSE_NOTES = (
    "[...document.querySelectorAll('.mantine-Notification-closeButton')]"
    ".forEach(e => e.click())"
)


def main() -> None:
    """Draw all pictures."""
    program = find_chromium()
    if program is None:
        raise SystemExit("no Chromium: install it, or name one in HANDMAP_CHROMIUM")
    view = View(RECORDING, ROBOT, compare="paper")
    replay = view.replay(RECORDING, ROBOT)
    with serving() as server, Browser(program, (1440, 900)) as browser:
        viewer = ReplayViewer(server, replay)
        viewer.display.trails.value = viewer.display.landmarks.value = True
        play_to(viewer, 7.9)
        stop = keep_drawing(viewer)
        browser.open(f"http://127.0.0.1:{server.get_port()}")
        shoot(browser, "view.png", (1440, 900))
        viewer.display.trails.value = viewer.display.landmarks.value = False
        shoot(browser, "view_800.png", (800, 600))
        stop()
        with tempfile.TemporaryDirectory() as folder:
            page = Path(folder) / "page.html"
            page.write_bytes(replay.page())
            browser.resize(1000, 800)
            browser.open(page.as_uri(), offline=True)
            browser.wait_for("!!document.querySelector('[role=slider]')")
            time.sleep(10.0)
            browser.press("Space", 32)
            shoot(browser, "view_page.png", (1000, 800))


def play_to(viewer: ReplayViewer, end: float) -> None:
    """Play to a time [s], and pause there."""
    while viewer.play_bar.time < end:
        viewer.tick(FRAME)
    viewer.play_bar.toggle()
    viewer.tick(0.0)


def keep_drawing(viewer: ReplayViewer) -> Callable[[], None]:
    """Draw frames in a thread until the function that is returned is called."""
    is_over = threading.Event()

    def draw() -> None:
        while not is_over.wait(0.1):
            viewer.tick(FRAME)

    thread = threading.Thread(target=draw, daemon=True)
    thread.start()

    def stop() -> None:
        is_over.set()
        thread.join()

    return stop


def shoot(browser: Browser, name: str, size: tuple[int, int]) -> None:
    """Save the page with 256 colours once it has settled."""
    browser.resize(*size)
    browser.wait_for("!!document.querySelector('canvas')")
    pictures: list[bytes] = []
    while len(pictures) < 3 or len(set(pictures[-2:])) > 1:
        time.sleep(4.0)
        browser.evaluate(CLOSE_NOTES)
        pictures.append(browser.screenshot()[0])
        if len(pictures) > 12:
            break
    image = (
        Image.open(BytesIO(pictures[-1]))
        .convert("RGB")
        .quantize(256, Image.Quantize.FASTOCTREE)
    )
    image.save(DOCS / "images" / name, optimize=True)
    print(
        f"wrote docs/images/{name}: {(DOCS / 'images' / name).stat().st_size / 1e3:.0f} kB"
    )


if __name__ == "__main__":
    main()
