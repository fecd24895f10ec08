"""Position, speed and acceleration limits as one box on the displacement, never empty.

    clip(q_min - q, -v dt, v dt) <= dq <= clip(q_max - q, -v dt, v dt)

Clipping is monotone, so the lower bound never passes the upper one, also where `q` starts outside
its limits: there both bounds meet at the speed limit and the joint comes back as fast as it may.
The stacked position and speed rows of mink and pink are infeasible in that case.

An acceleration limit is clipped into that box the same way, `clip(v_last dt -+ a dt^2, lower,
upper)`: position and speed limits have priority. To avoid such conflicts, a joint approaches its
limit only as fast as it can still brake,

    v dt + v^2 / (2 a) <= distance to the limit.

Once true, this stays true from sample to sample for any sample times. So a joint that starts at
rest inside its limits keeps both limits.

Joints can also brake together, each in proportion to its speed, so that the hand stops on the
straight line that it moves on. The joint that needs the longest sets the time `T` of that stop. The
displacement x of a sample and the stop behind it are the line `(1 + T / (2 dt)) x` together, for
any sample times to come.

With an acceleration limit a, no coordinate moves faster than `a LONGEST_STOP`. So every stop takes
at most that time, whatever the limit is.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.transform import as_floats

LONGEST_STOP = 0.5
"""Longest time in which a robot stops, whatever its acceleration limit is [s]."""
SHORTEST_DT = 1e-6
"""Least time that a sample accounts for [s].

