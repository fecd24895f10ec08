"""Inverse kinematics as one box-constrained QP per iteration, in place of eq. (8).

    min   sum_j w_j^2 |J_j dq - e_j|^2 + |W_w (J_w dq - e_w)|^2 + |E dq + e|^2
          + w_q^2 |q + dq - q_rest|^2 + w_d^2 |dq|^2
    s.t.  np.clip(q_min - q, -v dt, v dt) <= dq <= np.clip(q_max - q, -v dt, v dt)

Wrist and fingers are solved together. `w_d^2` is the damping plus a share of the weighted error
(Levenberg-Marquardt). `E` and `e` are the rows of further tasks (`handmap_core.ik.tasks`). The box
never contradicts itself: where `q` starts outside its limits, the joint comes back as fast as its
speed limit allows. Lengths are in units of 10 mm and angles of the wrist in units of 0.1 rad, which
keeps the Hessian near one, where solvers work best. `handmap_qp.ik.solvers` has others than DAQP.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal

import daqp
import numpy as np
import pinocchio as pin

from handmap_core.core import core
from handmap_core.errors import expect
from handmap_core.ik.gate import IkGate
from handmap_core.ik.motion import Motion, When
from handmap_core.ik.options import IkOptions
from handmap_core.ik.result import (
    WRIST_LEVERS,
    IkResult,
    Status,
    result_of,
    wrist_error,
)
from handmap_core.ik.tasks import (
    Goal,
    JointPositions,
    PointDistances,
    PointOffset,
    Task,
    TaskRows,
    tasks_named,
)
from handmap_core.se3 import Array, frozen, lengths, transform_points
from handmap_qp.hands import Hand, PinocchioConfiguration
from .collision import CollisionLimit

if TYPE_CHECKING:
    from handmap_core import _core
    from handmap_qp.hands import ShapePairs
    from .collision import Rows

# At DAQP's default tolerance of 1e-6 a joint was left 4e-7 rad outside its limit. Beyond 1000
# iterations DAQP cycles, and scaling the problem ends the cycle. Of 90,000 hostile problems one
# took 450; with targets at 1e18 m it took its default of 10,000, in 12 ms.
_DAQP = {"primal_tol": 1e-9, "iter_limit": 1000}
# Count a hand as at rest if its last step is shorter than this [rad or m].
_AT_REST = 1e-3
# Count a displacement as at its bound within this tolerance, relative to min(bound width, 1 rad or
# 1 m): the sum of iterations meets a bound up to rounding, clarabel and piqp up to 1e-7.
_AT_BOUND = 1e-7
# How often the step is solved again with the points that come too near where it ends.
_LOOKS = 3
# A coordinate is free if its step is farther from its bounds [rad or m].
_FREE = 1e-7
# Leave out pairs of shapes that are farther apart than this beyond their margin [m].
_HORIZON = 0.012


@lru_cache(maxsize=16)
def _costs(hand: Hand, options: IkOptions) -> Array:
    """Return the costs of points and wrist by their coordinates, shape (3 m + 6,), read-only."""
    return frozen(np.repeat([*options.point_costs(hand), *options.wrist_costs], 3))


def point_rows(
    configuration: PinocchioConfiguration,
    targets: Array,
    wrist: pin.SE3 | None = None,
    part: int = 0,
) -> tuple[Array, Array]:
    """Return error, shape (3 p,), and Jacobian, shape (3 p, k), of a hand's p points to targets.

    Args:
        configuration: Of the hand or robot, placed with Jacobians.
        targets: Targets of all reference points [m], shape (m, 3).
        wrist: Target of the wrist, if they go with it: what moves the wrist moves them too.
        part: Index of the hand.
    """
    own = configuration.parts[part]
    targets = targets[own]
    jacobian = configuration.point_jacobian()[3 * own.start : 3 * own.stop]
    if wrist:
        targets = moved_along(configuration.wrists[part], targets, wrist)
        carrying = configuration.wrist_jacobian(np.eye(6), part).any(axis=0)
        jacobian[:, carrying] = 0.0
    return (configuration.points[own] - targets).ravel(), jacobian


def moved_along(here: pin.SE3, targets: Array, wrist: pin.SE3) -> Array:
    """Return targets that are rigidly on a wrist's target, where the wrist is instead, (m, 3)."""
    return transform_points((here * wrist.inverse()).homogeneous, targets)


