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

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.ik.distances import NearPairs
from handmap_qp.ik.limits import LONGEST_STOP, SHORTEST_DT, BoxLimits, braking_displacement
from handmap_qp.ik.solvers import DaqpSolver
from handmap_qp.transform import frozen

_SHARES = (1.0, 0.5, 0.25, 0.1)
_ROUNDING = 1e-12
# Displacements of a sample are near this size [rad]; the solver is exact near one.
_SCALE = 0.05


class Motion(NamedTuple):
    """How a robot moves; do not write to the arrays.

    Attributes:
        q: Pinocchio configuration last commanded, shape (nq,).
        velocity: Displacement of the last sample divided by its time, in the active coordinates,
            shape (nv,).
        stop_times: Time in which each of them can stop on the line that was admitted [s], shape
            (nv,); 0 for at once.
    """

    q: np.ndarray
    velocity: np.ndarray
    stop_times: np.ndarray

    @classmethod
    def at_rest(cls, q: np.ndarray, nv: int) -> Motion:
        """Return the motion of a robot that stands at a configuration."""
        return cls(frozen(np.array(q)), frozen(np.zeros(nv)), frozen(np.zeros(nv)))

    @property
    def is_braking(self) -> bool:
        """Whether the robot moves, and its acceleration limit keeps it from standing at once."""
        return bool(self.stop_times.any() and self.velocity.any())


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
        near: What is known of the pairs of shapes, in this posture or one before.
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
        self.near: NearPairs | None = None
        self._hand, self._collisions = hand, collisions
        self._expansion = None if hand.expansion is None else hand.expansion.matrix
        nv = len(hand.active_columns)
        self._together = np.zeros(nv, bool) if collisions is None else collisions.path.columns
        self._limits = BoxLimits(
            hand,
            has_velocity_limits=has_velocity_limits,
            max_acceleration=max_acceleration,
            together=self._together,
        )

    def place(self, q: np.ndarray) -> None:
        """Put the robot at a configuration, at rest.

        Args:
            q: Pinocchio configuration, shape (nq,).
        """
        self.motion, self.near = Motion.at_rest(q, self._limits.size), None

    def bounds(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of the next displacement, shape (nv,) each.

        Args:
            dt: Time for it [s].
        """
        return self._limits.bounds(self.motion.q, dt, self.motion.velocity)

    def stopping(self, dt: float) -> float:
        """Return a bound of the stop behind the next displacement, as a multiple of it."""
        return self._limits.stopping(self.motion.velocity, dt)

    def admit(
        self,
        wanted: np.ndarray,
        first: np.ndarray,
        dt: float,
        near: NearPairs | None = None,
        end: NearPairs | None = None,
    ) -> np.ndarray:
        """Move the robot by a displacement, or by another one that is admitted.

        Args:
            wanted: Displacement in the active coordinates, shape (nv,).
            first: Another one that is shortened if the wanted one is not admitted, likewise.
            dt: Time for it [s].
            near: The pairs of shapes where it starts; needed if shapes are kept apart.
            end: Those where `wanted` ends; measured where it matters if omitted.

        Returns:
            The displacement taken: `wanted` itself if it is admitted.
        """
        brake = self._braking(dt)
        lower, upper = self._within_reach(brake, dt)
        taken = np.minimum(np.maximum(_finite(wanted), lower), upper)
        taken, times, is_inside = self._checked(taken, brake, dt)
        if not (is_inside and self._is_clear(taken, times, dt, near, end)):
            first = np.minimum(np.maximum(_finite(first), lower), upper)
            base = np.where(self._together, brake, first)
            for share in _SHARES:
                taken, times, is_inside = self._checked(base + share * (first - base), brake, dt)
                if is_inside and self._is_clear(taken, times, dt, near):
                    break
            else:
                taken, times, _ = self._checked(base, brake, dt)
                times = np.where(self._together, self._time_left(dt), times)
        self.near = near if end is None else end
        self._move(taken, times, dt)
        return taken

    def brake(self, dt: float) -> np.ndarray:
        """Take the stop that was admitted last, for one sample; return the displacement.

        Args:
            dt: Time of the sample [s].
        """
        dt = max(dt, SHORTEST_DT)
        displacement, times = self._braking(dt), self._time_left(dt)
        self._move(displacement, times, dt)
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
        dt, motion = max(dt, SHORTEST_DT), self.motion
        change = pin.difference(self._hand.model, motion.q, goal)[self._hand.active_columns]
        lower, upper = self.bounds(dt)
        limit = self._limits.farthest(dt * share)
        nearest = np.minimum(np.maximum(self._towards(change, limit, dt), lower), upper)
        slack = _ROUNDING + 1e-9 * limit
        reach = np.minimum(limit, self._limits.change(dt)) if stops else limit
        is_near = (np.abs(change) <= reach + slack) & (change <= upper + slack)
        is_there = bool((is_near & (change >= lower - slack)).all())
        near, wanted = None, change if is_there else nearest
        if self._collisions is not None:
            near, nearest = self._along_links(self._collisions, wanted, lower, upper, dt)
        taken = self.admit(wanted, nearest, dt, near)
        is_there = is_there and bool((np.abs(taken - change) <= slack).all())
        if is_there:
            inside = self._limits.clipped(goal, motion.q)
            self.motion = self.motion._replace(q=frozen(inside))
        return is_there

    def _towards(self, change: np.ndarray, limit: np.ndarray, dt: float) -> np.ndarray:
        """Return the part of a way that the robot takes if it must stop at its end."""
        allowed = np.copysign(
            braking_displacement(np.abs(change), np.maximum(self._limits.change(dt), 1e-200)),
            change,
        )
        if self._hand.is_floating:
            # Scale all six coordinates alike, so that the wrist stays on its path.
            part = (limit[:6] / np.maximum(np.abs(allowed[:6]), 1e-300)).min(initial=1.0)
            allowed[:6] *= part
        return np.minimum(np.maximum(allowed, -limit), limit)

    def _along_links(
        self,
        collisions: CollisionLimit,
        wanted: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        dt: float,
    ) -> tuple[NearPairs, np.ndarray]:
        """Measure the pairs of shapes; return the nearest displacement that keeps them apart."""
        placed = self._placed
        placed.place_with_jacobians(self.motion.q)
        near = collisions.measure(placed, dt=dt, before=self.near)
        box, stopping = (lower, upper), self.stopping(dt)
        G, h = collisions.feasible_rows(placed, *box, near=near, stopping=stopping)
        if not (G.dot(wanted) > h).any():
            return near, wanted
        rows = G, h / _SCALE
        found = self._solver.solve(
            np.eye(len(wanted)), -wanted / _SCALE, lower / _SCALE, upper / _SCALE, rows
        )
        # Without a solution, only the brake is left.
        found = np.zeros_like(wanted) if found is None else found * _SCALE
        return near, np.minimum(np.maximum(found, lower), upper)

    @cached_property
    def _placed(self) -> Configuration:
        return self._hand.configuration()

    @cached_property
    def _solver(self) -> DaqpSolver:
        return DaqpSolver(self._limits.size)

    def _braking(self, dt: float) -> np.ndarray:
        """Return the displacement of the stop that was admitted last."""
        _, velocity, times = self.motion
        return velocity * (dt * (1.0 - dt / np.maximum(times, dt)))

    def _time_left(self, dt: float) -> np.ndarray:
        """Return the times of that stop after a sample of it."""
        return np.maximum(self.motion.stop_times - dt, 0.0)

    def _within_reach(self, brake: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds, moved to where acceleration or the stop in force may lead."""
        lower, upper = self.bounds(dt)
        if not self._limits.has_acceleration:
            return lower, upper
        middle, change = self.motion.velocity * dt, self._limits.change(dt)
        least, most = np.minimum(middle - change, brake), np.maximum(middle + change, brake)
        return np.minimum(np.maximum(lower, least), most), np.minimum(
            np.maximum(upper, least), most
        )

    def _checked(
        self, displacement: np.ndarray, brake: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray, bool]:
        """Check the stop behind a displacement; coordinates that stop alone brake if they must.

        Args:
            displacement: Displacement, shape (nv,).
            brake: That of the stop in force, likewise.
            dt: Its time [s].

        Returns:
            The displacement, the times of the stop behind it, and whether the coordinates that stop
            together can do so inside the limits.
        """
        times = self._limits.stop_times(displacement / dt)
        if not self._limits.has_acceleration:
            return displacement, times, True
        whole = displacement * (1.0 + 0.5 * times / dt)
        room = self._limits.room(self.motion.q)
        # A joint outside its limits must not move farther out.
        can_stop = whole <= np.maximum(room[1], 0.0) + _ROUNDING
        can_stop &= whole >= np.minimum(room[0], 0.0) - _ROUNDING
        can_stop &= times <= LONGEST_STOP * (1.0 + 1e-9)
        if np.count_nonzero(can_stop) == len(can_stop):
            return displacement, times, True
        brakes = ~(can_stop | self._together)
        displacement = np.where(brakes, brake, displacement)
        times = np.where(brakes, self._time_left(dt), times)
        return displacement, times, bool(can_stop[self._together].all())

    def _is_clear(
        self,
        displacement: np.ndarray,
        times: np.ndarray,
        dt: float,
        near: NearPairs | None,
        end: NearPairs | None = None,
    ) -> bool:
        """Return whether a displacement and the stop behind it are clear of overlaps."""
        if self._collisions is None or near is None:
            return True
        path, time = self._collisions.path, times[self._together].max(initial=0.0)
        if time == 0.0 and end is not None:
            return path.is_clear(self.motion.q, near, displacement, end)
        whole = np.where(self._together, (1.0 + 0.5 * time / dt) * displacement, 0.0)
        return path.is_clear(self.motion.q, near, whole)

    def _move(self, displacement: np.ndarray, stop_times: np.ndarray, dt: float) -> None:
        q = self.motion.q
        step = displacement if self._expansion is None else self._expansion.dot(displacement)
        reached = self._limits.clipped(pin.integrate(self._hand.model, q, step), q)
        self.motion = Motion(frozen(reached), frozen(displacement / dt), frozen(stop_times))


def _finite(displacement: np.ndarray) -> np.ndarray:
    """Return a displacement, or none if it is not finite."""
    is_finite = math.isfinite(displacement.dot(displacement))
    return displacement if is_finite else np.zeros_like(displacement)
