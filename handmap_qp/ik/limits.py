"""Joint position and speed limits as one box on the displacement, which can never contradict itself.

    clip(q_min - q, -v dt, v dt) <= dq <= clip(q_max - q, -v dt, v dt)

Clipping is monotone, so the lower bound never passes the upper one, also where `q` starts outside its limits: there both bounds
meet at the speed limit and the joint comes back as fast as it may. The stacked position and speed rows of mink and pink are
infeasible in that case.
"""

from __future__ import annotations

import numpy as np

from handmap_qp.hand import Hand


class BoxLimits:
    """Bounds of the displacement within one sample.

    Args:
        hand: The hand.
        has_velocity_limits: Whether speed limits hold; position limits always do.
    """

    def __init__(self, hand: Hand, *, has_velocity_limits: bool = True) -> None:
        model = hand.model
        self._first_q = 7 if hand.is_floating else 0
        self._joints = slice(6 if hand.is_floating else 0, None)
        # A free-flyer's position limits are +-1.8e308 in Pinocchio and stay out of all arithmetic.
        self._lower = model.lowerPositionLimit[self._first_q :].copy()
        self._upper = model.upperPositionLimit[self._first_q :].copy()
        self._speed = model.velocityLimit.copy()
        if hand.is_floating:
            self._speed[:3] = hand.spec.wrist.max_linear_speed
            self._speed[3:6] = hand.spec.wrist.max_angular_speed
        if not has_velocity_limits:
            self._speed[:] = np.inf

    def bounds(self, q: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound of the displacement from `q`.

        Args:
            q: Pinocchio configuration, shape (nq,).
            dt: Time for the displacement [s].

        Returns:
            Two arrays of shape (nv,), `lower <= upper`.
        """
        upper = self._speed * dt
        lower = -upper
        angles, joints = q[self._first_q :], self._joints
        slowest, fastest = lower[joints], upper[joints].copy()
        upper[joints] = np.maximum(np.minimum(self._upper - angles, fastest), slowest)
        lower[joints] = np.minimum(np.maximum(self._lower - angles, slowest), fastest)
        return lower, upper
