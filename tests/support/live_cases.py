"""Shared by the tests of live input: a small recording of a moving hand."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np

from handmap_core.human.recording import Recording
from handmap_qp.hands import Side
from handmap_qp.hands.library import load_hand

PERIOD = 1.0 / 60.0


@cache
def moving_hand(count: int = 60, side: Side = "right") -> Recording:
    """Return a recording at 60 Hz of a hand that closes, opens and moves.

    Sample 10 is not valid.
    """
    human = load_hand("human" if side == "right" else "human_left", points="landmarks")
    landmarks = np.empty((count, 21, 3))
    for i in range(count):
        share = 0.3 + 0.3 * math.sin(0.1 * i)
        wrist = np.eye(4)
        wrist[:3, 3] = 0.001 * i, 0.2, 0.1
        q = human.rest + share * (human.upper_limits - human.rest)
        landmarks[i] = human.points(q, wrist)
    valid = np.arange(count) != 10
    landmarks[~valid] = np.nan
    # An odd start and uneven periods, as trackers have them.
    time = 1234.5 + PERIOD * np.arange(count) + 0.002 * np.sin(np.arange(count))
    return Recording("moving", time, landmarks, valid, side)


def save_recording(recording: Recording, file: Path) -> Path:
    """Write a recording as the `.npz` file that commands read."""
    np.savez(
        file,
        time=recording.time,
        landmarks=recording.landmarks,
        valid=recording.valid,
        handedness=recording.side,
    )
    return file
