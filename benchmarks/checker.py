"""An independent judge of a stream of commands: it shares no code with the QP, limits or gate.

Positions are judged exactly; a robot that starts outside its limits must not go farther out.
Velocities are finite differences of configurations, and accelerations those of velocities. Both
have the tolerance that rounding of the configurations gives them. The acceleration limit in force
is the largest one since the robot last stood still. Samples shorter than 1 us count as 1 us.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pinocchio as pin
from overlap import OverlapMeter

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs

OVERLAP = 1e-4
"""Largest overlap that counts as none [m]."""
_JOINT, _POSE, _SHARE = 1e-12, 1e-9, 1e-6
_STEP = 0.04


class Checker:
    """Judges the commands of one robot.

    Args:
        hand: The robot.
        shapes: Pairs of shapes that must not overlap, at or between commands; none if omitted.

    Attributes:
        commands: Number of commands judged.
        violations: Number of commands by what they violate.
        worst: Position beyond its limit [rad]; speed and acceleration over their limits; overlap
            [m].
    """

    def __init__(self, hand: Hand, shapes: ShapePairs | None = None) -> None:
        self._hand, self.commands = hand, 0
        self._meter = None if shapes is None else OverlapMeter(hand, shapes)
        self.violations, self.worst = Counter[str](), dict[str, float]()
        wrist = hand.spec.wrist
        free = 6 if hand.is_floating else 0
        twist = np.repeat([wrist.max_linear_speed, wrist.max_angular_speed], 3)[:free]
        self._turn = wrist.max_angular_speed * np.sqrt(3.0) if free else 0.0
        self._speed = np.concatenate([twist, hand.velocity_limits])
        self._rounding = np.repeat([_POSE, _JOINT], [free, len(hand.joint_names)])

    def start(self, q: np.ndarray) -> None:
        """Begin at a Pinocchio configuration, at rest."""
        self._q = q.copy()
        self._last = np.zeros(len(self._speed))
        self._dt, self._force = 1.0, 0.0

    def take(self, q: np.ndarray, dt: float, limit: float | None = None) -> None:
        """Judge the command of a configuration, its time [s], and the limit configured [rad/s^2].

        None stands for no limit of acceleration.
        """
        hand, before, dt = self._hand, self._q, max(dt, 1e-6)
        joints, start = q[hand.q_indices], before[hand.q_indices]
        low = np.minimum(hand.lower_limits, start)
        high = np.maximum(hand.upper_limits, start)
        beyond = np.maximum(low - joints, joints - high)
        self._note("position", float(beyond.max()), 0.0)
        moved = joints - start
        if hand.is_floating:
            poses = [pin.XYZQUATToSE3(each[:7]) for each in (before, q)]
            moved = np.concatenate([pin.log6(poses[0].actInv(poses[1])).vector, moved])
        is_ambiguous = self._turn * dt >= np.pi  # half a turn or more
        moved[:6] *= not (hand.is_floating and is_ambiguous)
        speed = (np.abs(moved) - self._rounding) / (self._speed * dt)
        self._note("speed", float(speed.max()), 1.0 + _SHARE)
        self._force = max(self._force, np.inf if limit is None else limit)
        velocity, noise = moved / dt, self._rounding * (1.0 / dt + 1.0 / self._dt)
        velocity[:6] = np.where(is_ambiguous, np.nan, velocity[:6])
        change = (np.abs(velocity - self._last) - noise) / (self._force * dt)
        self._note("acceleration", float(np.fmax.reduce(change)), 1.0 + _SHARE)
        if self._meter is not None and moved.any():
            count = int(np.abs(moved).max() / _STEP) + 2
            shares = np.arange(1, count) / count
            parts = [pin.interpolate(hand.model, before, q, share) for share in shares]
            self._note("overlap", max(map(self._meter.depth, (*parts, q))), OVERLAP)
        if (np.abs(moved) <= self._rounding).all():
            self._force = 0.0
        self._q, self._last, self._dt = q.copy(), velocity, dt
        self.commands += 1

    def _note(self, what: str, value: float, most: float) -> None:
        self.worst[what] = max(self.worst.get(what, -np.inf), value)
        self.violations[what] += not value <= most