In less, rounding of positions would be a speed.
"""


class BoxLimits:
    """Bounds of the displacement within one sample.

    Args:
        hand: The hand.
        has_velocity_limits: Whether speed limits hold; position limits always do.
        max_acceleration: Limit of every velocity coordinate's acceleration, shape (nv,) or one
            number for all [rad/s^2, and m/s^2 for a floating wrist's translation]; none if omitted.
        together: Which coordinates must be able to stop together, shape (nv,); none if omitted.

    Attributes:
        has_acceleration: Whether accelerations are limited.

    Raises:
        InvalidOptionsError: If an acceleration limit is not > 0 or has another shape.
    """

    def __init__(
        self,
        hand: Hand,
        *,
        has_velocity_limits: bool = True,
        max_acceleration: npt.ArrayLike | None = None,
        together: np.ndarray | None = None,
    ) -> None:
        # The solver's order is the model's, not that of `joint_names`.
        order = np.argsort(hand.v_indices)
        coordinates = hand.q_indices[order]
        limits = np.array([hand.lower_limits[order], hand.upper_limits[order]])
        speed = hand.velocity_limits[order]
        self._joints = slice(0, None)
        if hand.is_floating:
            wrist = hand.spec.wrist
            speeds = np.repeat([wrist.max_linear_speed, wrist.max_angular_speed], 3)
            speed = np.concatenate([speeds, speed])
            # Pinocchio's free-flyer has limits of +-1.8e308, which stay out of all arithmetic. With
            # infinite ones in their place, whole vectors are compared: any six of its seven
            # coordinates do for its six speeds.
            coordinates = np.concatenate([np.arange(1, 7), coordinates])
            unlimited = np.full(6, np.inf)
            limits = np.hstack([[-unlimited, unlimited], limits])
            self._joints = slice(6, None)
        self._limits = limits
        if not has_velocity_limits:
            speed = np.full(len(speed), np.inf)
        # Twice the same: numpy takes three times as long to spread a row over both limits.
        self._rows = np.array([coordinates, coordinates])
        self._speeds = np.array([speed, speed])
        self._together = np.zeros(len(speed), dtype=bool) if together is None else together
        self._has_together = bool(self._together.any())
        self.has_acceleration = max_acceleration is not None
        self._acceleration = (
            None if max_acceleration is None else _check_acceleration(max_acceleration, len(speed))
        )

    def bounds(
        self, q: np.ndarray, dt: float, previous_velocity: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper bound of the displacement from `q`.

        Args:
            q: Pinocchio configuration, shape (nq,).
            dt: Time for the displacement [s].
            previous_velocity: Displacement of the last sample divided by its time, shape (nv,); at
                rest if omitted. Matters only to acceleration limits.

        Returns:
            Two arrays of shape (nv,), `lower <= upper`.
        """
        farthest, room = self._speeds * dt, self.room(q)
        box = np.maximum(np.minimum(room, farthest), -farthest)
        lower, upper = box[0], box[1]
        if self._acceleration is None:
            return lower, upper
        velocity = np.zeros(self.size) if previous_velocity is None else previous_velocity
        return self._with_acceleration(self._acceleration, room, dt, velocity, lower, upper)

    @property
    def size(self) -> int:
        """Number of coordinates, nv."""
        return self._limits.shape[1]

    def room(self, q: np.ndarray) -> np.ndarray:
        """Return the displacements to the lower and to the upper position limit, shape (2, nv)."""
        return self._limits - q[self._rows]

    def clipped(self, q: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Return a configuration inside its position limits, or no farther outside than before.

        Args:
            q: Pinocchio configuration, shape (nq,).
            before: The one that it was reached from, which may be outside.
        """
        rows = self._rows[0]
        reached, start = q[rows], before[rows]
        lower, upper = np.minimum(self._limits[0], start), np.maximum(self._limits[1], start)
        inside = np.minimum(np.maximum(reached, lower), upper)
        if inside.tobytes() != reached.tobytes():
            q = q.copy()
            q[rows] = inside
        return q

    def farthest(self, dt: float) -> np.ndarray:
        """Return the displacements at the speed limits, shape (nv,)."""
        return self._speeds[0] * dt

    def change(self, dt: float) -> np.ndarray:
        """Return by how much acceleration can change a displacement, shape (nv,)."""
        if self._acceleration is None:
            return np.full(self.size, np.inf)
        return self._acceleration * (dt * dt)

    def stop_times(self, velocity: np.ndarray) -> np.ndarray:
        """Return the time in which each coordinate stops [s], shape (nv,); 0 without limits.

        Args:
            velocity: Of all coordinates, shape (nv,).
        """
        if self._acceleration is None:
            return np.zeros_like(velocity)
        times = np.abs(velocity) / self._acceleration
        if self._has_together:
            times[self._together] = times[self._together].max()
        return times

    def stopping(self, velocity: np.ndarray, dt: float) -> float:
        """Return a bound of the stop behind the next displacement, as a multiple of it.

        Args:
            velocity: Of the last sample, shape (nv,).
            dt: Time of the next sample [s].
        """
        if self._acceleration is None or not self._has_together:
            return 0.0
        longest = (np.abs(velocity) / self._acceleration)[self._together].max()
        return 0.5 * (float(longest) + dt) / dt

    def _with_acceleration(
        self,
        acceleration: np.ndarray,
        room: np.ndarray,
        dt: float,
        velocity: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the part of the box within reach of the last velocity, or its nearest corner."""
        joints = self._joints
        # The lower bound avoids a division by zero where the product underflows.
        change = np.maximum(self.change(dt), 1e-200)
        middle = velocity * dt
        lowest, highest = middle - change, middle + change
        # Faster than this, a stop would take too long.
        most = acceleration * (LONGEST_STOP * dt)
        least = -most
        # Past a limit there is no braking distance left; the box brings the joint back.
        below, above = np.maximum(-room[0, joints], 0.0), np.maximum(room[1, joints], 0.0)
        to_upper = braking_displacement(above, change[joints])
        to_lower = braking_displacement(below, change[joints])
        if self._has_together:
            stretch = 1.0 + np.where(self._together, self.stopping(velocity, dt), 0.0)[joints]
            to_upper = np.minimum(to_upper, above / stretch)
            to_lower = np.minimum(to_lower, below / stretch)
        most[joints] = np.minimum(most[joints], to_upper)
        least[joints] = np.maximum(least[joints], -to_lower)
        most = np.minimum(np.maximum(most, lowest), highest)
        least = np.minimum(np.maximum(least, lowest), highest)
        return np.minimum(np.maximum(least, lower), upper), np.minimum(
            np.maximum(most, lower), upper
        )


def stopping_distances(hand: Hand) -> np.ndarray:
    """Return how far each joint moves at most while it stops, shape (n,) [rad or m].

    From its speed limit and `LONGEST_STOP`; it is no more than its range.
    """
    ranges = hand.upper_limits - hand.lower_limits
    return np.minimum(0.5 * LONGEST_STOP * hand.velocity_limits, ranges)


def as_slice(indices: np.ndarray) -> slice | np.ndarray:
    """Return consecutive indices as a slice, which is quicker and makes no copy."""
    first, count = int(indices[0]), len(indices)
    return (
        slice(first, first + count)
        if np.array_equal(indices, np.arange(first, first + count))
        else indices
    )


def braking_displacement(distance: np.ndarray, change: np.ndarray | float) -> np.ndarray:
    """Return the largest displacement x after which a joint can still stop within `distance`.

    The root of `x + x^2 / (2 a dt^2) = distance`, in a form without cancellation.

    Args:
        distance: Distances [rad or m].
        change: `a dt^2`, likewise.
    """
    return 2.0 * distance / (1.0 + np.sqrt(1.0 + 2.0 * distance / change))


def _check_acceleration(max_acceleration: npt.ArrayLike, nv: int) -> np.ndarray:
    try:
        limit = np.array(as_floats(max_acceleration, "max_acceleration"))
    except InvalidInputError:
        limit = np.empty(0)
    if limit.ndim == 0:
        limit = np.full(nv, float(limit))
    if limit.shape != (nv,) or not (limit > 0.0).all():
        raise InvalidOptionsError(
            option="max_acceleration",
            expected=f"{nv} numbers > 0, or one for all",
            value=max_acceleration,
        )
    return limit
