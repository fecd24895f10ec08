"""Displacements from which the hand can still stop without an overlap.

A displacement x takes a sample of dt. Behind it the joints can brake together, in the time T that
their acceleration limits ask for, and stay on the line they move on. So the sample and the stop are
the line from q to

    q + (1 + T / (2 dt)) x

together. A displacement is admitted if that line is inside the position limits and clear of
overlaps. The stop stays possible while the hand brakes, for any sample times:

    x_brake = v (1 - dt / T) dt,    v the last velocity,

ends on the line that was found clear, and needs the time T - dt. Another displacement that is not
admitted is shortened towards x_brake. Both are inside the box of speed and acceleration, so all
between are. A hand that starts without an overlap never has one.

The displacement that is shortened is that of the first iteration of the QP. The sum of all
iterations is longer, and farther from the start, where the rows of the QP are exact.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from handmap_qp.ik.clear_path import ClearPath
from handmap_qp.ik.distances import NearPairs
from handmap_qp.ik.limits import BoxLimits

_SHARES = (1.0, 0.5, 0.25, 0.1)
_ROUNDING = 1e-12


class Start(NamedTuple):
    """Where a sample begins.

    Attributes:
        q: Pinocchio configuration, shape (nq,).
        near: The pairs of shapes there.
    """

    q: np.ndarray
    near: NearPairs


class Moving(Protocol):
    """State of a hand that moves.

    Attributes:
        stop_time: Time of the stop that was found clear at the last sample [s]; 0 if it may stop
            at once.
    """

    stop_time: float

    @property
    def velocity(self) -> np.ndarray:
        """Displacement of the last sample divided by its time, shape (nv,)."""
        ...


class StopGuard:
    """Admits displacements of one hand.

    Args:
        limits: Its limits.
        path: Checks its ways.
    """

    def __init__(self, limits: BoxLimits, path: ClearPath) -> None:
        self._limits, self._path = limits, path

    def longest_stop(self, velocity: np.ndarray, dt: float) -> float:
        """Return a bound of the stop's time after the next sample [s]; 0 for stops at once.

        Args:
            velocity: Of the last sample, shape (nv,).
            dt: Time of the next sample [s].
        """
        if not self._limits.has_acceleration:
            return 0.0
        return self._limits.stop_time(velocity, self._path.columns) + dt

    def bounds(
        self, q: np.ndarray, velocity: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the part of the limits' box in which the joints can stop together.

        Args:
            q: Pinocchio configuration, shape (nq,).
            velocity: Of the last sample, shape (nv,).
            dt: Time of the next sample [s].

        Returns:
            Lower and upper bound of the displacement, shape (nv,) each.
        """
        if not self._limits.has_acceleration:
            return self._limits.bounds(q, dt)
        times = np.where(self._path.columns, self.longest_stop(velocity, dt), 0.0)
        return self._limits.bounds(q, dt, velocity, stop_times=times)

    def admit(
        self,
        start: Start,
        displacement: np.ndarray,
        first: np.ndarray,
        dt: float,
        state: Moving,
        end: NearPairs | None = None,
    ) -> np.ndarray:
        """Return the displacement of a sample that is admitted, and note its stop.

        Where the hand starts outside its limits, it comes back as the QP says.

        Args:
            start: Where the hand is before it.
            displacement: Sum of the QP's iterations, inside the box, shape (nv,).
            first: Displacement of the first iteration, likewise.
            dt: Time for it [s].
            state: The hand; its `stop_time` is set.
            end: Where `displacement` ends; measured where it matters if omitted.

        Returns:
            `displacement` itself if it is admitted, or another one, shape (nv,).
        """
        if self._admits(start, displacement, dt, state, end):
            return displacement
        is_braking = state.stop_time > dt
        change = state.velocity * (dt * (1.0 - dt / state.stop_time)) if is_braking else 0.0
        is_outside = self._limits.outside(start.q, np.zeros_like(first)) > 0.0
        brake = np.where(self._path.columns & ~is_outside, change, first)
        for share in _SHARES:
            shortened = brake + share * (first - brake)
            if self._admits(start, shortened, dt, state):
                return shortened
        state.stop_time = max(state.stop_time - dt, 0.0)
        return brake

    def _admits(
        self,
        start: Start,
        displacement: np.ndarray,
        dt: float,
        state: Moving,
        end: NearPairs | None = None,
    ) -> bool:
        """Return whether a sample and its stop are inside the limits and clear; note the stop."""
        limits, columns = self._limits, self._path.columns
        time = limits.stop_time(displacement / dt, columns) if limits.has_acceleration else 0.0
        if time == 0.0 and end is not None:
            # The QP's box keeps a displacement without a stop behind it inside the limits.
            is_clear = self._path.is_clear(*start, displacement, end)
        else:
            whole = np.where(columns, (1.0 + 0.5 * time / dt) * displacement, 0.0)
            least = limits.outside(start.q, np.zeros_like(displacement))
            is_inside = (limits.outside(start.q, whole) <= least + _ROUNDING).all()
            is_clear = bool(is_inside) and self._path.is_clear(*start, whole)
        if is_clear:
            state.stop_time = time
        return is_clear
