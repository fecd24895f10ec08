"""Retarget the samples that a parent process asks for, and time each: `interleaved.Worker`.

    timed.py --peer dexi-rs --method vector --robot allegro_hand_right --data .peers/data IN.npz

Runs in the environment of the peer. Requests and answers are lines of JSON, as of
`benchmarks/speed/mapping_worker.py`. The time is that of the peer's own `retarget`; `frame_ns` is
that of the hand's frame in numpy, which the peers' examples compute before it.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

import numpy as np
import runner
from timer import timer_cost


def main() -> None:
    """Build the peer, then answer requests until the input ends."""
    parser = argparse.ArgumentParser(description="Time a peer, sample by sample.")
    parser.add_argument("--peer", choices=sorted(runner.SOLVERS), required=True)
    parser.add_argument("--method", choices=runner.METHODS, required=True)
    parser.add_argument("--robot", required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("samples", type=Path)
    given = parser.parse_args()
    landmarks = np.load(given.samples)["landmarks"]
    config = runner.load_config(given.data, given.method, given.robot, is_filtered=True)
    solver = runner.SOLVERS[given.peer](config)
    indices = runner.human_indices(config)
    timer = timer_cost()
    print(json.dumps({"ready": True, "version": solver.version}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        first, last = request["samples"]
        times, frames, joints = [], [], []
        for sample in landmarks[first:last]:
            begun = time.thread_time_ns()
            reference = runner.reference_value(sample, indices)
            started = time.thread_time_ns()
            q = solver.retarget(reference)
            times.append(time.thread_time_ns() - started - timer)
            frames.append(started - begun)
            joints.append(np.asarray(q).tolist())
        print(json.dumps({"ns": times, "frame_ns": frames, "q": joints}), flush=True)


if __name__ == "__main__":
    # dex-retargeting keeps links in a set: with hashes that change, sums change in the last digit.
    if os.environ.get("PYTHONHASHSEED") != "0":
        os.environ["PYTHONHASHSEED"] = "0"
        os.execv(sys.executable, [sys.executable, *sys.argv])
    main()
