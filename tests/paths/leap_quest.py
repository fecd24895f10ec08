"""A LEAP hand and a Quest: from the wheel to commands, with the page for headsets."""

from __future__ import annotations

import urllib.request

from browser import Browser, find_chromium
from paths.fresh import Fresh, stop
from paths.headset import lead_by_headset

ROBOT = "leap_right"


def stream_from_page(path: Fresh, ports: dict[str, int], program: str) -> None:
    """Open the page in a browser with an emulated headset, and follow its session."""
    with Browser(program, size=(1100, 1000)) as browser:
        address = f"http://127.0.0.1:{ports['web']}/?right={ROBOT}&left="
        lead_by_headset(path, browser, address)
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
