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
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import LONGEST_STOP, Hand
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.ik.distances import NearPairs
from handmap_qp.ik.limits import SHORTEST_DT, Box, BoxLimits, braking_displacement
from handmap_qp.ik.solvers import DaqpSolver

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
        self._known: tuple[Motion, float, Box | None] = (motion, 0.0, None)
        self._expansion = None if hand.expansion is None else hand.expansion.matrix
        self._at_once = np.zeros(len(hand.active_columns))
        self._limits = BoxLimits(
            hand,
            has_velocity_limits=has_velocity_limits,
            max_acceleration=max_acceleration,
            together=None if collisions is None else collisions.path.columns,
        )
        self._together = self._limits.together

    def place(self, q: np.ndarray) -> None:
        """Put the robot at a configuration, at rest.

        Args:
            q: Pinocchio configuration, shape (nq,).
        """
        self.motion, self.near = Motion.at_rest(q, self._limits.size), None

    def bounds(self, dt: float, share: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of the next displacement, shape (nv,) each.

        Args:
            dt: Time for it [s].
            share: Share of the speed limits to use, as far as braking allows.
        """
        lower, upper = self._box(dt)[:2]
        return (lower, upper) if share == 1.0 else self._limits.slowed(lower, upper, share * dt)

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
        box, times, is_inside = self._box(dt), self._at_once, True
        # This also replaces NaN.
        taken = np.fmin(np.fmax(wanted, box.lower), box.upper)
        if self._limits.has_acceleration:
            times = self._limits.stop_times(taken, dt)
            is_inside = bool(((taken >= box.least) & (taken <= box.most)).all())
        if not (is_inside and self._is_clear(taken, times, dt, near, end)):
            first = np.fmin(np.fmax(first, box.lower), box.upper)
            taken, times = self._shortened(None if is_inside else taken, first, dt, near)
        self.near = near if end is None else end
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
        dt, motion = max(dt, SHORTEST_DT), self.motion
        change = pin.difference(self._hand.model, motion.q, goal)[self._hand.active_columns]
        lower, upper = self.bounds(dt)
        limit = self._limits.farthest(dt * share)
        nearest = np.minimum(np.maximum(self._towards(change, limit, dt), lower), upper)
        slack = 1e-12 + 1e-9 * limit
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
            self.motion = self.motion._replace(q=inside)
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

    def _box(self, dt: float) -> Box:
        """Return the bounds, which are asked for twice, for the QP and for the check."""
        motion, known_dt, box = self._known
        if box is None or motion is not self.motion or known_dt != dt:
            box = self._limits.box(self.motion.q, dt, self.motion.velocity)
            self._known = self.motion, dt, box
        return box

    def _braking(self, dt: float) -> np.ndarray:
        """Return the displacement of the stop that was admitted last."""
        share = 1.0 - dt / np.maximum(self.motion.stop_times, dt)
        return self.motion.velocity * (dt * share)

    def _shortened(
        self, wanted: np.ndarray | None, first: np.ndarray, dt: float, near: NearPairs | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a displacement that is admitted, and the times of the stop behind it.

        Coordinates that stop alone take theirs, or brake. The others take shares of `first`.

        Args:
            wanted: Displacement to try before, shape (nv,); None for none.
            first: The one that is shortened, likewise.
            dt: Its time [s].
            near: The pairs of shapes where it starts.
        """
        brake, left = self._braking(dt), np.maximum(self.motion.stop_times - dt, 0.0)
        middle, change = self.motion.velocity * dt, self._limits.change(dt)
        # From a higher limit, the stop in force may brake harder than the limit allows.
        least, most = np.minimum(middle - change, brake), np.maximum(middle + change, brake)
        first = np.minimum(np.maximum(first, least), most)
        base, together = np.where(self._together, brake, first), self._together
        candidates = [base + share * (first - base) for share in _SHARES]
        if wanted is not None:
            candidates.insert(0, np.minimum(np.maximum(wanted, least), most))
        for tried in (*candidates, base):
            times = self._limits.stop_times(tried, dt)
            whole = tried * (1.0 + 0.5 * times / dt)
            can_stop = self._limits.is_inside(self.motion.q, whole)
            can_stop &= times <= LONGEST_STOP * (1.0 + 1e-9)
            brakes = ~(can_stop | together)
            taken, times = np.where(brakes, brake, tried), np.where(brakes, left, times)
            is_admitted = tried is not base and bool(can_stop[together].all())
            if is_admitted and self._is_clear(taken, times, dt, near):
                return taken, times
        # The line of the stop in force was found clear before.
        return taken, np.where(together, left, times)

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
        self.motion = Motion(reached, displacement, dt, stop_times)
