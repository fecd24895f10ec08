"""Limits of displacements, as the gate takes them; `handmap/limits.hpp` has the formulas."""

from __future__ import annotations

import math

import numpy as np

from handmap_core.hands import Hand
from handmap_core.models import BoxLimits
from handmap_core.se3 import Array
from .options import IkOptions

# Accelerations from here on count as no limit [rad/s^2, m/s^2].
_NO_LIMIT = 1e100


def box_limits(
    hand: Hand,
    options: IkOptions = IkOptions(),
    together: Array | None = None,
) -> BoxLimits:
    """Return the limits of a hand.

    Args:
        hand: The hand.
        options: Say whether speed limits hold, and limit the acceleration.
        together: Which coordinates must be able to stop together, shape (k,); none if omitted.
    """
    size = len(hand.active_columns)
    # The limits of a configuration. Those of Pinocchio's free-flyer, +-1.8e308, stay out of all
    # arithmetic. Infinite ones take their place, so its first coordinate does for six speeds.
    lowest = np.full(hand.model.nq, -np.inf)
    highest = -lowest
    lowest[hand.q_indices] = hand.lower_limits
    highest[hand.q_indices] = hand.upper_limits
    joints = hand.joint_columns
    coordinates = np.zeros(size, dtype=np.int64)
    coordinates[joints] = hand.q_indices
    speeds = np.full(size, np.inf)
    if options.has_velocity_limits:
        speeds[joints] = hand.velocity_limits
        if hand.is_floating:
            speeds[:6] = np.repeat(hand.wrist_speeds, 3)
    # A limit beyond all speeds is none; as such, its products with times cannot overflow.
    most = options.max_acceleration
    return BoxLimits(
        lowest=lowest,
        highest=highest,
        lower=lowest[coordinates],
        upper=highest[coordinates],
        speeds=speeds,
        coordinates=coordinates,
        together=np.zeros(size, dtype=np.bool_) if together is None else together,
        acceleration=math.inf if most is None or most >= _NO_LIMIT else most,
    )
