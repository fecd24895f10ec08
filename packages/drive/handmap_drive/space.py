"""Where a hand can go without touching itself."""

import numpy as np
import pinocchio as pin

from handmap_qp.hands import Hand, all_pairs, find_fingers
from handmap_qp.ik import Gate, IkOptions, Motion
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.se3 import Array
from .driver import Driver

APART, TUNED, EXACT = 0.1, 0.03, 0.0
"""Share of a line by which a joint may be ahead of others: at first, once tuned, and never."""
Vector = tuple[float, float, float]
ON_ITS_BACK: Vector = 0.0, 0.0, 1.0
_HOME = 0.15
"""What home keeps from the ends of a range, a share of it."""
_ANY_TIME = 1.0
"""Time that a move takes, which bounds nothing: only its path counts [s]."""
_LEAST = 0.2
"""What it keeps at least [rad]."""


class Space:
    """Postures of a hand's joints with a motor, and the lines on which nothing touches.

    Args:
        hand: The hand, with a fixed wrist.
        driver: Its motors.
        down: Direction of gravity in the palm frame, shape (3,); it lies on its back if omitted.

    Attributes:
        hand: As given.
        own: Indices of the joints with a motor among the hand's.
        limits: Least and largest angles of these [rad], shape (2, n).
        home: The open hand, away from the limits [rad], shape (n,).
    """

    def __init__(self, hand: Hand, driver: Driver, down: Vector = ON_ITS_BACK) -> None:
        self.hand = hand
        self.own = own = [*map(hand.joint_names.index, driver.joint_names)]
        self.limits = np.clip(hand.limits[:, own], *driver.range)
        low, high = self.limits
        width = high - low
        kept = np.clip(_HOME * width, _LEAST, 0.5 * width)
        self.home = np.clip(hand.zero[own], low + kept, high - kept)
        self._weighted = pin.Model(hand.model)
        palm = hand.frame_pose("palm", hand.rest)[:3, :3]
        self._weighted.gravity.linear = 9.81 * palm.dot(down) / np.linalg.norm(down)
        self._data = self._weighted.createData()
        self._gate = Gate(
            hand,
            Motion.at_rest(
                hand.configuration_vector(hand.rest), len(hand.active_columns)
            ),
            IkOptions(has_velocity_limits=False),
            CollisionLimit(hand, all_pairs(hand)),
        )
        # One line that is exact, and three on which some joints are ahead and some behind.
        random = np.random.default_rng(0)
        self._sides = random.choice([-1.0, 0.0, 1.0], (4, len(own)))
        self._sides[0] = 0.0

    def posture(self, q: Array) -> Array:
        """Return all joints of the hand, those without a motor at rest [rad], shape (..., n)."""
        full = np.tile(self.hand.rest, (*q.shape[:-1], 1))
        full[..., self.own] = q
        return full

    def weights(self, q: Array) -> Array:
        """Return the torques that hold the hand's links by angles [rad]: [N m], shape (..., n)."""

        def torques(posture: Array) -> Array:
            at = self.hand.configuration_vector(posture)
            return pin.computeGeneralizedGravity(self._weighted, self._data, at)

        held = np.apply_along_axis(torques, -1, self.posture(q))
        return held @ self.hand.joint_motion[:, self.own]

    def chain(self, finger: str) -> Array:
        """Return which joints are those of a finger, shape (n,)."""
        fingers = find_fingers(self.hand)
        return np.isin(self.own, fingers[finger].columns)

    def is_free(self, start: Array, goal: Array, apart: float = APART) -> bool:
        """Return whether nothing touches on a line, even if joints are ahead by a share of it."""
        shares = 1.0 + apart * self._sides
        ends = np.clip(start + shares * (goal - start), *self.limits)
        begin = self.posture(start)
        at = self.hand.configuration_vector(begin)
        moves = self.posture(ends) - begin
        order = self.hand.joint_columns.argsort()
        return all(self._is_admitted(at, move) for move in moves[:, order])

    def _is_admitted(self, at: Array, move: Array) -> bool:
        """Return whether the gate admits a displacement (n,) at rest in a configuration (nq,)."""
        self._gate.place(at)
        admitted = self._gate.admit(move, move, _ANY_TIME)
        return bool(np.allclose(admitted, move, rtol=0.0, atol=1e-9))
