"""How a robot moves, and when its commands are.

The gate owns both (`handmap_core.ik.gate`): a command gives its instant, not a duration, so that
speed and acceleration hold by the time stamps of the commands.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from handmap_core.core import core
from handmap_core.se3 import Array

SHORTEST_DT = 1e-6
"""Least time that a sample accounts for [s].

In less, rounding of positions would be a speed.
"""

LONGEST_STEP: float = core.LONGEST_STEP
"""Longest time that one command may take, in usual periods of its samples.

After a longer one the robot has stood still, and must not make up for it in one command.
"""

BEHIND: float = core.BEHIND
"""An instant that is earlier than the robot's last command by more is of another clock [s]."""


class Motion(NamedTuple):
    """How a robot moves. Writing to the arrays moves nothing.

    Attributes:
        q: Pinocchio configuration last commanded, shape (nq,).
        displacement: Displacement of the last command in the active coordinates, shape (nv,).
        dt: Time from the command before to the last one [s].
        stop_times: Time in which each coordinate can stop on the line that was admitted [s], shape
            (nv,); 0 for at once.
        time: Instant of the last command, on the robot's clock [s].
    """

    q: Array
    displacement: Array
    dt: float
    stop_times: Array
    time: float = 0.0

    @classmethod
    def at_rest(cls, q: Array, nv: int, time: float = 0.0) -> Motion:
        """Return the motion of a robot that stands at a configuration since an instant [s]."""
        return cls(np.array(q), np.zeros(nv), 1.0, np.zeros(nv), time)

    @property
    def velocity(self) -> Array:
        """Velocity in the last sample, shape (nv,)."""
        return self.displacement / self.dt

    @property
    def is_braking(self) -> bool:
        """Whether the robot moves, and its acceleration limit keeps it from standing at once."""
        return bool(self.stop_times.any() and self.displacement.any())


class Instant(NamedTuple):
    """When a command is.

    Attributes:
        time: Its instant on the robot's clock, which counts from an arbitrary zero [s].
        longest: Longest time that the command may take [s].
    """

    time: float
    longest: float = math.inf


When = float | Instant
"""When a command is: its `Instant`, or the time since the robot's last command [s]."""


class Interval(NamedTuple):
    """The time of a robot's next command. Only a gate makes one.

    Attributes:
        dt: Time since the robot's last command [s].
        granted: Part of it in which the command may move the robot [s].
        time: Instant of the command on the robot's clock [s].
    """

    dt: float
    granted: float
    time: float
