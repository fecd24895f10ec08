"""Draw the picture of `handmap hands edit` in docs/own_hand.md: `python docs/edit_picture.py`.

Needs the extras `robots`, `view` and `plot`, pillow, and Chromium (`HANDMAP_CHROMIUM` names another
one).
"""

from __future__ import annotations

import sys
import tempfile
from io import BytesIO
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent / "tests" / "support"))

from browser import Browser, find_chromium  # noqa: E402
from edit_page import Page  # noqa: E402
from patience import kept_going, wait_until  # noqa: E402
from PIL import Image  # noqa: E402
from view import CLOSE_NOTES  # noqa: E402

from handmap_qp.apps.onboarding.edit import open_description  # noqa: E402
from handmap_qp.apps.onboarding.editor import HandEditor  # noqa: E402
from handmap_qp.apps.viewer.serving import serving  # noqa: E402

HAND = "allegro_right"
PICTURE = DOCS / "images" / "edit.webp"
_SIZE = (1440, 926)
_WIDTH = 1008  # of the picture [pixel]


def main() -> None:
    """Draw the page with its gestures, and with two palms to choose from."""
    program = find_chromium()
    if program is None:
        raise SystemExit("no Chromium: install it, or name one in HANDMAP_CHROMIUM")
    with (
        serving() as server,
        Browser(program, _SIZE) as browser,
        tempfile.TemporaryDirectory() as folder,
    ):
        out = Path(folder) / "mine.yaml"
        editor = HandEditor(server, open_description(HAND), out)
        with kept_going(editor.tick, 0.05):
            browser.open(f"http://127.0.0.1:{server.get_port()}")
            Page(browser).press("Choose the palm by pictures")
            wait_until(lambda: editor.gestures.question is not None)
            browser.wait_for("document.body.innerText.includes('The left one')")
            browser.evaluate(CLOSE_NOTES)
            # The first shot waits until the hand is drawn.
            browser.screenshot()
            png, _ = browser.screenshot()
    page = Image.open(BytesIO(png)).convert("RGB")
    height = round(_WIDTH * page.height / page.width)
    page.resize((_WIDTH, height), Image.Resampling.LANCZOS).save(PICTURE, quality=80)
    print(f"wrote docs/images/{PICTURE.name}: {PICTURE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
