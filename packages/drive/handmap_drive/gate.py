"""The gate of the motors: it limits how fast goals move, and every goal goes through it."""

from itertools import compress

import numpy as np

from handmap_qp.errors import expect
from handmap_qp.hands import Names
from handmap_qp.se3 import Array
from .driver import Driver, DriverError, Health

APPROACH = 0.5
"""Speed of goals until they meet their targets [rad/s]."""
_ACCELERATION = 20.0
"""How quickly the limit of the speed grows after the approach [rad/s^2]."""
_TURNS = 2.0
"""Longest time between two goals that counts for their speed, in turns of the loop."""


class Gate:
    """Writes goals of motors, and reads the motors.

    Goals begin where the motors are: at first, after each stop, and until a motor has torque. From
    there each goal moves at most at `APPROACH` until it meets its target. Then the limit of its
    speed grows to that of the driver. The time between two writes counts, up to two turns.

    All angles are those that motors are commanded and report. A calibration that is wrong can only
    make the targets wrong.

    Args:
        driver: The motors, connected.

    Attributes:
        driver: As given.
        measured: Where the motors were read last [rad], shape (n,); not finite before `read`.
        goal: The last goal written, or `measured` for motors without torque [rad], shape (n,).
        has_met: Whether the approach of each motor is over, shape (n,).
        lost: Joints whose motor had torque, and has none although it was not stopped.
    """

    def __init__(self, driver: Driver) -> None:
        count = len(driver.joint_names)
        self.driver = driver
        self.measured: Array = np.full(count, np.nan)
        self.goal: Array = self.measured
        self.has_met = np.zeros(count, bool)
        # From goals to their targets, before the last step.
        self._away = np.zeros(count)
        self.lost: Names = ()
        self._slowest = min(APPROACH, driver.speed)
        self._speed = np.full(count, self._slowest)
        self._has_torque = np.zeros(count, bool)
        # Time of the last write since the last stop [s].
        self._written: float | None = None

    def read(self) -> tuple[Array, Array, Health]:
        """Return where the motors are [rad], their torques, shapes (n,), and their health.

        Raises:
            DriverError: If an answer is missing or damaged, or an angle is not a number.
        """
        q, torque, health = self.driver.read()
        names = self.driver.joint_names
        for name, angle in zip(names, q, strict=True):
            if not np.isfinite(angle):
                raise DriverError(f"{name}: its angle is not a number")
        is_powered = np.array([name not in health.unpowered for name in names])
        has_lost = self._has_torque & ~is_powered
        self.lost = tuple(compress(names, has_lost))
        # Before the first write since a stop, torque may be that of a stop whose message was lost.
        if self._written is not None:
            self._has_torque = self._has_torque | is_powered
        self.measured = q
        self.goal = np.where(self._has_torque, self.goal, q)
        return q, torque, health

    def begin(self, place: Array) -> None:
        """Begin at other goals than the angles that were read.

        For encoders that are not in the motors, if goals that hold the joints are known from a
        measurement of this hand just before. Call it after `read`, without torque.

        Args:
            place: The goals that hold the joints where they are [rad], shape (n,).
        """
        self.goal = np.clip(place, *self.driver.range)

    def write(self, target: Array, effort: float, now: float) -> Array:
        """Move the goals towards targets, and write them.

        Args:
            target: Where the motors are to go [rad], shape (n,).
            effort: Limit of the torque, a share of the largest.
            now: The present [s]; only differences count.

        Returns:
            The goals [rad], shape (n,).

        Raises:
            InvalidInputError: If a target is not a number, or the motors were not read.
            DriverError: If a motor lost its torque and was not stopped since.
        """
        if self.lost:
            raise DriverError(f"{', '.join(self.lost)}: torque lost")
        expect(np.isfinite(target).all(), "target", "numbers", value=target.tolist())
        expect(np.isfinite(self.goal).all(), "goal", "motors that were read")
        driver = self.driver
        turn = 1.0 / driver.rate
        elapsed = turn if self._written is None else now - self._written
        dt = np.clip(elapsed, 0.0, _TURNS * turn)
        away = np.clip(target, *driver.range) - self.goal
        step = self._speed * dt
        # It is in reach, or has come past the goal.
        meets = (np.abs(away) <= step) | (away * self._away < 0.0)
        self._away = away
        # A joint without torque may fall past its target.
        self.has_met = self.has_met | (self._has_torque & meets)
        self.goal = self.goal + np.clip(away, -step, step)
        grown = np.minimum(self._speed + _ACCELERATION * dt, driver.speed)
        self._speed = np.where(self.has_met, grown, self._slowest)
        self._written = now
        driver.write(self.goal, effort)
        return self.goal

    def stop(self) -> None:
        """Take the torque away, and begin where the motors are read next."""
        self.driver.stop()
        self.lost = ()
        self.has_met = np.zeros_like(self.has_met)
        self._away = np.zeros_like(self._away)
        self._speed = np.full_like(self._speed, self._slowest)
        self._has_torque = np.zeros_like(self._has_torque)
        self._written = None
        self.goal = np.full_like(self.goal, np.nan)
