"""A recording of three reaches in a headset's world."""

from __future__ import annotations

from typing import Any

import numpy as np

from handmap_qp import Recording, load_hand

HUMAN = load_hand("human", points="landmarks")
WAYS = np.array([[0.0, 0.0, -0.3], [-0.3, 0.0, 0.0], [0.0, 0.3, 0.0]])
"""Reaches forward, to the left and up in a headset's world [m]."""


def reaching_hand(**changes: Any) -> Recording:
    """A hand that reaches forward, to the left and up in a headset's world, a second each."""
    time = np.arange(180) / 60.0
    share = np.clip(time[:, None] - np.arange(3), 0.0, 1.0)
    still = HUMAN.points(HUMAN.rest, np.eye(4))
    values: dict[str, Any] = {
        "name": "reaches",
        "time": time,
        "landmarks": still + (share @ WAYS)[:, None],
        "valid": np.ones(180, dtype=bool),
        "side": "right",
        **changes,
    }
    return Recording(**values)
