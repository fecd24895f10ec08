"""Whether the joints of a robot go where they are commanded: `FollowingCheck`."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.hands import Hand
from handmap_core.se3 import Array, as_floats

# Joints may be where they were commanded at any time since this long ago [s].
_DELAY = 0.05
# Encoders that say nothing for longer are late [s].
_SILENCE = 0.15
# Commands that are kept: those of the delay at 1 kHz.
_MOST = 50


class FollowingCheck:
    """Compares measured joints with what was commanded of late.

    A joint does not follow if it has been farther than `error` from all commands of the last 50 ms,
    for `patience`. So it is if it is jammed, its motor is dead, or somebody pushes it; and if an
    object in the hand stops it, which `error` should leave room for.

    Args:
        robot: The robot hand.
        error: Distance at which a joint does not follow [rad], and at most half of its range, in
            its own unit; None to measure only.
        patience: Time for which it must last [s].

    Attributes:
        error: How far each joint was from the commands when it was measured last, in the order of
            `robot.joint_names` [rad or m], shape (n,).
    """

    def __init__(
        self, robot: Hand, error: float | None = 0.3, patience: float = 0.05
    ) -> None:
        lower, upper = robot.limits
        self._is_limited = error is not None
        self._allowed = np.minimum(error or math.inf, 0.5 * (upper - lower))
        self._patience = patience
        self._sent: deque[tuple[float, Array]] = deque(maxlen=_MOST)
        self._off_since = np.full(len(lower), np.inf)
        self._heard = math.inf
        self.error = np.zeros(len(lower))

    def command(self, q: ArrayLike, now: float) -> None:
        """Note a command: joint angles [rad or m], shape (n,), and its time on any clock [s]."""
        self._sent.append((now, np.array(q)))

    def restart(self) -> None:
        """Forget the commands and the joints that did not follow: the robot starts again."""
        self._sent.clear()
        self._off_since[:] = np.inf

    def measure(self, q: ArrayLike, now: float, *, goes_on: bool = True) -> None:
        """Compare measured joints with the commands.

        Args:
            q: Joint angles that the robot has now [rad or m], shape (n,).
            now: Time on the same clock [s].
            goes_on: Whether measurements are promised to go on: if they stay away, the robot is
                lost.

        Raises:
            InvalidInputError: If it is not n finite numbers.
        """
        q = as_floats(q, "measured_q", shape=self._allowed.shape, is_finite=True)
        if goes_on:
            self._heard = now
        while len(self._sent) > 1 and self._sent[1][0] <= now - _DELAY:
            self._sent.popleft()
        late = np.array([command for _, command in self._sent] or [q])
        self.error = q - np.clip(q, late.min(axis=0), late.max(axis=0))
        is_off = np.abs(self.error) > self._allowed
        self._off_since = np.where(is_off, np.minimum(self._off_since, now), np.inf)

    def is_lost(self, now: float) -> bool:
        """Return whether a joint does not follow, or measurements stay away for over 150 ms."""
        return now >= self.lost_at

    @property
    def lost_at(self) -> float:
        """When the robot is lost if it is not measured until then, on the calls' clock [s]."""
        if not self._is_limited:
            return math.inf
        return min(self._off_since.min() + self._patience, self._heard + _SILENCE)
