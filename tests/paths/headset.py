"""A person with a headset, emulated in Chromium: opens the page and moves the right hand.

The hand is the right one of the recording that comes with the package.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from browser import Browser
from paths.fresh import Fresh

from handmap_core.human.recording import sample_columns
from handmap_qp import read_recording
from handmap_qp.trackers.layouts.tables import load_layout

EMULATION = Path(__file__).parents[1] / "live" / "xr_emulation.js"
# A headset has the service's clock: without what the tests of the page ask for.
_OWN_CLOCK = "\nWebSocket.prototype.send = send;\n"
_FOLLOWED = '["converged", "limited", "unsettled", "unreachable"]'
"""Statuses of a robot that follows."""
RATE = 30.0
"""Pictures that the emulated headset takes in a second."""


def headset_joints() -> list[list[list[float]]]:
    """Return the 25 joints of a hand as a headset gives them [m], for each sample."""
    layout = load_layout("webxr25")
    samples = [
        each for each in sample_columns(read_recording("demo", "right")) if each.valid
    ]
    return np.round([layout.write(each)[:, :3] for each in samples], 5).tolist()


def says(selector: str, words: str) -> str:
    """Return the expression of whether an element of the page says some words."""
    found = f"document.querySelector({json.dumps(selector)})?.textContent"
    return f"{found}?.includes({json.dumps(words)})"


def lead_by_headset(path: Fresh, browser: Browser, address: str) -> None:
    """Open the page, start the headset, and stream the right hand, to and fro.

    Args:
        path: The path, which times it.
        browser: The browser, with no page yet.
        address: Address of the page.
    """
    with path.step(f"the page in a headset's browser: {address}"):
        source = EMULATION.read_text(encoding="utf-8") + _OWN_CLOCK
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=source)
        browser.open(address)
        browser.wait_for(says("#state", "Ready"))
        browser.evaluate(f"emulated.rate = {RATE}; 0")
        # A person's click: without one, no browser starts a headset.
        browser.click_on("#start-vr")
        browser.wait_for(says("#state", "Waiting for hands"))
        # To and fro, because a jump from the end to the start is none of a person's.
        browser.evaluate(
            f"window.joints = {json.dumps(headset_joints())}; window.sample = 0;"
            "emulated.beforeFrame = () => { const last = joints.length - 1; sample += 1;"
            " emulated.hands.right = joints[Math.abs((sample + last) % (2 * last) - last)];"
            " }; 0"
        )
        browser.wait_for(says("#right .state", "streaming"))
        # After the hand is measured, on a busy machine much later.
        browser.wait_for(
            f"{_FOLLOWED}.includes(document.querySelector('#right .robot').textContent)"
        )
