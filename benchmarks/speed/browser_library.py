"""The library in a browser: its size, the time of a sample, its distance from Python, the page.

Node and Python follow the same recording with the same saved hand, one after the other in one run.
The playground is opened in headless Chromium, which draws in software: a GPU is faster.

    python benchmarks browser_library
    python benchmarks browser_library --hands allegro_right --no-page
"""

from __future__ import annotations

# isort: split
import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path

import numpy as np
from browser import Browser, QuietHandler, find_chromium
from wasm_library import PACKAGE, ROOT, compiled_library

from handmap_qp import Follower, HandMapper, load_hand, read_recording
from handmap_qp.apps.saving import saved_bytes
from handmap_qp.human import scaled_human

HANDS = ("allegro_right", "shadow_right", "panda_gripper")
_WARM = 50  # samples that compile what the next ones run
_WATCHED = 5.0  # time for which pictures are counted [s]


def follow_both(name: str, wasm: Path, folder: Path) -> None:
    """Follow the demo under Node and in Python, and print a row."""
    recording = read_recording("demo", "right")
    mapper = HandMapper(scaled_human(recording, points="landmarks"), load_hand(name))
    saved = folder / f"{name}.hand"
    saved.write_bytes(saved_bytes(mapper))
    samples = [recording.sample(i) for i in range(len(recording))]
    given = [
        {
            "time": each.time,
            "landmarks": each.landmarks.ravel().tolist(),
            "wrist": None if each.wrist is None else each.wrist.ravel().tolist(),
            "valid": bool(each.valid),
            "confidence": each.confidence,
        }
        for each in samples
    ]
    file = folder / "samples.json"
    file.write_text(json.dumps(given))
    program = ROOT / "tests" / "support" / "follow.mjs"
    command = ["node", program, PACKAGE / "src" / "handmap.js", wasm, saved, file]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    follower = Follower(mapper)
    times = []
    farthest = 0.0
    for sample, there in zip(samples, found["commands"], strict=True):
        started = time.perf_counter()
        step = follower.map_sample(sample)
        times.append(time.perf_counter() - started)
        farthest = max(farthest, float(np.abs(step.command.q - there["q"]).max()))
    node = np.median(found["times"][_WARM:])
    python = 1e3 * np.median(times[_WARM:])
    print(
        f"{name:15} {node:8.3f} ms {python:8.3f} ms {node / python:6.2f} {farthest:12.1e}"
    )


def open_page(folder: Path, wasm: Path) -> None:
    """Make the playground, open it, and print how soon and how often it draws."""
    target = folder / "page"
    pack = [sys.executable, PACKAGE / "pack.py", target, "--wasm", wasm]
    paths = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run(pack, check=True, env=paths, stdout=subprocess.DEVNULL)
    program = find_chromium()
    if program is None:
        sys.exit("browser_library: Chromium is missing; HANDMAP_CHROMIUM names one")
    handler = partial(QuietHandler, directory=target)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with Browser(program, (1200, 760), draws_seldom=False) as page:
            started = time.perf_counter()
            page.open(f"http://127.0.0.1:{server.server_port}/")
            page.wait_for("document.body && document.body.dataset.frames > 0")
            first = time.perf_counter() - started
            time.sleep(_WATCHED)
            rate = page.evaluate("document.body.dataset.frames")
        server.shutdown()
    size = sum(each.stat().st_size for each in target.rglob("*") if each.is_file())
    print(
        f"page: {size / 1e6:.1f} MB, first picture after {first:.1f} s, {rate} a second"
    )


def main() -> None:
    """Print what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hands", nargs="+", default=HANDS, metavar="NAME")
    parser.add_argument(
        "--page", action=argparse.BooleanOptionalAction, default=True, help="open it"
    )
    given = parser.parse_args()
    if shutil.which("emcc") is None or shutil.which("node") is None:
        print("needs Emscripten and Node: apt install emscripten nodejs")
        sys.exit(2)
    wasm = compiled_library()
    print(f"handmap.wasm: {wasm.stat().st_size / 1e3:.0f} kB")
    print(f"{'hand':15} {'Node':>11} {'Python':>11} {'ratio':>6} {'off [rad]':>12}")
    with tempfile.TemporaryDirectory() as folder:
        for name in given.hands:
            follow_both(name, wasm, Path(folder))
        if given.page:
            open_page(Path(folder), wasm)


if __name__ == "__main__":
    main()
