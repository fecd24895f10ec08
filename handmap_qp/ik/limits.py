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
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.transform import as_floats


class BoxLimits:
    """Bounds of the displacement within one sample.

    Args:
        hand: The hand.
        has_velocity_limits: Whether speed limits hold; position limits always do.
        max_acceleration: Limit of every velocity coordinate's acceleration, shape (nv,) or one
            number for all [rad/s^2, and m/s^2 for a floating wrist's translation]; none if omitted.

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
        self._lower, self._upper = self._limits = limits
        self._coordinates = as_slice(coordinates)
        if not has_velocity_limits:
            speed = np.full(len(speed), np.inf)
        # Twice the same: numpy takes three times as long to spread a row over both limits.
        self._rows = np.array([coordinates, coordinates])
        self._speeds = np.array([speed, speed])
        self.has_acceleration = max_acceleration is not None
        self._acceleration = (
            None if max_acceleration is None else _check_acceleration(max_acceleration, len(speed))
        )

    def bounds(
        self,
        q: np.ndarray,
        dt: float,
        previous_velocity: np.ndarray | None = None,
        *,
        stop_times: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper bound of the displacement from `q`.

        Args:
            q: Pinocchio configuration, shape (nq,).
            dt: Time for the displacement [s].
            previous_velocity: Displacement of the last sample divided by its time, shape (nv,); at
                rest if omitted. Matters only to acceleration limits.
            stop_times: Time in which each coordinate must be able to stop [s], shape (nv,); as fast
                as it can by itself if omitted. Matters only to acceleration limits.

        Returns:
            Two arrays of shape (nv,), `lower <= upper`.
        """
        farthest, room = self._speeds * dt, self._limits - q[self._rows]
        box = np.maximum(np.minimum(room, farthest), -farthest)
        lower, upper = box[0], box[1]
        if self._acceleration is None:
            return lower, upper
        return self._with_acceleration(
            self._acceleration, room, dt, previous_velocity, lower, upper, stop_times
        )

    @property
    def size(self) -> int:
        """Number of coordinates, nv."""
        return self._limits.shape[1]

    def stop_time(self, velocity: np.ndarray, columns: np.ndarray) -> float:
        """Return the time in which coordinates can stop together [s]; 0 without limits.

        Args:
            velocity: Of all coordinates, shape (nv,).
            columns: Which of them stop together, shape (nv,).
        """
        if self._acceleration is None:
            return 0.0
        return float((np.abs(velocity) / self._acceleration)[columns].max(initial=0.0))

    def outside(self, q: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        """Return how far a displacement takes each joint outside its position limits, shape (nv,).

        Args:
            q: Pinocchio configuration, shape (nq,).
            displacement: Displacement, shape (nv,).
        """
        reached = q[self._coordinates] + displacement
        return np.maximum(np.maximum(self._lower - reached, reached - self._upper), 0.0)

    def _with_acceleration(
        self,
        acceleration: np.ndarray,
        room: np.ndarray,
        dt: float,
        previous_velocity: np.ndarray | None,
        lower: np.ndarray,
        upper: np.ndarray,
        stop_times: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the part of the box within reach of the last velocity, or its nearest corner."""
        joints = self._joints
        # The lower bound avoids a division by zero for samples so short that dt^2 underflows.
        change = np.maximum(acceleration * dt**2, 1e-200)
        middle = 0.0 if previous_velocity is None else previous_velocity * dt
        lowest, highest = middle - change, middle + change
        least, most = lowest.copy(), highest.copy()
        # Past a limit there is no braking distance left; the box brings the joint back.
        below, above = np.maximum(-room[0, joints], 0.0), np.maximum(room[1, joints], 0.0)
        to_upper = braking_displacement(above, change[joints])
        to_lower = braking_displacement(below, change[joints])
        if stop_times is not None:
            stretch = 1.0 + 0.5 * stop_times[joints] / dt
            to_upper = np.minimum(to_upper, above / stretch)
            to_lower = np.minimum(to_lower, below / stretch)
        most[joints] = np.minimum(np.maximum(to_upper, lowest[joints]), highest[joints])
        least[joints] = np.minimum(np.maximum(-to_lower, lowest[joints]), highest[joints])
        return np.minimum(np.maximum(least, lower), upper), np.minimum(
            np.maximum(most, lower), upper
        )


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
