"""Moves motors along straight lines, and logs what they were commanded and did."""

from collections.abc import Callable, Iterator
from math import ceil
from typing import NamedTuple

import numpy as np

from handmap_qp.se3 import Array
from .drive import HOTTEST, UNANSWERED
from .driver import Driver, DriverError, insisting
from .gate import Gate
from .joint_map import Direct, JointMap

_REST = 0.25
"""Time to come to rest [s]."""
_AT_REST = 9
"""Turns at the end of a rest whose mean counts."""


class Log(NamedTuple):
    """What a hand was commanded and did in each turn.

    Attributes:
        time: Of each turn [s], shape (T,).
        commanded: What motors were commanded [rad], shape (T, n).
        q: Where joints were [rad], shape (T, n).
        torque: Their torques, shares of the largest, shape (T, n).
    """

    time: Array
    commanded: Array
    q: Array
    torque: Array


class Motion:
    """Moves motors, and logs each turn; `start` is first.

    Args:
        driver: The motors, connected.
        effort: Limit of the torque, a share of the largest.
        times: Yields the time of each turn [s].

    Attributes:
        driver: As given.
        effort: As given.
        goal: Where the joints were to go last [rad], shape (n,).
    """

    def __init__(self, driver: Driver, effort: float, times: Iterator[float]) -> None:
        self.driver = driver
        self.effort = effort
        self._times = times
        self._gate = Gate(driver)
        self._rows: list[tuple[float, Array, Array, Array]] = []

    def start(self, joints: JointMap | None = None) -> None:
        """Begin where the joints are.

        Args:
            joints: Maps joints to motors, as it was measured just before; joints do what motors are
                commanded if omitted.

        Raises:
            DriverError: If motors do not answer.
        """
        self._joints = joints or Direct(self.driver)
        q, *_ = insisting(self._gate.read)
        self.goal = self._joints.angles(q)
        self._joints.restart(self.goal)
        # Encoders may be at the joints, which are then held by other goals than their angles.
        self._gate.begin(self._joints.command(self.goal))
        self._lost = 0

    def stop(self) -> None:
        """Take the torque away; `start` goes on."""
        self._gate.stop()

    @property
    def count(self) -> int:
        """Number of turns up to now."""
        return len(self._rows)

    def log(self, start: int = 0) -> Log:
        """Return what happened since a turn."""
        columns = zip(*self._rows[start:], strict=True)
        return Log(*map(np.array, columns))

    def turn(self, goal: Array) -> None:
        """Tell motors where joints are to go [rad], and log what they do.

        Raises:
            DriverError: If they do not answer for some time, are too hot, report a fault or lose
                their torque.
        """
        now = next(self._times)
        self.goal = goal
        target = self._joints.command(goal)
        # Motors that were not read keep their goals: they may have been reset.
        if not self._lost:
            self._gate.write(target, self.effort, now)
        commanded = self._gate.goal
        try:
            q, torque, health = self._gate.read()
        except DriverError:
            self._lost += 1
            if self._lost > UNANSWERED * self.driver.rate:
                raise
            return
        self._lost = 0
        health.check(self.driver.joint_names, HOTTEST)
        self._rows.append((now, commanded, q, torque))

    def go(
        self,
        goal: Array,
        speed: float,
        until: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Go straight to a goal.

        Args:
            goal: The goal [rad].
            speed: Speed of the joint that goes farthest, at most that of its motors [rad/s].
            until: Is asked in each turn whether to stay there.

        Returns:
            Whether it stayed.
        """
        farthest = np.abs(goal - self.goal).max()
        step = min(speed, self.driver.speed) / self.driver.rate
        count = ceil(farthest / step)
        for place in np.linspace(self.goal, goal, count + 1)[1:]:
            self.turn(place)
            if until():
                return True
        return False

    def rest(self) -> tuple[Array, Array]:
        """Wait until joints are at rest; return where they are [rad], and their torques."""
        for _ in range(round(_REST * self.driver.rate)):
            self.turn(self.goal)
        return self.mean(_AT_REST)

    def mean(self, count: int) -> tuple[Array, Array]:
        """Return the mean of joints [rad] and torques over the last turns."""
        *_, q, torque = self.log(-count)
        return q.mean(axis=0), torque.mean(axis=0)
