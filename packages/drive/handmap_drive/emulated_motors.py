"""The joints behind emulated motors, and what each kind of motors does with messages."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np

LAG = 0.03  # s
FASTEST = 8.48  # rad/s
STIFFNESS = 0.6
"""Torque, as a share of the largest, per rad between goal and position."""
FRICTION = 0.02
"""Torque without which nothing moves, as a share of the largest."""
OVERLOAD, LONGEST = 0.9, 1.0
"""Torque, as a share of the largest, that a motor bears for a time only [s]."""
HOTTEST = 70.0  # degrees Celsius


class EmulatedMotors(ABC):
    """Motors that follow their goals with a lag, a speed limit and a limit of torque.

    Args:
        numbers: Their numbers.
        angle: Where they are at the start [rad].

    Attributes:
        numbers: As given. Arrays have a value for each motor in this order.
        wall: Least and largest angles to which they can move [rad].
        temperature: How hot they are [degrees Celsius].
        silent: Those that do not answer.
        booting: Until when each motor restarts: it hears and answers nothing [s].
        deaf: Registers for which messages to all motors get lost.
        heard: When they heard a message [s].
        patience: After how long without a message they hold [s].
    """

    ends: ClassVar[Any] = [[-9.0], [9.0]]
    """`wall` at the start."""
    own: ClassVar[range | None] = None
    """Their numbers, if there are no others."""

    def __init__(self, numbers: range, angle: float) -> None:
        self.numbers = self.own or numbers
        count = len(self.numbers)
        self.wall = np.broadcast_to(self.ends, (2, count)).copy()
        self.angle = np.clip(np.full(count, angle), *self.wall)
        self.goal = self.angle.copy()
        self.limit = np.ones(count)
        self.effort, self.pressed = np.zeros((2, count))
        self.temperature = np.full(count, 30.0)
        self.has_torque, self.is_hot, self.is_loaded = np.zeros((3, count), bool)
        self.silent = self.deaf = frozenset[int]()
        self.patience = np.full(count, np.inf)
        self.booting = np.full(count, -np.inf)
        self.heard = time.monotonic()

    @property
    def allowed(self) -> np.ndarray:
        """Limits of torque, 0 for motors without torque."""
        return self.has_torque * self.limit

    @property
    def is_faulty(self) -> np.ndarray:
        """Which motors have a fault, and no torque until they are new."""
        return self.is_hot | self.is_loaded

    def move(self, dt: float, now: float) -> None:
        """Advance the joints."""
        late = self.has_torque & (now - self.heard > self.patience)
        if late.any():
            self.hold(late)
        away = self.goal - self.angle
        limit = self.allowed
        self.effort = np.clip(STIFFNESS * away, -limit, limit)
        # A lag of first order; against friction, some torque is needed.
        fastest = FASTEST * (limit > FRICTION)
        speed = np.clip(away / LAG, -fastest, fastest)
        self.angle = np.clip(self.angle + dt * speed, *self.wall)
        self.pressed = (np.abs(self.effort) > OVERLOAD) * (self.pressed + dt)
        self.is_loaded |= self.pressed > LONGEST
        self.is_hot |= self.temperature > HOTTEST
        self.has_torque &= ~self.is_faulty

    def hold(self, late: np.ndarray) -> None:
        """Let motors stay where they are, because they have heard nothing for too long."""
        self.goal = np.where(late, self.angle, self.goal)
        self.patience[late] = np.inf

    def reboot(self, number: int, seconds: float, now: float) -> None:
        """Let a motor restart, as after a loss of its supply; of a hand, all of them do.

        Args:
            number: The motor's.
            seconds: Time in which it hears and answers nothing.
            now: The present [s].
        """
        which = np.full(len(self.numbers), self.own is not None)
        which[self.numbers.index(number)] = True
        self.booting[which] = now + seconds
        self.pressed[which] = 0.0
        self.is_hot[which] = False
        self.is_loaded[which] = False
        self.has_torque[which] = False
        self.patience[which] = np.inf
        self.goal = np.where(which, self.angle, self.goal)
        self.forget(which)

    def forget(self, which: np.ndarray) -> None:
        """Give motors the registers that they have when they start."""
        self.limit[which] = 1.0

    @property
    def is_booting(self) -> np.ndarray:
        """Which motors hear and answer nothing yet."""
        return self.heard < self.booting

    @property
    def state(self) -> dict[str, np.ndarray]:
        """What they do."""
        return {
            "goal": self.goal,
            "angle": self.angle,
            "limit": self.allowed,
            "effort": self.effort,
        }

    @abstractmethod
    def messages(self, buffer: bytearray) -> Iterator[Any]:
        """Remove the complete messages from what has arrived, and yield them."""

    @abstractmethod
    def obey(self, message: Any) -> Iterator[bytes]:
        """Do what a message says, and yield the answers."""
