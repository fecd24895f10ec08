"""Where a hand can go without touching itself."""

import numpy as np

from handmap_qp.hands import THUMB, Hand, all_pairs, find_fingers
from handmap_qp.ik.collision import CollisionLimit
from .driver import Driver

APART, TUNED, EXACT = 0.1, 0.03, 0.0
"""Share of a line by which a joint may be ahead of others: at first, once tuned, and never."""
_HOME, _LEAST = 0.15, 0.2
"""What home keeps from the ends of a range: a share of it, and at least this much [rad]."""


class Space:
    """Postures of a hand's joints with a motor, and the lines on which nothing touches.

    Args:
        hand: The hand, with a fixed wrist.
        driver: Its motors.

    Attributes:
        hand: As given.
        own: Indices of the joints with a motor among the hand's.
        limits: Least and largest angles of these [rad], shape (2, n).
        home: The open hand, away from the limits [rad], shape (n,).
    """

    def __init__(self, hand: Hand, driver: Driver) -> None:
        self.hand = hand
        self.own = own = [*map(hand.joint_names.index, driver.joint_names)]
        self.limits = np.clip(hand.limits[:, own], *driver.range)
        low, high = self.limits
        width = high - low
        kept = np.clip(_HOME * width, _LEAST, 0.5 * width)
        self.home = np.clip(hand.zero[own], low + kept, high - kept)
        self._touch = CollisionLimit(hand, all_pairs(hand))
        # One line that is exact, and three on which some joints are ahead and some behind.
        sides = np.random.default_rng(0).choice([-1.0, 0.0, 1.0], (4, len(own)))
        sides[0] = 0.0
        self._sides = sides

    def posture(self, q: np.ndarray) -> np.ndarray:
        """Return all joints of the hand, those without a motor at rest [rad], shape (..., n)."""
        full = np.tile(self.hand.rest, (*q.shape[:-1], 1))
        full[..., self.own] = q
        return full

    def chain(self, finger: str) -> np.ndarray:
        """Return which joints are those of a finger, shape (n,)."""
        return np.isin(self.own, find_fingers(self.hand)[finger].columns)

    def is_free(
        self, start: np.ndarray, goal: np.ndarray, apart: float = APART
    ) -> bool:
        """Return whether nothing touches on a line, even if joints are ahead by a share of it."""
        hand = self.hand
        shares = 1.0 + apart * self._sides
        ends = np.clip(start + shares * (goal - start), *self.limits)
        moves = np.zeros((len(ends), len(self._touch.columns)))
        moves[:, hand.joint_columns[self.own]] = ends - start
        at = hand.configuration_vector(self.posture(start))
        return not any(self._touch.met_on(at, move) for move in moves)

    def path(self, goal: np.ndarray) -> list[np.ndarray]:
        """Return free lines from home, straight or with the thumb first or last; or nothing."""
        home, is_thumb = self.home, self.chain(THUMB)
        thumb_last = np.where(is_thumb, home, goal)
        thumb_first = np.where(is_thumb, goal, home)
        for via in (goal, thumb_last, thumb_first):
            if self.is_free(home, via, TUNED) and self.is_free(via, goal, TUNED):
                return [home, via, goal]
        return []