def wrist_rows(
    hand: PinocchioConfiguration, target: pin.SE3, part: int = 0
) -> tuple[Array, Array]:
    """Return error, shape (6,), and Jacobian, (6, k), of a wrist to a pose, in its own axes."""
    offset = target.actInv(hand.wrists[part])
    return pin.log6(offset).vector, hand.wrist_jacobian(pin.Jlog6(offset), part)


def cost_rows(
    hand: Hand, options: IkOptions, configuration: PinocchioConfiguration, goal: Goal
) -> list[TaskRows]:
    """Return the rows of every term of the cost at a configuration, with their weights.

    Args:
        hand: The hand.
        options: The weights.
        configuration: Of the hand, placed with Jacobians.
        goal: What the cost asks for.
    """
    costs = _costs(hand, options)
    blocks = []
    for part, own in enumerate(configuration.parts):
        wrist = None if goal.wrists is None else pin.SE3(goal.wrists[part])
        carrier = wrist if options.points_follow_wrist else None
        rows = point_rows(configuration, goal.points, carrier, part)
        blocks.append((costs[3 * own.start : 3 * own.stop], *rows))
        if wrist:
            blocks.append((costs[-6:], *wrist_rows(configuration, wrist, part)))
    terms = []
    for cost, error, jacobian in blocks:
        residual = cost * error
        rows = cost[:, None] * jacobian
        # Damp by error times lever, the curvature that the linearisation neglects.
        damping = options.error_damping * lengths(residual) * lengths(rows.T)
        damping[: 3 if hand.is_floating else 0] = 0.0  # a floating wrist's translation
        terms.append(TaskRows(residual, rows, damping))
    every = slice(None)
    postures = [JointPositions(hand, every, q, weight) for weight, q in goal.postures]
    tasks = *postures, *goal.tasks
    return [*terms, *(task.linearise(configuration) for task in tasks)]


def squared_damping(hand: Hand, options: IkOptions, goal: Goal, size: int) -> Array:
    """Return the squared cost of any motion of each of k coordinates, shape (k,)."""
    damping = np.full(size, options.damping**2)
    if goal.damping_shares is not None:
        damping[hand.joint_columns] *= goal.damping_shares**2
    return damping


def direct_cost(
    hand: Hand, options: IkOptions, configuration: PinocchioConfiguration, goal: Goal
) -> tuple[Array, Array]:
    """Return H, shape (k, k), and c, shape (k,), of the QP; arguments as of `cost_rows`."""
    eye = np.eye(configuration.nv)
    H = squared_damping(hand, options, goal, configuration.nv) * eye
    c = np.zeros(len(H))
    for residual, rows, damping in cost_rows(hand, options, configuration, goal):
        H += rows.T.dot(rows) + damping * eye
        c += residual.dot(rows)
    return H, c


def solve_by_daqp(
    H: Array, c: Array, lower: Array, upper: Array, rows: Rows | None = None
) -> Array | None:
    """Solve by DAQP, a dual active-set method: exact, and a warm start gains nothing."""
    G = np.zeros((0, len(c)))
    if rows:
        # DAQP takes the box first and the rows behind it.
        G, h = rows
        upper = np.append(upper, h)
        lower = np.append(lower, np.full(len(h), -np.inf))
    sense = np.zeros(len(upper), dtype=np.int32)
    # With a Hessian of 1e11 (targets 1000 km away) it reports feasible problems as infeasible. The
    # solution does not depend on the cost's scale.
    for scale in (1.0, 1.0 / H.diagonal().max()):
        cost = scale * H, scale * c
        x, _, flag, _ = daqp.solve(*cost, G, upper, lower, sense, **_DAQP)
        if flag > 0:
            return x
    return None


