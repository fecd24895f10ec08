"""Recordings of both hands that meet: palms that come near each other while fingers close."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from handmap_core.human.sample import human_name
from handmap_qp import Recording, load_hand
from handmap_qp.hands import Side

_RATE = 60.0

Hands = Mapping[Side, Recording]


def meeting_hands() -> Hands:
    """Make recordings of palms that come from 285 mm to 60 mm, and of fingers that close."""
    time_ = np.arange(0.0, 10.0, 1.0 / _RATE)
    near = 0.5 - 0.5 * np.cos(2.0 * np.pi * time_ / time_[-1])
    signs: dict[Side, float] = {"left": 1.0, "right": -1.0}
    found = {}
    for side, sign in signs.items():
        human = load_hand(human_name(side), points="landmarks")
        # They are straight where the palms are near.
        share = (0.5 - 0.5 * np.cos(3.0 * time_ + sign)) * (1.0 - near)
        q = 0.6 * share[:, None] * human.upper_limits
        # Each palm faces the other one; +x is forward, +y left and +z up.
        wrist = np.eye(4)
        wrist[:3, :3] = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
        wrist[1, :3] *= sign
        wrist[2, :3] *= sign
        points = np.array([human.points(each, wrist) for each in q])
        points[..., 1] += 0.5 * sign * (0.285 - 0.225 * near)[:, None]
        valid = np.ones(len(time_), dtype=bool)
        found[side] = Recording("meeting hands", time_, points, valid, side)
    return found
