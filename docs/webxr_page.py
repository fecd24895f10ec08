"""Draw the picture of the headset's page in docs/live.md: `python docs/webxr_page.py`.

An emulated headset shows two moving hands, and a driver says what the fingers of the right robot
feel. Needs the extras `robots` and `service`, pillow, and Chromium (`HANDMAP_CHROMIUM` names
another one).
"""

from __future__ import annotations

import sys
import tempfile
from io import BytesIO
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent / "tests" / "support"))

from browser import Browser, find_chromium  # noqa: E402
from patience import kept_going  # noqa: E402
from PIL import Image  # noqa: E402
from service_tools import WEB, client_of, serving, token_file  # noqa: E402
from webxr_pages import EMULATION, TOKEN, show_hands, start, wait_for_text  # noqa: E402

PICTURE = DOCS / "images" / "webxr_page.png"
FORCES = {"thumb": 3.2, "index": 2.4, "middle": 1.1, "ring": 0.0}
"""Contact forces that the right robot's fingers feel [N]."""
CLOCK = """
EmulatedFrame.prototype.getViewerPose = () => null;
const request = EmulatedSession.prototype.requestAnimationFrame;
EmulatedSession.prototype.requestAnimationFrame = function (draw) {
  request.call(this, (now, frame) => draw(performance.now(), frame));
};
"""
"""Gives frames the time of the page, for true delays, and draws nothing in the headset.

The emulated headset counts frames otherwise, and software rendering would hold them up.
"""
DELAY = 40
"""Longest delay of answers that the picture shows [ms]."""
_SIZE = (1000, 1180)


def main() -> None:
    """Draw the page while both hands stream."""
    program = find_chromium()
    if program is None:
        raise SystemExit("no Chromium: install it, or name one in HANDMAP_CHROMIUM")
    with tempfile.TemporaryDirectory() as folder:
        token = token_file(Path(folder), TOKEN)
        with (
            serving(**WEB, web_token_file=token, simulated_time=True) as server,
            Browser(program, _SIZE) as browser,
            client_of(server) as driver,
        ):
            browser.call("Page.addScriptToEvaluateOnNewDocument", source=EMULATION)
            words = "?right=allegro_right&left=leap_left"
            start(browser, server, words=words, more=CLOCK)
            show_hands(browser, "right", "left")
            for side in ("right", "left"):
                wait_for_text(browser, f"#{side} .state", "streaming")
            # The hands are measured first.
            browser.wait_for(
                "[...document.querySelectorAll('#robots .mode')]"
                ".filter((mode) => mode.textContent.startsWith('follows')).length == 2"
            )
            driver.watch("webxr-right")
            with kept_going(lambda: driver.touch(forces=FORCES), 0.05):
                browser.wait_for("!document.querySelector('#right .haptics').hidden")
                browser.evaluate("window.scrollTo(0, 0)")
                # The first shot waits until the page is drawn, and holds up its frames.
                browser.screenshot()
                browser.wait_for(
                    f"parseInt(document.querySelector('#right .delay').textContent) < {DELAY}"
                )
                png, _ = browser.screenshot()
    image = Image.open(BytesIO(png)).convert("RGB")
    image.quantize(256, Image.Quantize.FASTOCTREE).save(PICTURE, optimize=True)
    print(f"wrote docs/images/{PICTURE.name}: {PICTURE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
