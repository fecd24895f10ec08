"""A teleoperation loop at 60 Hz: landmarks in, commands out, on time.

python examples/01_loop_60hz.py [SECONDS]
"""

import sys
import time

import numpy as np

from handmap_qp import HandMapper, load_hand

RATE = 60.0


def landmarks_now(seconds: float) -> np.ndarray:
    """Return what a tracker would give: a hand that closes and opens once in two seconds."""
    hand = load_hand("human", points="landmarks")
    share = 0.5 - 0.5 * np.cos(np.pi * seconds)
    return hand.points(hand.rest + 0.8 * share * (hand.upper_limits - hand.rest))


def main(duration: float) -> None:
    """Map for a while, and print how long a step takes."""
    mapper = HandMapper(
        load_hand("human", points="landmarks"), load_hand("allegro_right")
    )
    start = now = time.monotonic()
    steps = []
    while now - start < duration:
        now = time.monotonic()
        # The robot's limits hold in the time since its last command.
        step = mapper.map_landmarks(landmarks_now(now - start), time=now)
        steps.append(step)
        # Send step.command.q to your robot here.
        time.sleep(max(0.0, 1.0 / RATE - (time.monotonic() - now)))
    duration_ms = 1e3 * np.median([step.duration for step in steps])
    print(f"{len(steps)} commands, the last one {steps[-1].status}")
    print(f"a step takes {duration_ms:.2f} ms (median)")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 2.0)
