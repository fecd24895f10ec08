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

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.hands.hand import LONGEST_STOP, Hand
from handmap_qp.se3 import as_floats

SHORTEST_DT = 1e-6
"""Least time that a sample accounts for [s].

In less, rounding of positions would be a speed.
"""

# A stop that ends outside the limits by no more counts as inside [rad or m].
_ROUNDING = 1e-12
# Accelerations from here on count as no limit [rad/s^2, m/s^2].
_NO_LIMIT = 1e100
# Distances count as no more than this, because a floating wrist has infinite ones [rad or m].
_FAR = 1e9


class Box(NamedTuple):
    """Bounds of the displacement of one sample, shape (nv,) each.

    Attributes:
        lower: Lower bound, never above the upper one.
        upper: Upper bound.
        least: From this to `most`, the acceleration limit leads to a displacement, and to a stop
            behind it inside the limits of position and time. Where limits contradict each other,
            bounds are outside.
        most: As said.
    """

    lower: np.ndarray
    upper: np.ndarray
    least: np.ndarray
    most: np.ndarray


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
        together: As given, shape (nv,).

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
        self._limits = limits
        if not has_velocity_limits:
            speed = np.full(len(speed), np.inf)
        self._loose = np.array([limits[0] - _ROUNDING, limits[1] + _ROUNDING])
        # The limits of a whole configuration; infinite for all but the hand's joints.
        self._box = np.full((2, hand.model.nq), [[-np.inf], [np.inf]])
        self._box[:, hand.q_indices] = hand.lower_limits, hand.upper_limits
        # Twice the same: numpy takes three times as long to spread a row over both limits.
        self._rows = np.array([coordinates, coordinates])
        self._speeds = np.array([speed, speed])
        self.together = np.zeros(len(speed), dtype=bool) if together is None else together
        self._has_together = bool(self.together.any())
        self.has_acceleration = max_acceleration is not None
        most = np.inf if max_acceleration is None else max_acceleration
        self._accelerations = np.array([_check_acceleration(most, len(speed))] * 2)
        self._signs = np.repeat([[-1.0], [1.0]], len(speed), 1)

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
        return self.box(q, dt, previous_velocity)[:2]

    def box(self, q: np.ndarray, dt: float, previous_velocity: np.ndarray | None = None) -> Box:
        """Return the bounds, and which displacements need no further check; as `bounds`."""
        farthest, room = self._speeds * dt, self._limits - q[self._rows]
        box = np.maximum(np.minimum(room, farthest), -farthest)
        if not self.has_acceleration:
            return Box(box[0], box[1], box[0], box[1])
        velocity = np.zeros(self.size) if previous_velocity is None else previous_velocity
        # The lower bound avoids a division by zero where the product underflows.
        change = np.maximum(self._accelerations * (dt * dt), 1e-200)
        middle = np.array([velocity, velocity]) * dt
        lowest, highest = middle - change, middle + change
        # Past a limit there is no braking distance left; the box brings the joint back.
        distance = np.minimum(np.maximum(self._signs * room, 0.0), _FAR)
        # Faster than this, a stop would take too long.
        usable = self._accelerations * (LONGEST_STOP * dt)
        most = np.minimum(braking_displacement(distance, change), usable)
        if self._has_together:
            stretch = np.where(self.together, 1.0 + self.stopping(velocity, dt), 1.0)
            most = np.minimum(most, distance / stretch)
        most *= self._signs
        bounds = np.minimum(np.maximum(most, lowest), highest)
        bounds = np.minimum(np.maximum(bounds, box[0]), box[1])
        return Box(
            bounds[0],
            bounds[1],
            np.maximum(most[0], lowest[0]) - _ROUNDING * dt,
            np.minimum(most[1], highest[1]) + _ROUNDING * dt,
        )

    def slowed(
        self, lower: np.ndarray, upper: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the part of a box (nv,) that is reached in a time [s], or its nearest corner."""
        farthest = self.farthest(dt)
        return np.clip(-farthest, lower, upper), np.clip(farthest, lower, upper)

    @property
    def size(self) -> int:
        """Number of coordinates, nv."""
        return self._limits.shape[1]

    def is_inside(self, q: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        """Return which coordinates a displacement leaves inside their position limits, shape (nv,).

        One that is outside must not move farther out.

        Args:
            q: Pinocchio configuration, shape (nq,).
            displacement: Displacement, shape (nv,).
        """
        room = self._loose - q[self._rows]
        is_inside = (displacement >= room[0]) & (displacement <= room[1])
        if np.count_nonzero(is_inside) == len(is_inside):
            return is_inside
        least, most = np.minimum(room[0], 0.0), np.maximum(room[1], 0.0)
        return (displacement >= least) & (displacement <= most)

    def clipped(self, q: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Return a configuration inside its position limits, or no farther outside than before.

        Args:
            q: Pinocchio configuration, shape (nq,).
            before: The one that it was reached from, which may be outside.
        """
        least, most = np.minimum(self._box[0], before), np.maximum(self._box[1], before)
        inside = np.maximum(q, least, out=least)
        return np.minimum(inside, most, out=most)

    def farthest(self, dt: float) -> np.ndarray:
        """Return the displacements at the speed limits, shape (nv,)."""
        return self._speeds[0] * dt

    def change(self, dt: float) -> np.ndarray:
        """Return by how much acceleration can change a displacement, shape (nv,)."""
        return self._accelerations[0] * (dt * dt)

    def stop_times(self, displacement: np.ndarray, dt: float) -> np.ndarray:
        """Return the time in which each coordinate stops behind a displacement [s], shape (nv,).

        Args:
            displacement: Displacement, shape (nv,).
            dt: Time for it [s].
        """
        times = np.abs(displacement / dt) / self._accelerations[0]
        if self._has_together:
            times[self.together] = times[self.together].max()
        return times

    def stopping(self, velocity: np.ndarray, dt: float) -> float:
        """Return a bound of the stop behind the next displacement, as a multiple of it.

        Args:
            velocity: Of the last sample, shape (nv,).
            dt: Time of the next sample [s].
        """
        if not (self.has_acceleration and self._has_together):
            return 0.0
        longest = (np.abs(velocity) / self._accelerations[0])[self.together].max()
        return 0.5 * (float(longest) + dt) / dt


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
    # A limit beyond all speeds is none; as such, its products with times cannot overflow.
    return np.where(limit < _NO_LIMIT, limit, np.inf)
