"""Limits of a displacement: a box that is never empty, and a gate that every displacement passes.

**The box** of position, speed and acceleration limits is

    clip(q_min - q, -v dt, v dt) <= dq <= clip(q_max - q, -v dt, v dt).

Clipping is monotone, so the lower bound never passes the upper one, also where `q` starts outside
its limits: there both bounds meet at the speed limit and the joint comes back as fast as it may.
The stacked position and speed rows of mink and pink are infeasible in that case.

An acceleration limit is clipped into that box the same way, `clip(v_last dt -+ a dt^2, lower,
upper)`: position and speed limits have priority. To avoid such conflicts, a joint approaches its
limit only as fast as it can still brake,

    v dt + v^2 / (2 a) <= distance to the limit.

Once true, this stays true from sample to sample for any sample times. So a joint that starts at
rest inside its limits keeps both limits. No coordinate moves faster than `a LONGEST_STOP`, so every
stop takes at most that time, whatever the limit is.

**The gate** keeps a stop behind every displacement possible. A displacement x takes a sample of dt.
Behind it each coordinate can brake in a time T, and moves by half of T times its velocity
meanwhile. So the sample and the stop are the line from q to

    q + (1 + T / (2 dt)) x

together. Coordinates that move shapes against each other brake together, each in proportion to its
speed, with the T of the slowest, so that the hand stays on the straight line that it moves on. A
displacement is admitted if

- it is within the limits of position, speed and acceleration,
- the whole line is inside the position limits and, where links are kept apart, clear of overlaps,
- T is at most `LONGEST_STOP`.

The stop that was admitted last stays possible while the hand brakes, for any sample times:

    x_brake = v (1 - dt / T) dt,    v the last velocity,

ends on the line that was found clear, and needs the time T - dt. Another displacement that is not
admitted is shortened towards x_brake, the fingers of each hand by themselves, and replaced by it at
last. Both are within the limits of speed and acceleration, so all between are. A hand that starts
without an overlap never has one.

Where pairs meet on the line, the QP is solved again, with rows for the points that met (see
`handmap_qp.ik.collision`), and its displacement is what is admitted or, at last, shortened.

Where a limit is lowered while the hand moves, the stop that was found under the former one stays in
force until a stop under the new one is admitted.

What is shortened is the displacement of the first iteration of the QP, or of the last one around
what met: the sum of all iterations is longer, and farther from where the rows are exact.

**The gate owns the time.** It knows the instant of the robot's last command. The next command gives
its own instant, and takes the time between both, whoever asked for the last one: dt above is that
time. A command that is not later takes `SHORTEST_DT`. So the speed x / dt and the acceleration
(x / dt - v) / dt, v the velocity of the command before, hold by the time stamps of the commands.

A command after a pause must not make up for all of it. It moves as far as the time that is granted
allows, and counts as braking without commands in the time beyond that. If braking over the whole
time leads farther, the acceleration limit has priority.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from handmap_qp.hands import LONGEST_STOP, Hand
from handmap_qp.se3 import Array
from .core import core
from .options import IkOptions

if TYPE_CHECKING:
    from collections.abc import Callable

    from handmap_qp.hands import Configuration
    from .collision import CollisionLimit, NearPairs

Rows = tuple[Array, Array]
"""G, shape (r, n), and h, shape (r,), of `G x <= h`."""
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

# A stop that ends outside the limits by no more counts as inside [rad or m].
_ROUNDING = 1e-12
# Accelerations from here on count as no limit [rad/s^2, m/s^2].
_NO_LIMIT = 1e100
# Distances count as no more than this, because a floating wrist has infinite ones [rad or m].
_FAR = 1e9
# Pairs that are nearer than their margin by less than this need not part [m].
_ROUGHLY = 2e-5
# Share of their excess by which pairs part in a sample. All of it makes links oscillate that are
# pressed together.
_PARTED = 0.3
# Pairs whose distance changes by less than this part slowly [m/rad]: all of the box would part them
# by a few um, and the fingers would jump.
_LEVER = 0.015
# Parting takes this share of the box at most. All of it may leave nothing but its corner, which
# DAQP reports as infeasible.
_INSIDE = 0.9
# A row is tight within this [m]. It holds a step back where the cost would fall by this much per
# metre: where a point stays some millimetre from its target because of it.
TIGHT, _PRESSING = 1e-7, 10.0
_SHARES = (1.0, 0.5, 0.25, 0.1)
# How often a way is sought around what meets, and how far apart its points are kept then [m].
_TRIES, _CLEARED = 3, 5e-4


class BoxLimits:
    """Bounds of the displacement within one sample.

    Args:
        hand: The hand.
        options: Say whether speed limits hold, and limit the acceleration.
        together: Which coordinates must be able to stop together, shape (nv,); none if omitted.

    Attributes:
        size: Number of coordinates, nv.
        lowest: Lower position limits of a configuration, shape (nq,); `highest` the upper ones.
        coordinates: Where each coordinate's joint is in a configuration, shape (nv,).
        lower: Lower position limits of the coordinates, shape (nv,); `upper` the upper ones.
        speeds: Speed limits, shape (nv,); infinite for none.
        acceleration: Limit of every coordinate's acceleration; infinite for none.
        together: As given, shape (nv,).
    """

    def __init__(
        self,
        hand: Hand,
        options: IkOptions = IkOptions(),
        together: Array | bool = False,
    ) -> None:
        self.size = len(hand.active_columns)
        # The limits of a configuration. Those of Pinocchio's free-flyer, +-1.8e308, stay out of all
        # arithmetic. Infinite ones take their place, so its first coordinate does for six speeds.
        self.lowest = np.full(hand.model.nq, -np.inf)
        self.highest = -self.lowest
        self.lowest[hand.q_indices] = hand.lower_limits
        self.highest[hand.q_indices] = hand.upper_limits
        joints = hand.joint_columns
        self.coordinates = np.zeros(self.size, dtype=int)
        self.coordinates[joints] = hand.q_indices
        self.lower = self.lowest[self.coordinates]
        self.upper = self.highest[self.coordinates]
        self.speeds = np.full(self.size, np.inf)
        if options.has_velocity_limits:
            self.speeds[joints] = hand.velocity_limits
            if hand.is_floating:
                wrist = hand.spec.wrist
                self.speeds[:6] = np.repeat(
                    [wrist.max_linear_speed, wrist.max_angular_speed], 3
                )
        self.together = np.zeros(self.size, dtype=bool) | together
        # A limit beyond all speeds is none; as such, its products with times cannot overflow.
        most = options.max_acceleration
        self.acceleration = math.inf if most is None or most >= _NO_LIMIT else most

    def box(self, q: Array, dt: float, velocity: ArrayLike = 0.0) -> Array:
        """Return the bounds of the displacement, and which need no further check.

        Args:
            q: Pinocchio configuration, shape (nq,).
            dt: Time for the displacement [s].
            velocity: Displacement of the last sample divided by its time, shape (nv,). Matters only
                to acceleration limits.

        Returns:
            Shape (4, nv): lower bound, and upper bound, which is never below; then the least and
            the largest displacement to which the acceleration limit leads, with a stop behind it
            inside the limits of position and time. Where limits contradict each other, bounds are
            outside.
        """
        farthest = self.speeds * dt
        ends = np.array([self.lower, self.upper]) - q[self.coordinates]
        lower, upper = np.clip(ends, -farthest, farthest)
        change = self.change(dt)
        middle = np.multiply(velocity, dt)
        stretch = 1.0 + self.stopping(velocity, dt) * self.together
        # Faster than this, a stop would take too long.
        usable = self.acceleration * (LONGEST_STOP * dt)
        # Past a limit there is no braking distance left; the box brings the joint back.
        room = np.clip([-ends[0], ends[1]], 0.0, _FAR)
        reach = np.minimum(braking_displacement(room, change), usable)
        # Alone, the braking displacement is never longer than the room.
        down, most = np.minimum(reach, room / stretch)
        least = -down
        lowest = middle - change
        highest = middle + change
        slack = _ROUNDING * dt
        reached = np.clip([least, most], lowest, highest)
        allowed = np.maximum(least, lowest) - slack, np.minimum(most, highest) + slack
        return np.array([*np.clip(reached, lower, upper), *allowed])

    def is_inside(self, q: Array, displacement: Array) -> Array:
        """Return which coordinates a displacement leaves inside their position limits, shape (nv,).

        One that is outside must not move farther out.

        Args:
            q: Pinocchio configuration, shape (nq,).
            displacement: Displacement, shape (nv,).
        """
        here = q[self.coordinates]
        least = np.minimum(self.lower - _ROUNDING - here, 0.0)
        most = np.maximum(self.upper + _ROUNDING - here, 0.0)
        return displacement == np.clip(displacement, least, most)

    def clipped(self, q: Array, before: Array) -> Array:
        """Return a configuration inside its position limits, or no farther outside than before.

        Args:
            q: Pinocchio configuration, shape (nq,).
            before: The one that it was reached from, which may be outside.
        """
        return np.clip(
            q, np.minimum(self.lowest, before), np.maximum(self.highest, before)
        )

    def change(self, dt: float) -> float:
        """Return by how much acceleration can change a displacement [rad or m]; never 0."""
        return max(self.acceleration * (dt * dt), 1e-200)

    def stop_times(self, displacement: Array, dt: float) -> Array:
        """Return the time in which each coordinate stops behind a displacement [s], shape (nv,).

        Args:
            displacement: Displacement, shape (nv,).
            dt: Time for it [s].
        """
        times = np.abs(displacement / dt) / self.acceleration
        longest = times.max(initial=0.0, where=self.together)
        return np.where(self.together, longest, times)

    def stopping(self, velocity: ArrayLike, dt: float) -> float:
        """Return a bound of the stop behind the next displacement, as a multiple of it.

        Args:
            velocity: Of the last sample, shape (nv,).
            dt: Time of the next sample [s].
        """
        if self.acceleration == math.inf or not self.together.any():
            return 0.0
        fastest = (np.abs(velocity) * self.together).max()
        return 0.5 * (fastest / self.acceleration + dt) / dt


def braking_displacement(distance: Array, change: float) -> Array:
    """Return the largest displacement x after which a joint can still stop within `distance`.

    The root of `x + x^2 / (2 a dt^2) = distance`, in a form without cancellation.

    Args:
        distance: Distances [rad or m].
        change: `a dt^2`, likewise.
    """
    return 2.0 * distance / (1.0 + np.sqrt(1.0 + 2.0 * distance / change))


def feasible(
    rows: Rows,
    lower: Array,
    upper: Array,
    *,
    stopping: float = 0.0,
    so_far: Array | None = None,
) -> Rows:
    """Loosen rows where they contradict each other or a box.

    The displacement nearest to none inside the box always satisfies them: where a pair is nearer
    than the margin already, it need not part at once, only not come closer than the limits make it.
    Where a displacement is found that parts all those pairs without harm to the others, that is
    what they are held to; it is damped, so that pairs whose distance hardly depends on the joints
    part slowly. Pairs that are nearer by a few um are not parted.

    Args:
        rows: G and h of `CollisionLimit.rows`, for the whole displacement of a sample.
        lower: Lower bound of the rest of the displacement, shape (n,).
        upper: Upper bound, shape (n,).
        stopping: Part of the sample's displacement that the hand needs to stop behind it.
        so_far: Displacement of the sample up to here, shape (n,); none if omitted.

    Returns:
        G, shape (r, n), and h, shape (r,), for the rest of the displacement.
    """
    G, h = rows
    h = h / (1.0 + stopping)
    if so_far is not None:
        h -= G.dot(so_far)
    witness = np.clip(0.0, lower, upper)
    kept = G.dot(witness)
    excess = kept - h
    loose = np.maximum(h, kept)
    is_nearer = excess > _ROUGHLY
    apart = G[is_nearer]
    gram = apart.dot(apart.T) + _LEVER**2 * np.eye(len(apart))
    parting = -_PARTED * np.linalg.solve(gram, excess[is_nearer]).dot(apart)
    within = np.clip(parting, _INSIDE * (lower - witness), _INSIDE * (upper - witness))
    parted = kept + G.dot(within)
    does_harm = (parted > loose + _ROUNDING) & ~is_nearer
    return G, loose if does_harm.any() else np.maximum(h, parted)


class Motion(NamedTuple):
    """How a robot moves; do not write to the arrays.

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