class PointIk:
    """Moves a hand's reference points and wrist towards their targets, within its limits.

    Args:
        hand: The hand.
        options: Weights and settings.
        motion: How the hand moves; at rest in its neutral configuration if omitted.
        contacts: Pairs of shapes that are kept apart, whatever `avoids_self_collision` says; those
            within 12 mm beyond their margin get a row, in short samples fewer.
        detours: Of each hand, as of the solver that this one is a copy of; none if omitted.

    Attributes:
        hand: The hand.
        options: Weights and settings.
        gate: Admits the displacements, and knows how the hand moves.
        core: The compiled core of this hand.
        is_compiled: Whether it solves the QP, which is posed in Python for other solvers.

    Raises:
        InvalidInputError: If `options` are something else.
        InvalidOptionsError: If there is no such solver or task.
        HandError: If the core cannot move a joint of the hand.
    """

    def __init__(
        self,
        hand: Hand,
        options: IkOptions,
        motion: Motion | None = None,
        contacts: ShapePairs | None = None,
        detours: Sequence[_core.Detour] | None = None,
    ) -> None:
        expect(isinstance(options, IkOptions), "ik", "an IkOptions", value=options)
        self.hand = hand
        self.options = options
        collisions = None
        if contacts:
            collisions = CollisionLimit(hand, contacts, _HORIZON)
        elif options.avoids_self_collision:
            collisions = CollisionLimit(hand)
        self._contacts = contacts
        self._tasks = tasks_named(options.tasks, hand)
        self.is_compiled = options.is_compiled
        self._solver = solve_by_daqp
        if options.solver != "daqp":
            # qpsolvers takes a second to import.
            from .solvers import make_solver

            self._solver = make_solver(options.solver)
        at_rest = Motion.at_rest(pin.neutral(hand.model), len(hand.active_columns))
        self.gate = IkGate(hand, motion or at_rest, options, collisions)
        self.core = self.gate.core
        if detours:
            self.core.go_on(detours)
        # The pair of shapes that the last QP posed in Python was pressed against; -1 for none.
        self._pressed = -1

    def __reduce__(self) -> tuple[Any, ...]:
        """Build a copy with a workspace of its own that continues the same motion."""
        detours = self.core.detours
        motion = self.gate.motion
        return PointIk, (self.hand, self.options, motion, self._contacts, detours)

    @cached_property
    def _configuration(self) -> PinocchioConfiguration:
        return self.hand.configuration()

    @property
    def configuration(self) -> PinocchioConfiguration:
        """The present posture; `place` puts the hand somewhere else."""
        self._configuration.place(self.gate.motion.q)
        return self._configuration

    def place(self, q: Array) -> None:
        """Put the hand at a configuration, at rest.

        Args:
            q: Pinocchio configuration, shape (nq,).
        """
        self.gate.place(q)

    def solve(
        self,
        point_targets: Array,
        wrist_target: Array | None,
        dt: When,
        *,
        rest: Array | None = None,
        regularisation: Array | None = None,
        tasks: Sequence[Task] = (),
        margins: Array | None = None,
        speed: float = 1.0,
    ) -> IkResult:
        """Move the hand towards its targets for one sample.

        Args:
            point_targets: Targets of the reference points in the world [m], shape (m, 3).
            wrist_target: Target of the wrist frame, shape (4, 4), or of each hand's of a robot, (h,
                4, 4). None leaves it free; fixed hands need none.
            dt: Time since the robot's last command [s], or the instant of this one; bounds the
                displacement through the limits of speed and acceleration.
            rest: Joint positions that the rest term pulls to, in the order of `Hand.joint_names`
                [rad or m], shape (n,); the hand's rest posture if omitted.
            regularisation: Share of the weights of the rest term and of the damping of each of
                them, shape (n,); all of both if omitted.
            tasks: Further terms of the cost.
            margins: Distance that each pair of `contacts` keeps [m]; the hand's own if omitted.
            speed: Share of the speed limits to use. Braking from a higher speed takes the time that
                the acceleration limit asks for.

        Returns:
            The result. On `failed`, the configuration is the one before the call, except for
            joints outside their limits.
        """
        tasks = *tasks, *self._tasks
        wrists = None if wrist_target is None else wrist_target.reshape(-1, 4, 4)
        postures = self.postures(self.gate.interval(dt).granted, rest, regularisation)
        goal = Goal(
            point_targets,
            wrists,
            postures,
            tasks,
            dt,
            margins,
            speed,
            regularisation,
        )
        if not self.is_compiled:
            return self._solve_here(goal)
        return self.result_of(self._solve_in_core(goal))

    def _solve_in_core(self, goal: Goal) -> core.Step:
        """Return the core's step to the targets of one sample."""
        distances = []
        offsets = []
        others = []
        for task in goal.tasks:
            # A subclass may have other rows.
            if type(task) is PointDistances:
                distances.append((task.core, task.distances, task.weights))
            elif isinstance(task, PointOffset):
                points = task.points
                offsets.append((points.joints, points.offsets, task.aim, task.weight))
            else:
                others.append(task)
        return self.core.solve(
            goal.points,
            goal.wrists,
            goal.postures,
            goal.dt,
            goal.margins,
            goal.speed,
            goal.damping_shares,
            distances,
            offsets,
            partial(self._linearise, others) if others else None,
        )

    def _linearise(self, tasks: Sequence[Task], q: Array) -> list[TaskRows]:
        """Return the rows of tasks that the core does not have, at a configuration, (nq,)."""
        self._configuration.place(q)
        return [task.linearise(self._configuration) for task in tasks]

    def result_of(self, step: core.Step) -> IkResult:
        """Return the result of a step of the core."""
        return result_of(step, self.hand, self.gate.links)

    def _solve_here(self, goal: Goal) -> IkResult:
        """Move the hand straight towards the targets of one sample, by QPs that are posed here."""
        gate = self.gate
        configuration = self.configuration
        start = gate.motion.q
        dt = goal.dt
        lower, upper = gate.bounds(dt, goal.speed)
        rows = gate.rows(dt, lower, upper, goal.margins)
        total = first = step = np.zeros(len(lower))
        iterations = 0
        last_step = math.inf

        def go_on(so_far: Array, limits: Rows | None) -> tuple[Array, Array | None]:
            """Solve one QP; return the displacement with its step, and the step, if any."""
            nonlocal iterations
            iterations += 1
            # Leave later iterations the rest of the bounds, which hold for the whole sample.
            step, slope = self._step(goal, lower - so_far, upper - so_far, limits)
            is_pressed = rows and step is not None
            self._pressed = rows.pressed_pair(slope, step) if is_pressed else -1
            # Clip exactly: solvers hold the box up to their tolerance. On failure, bring joints
            # outside their limits back all the same: the box excludes zero there.
            return np.clip(0.0 if step is None else so_far + step, lower, upper), step

        def around(limits: Rows) -> Array:
            """Solve from the start again, with rows of the points that met."""
            configuration.place(start)
            return go_on(np.zeros(len(lower)), limits)[0]

        while (
            last_step > self.options.step_tolerance
            and iterations < self.options.max_iterations
        ):
            total, step = go_on(total, rows.behind(total) if rows else None)
            last_step = 0.0 if step is None else math.sqrt(step.dot(step))
            first = total if iterations == 1 else first
            # Displace from the start rather than step by step, so that a floating wrist's twist
            # keeps its limits exactly.
            configuration.displace(start, total)
        for _ in range(_LOOKS):
            met = rows.at_end(total) if rows else None
            if met is None:
                break
            total = first = around(met)
        total = gate.admit(total, first, dt, rows, around)
        status = "failed" if step is None else "solved"
        targets, off = goal.points.copy(), 0.0
        placed = self.configuration
        if self.options.points_follow_wrist and goal.wrists is not None:
            hands = zip(placed.parts, placed.wrists, goal.wrists, strict=True)
            for own, here, wrist in hands:
                targets[own] = moved_along(here, targets[own], pin.SE3(wrist))
                error = wrist_error(here.homogeneous, wrist)
                off = max(off, *(error * WRIST_LEVERS))
        width = np.minimum(upper - lower, 1.0)
        is_high = upper - total <= _AT_BOUND * width
        is_low = total - lower <= _AT_BOUND * width
        active = is_high.astype(np.int8) - is_low
        return self._result(status, targets, total, active, iterations, last_step, off)

    def hold(self, dt: When) -> IkResult:
        """Bring the hand to a stop within its acceleration limit, without targets.

        Args:
            dt: Time since the robot's last command [s], or the instant of this one.
        """
        return self.result_of(self.core.hold(dt))

    def postures(
        self, dt: float, rest: Array | None, regularisation: Array | None = None
    ) -> list[tuple[float | Array, Array]]:
        """Return weights and postures of the cost of a sample; see `Goal` and `solve`."""
        hand = self.hand
        options = self.options
        weight = options.rest_weight
        of_rest = weight if regularisation is None else weight * regularisation
        postures = [(of_rest, hand.rest if rest is None else rest)]
        if options.speed_weight == 0.0 and options.acceleration_weight == 0.0:
            return postures
        # The whole displacement of a sample costs, and its difference from the last one's.
        motion = self.gate.motion
        start = motion.q[hand.q_indices]
        ahead = start + dt * motion.velocity[hand.joint_columns]
        return [
            *postures,
            (options.speed_weight, start),
            (options.acceleration_weight, ahead),
        ]

    def _step(
        self, goal: Goal, lower: Array, upper: Array, rows: Rows | None
    ) -> tuple[Array | None, Array]:
        """Pose the QP of one iteration and solve it.

        Returns:
            The step, None if the solver fails; and the slope of the cost there, 0 at bounds.
        """
        problem = self.hand, self.options, self._configuration, goal
        if self.options.formulation == "mink":
            from .mink_problem import build_problem

            posed = build_problem(*problem)
            H, c = np.asarray(posed.P), posed.q
        else:
            H, c = direct_cost(*problem)
        step = self._solver(H, c, lower, upper, rows)
        # Catch NaN too, which solvers return where extreme weights or targets overflow.
        if step is None or not math.isfinite(step.dot(step)):
            return None, c
        is_free = np.minimum(step - lower, upper - step) > _FREE
        return step, is_free * (H.dot(step) + c)

    @property
    def _held_by(self) -> int:
        """The pair of shapes that stopped the last displacement, or else what it was pressed to."""
        return self.gate.held_by if self.gate.held_by >= 0 else self._pressed

    def _result(
        self,
        end: Literal["solved", "failed"],
        targets: Array,
        displacement: Array,
        active: Array,
        iterations: int,
        last_step: float,
        off: float = 0.0,
    ) -> IkResult:
        configuration = self.configuration
        points = configuration.points.copy()
        farthest = max(off, *lengths(points - targets))
        status: Status = "unreachable" if last_step <= _AT_REST else "unsettled"
        if end != "solved":
            status = end
        elif farthest <= self.options.point_tolerance:
            status = "converged"
        elif active.any():
            status = "limited"
        return IkResult(
            status,
            points,
            targets,
            configuration.q.copy(),
            np.array([wrist.homogeneous for wrist in configuration.wrists]),
            frozen(displacement),
            frozen(active),
            self.hand,
            iterations,
            last_step,
            self.gate.links[self._held_by],
        )
