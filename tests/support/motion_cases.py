"""A motion with known values."""

from __future__ import annotations

import numpy as np

from handmap_qp import load_hand
from handmap_qp.human import HumanMotion
from handmap_qp.se3 import affine

HUMAN = load_hand("human", points="joints")


def waving(count: int = 40) -> HumanMotion:
    """Record a hand that opens and closes while its wrist moves."""
    time = np.linspace(0.0, 1.0, count)
    way = 0.5 - 0.5 * np.cos(2.0 * np.pi * time)
    q = HUMAN.rest + 0.4 * way[:, None] * (HUMAN.upper_limits - HUMAN.rest)
    turns = np.array(
        [
            [[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]]
            for a in 0.3 * way
        ]
    )
    wrist = np.array(
        [
            affine(turn, np.array([0.2 * x, 0.0, 0.1]))
            for turn, x in zip(turns, way, strict=True)
        ]
    )
    dt = np.full(count, time[1])
    return HumanMotion(HUMAN, time, dt, q, wrist, np.ones(count, dtype=bool))
