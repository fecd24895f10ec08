"""A recording of a person whose thumb and index touch now and then."""

from __future__ import annotations

import numpy as np

from handmap_core.human.recording import Recording
from handmap_qp import HumanLengths, load_hand

LENGTHS = HumanLengths.from_hand_length(0.18)


def worn(count: int = 600, rate: float = 60.0, gap: float = 0.015) -> Recording:
    """Record a hand that opens and closes, and whose thumb and index touch every 3 s for 0.3 s.

    Where the skin touches, this tracker gives a distance of `gap` [m].
    """
    hand = load_hand("human", points="landmarks", lengths=LENGTHS)
    half = 0.5 * (hand.upper_limits - hand.rest)
    time, landmarks = np.arange(count) / rate, []
    for t in time:
        points = hand.points(hand.rest + 0.3 * (1.0 - np.cos(3.0 * t)) * half)
        share = np.clip(2.5 * (0.55 - abs(t % 3.0 - 1.5)), 0.0, 1.0)
        share = share * share * (3.0 - 2.0 * share)
        # Three joints of the index move together, so that their bones stay as long as they are.
        spread = points[8] - points[4]
        points[6:9] += share * (gap / np.linalg.norm(spread) - 1.0) * spread
        landmarks.append(points)
    return Recording(
        "worn", time, np.array(landmarks), np.ones(count, dtype=bool), "right"
    )
