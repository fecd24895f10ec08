"""Initial postures and poses for the tests of the mapping."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from strategies import motion_of

from handmap_qp import load_hand
from handmap_qp.hands.hand import Hand

HUMAN = load_hand("human", points="fingertips_middle")


def near_rest(
    generator: np.random.Generator, amount: float = 0.15, hand: Hand = HUMAN
) -> np.ndarray:
    """Draw a posture near rest."""
    room = np.minimum(hand.upper_limits - hand.rest, hand.rest - hand.lower_limits)
    return hand.rest + generator.uniform(-amount, amount, size=len(room)) * room


def little_pose(generator: np.random.Generator, size: float = 0.05) -> np.ndarray:
    """Draw a pose near the identity."""
    return motion_of(
        pin.exp3(generator.uniform(-size, size, size=3)),
        generator.uniform(-size, size, size=3),
    )
