"""A LEAP hand and a Quest: from the wheel to commands, with the page for headsets.

The headset is emulated in Chromium (`tests/live/xr_emulation.js`); its hand is the right one of the
recording that comes with the package.
"""

from __future__ import annotations

import json
import urllib.request
from pathlib import Path

import numpy as np
from browser import Browser, find_chromium
from paths.fresh import Fresh, stop

from handmap_core.human.recording import sample_columns
from handmap_qp import read_recording
from handmap_qp.trackers.layouts.tables import load_layout

ROBOT = "leap_right"
EMULATION = Path(__file__).parents[1] / "live" / "xr_emulation.js"


def headset_joints() -> list[list[list[float]]]:
    """Return the 25 joints of a hand as a headset gives them [m], for each sample."""
    layout = load_layout("webxr25")
    samples = [
        each for each in sample_columns(read_recording("demo", "right")) if each.valid
    ]
    return np.round([layout.write(each)[:, :3] for each in samples], 5).tolist()


def stream_from_page(path: Fresh, ports: dict[str, int], program: str) -> None:
    """Open the page in a browser with an emulated headset, and follow its session."""
    joints = json.dumps(headset_joints())
    state = "document.querySelector({})?.textContent.includes({})".format
    with Browser(program, size=(1100, 1000)) as browser:
        with path.step(f"the page in a headset's browser, ?right={ROBOT}"):
            source = EMULATION.read_text(encoding="utf-8")
            browser.call("Page.addScriptToEvaluateOnNewDocument", source=source)
            browser.open(f"http://127.0.0.1:{ports['web']}/?right={ROBOT}&left=")
            browser.wait_for(state("'#state'", "'Ready'"))
            # A click of a person's, without which no browser starts a headset.
            place = browser.evaluate(
                "(() => { emulated.rate = 30; const button = document.querySelector('#start-vr');"
                "button.scrollIntoView({block: 'center'});"
                "const box = button.getBoundingClientRect();"
                "return [box.x + box.width / 2, box.y + box.height / 2]; })()"
            )
            browser.click(*place)
            browser.wait_for(state("'#state'", "'Waiting for hands'"))
            browser.evaluate(
                f"window.joints = {joints}; window.sample = 0; emulated.hands = {{}};"
                "setInterval(() => { emulated.hands.right = joints[sample % joints.length];"
                " sample += 1; }, 33); 0"
            )
            browser.wait_for(state("'#right .state'", "'streaming'"))
        path.watch(ports, "webxr-right")


def main() -> None:
    """Go the path."""
    with Fresh("LEAP and a Quest", "plot", "view", "service") as path:
        path.handmap("demo")
        path.handmap("hands", "show", ROBOT)
        with path.serving("--web", "--web-port", "0") as ports:
            with path.step("the page for headsets is served"):
                address = f"http://127.0.0.1:{ports['web']}/"
                with urllib.request.urlopen(address, timeout=30.0) as page:
                    if b"start-vr" not in page.read():
                        stop("the service's page is another one")
            if program := find_chromium():
                stream_from_page(path, ports, program)
            else:
                path.leave_out("the page in a browser", "no Chromium on the path")
            to = f"127.0.0.1:{ports['requests']}"
            replay = ("track", "replay", "demo", "--loop", "--to", to, "--robot", ROBOT)
            with path.running(*replay, "--session", "replay"):
                path.watch(ports, "replay")
        path.leave_out("a headset of a maker", "none is here")


if __name__ == "__main__":
    main()
