"""The page for headsets in a `Browser`, with an emulated headset."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from browser import Browser
from live_cases import moving_hand

from handmap_core.human.recording import sample_columns
from handmap_qp.apps.service.server import Server
from handmap_qp.trackers.layouts.tables import load_layout

EMULATION = Path(__file__, "../../live/xr_emulation.js").resolve().read_text("utf-8")
"""The headset, a script to run before those of the page."""
TOKEN = "a-token-of-the-tests"
RATE = 30.0
"""Frames of the headset [Hz]."""
LAYOUT = load_layout("webxr25")


def webxr_joints(side: str) -> np.ndarray:
    """Return the 25 joints of a moving hand for each sample [m], shape (T, 25, 3)."""
    samples = [each for each in sample_columns(moving_hand(40, side)) if each.valid]
    return np.round([LAYOUT.write(each)[:, :3] for each in samples], 5)


def open_page(
    browser: Browser,
    server: Server,
    *,
    more: str = "",
    token: str = TOKEN,
    words: str = "?right=allegro_right&left=three_finger",
) -> None:
    """Load the page with an emulated headset, changed by `more` before the page's own script."""
    browser.open("about:blank")
    added = browser.call("Page.addScriptToEvaluateOnNewDocument", source=more)[
        "identifier"
    ]
    browser.open(f"http://127.0.0.1:{server.ports['web']}/{words}#token={token}")
    browser.wait_for("document.querySelector('#left .state')?.textContent")
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added)


def text(browser: Browser, selector: str) -> str:
    return browser.evaluate(
        f"document.querySelector({json.dumps(selector)}).textContent"
    )


def wait_for_text(browser: Browser, selector: str, part: str) -> None:
    query = f"document.querySelector({json.dumps(selector)}).textContent"
    browser.wait_for(f"{query}.includes({json.dumps(part)})")


def show_hands(browser: Browser, *sides: str) -> None:
    """Let the emulated headset see moving hands, to and fro without jumps."""
    joints = {side: webxr_joints(side).tolist() for side in sides}
    browser.evaluate(
        f"window.joints = {json.dumps(joints)}; window.sample = 0; emulated.hands = {{}};"
        "emulated.beforeFrame = () => { sample += 1; for (const side in joints)"
        " emulated.hands[side] = joints[side][Math.abs(sample % 76 - 38)]; }; 0"
    )


def start(browser: Browser, server: Server, **choices: Any) -> None:
    open_page(browser, server, **choices)
    browser.evaluate(f"emulated.rate = {RATE}; 0")
    wait_for_text(browser, "#state", "Ready")
    browser.click_on("#start-vr")
    wait_for_text(browser, "#state", "Waiting for hands")
