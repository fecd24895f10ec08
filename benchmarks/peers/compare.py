"""The peers as outside methods of `handmap compare --peers` and `handmap score --tasks`.

`compare.py list HAND` prints the methods as JSON. `compare.py run METHOD HAND IN.npz OUT.npz` maps
a recording. `compare.py live METHOD HAND` maps landmarks as they come (`live.py`). HAND is a name
or the path of a hand.yaml. On failure, the last line on stderr says why, and the exit code is 1.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from handmap_qp.errors import HandmapError
from handmap_qp.hands.library import load_hand
from handmap_qp.trackers.formats import read_recording
from peers import build
from peers.live import command_of
from peers.results import METHODS, PeerError, peer_robot, run_peer


def list_methods(hand: str) -> None:
    """Print the methods for a hand as JSON."""
    missing = build.missing_peers()
    runnable = [m for m in METHODS.values() if m.peer not in missing]
    if not runnable:
        raise PeerError(f"--peers: {build.why_missing(missing)}")
    peer_robot(load_hand(hand))
    json.dump([{"name": m.name, "about": m.title} for m in runnable], sys.stdout)


def run(method: str, hand: str, given: str, made: str) -> None:
    """Map a recording, and write joints, times and the wrist if the peer moves it."""
    motion = run_peer(method, read_recording(given), load_hand(hand))
    columns = {"q": motion.q, "step_time": motion.cpu_time}
    if motion.own_wrist is not None:
        columns["wrist"] = motion.own_wrist
    np.savez(made, allow_pickle=False, **columns)


def live(method: str, hand: str) -> None:
    """Become the worker of a method, in the environment of its peer."""
    command = command_of(method, load_hand(hand))
    # As `runner.py`: dex-retargeting keeps links in a set.
    os.environ["PYTHONHASHSEED"] = "0"
    os.execv(command[0], command)


def main(words: list[str]) -> int:
    """Run a command; return the exit code."""
    commands = {"list": (list_methods, 1), "run": (run, 4), "live": (live, 2)}
    name, arguments = (words[0], words[1:]) if words else ("", [])
    if name not in commands or len(arguments) != commands[name][1]:
        print(
            "usage: compare.py list HAND | run METHOD HAND IN.npz OUT.npz | live METHOD HAND",
            file=sys.stderr,
        )
        return 1
    try:
        commands[name][0](*arguments)
    except HandmapError as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
