"""dexi-rs live in a loop, as a mapping of `handmap score --tasks`.

    pip install 'handmap-qp[peers]'      # or: make peers
    handmap score --tasks pick --methods teleoperation benchmarks/peers/live.py:dexpilot

The peer runs in a process of its own, as published but without its low-pass filter; our limits clip
its joints. Where the peer's robot has a wrist that ours has not (Shadow's), its turn is left out.

The same file is the worker: `live.py METHOD ROBOT DATA` reads landmarks as JSON lines, answers
joints, and begins anew at the line `"reset"`.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

# Run by path, by this package's interpreter or by the peer's.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

if TYPE_CHECKING:
    from handmap_score.tasks.operator import HumanHand, Joints

    from handmap_qp.hands.hand import Hand

_PEER = "dexi-rs"
_RESET = "reset"


class LivePeer:
    """A method of dexi-rs in a process of its environment.

    Args:
        method: `dexpilot` or `vector`.
        robot: A robot hand that the peers have a configuration for.

    Raises:
        InvalidInputError: If they have none.
        PeerError: If the peer does not start.
    """

    def __init__(self, method: str, robot: Hand) -> None:
        results = importlib.import_module("peers.results")
        build = importlib.import_module("peers.build")
        command = [
            build.python_of(_PEER),
            __file__,
            method,
            results.peer_robot(robot),
            build.data_folder(),
        ]
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        except OSError as error:
            raise results.PeerError(build.why_missing([_PEER])) from error
        names = self._read()
        self._columns = {
            name: names.index(results.peer_joint(robot, name))
            for name in robot.joint_names
        }
        self._low, self._high = robot.limits

    def reset(self) -> None:
        """Begin an attempt with a new solver."""
        self._ask(_RESET)

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Return the peer's joints, clipped to the robot's limits."""
        q = np.array(self._ask(hand.landmarks.tolist()))[[*self._columns.values()]]
        q = np.clip(q, self._low, self._high)
        return dict(zip(self._columns, q.tolist(), strict=True))

    def _ask(self, value: str | list[list[float]]) -> list[float]:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(value) + "\n")
        self._process.stdin.flush()
        return self._read()

    def _read(self) -> list:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())


def dexpilot(human: Hand, robot: Hand) -> LivePeer:
    """Return DexPilot for a robot; the peer does not measure the person."""
    return LivePeer("dexpilot", robot)


def vector(human: Hand, robot: Hand) -> LivePeer:
    """Return the vector method for a robot; the peer does not measure the person."""
    return LivePeer("vector", robot)


def serve(method: str, robot: str, data: str) -> None:
    """Answer lines until the other end closes."""
    runner = importlib.import_module("peers.runner")
    config = runner.load_config(Path(data), method, robot, is_filtered=False)
    indices = runner.human_indices(config)
    sign = 1.0 if robot.endswith("right") else -1.0
    solver = runner.DexiRs(config)
    print(json.dumps(solver.joint_names), flush=True)
    for line in sys.stdin:
        value = json.loads(line)
        if value == _RESET:
            solver = runner.DexiRs(config)
            answer = []
        else:
            reference = runner.reference_value(np.array(value), indices, sign)
            answer = solver.retarget(reference).tolist()
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    serve(*sys.argv[1:])
