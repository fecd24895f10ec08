"""Follow the demo's samples that a parent process requests, and time each: `interleaved.Worker`.

    python benchmarks follower_worker ROBOT PRESET

Requests and answers are those of `library_worker.cpp`. A call is `Follower.map_sample` with the
joints of its command read.
"""

from __future__ import annotations

import json
import sys
import time

from faulty_recordings import DEMO
from peers.timer import timer_cost
from run_cases import mapper_of

from handmap_qp import Follower, HandMapper


def serve(mapper: HandMapper) -> None:
    """Answer requests until the input ends."""
    samples = [DEMO.sample(i) for i in range(len(DEMO))]
    follower = Follower(mapper)
    timer = timer_cost()
    print(json.dumps({"ready": True, "samples": len(samples)}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        if request["starts"]:
            mapper.reset()
            follower = Follower(mapper)
        times, joints, wrists = [], [], []
        for sample in samples[slice(*request["samples"])]:
            started = time.thread_time_ns()
            step = follower.map_sample(sample)
            # The core makes arrays when they are read.
            q = step.command.q
            times.append(time.thread_time_ns() - started - timer)
            joints.append(q.tolist())
            wrists.append(step.command.wrist.ravel().tolist())
        print(json.dumps({"ns": times, "q": joints, "wrist": wrists}), flush=True)


if __name__ == "__main__":
    serve(mapper_of(*sys.argv[1:]))
