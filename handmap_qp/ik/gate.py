"""The gate: every displacement of a robot passes it, and a stop behind it is always possible.

A displacement x takes a sample of dt. Behind it each coordinate can brake in a time T, and moves by
half of T times its velocity meanwhile. So the sample and the stop are the line from q to

    q + (1 + T / (2 dt)) x

together. Coordinates that move shapes against each other brake together, with one T, so that the
hand stays on the straight line that it moves on. A displacement is admitted if

- it is within the limits of position, speed and acceleration,
- the whole line is inside the position limits and, where links are kept apart, clear of overlaps,
- T is at most `LONGEST_STOP`.

The stop that was admitted last stays possible while the hand brakes, for any sample times:

    x_brake = v (1 - dt / T) dt,    v the last velocity,

ends on the line that was found clear, and needs the time T - dt. Another displacement that is not
admitted is shortened towards x_brake, and replaced by it at last. Both are within the limits of
speed and acceleration, so all between are. A hand that starts without an overlap never has one.

Where a limit is lowered while the hand moves, the stop that was found under the former one stays in
force until a stop under the new one is admitted.

The displacement that is shortened is that of the first iteration of the QP. The sum of all
iterations is longer, and farther from the start, where the rows of the QP are exact.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import LONGEST_STOP, Hand
from handmap_qp.ik.limits import (
    SHORTEST_DT,
    BoxLimits,
    braking_displacement,
    clip,
    feasible,
)
from handmap_qp.ik.solvers import solve_by_daqp

if TYPE_CHECKING:
    from handmap_qp.ik.collision import CollisionLimit, NearPairs

_SHARES = (1.0, 0.5, 0.25, 0.1)
# Displacements of a sample are near this size [rad]; the solver is exact near one.
_SCALE = 0.05


class Motion(NamedTuple):
    """How a robot moves; do not write to the arrays.

    Attributes:
        q: Pinocchio configuration last commanded, shape (nq,).
        displacement: Displacement of the last sample in the active coordinates, shape (nv,).
        dt: Time of that sample [s].
        stop_times: Time in which each coordinate can stop on the line that was admitted [s], shape
            (nv,); 0 for at once.
    """

    q: np.ndarray
    displacement: np.ndarray
    dt: float
    stop_times: np.ndarray

    @classmethod
    def at_rest(cls, q: np.ndarray, nv: int) -> Motion:
        """Return the motion of a robot that stands at a configuration."""
        return cls(np.array(q), np.zeros(nv), 1.0, np.zeros(nv))

    @property
    def velocity(self) -> np.ndarray:
        """Velocity in the last sample, shape (nv,)."""
        return self.displacement / self.dt

    @property
    def is_braking(self) -> bool:
        """Whether the robot moves, and its acceleration limit keeps it from standing at once."""
        return bool(self.stop_times.any() and self.displacement.any())


class Gate:
    """Owns the motion of a robot, and admits its displacements.

    Args:
        hand: The robot.
        motion: How it moves; it may come from the gate of another limit.
        has_velocity_limits: Whether speed limits hold; position limits always do.
        max_acceleration: Limit of every coordinate [rad/s^2, m/s^2]; None for none.
        collisions: Pairs of shapes to keep apart; none if omitted.

    Attributes:
        motion: How the robot moves.
        collisions: As given.
        measured: What was found last of the pairs of shapes, in this posture or one before.
    """

    def __init__(
        self,
        hand: Hand,
        motion: Motion,
        *,
        has_velocity_limits: bool = True,
        max_acceleration: float | None = None,
        collisions: CollisionLimit | None = None,
    ) -> None:
        self.motion = motion
        self.collisions = collisions
        self._hand = hand
        self.measured: NearPairs | None = None
        self._limits = BoxLimits(
            hand,
            has_velocity_limits=has_velocity_limits,
            max_acceleration=max_acceleration,
            together=None if collisions is None else collisions.columns,
        )
        self._together = self._limits.together

    def place(self, q: np.ndarray) -> None:
        """Put the robot at a configuration, at rest.

        Args:
            q: Pinocchio configuration, shape (nq,).
        """
        self.motion = Motion.at_rest(q, self._limits.size)
        self.measured = None

    def bounds(self, dt: float, share: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of the next displacement, shape (nv,) each.

        Args:
            dt: Time for it [s].
            share: Share of the speed limits to use, as far as braking allows.
        """
        lower, upper, *_ = self._limits.box(self.motion.q, dt, self.motion.velocity)
        farthest = share * dt * self._limits.speeds
        # Up to that displacement, or the nearest corner of the box.
        return clip(-farthest, lower, upper), clip(farthest, lower, upper)

    def stopping(self, dt: float) -> float:
        """Return a bound of the stop behind the next displacement, as a multiple of it."""
        return self._limits.stopping(self.motion.velocity, dt)

    def near(
        self, collisions: CollisionLimit, dt: float, margins: np.ndarray | None = None
    ) -> NearPairs:
        """Return the pairs of shapes where the robot is, measured unless they are known.

        Args:
            collisions: The gate's.
            dt: Time of the next sample [s].
            margins: Distance that each pair keeps [m], shape (k,); the hand's own if omitted.
        """
        near = self.measured
        if near is None or near.q.tobytes() != self.motion.q.tobytes():
            near = collisions.measure(self.motion.q, dt, margins, before=near)
            self.measured = near
        return near

    def admit(
        self,
        wanted: np.ndarray,
        first: np.ndarray,
        dt: float,
        end: NearPairs | None = None,
    ) -> np.ndarray:
        """Move the robot by a displacement, or by another one that is admitted.

        Args:
            wanted: Displacement in the active coordinates, shape (nv,).
            first: Another one that is shortened if the wanted one is not admitted, likewise.
            dt: Time for it [s].
            end: The pairs of shapes where `wanted` ends; measured where it matters if omitted.

        Returns:
            The displacement taken: `wanted` itself if it is admitted.
        """
        box = self._limits.box(self.motion.q, dt, self.motion.velocity)
        # This also replaces NaN.
        taken = np.fmin(np.fmax(wanted, box.lower), box.upper)
        times = self._limits.stop_times(taken, dt)
        is_inside = bool(((taken >= box.least) & (taken <= box.most)).all())
        if not (is_inside and self._is_clear(taken, times, dt, end)):
            first = np.fmin(np.fmax(first, box.lower), box.upper)
            taken, times = self._shortened(None if is_inside else taken, first, dt)
        self.measured = self.measured if end is None else end
        self._move(taken, times, dt)
        return taken

    def brake(self, dt: float) -> np.ndarray:
        """Take the stop that was admitted last, for one sample; return the displacement.

        Args:
            dt: Time of the sample [s].
        """
        dt = max(dt, SHORTEST_DT)
        displacement = self._braking(dt)
        self._move(displacement, np.maximum(self.motion.stop_times - dt, 0.0), dt)
        return displacement

    def approach(
        self, goal: np.ndarray, dt: float, share: float = 1.0, *, stops: bool = False
    ) -> bool:
        """Move towards a configuration.

        Where links are kept apart, the robot takes the nearest displacement that the rows of
        self-collision avoidance allow,

            min |x - wanted|^2   s.t.   lower <= x <= upper,   G x <= h,

        so that links slide along each other instead of meeting, or a part of it, or it brakes.

        Args:
            goal: Pinocchio configuration, shape (nq,).
            dt: Time for it [s].
            share: Share of the speed limits to use.
            stops: Whether the robot must be able to stop there at once.

        Returns:
            Whether it is reached.
        """
        dt = max(dt, SHORTEST_DT)
        motion = self.motion
        change = pin.difference(self._hand.model, motion.q, goal)[
            self._hand.active_columns
        ]
        lower, upper = self.bounds(dt)
        limit = self._limits.speeds * (dt * share)
        slack = 1e-12 + 1e-9 * limit
        reach = np.minimum(limit, self._limits.change(dt)) if stops else limit
        is_near = (np.abs(change) <= reach + slack) & (change <= upper + slack)
        is_there = bool((is_near & (change >= lower - slack)).all())
        nearest = clip(self._towards(change, limit, dt), lower, upper)
        wanted = change if is_there else nearest
        if self.collisions is not None:
            nearest = self._along_links(self.collisions, wanted, lower, upper, dt)
        taken = self.admit(wanted, nearest, dt)
        is_there = is_there and bool((np.abs(taken - change) <= slack).all())
        if is_there:
            self.motion = self.motion._replace(q=self._limits.clipped(goal, motion.q))
        return is_there

    def _towards(self, change: np.ndarray, limit: np.ndarray, dt: float) -> np.ndarray:
        """Return the part of a path that the robot takes if it must stop at its end."""
        allowed = braking_displacement(np.abs(change), self._limits.change(dt))
        if self._hand.is_floating:
            # Scale all six coordinates alike, so that the wrist stays on its path.
            allowed[:6] *= (limit[:6] / np.maximum(allowed[:6], 1e-300)).min(
                initial=1.0
            )
        return np.copysign(np.minimum(allowed, limit), change)

    def _along_links(
        self,
        collisions: CollisionLimit,
        wanted: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        dt: float,
    ) -> np.ndarray:
        """Return the displacement nearest to a wanted one that the rows of the pairs allow."""
        self._placed.place_with_jacobians(self.motion.q)
        rows = collisions.rows(self._placed, self.near(collisions, dt))
        G, h = feasible(rows, lower, upper, stopping=self.stopping(dt))
        if not (G.dot(wanted) > h).any():
            return wanted
        scaled = [each / _SCALE for each in (-wanted, lower, upper, h)]
        found = solve_by_daqp(np.eye(len(wanted)), *scaled[:3], (G, scaled[3]))
        # Without a solution, only the brake is left.
        return clip(0.0 if found is None else found * _SCALE, lower, upper)

    @cached_property
    def _placed(self) -> Configuration:
        return self._hand.configuration()

    def _braking(self, dt: float) -> np.ndarray:
        """Return the displacement of the stop that was admitted last."""
        share = 1.0 - dt / np.maximum(self.motion.stop_times, dt)
        return self.motion.velocity * (dt * share)

    def _shortened(
        self, wanted: np.ndarray | None, first: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a displacement that is admitted, and the times of the stop behind it.

        Coordinates that stop alone take theirs, or brake. The others take shares of `first`.

        Args:
            wanted: Displacement to try before, shape (nv,); None for none.
            first: The one that is shortened, likewise.
            dt: Its time [s].
        """
        brake = self._braking(dt)
        left = np.maximum(self.motion.stop_times - dt, 0.0)
        middle = self.motion.velocity * dt
        change = self._limits.change(dt)
        together = self._together
        # From a higher limit, the stop in force may brake harder than the limit allows.
        least = np.minimum(middle - change, brake)
        most = np.maximum(middle + change, brake)
        first = clip(first, least, most)
        base = np.where(together, brake, first)
        candidates = [base + share * (first - base) for share in _SHARES]
        if wanted is not None:
            candidates.insert(0, clip(wanted, least, most))
        for tried in (*candidates, base):
            times = self._limits.stop_times(tried, dt)
            can_stop = self._limits.is_inside(
                self.motion.q, tried * (1.0 + 0.5 * times / dt)
            )
            can_stop &= times <= LONGEST_STOP * (1.0 + 1e-9)
            brakes = ~(can_stop | together)
            taken = np.where(brakes, brake, tried)
            times = np.where(brakes, left, times)
            is_admitted = tried is not base and bool(can_stop[together].all())
            if is_admitted and self._is_clear(taken, times, dt):
                return taken, times
        # The line of the stop in force was found clear before.
        return taken, np.where(together, left, times)

    def _is_clear(
        self,
        displacement: np.ndarray,
        times: np.ndarray,
        dt: float,
        end: NearPairs | None = None,
    ) -> bool:
        """Return whether a displacement and the stop behind it are clear of overlaps."""
        if self.collisions is None:
            return True
        near = self.near(self.collisions, dt)
        time = times.max(initial=0.0, where=self._together)
        if time == 0.0 and end is not None:
            return self.collisions.is_clear(near, displacement, end)
        whole = np.where(self._together, (1.0 + 0.5 * time / dt) * displacement, 0.0)
        return self.collisions.is_clear(near, whole)

    def _move(
        self, displacement: np.ndarray, stop_times: np.ndarray, dt: float
    ) -> None:
        q = self.motion.q
        expansion = self._hand.expansion
        step = displacement if expansion is None else expansion.matrix.dot(displacement)
        reached = self._limits.clipped(pin.integrate(self._hand.model, q, step), q)
        self.motion = Motion(reached, displacement, dt, stop_times)