class Gate:
    """Owns the motion of a robot and its time, and admits its displacements.

    Args:
        hand: The robot.
        motion: How it moves; it may come from the gate of another limit.
        options: As of `BoxLimits`.
        collisions: Pairs of shapes to keep apart; none if omitted.

    Attributes:
        hand: As given.
        limits: Of position, speed and acceleration.
        collisions: As given.
        read_motion: Returns the motion; the compiled core's own where that has moved the robot.
        links: Links of each pair; at -1, there are none.
        near: The pairs that have rows, where the robot is.
        held_by: Index of the pair that holds the robot back; -1 for none.
    """

    def __init__(
        self,
        hand: Hand,
        motion: Motion,
        options: IkOptions = IkOptions(),
        collisions: CollisionLimit | None = None,
    ) -> None:
        self.motion = motion
        self.collisions = collisions
        self.hand = hand
        together = collisions.columns if collisions else False
        self.limits = BoxLimits(hand, options, together)
        self.links = collisions.bounds.links if collisions else [()]
        self.held_by = -1

    @property
    def motion(self) -> Motion:
        """How the robot moves."""
        return self.read_motion()

    @motion.setter
    def motion(self, motion: Motion) -> None:
        self.read_motion = lambda: motion

    def moves_as(self, other: Gate) -> bool:
        """Tell whether both gates have the motion of one and the same command."""
        return self.read_motion is other.read_motion

    def place(self, q: Array) -> None:
        """Put the robot at a configuration of Pinocchio, shape (nq,), at rest.

        Its clock goes on.
        """
        self.motion = Motion.at_rest(q, self.limits.size, self.motion.time)

    def interval(self, when: When) -> Interval:
        """Return the time of the next command; `SHORTEST_DT` if it is not later than the last."""
        last = self.motion.time
        if isinstance(when, Instant):
            # `max` keeps its first argument where the other one is NaN.
            dt = max(SHORTEST_DT, when.time - last)
            granted = min(dt, max(SHORTEST_DT, when.longest))
            return Interval(dt, granted, max(last + SHORTEST_DT, when.time))
        dt = max(SHORTEST_DT, when)
        return Interval(dt, dt, last + dt)

    def bounds(self, when: When, share: float = 1.0) -> Array:
        """Return the lower and upper bounds of the next displacement, shape (2, nv).

        Args:
            when: When the next command is.
            share: Share of the speed limits to use, as far as braking allows.
        """
        dt, granted, _ = self.interval(when)
        motion = self.motion
        lower, upper, *_ = self.limits.box(motion.q, dt, motion.velocity)
        farthest = share * granted * self.limits.speeds
        reach = np.array([-farthest, farthest])
        if granted < dt:
            # Without commands, the robot has braked in the time beyond the grant.
            beyond = (dt - granted) / np.maximum(motion.stop_times, 1e-300)
            middle = motion.velocity * np.maximum(1.0 - beyond, 0.0) * granted
            change = self.limits.change(granted)
            reach = np.clip(reach, middle - change, middle + change)
        # Up to that displacement, or the nearest corner of the box.
        return np.clip(reach, lower, upper)

    def stopping(self, when: When) -> float:
        """Return a bound of the stop behind the next displacement, as a multiple of it."""
        return self.limits.stopping(self.motion.velocity, self.interval(when).dt)

    def rows(
        self, placed: Configuration, when: When, margins: Array | None = None
    ) -> Rows | None:
        """Return the rows of the pairs of shapes for the next displacement; None without pairs.

        Args:
            placed: The robot where it is, with Jacobians.
            when: When the next command is.
            margins: Distance that each pair keeps [m], shape (k,); the hand's own if omitted.
        """
        collisions = self.collisions
        if not collisions:
            return None
        q, last, *_ = self.motion
        dt = self.interval(when).dt
        self.near = near = collisions.measure(q, dt, margins, last)
        self._row_pairs = near.pairs
        return collisions.rows(placed, near, margins)

    def joined(
        self,
        rows: Rows,
        placed: Configuration,
        met: NearPairs,
        margins: Array | float | None = _CLEARED,
    ) -> Rows:
        """Return rows, and those of points that met; arguments as of `rows` and `admit`."""
        assert self.collisions
        G, h = self.collisions.rows(placed, met, margins)
        self._row_pairs = np.append(self._row_pairs, met.pairs)
        return np.vstack([rows[0], G]), np.append(rows[1], h)

    def press(self, slope: Array, step: Array, rows: Rows) -> None:
        """Note the pair whose row the cost presses a step against most, if it is much.

        Args:
            slope: Derivative of the cost there, 0 at bounds of the box, shape (n,).
            step: Solution of a QP with these rows, shape (n,).
            rows: G and h.
        """
        G, h = rows
        pressed = -G.dot(slope) / (np.square(G).sum(axis=1) + _LEVER**2)
        pressed *= h - G.dot(step) <= TIGHT
        if pressed.max(initial=0.0) > _PRESSING:
            # Shapes in one plane press alike but for rounding: the first one counts.
            self.held_by = int(self._row_pairs[pressed.round(3).argmax()])

    def admit(
        self,
        wanted: Array,
        first: Array,
        when: When,
        around: Callable[[NearPairs], Array] | None = None,
        tries: int = _TRIES,
    ) -> Array:
        """Move the robot by a displacement, or by another one that is admitted.

        Args:
            wanted: Displacement in the active coordinates, shape (nv,).
            first: Another one that is shortened if the wanted one is not admitted, likewise.
            when: When the command is.
            around: Finds another one in place of both, which keeps apart what meets on the line of
                the wanted one.
            tries: How often that is asked for.

        Returns:
            The displacement taken: `wanted` itself if it is admitted.
        """
        dt, _, time = self.interval(when)
        box = self.limits.box(self.motion.q, dt, self.motion.velocity)
        lower, upper, least, most = box
        # This also replaces NaN.
        taken = np.fmin(np.fmax(wanted, lower), upper)
        times = self.limits.stop_times(taken, dt)
        is_inside = ((taken >= least) & (taken <= most)).all()
        met = self._met_on(taken, times, dt) if is_inside else None
        if met and len(met.pairs):
            if around and tries:
                other = around(met)
                return self.admit(other, other, when, around, tries - 1)
            self.held_by = int(met.pairs[met.found[:, 0].argmin()])
        if not is_inside or met:
            first = np.fmin(np.fmax(first, lower), upper)
            taken, times = self._shortened(taken, first, dt)
        self._move(taken, times, dt, time)
        return taken

    def brake(self, when: When) -> Array:
        """Take the stop that was admitted last, for one command; return the displacement."""
        dt, _, time = self.interval(when)
        self.held_by = -1
        displacement, left = self._braking(dt)
        self._move(displacement, left, dt, time)
        return displacement

    def _braking(self, dt: float) -> tuple[Array, Array]:
        """Return the displacement of the stop that was admitted last, and its times behind that."""
        times = self.motion.stop_times
        share = 1.0 - dt / np.maximum(times, dt)
        return self.motion.velocity * (dt * share), np.maximum(times - dt, 0.0)

    def _shortened(self, wanted: Array, first: Array, dt: float) -> tuple[Array, Array]:
        """Return a displacement that is admitted, and the times of the stop behind it.

        Coordinates that stop alone take theirs, or brake. The others take the wanted one or shares
        of `first`; shape (nv,) each. First the fingers of each hand do, while all else brakes: no
        hand stops for what another one meets. Then all do, with what was found for the fingers.
        """
        limits = self.limits
        brake, left = self._braking(dt)
        middle = self.motion.velocity * dt
        change = limits.change(dt)
        together = limits.together
        # From a higher limit, the stop in force may brake harder than the limit allows.
        least = np.minimum(middle - change, brake)
        most = np.maximum(middle + change, brake)
        wanted, first = np.clip([wanted, first], least, most)
        base = np.where(together, brake, first)
        fingers = [self.hand.joint_columns[own] for own in self.hand.finger_joints]
        for own in (*fingers, slice(None)):
            shares = [base + share * (first - base) for share in _SHARES]
            for candidate in (wanted, *shares, base):
                tried = base.copy()
                tried[own] = candidate[own]
                times = limits.stop_times(tried, dt)
                can_stop = limits.is_inside(
                    self.motion.q, tried * (1.0 + 0.5 * times / dt)
                )
                can_stop &= times <= LONGEST_STOP * (1.0 + 1e-9)
                brakes = ~(can_stop | together)
                taken = np.where(brakes, brake, tried)
                times = np.where(brakes, left, times)
                if can_stop[together].all() and not self._met_on(taken, times, dt):
                    break
            else:
                # The line of the stop in force was found clear before.
                times = np.where(together, left, times)
            first[own] = taken[own]
        return taken, times

    def _met_on(self, displacement: Array, times: Array, dt: float) -> NearPairs | None:
        """Return what meets in a displacement and the stop behind it; None if nothing does."""
        if not self.collisions:
            return None
        whole = (1.0 + 0.5 * times / dt) * displacement
        whole = np.where(self.limits.together, whole, 0.0)
        return self.collisions.met_on(self.motion.q, whole)

    def _move(
        self, displacement: Array, stop_times: Array, dt: float, time: float
    ) -> None:
        q = self.motion.q
        step = self.hand.spread.dot(displacement)
        reached = self.limits.clipped(pin.integrate(self.hand.model, q, step), q)
        self.motion = Motion(reached, displacement, dt, stop_times, time)
