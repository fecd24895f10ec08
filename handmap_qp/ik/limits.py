"""Limits of displacements, as the gate takes them; `core/limits.hpp` has the formulas."""

from __future__ import annotations

import math

import numpy as np

from handmap_qp.hands import Hand
from handmap_qp.se3 import Array
from .options import IkOptions

# Accelerations from here on count as no limit [rad/s^2, m/s^2].
_NO_LIMIT = 1e100


class BoxLimits:
    """Limits of position, speed and acceleration, from which the core makes the bounds of a sample.

    Args:
        hand: The hand.
        options: Say whether speed limits hold, and limit the acceleration.
        together: Which coordinates must be able to stop together, shape (nv,); none if omitted.

    Attributes:
        size: Number of coordinates, nv.
        lowest: Lower position limits of a configuration, shape (nq,); `highest` the upper ones.
        coordinates: Where each coordinate's joint is in a configuration, shape (nv,).
        lower: Lower position limits of the coordinates, shape (nv,); `upper` the upper ones.
        speeds: Speed limits, shape (nv,); infinite for none.
        acceleration: Limit of every coordinate's acceleration; infinite for none.
        together: As given, shape (nv,).
    """

    def __init__(
        self,
        hand: Hand,
        options: IkOptions = IkOptions(),
        together: Array | bool = False,
    ) -> None:
        self.size = len(hand.active_columns)
        # The limits of a configuration. Those of Pinocchio's free-flyer, +-1.8e308, stay out of all
        # arithmetic. Infinite ones take their place, so its first coordinate does for six speeds.
        self.lowest = np.full(hand.model.nq, -np.inf)
        self.highest = -self.lowest
        self.lowest[hand.q_indices] = hand.lower_limits
        self.highest[hand.q_indices] = hand.upper_limits
        joints = hand.joint_columns
        self.coordinates = np.zeros(self.size, dtype=int)
        self.coordinates[joints] = hand.q_indices
        self.lower = self.lowest[self.coordinates]
        self.upper = self.highest[self.coordinates]
        self.speeds = np.full(self.size, np.inf)
        if options.has_velocity_limits:
            self.speeds[joints] = hand.velocity_limits
            if hand.is_floating:
                wrist = hand.spec.wrist
                self.speeds[:6] = np.repeat(
                    [wrist.max_linear_speed, wrist.max_angular_speed], 3
                )
        self.together = np.zeros(self.size, dtype=bool) | together
        # A limit beyond all speeds is none; as such, its products with times cannot overflow.
        most = options.max_acceleration
        self.acceleration = math.inf if most is None or most >= _NO_LIMIT else most
