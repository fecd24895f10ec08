"""Inverse kinematics as one box-constrained QP per iteration, in place of eq. (8).

    min   sum_j w_j^2 |J_j dq - e_j|^2 + |W_w (J_w dq - e_w)|^2 + |E dq + e|^2
          + w_q^2 |q + dq - q_rest|^2 + w_d^2 |dq|^2
    s.t.  clip(q_min - q, -v dt, v dt) <= dq <= clip(q_max - q, -v dt, v dt)

Wrist and fingers are solved together. `w_d^2` is the damping plus a share of the weighted error
(Levenberg-Marquardt). `E` and `e` are the rows of further tasks (`handmap_qp.ik.tasks`). The box
never contradicts itself: where `q` starts outside its limits, the joint comes back as fast as its
speed limit allows. Lengths are in units of 10 mm and angles of the wrist in units of 0.1 rad, which
keeps the Hessian near one, where solvers work best.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Literal, NamedTuple, Self

import msgspec
import numpy as np
import pinocchio as pin

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.placements import placement_views
from handmap_qp.hands.shape_pairs import ShapePairs
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.ik.costs import point_costs, wrist_costs
from handmap_qp.ik.gate import Gate, Motion
from handmap_qp.ik.limits import SHORTEST_DT, as_slice
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.solvers import make_solver
from handmap_qp.ik.tasks import Task
from handmap_qp.se3 import frozen

End = Literal["solved", "failed", "released"]
# Count a hand as at rest if its last step is shorter than this [rad or m].
_AT_REST = 1e-3
# Count a displacement as at its bound within this tolerance, relative to min(bound width, 1 rad or
# 1 m): the sum of iterations meets a bound up to rounding, clarabel and piqp up to 1e-7.
_AT_BOUND = 1e-7

# Leave out pairs of shapes that are farther apart than this beyond their margin [m].
_HORIZON = 0.012

Status = Literal["converged", "limited", "unreachable", "unsettled", "failed", "released"]


class IkResult(msgspec.Struct, frozen=True, eq=False, dict=True):
    """Result of the iterations of one sample.

    Attributes:
        end: `solved`; `failed`: the solver found no answer, and the hand stays where it was, or
            comes back into its limits; `released`: it had no targets.
        points: Reference points [m], shape (m, 3).
        targets: Their targets [m], shape (m, 3).
        point_tolerance: Length of an error that counts as none [m].
        displacement: From the sample before to this one, in the active coordinates (wrist, and
            joints that follow no other), shape (k,).
        lower: Its lower bounds from position and speed limits, shape (k,).
        upper: Its upper bounds, shape (k,).
        joint_columns: Where in those the hand's joints are, in the order of `Hand.joint_names`,
            shape (n,).
        iterations: QPs solved.
        last_step: Euclidean norm of the last iteration's step [rad or m].
    """

    end: End
    points: np.ndarray
    targets: np.ndarray
    point_tolerance: float
    displacement: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    joint_columns: np.ndarray
    iterations: int
    last_step: float

    @property
    def errors(self) -> np.ndarray:
        """Target minus point [m], shape (m, 3)."""
        return self.targets - self.points

    @cached_property
    def active(self) -> np.ndarray:
        """-1 at a lower bound, +1 at an upper one, 0 between, shape (k,), read-only."""
        return frozen(active_bounds(self.displacement, self.lower, self.upper))

    @property
    def status(self) -> Status:
        """Outcome: how well the targets were met.

        `converged`: all points have arrived; `limited`: joints or wrist at a limit keep some away;
        `unreachable`: no limit does and the hand does not move any more; `unsettled`: it is still
        on its way; `failed` and `released` as in `end`.
        """
        if self.end != "solved":
            return self.end
        is_near = np.linalg.norm(self.errors, axis=1).max() <= self.point_tolerance
        return self._status(bool(is_near), bool(self.active.any()))

    def _status(self, is_near: bool, is_limited: bool) -> Status:
        if self.end != "solved":
            return self.end
        if is_near:
            return "converged"
        if is_limited:
            return "limited"
        return "unreachable" if self.last_step <= _AT_REST else "unsettled"


class IkColumns(NamedTuple):
    """Outcome of many samples; see `IkResult`.

    Attributes:
        status: Status of each.
        active: Active bounds, shape (T, k).
    """

    status: list[Status]
    active: np.ndarray

    @classmethod
    def of(cls, results: Sequence[IkResult]) -> Self:
        """Compute status and active bounds of results of one hand, by column."""
        active = active_bounds(
            np.array([result.displacement for result in results]),
            np.array([result.lower for result in results]),
            np.array([result.upper for result in results]),
        )
        errors = np.array([result.errors for result in results])
        tolerances = np.array([result.point_tolerance for result in results])
        excess = np.linalg.norm(errors, axis=2).max(axis=1) - tolerances
        bounds = np.count_nonzero(active, axis=1).tolist()
        flags = zip(results, excess.tolist(), bounds, strict=True)
        return cls(
            [result._status(over <= 0.0, count > 0) for result, over, count in flags], active
        )


def active_bounds(displacement: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return -1 at a lower bound, +1 at an upper one, 0 between.

    Args:
        displacement: Of one sample or of many, shape (..., k).
        lower: Its lower bounds, shape (..., k).
        upper: Its upper bounds, shape (..., k).

    Returns:
        Integers, shape (..., k).
    """
    near = _AT_BOUND * np.minimum(upper - lower, 1.0)
    return (upper - displacement <= near).astype(np.int8) - (displacement - lower <= near)


class PointIk:
    """Moves a hand's reference points and wrist towards their targets, within its limits.

    Args:
        hand: The hand.
        options: Weights and settings.
        motion: How the hand moves; at rest in its neutral configuration if omitted.
        contacts: Pairs of shapes that are kept apart, whatever `avoids_self_collision` says; those
            within 12 mm beyond their margin get a row, in short samples fewer. Or the rows of
            another `PointIk` of this hand.

    Attributes:
        hand: The hand.
        options: Weights and settings.
        gate: Admits the displacements, and knows how the hand moves.
        configuration: The present posture; `place` puts the hand somewhere else.
    """

    def __init__(
        self,
        hand: Hand,
        options: IkOptions,
        motion: Motion | None = None,
        *,
        contacts: ShapePairs | CollisionLimit | None = None,
    ) -> None:
        self.hand = hand
        self.options = options
        self.configuration = hand.configuration()
        nv = self.configuration.nv
        count = len(hand.reference_points)
        self._collisions = None
        if isinstance(contacts, ShapePairs):
            contacts = CollisionLimit(hand, pairs=contacts, horizon=_HORIZON)
        self._contacts = contacts
        if contacts is not None:
            self._collisions = contacts
        elif options.avoids_self_collision:
            self._collisions = CollisionLimit(hand)
        self._solver = make_solver(options.solver, nv)
        # Sort joints as the active coordinates, that is as the model, unlike `joint_names`.
        self._order = np.argsort(hand.joint_columns)
        first_joint = nv - len(self._order)
        self._joint_angles = as_slice(hand.q_indices[self._order])
        self.gate = Gate(
            hand,
            motion or Motion.at_rest(self.configuration.q, nv),
            has_velocity_limits=options.has_velocity_limits,
            max_acceleration=options.max_acceleration,
            collisions=self._collisions,
        )
        self.configuration.place_with_jacobians(self.gate.motion.q)
        position, orientation = wrist_costs(options)
        self._row_weights = np.repeat([*point_costs(hand, options), position, orientation], 3)
        self._mask = self.configuration.support * self._row_weights[:, None]
        # Reserve rows for point minus target, and for the twist from target to wrist.
        self._error = np.zeros(3 * count + 6)
        self._weighted_error = np.zeros(3 * count + 6)
        self._point_error = self._error[: 3 * count].reshape(count, 3)
        self._wrist_error = self._error[3 * count :]
        self._rest_weights = np.full(len(self._order), float(options.rest_weight) ** 2)
        self._diagonal = np.full(nv, float(options.damping) ** 2)
        self._diagonal[first_joint:] += self._rest_weights
        # Weigh the whole displacement of a sample, and its difference from the last one's.
        self._speed_cost = options.speed_weight**2
        self._acceleration_cost = options.acceleration_weight**2
        self._is_smooth = self._speed_cost + self._acceleration_cost > 0.0
        self._diagonal[first_joint:] += self._speed_cost + self._acceleration_cost
        self._first_joint = first_joint
        self._error_damping = options.error_damping
        self._weighted_all = np.empty((3 * count + 6, hand.model.nv))
        self._H = np.empty((nv, nv))
        self._H_diagonal = self._H.reshape(-1)[:: nv + 1]
        self._H_turning = self._H_diagonal[3 if hand.is_floating else 0 :]
        self._c = np.empty(nv)
        self._c_joints = self._c[first_joint:]
        self._zero_step = frozen(np.zeros(nv))
        self._target = pin.SE3.Identity()
        self._target_columns = placement_views([self._target]).columns.reshape(4, 3)
        self._target_columns.setflags(write=True)

    def __getstate__(self) -> tuple[Any, ...]:
        """Return what a copy is built from: arrays are views of each other."""
        return self.hand, self.options, self._contacts, self.gate.motion, self.gate.near

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        """Build a solver with a workspace of its own that continues the same motion."""
        hand, options, contacts, motion, near = state
        PointIk.__init__(self, hand, options, motion, contacts=contacts)
        self.gate.near = near

    @property
    def collisions(self) -> CollisionLimit | None:
        """Rows of the pairs of shapes that are kept apart; None if there are none."""
        return self._collisions

    def with_options(self, options: IkOptions) -> PointIk:
        """Return a solver with other options that moves the same hand on from where it is."""
        return PointIk(self.hand, options, self.gate.motion, contacts=self._contacts)

    def on_hand(self, hand: Hand, contacts: ShapePairs | None) -> PointIk:
        """Return a solver for the same hand with other reference points, going on from here.

        Args:
            hand: The hand; its joints and its mount are those of this one.
            contacts: Pairs of shapes to keep apart.
        """
        return PointIk(hand, self.options, self.gate.motion, contacts=contacts)

    def place(self, q: np.ndarray) -> None:
        """Put the hand at a configuration, at rest.

        Args:
            q: Pinocchio configuration, shape (nq,).
        """
        self.configuration.place_with_jacobians(q)
        self.gate.place(q)

    def move_on(self, motion: Motion) -> None:
        """Continue from another motion of the same hand."""
        self.gate.motion = motion
        self._catch_up()

    def solve(
        self,
        point_targets: np.ndarray,
        wrist_target: np.ndarray | None,
        dt: float,
        *,
        rest: np.ndarray | None = None,
        tasks: Sequence[Task] = (),
        margins: np.ndarray | None = None,
        speed: float = 1.0,
    ) -> IkResult:
        """Move the hand towards its targets for one sample.

        Args:
            point_targets: Targets of the reference points in the world [m], shape (m, 3).
            wrist_target: Target of the wrist frame, shape (4, 4). None leaves it free; fixed hands
                need none.
            dt: Time since the last sample [s]; bounds the displacement through the speed limits.
            rest: Joint positions that the rest term pulls to, in the order of `Hand.joint_names`
                [rad or m], shape (n,); the hand's rest posture if omitted.
            tasks: Further terms of the cost.
            margins: Distance that each pair of `contacts` keeps [m]; the hand's own if omitted.
            speed: Share of the speed limits to use. Braking from a higher speed takes the time that
                the acceleration limit asks for.

        Returns:
            The result. On `failed`, the configuration is the one before the call, except for
            joints outside their limits.
        """
        configuration, options = self.configuration, self.options
        gate, collisions = self.gate, self._collisions
        dt, start = max(dt, SHORTEST_DT), gate.motion.q
        self._catch_up()
        stopping = 0.0 if collisions is None else gate.stopping(dt)
        lower, upper = gate.bounds(dt, speed)
        target = self._pose_of(wrist_target)
        resting = (self.hand.rest if rest is None else rest)[self._order]
        first = total = self._zero_step
        near = end_pairs = linear = rows = None
        last_step, iterations, end = np.inf, 0, "solved"
        while last_step > options.step_tolerance and iterations < options.max_iterations:
            self._linearise(point_targets, target, resting, tasks)
            if self._is_smooth:
                self._smooth(total, dt)
            # Leave later iterations the rest of the bounds, which hold for the whole sample.
            least, most = (lower - total, upper - total) if iterations else (lower, upper)
            if collisions is not None:
                if near is None or linear is None:
                    near = gate.near
                    if near is None or near.q.tobytes() != start.tobytes():
                        near = collisions.measure(configuration, margins, dt, before=near)
                    linear = collisions.rows(configuration, margins, near)
                so_far = total if iterations else None
                rows = collisions.feasible(linear, least, most, stopping=stopping, so_far=so_far)
            step = self._solver.solve(self._H, self._c, least, most, rows)
            iterations += 1
            length = math.nan if step is None else math.sqrt(step.dot(step))
            # Catch NaN too, which solvers return where extreme weights or targets overflow.
            if step is None or not math.isfinite(length):
                # Bring joints outside their limits back all the same: the box excludes zero there.
                total = np.minimum(np.maximum(self._zero_step, lower), upper)
                last_step, end = 0.0, "failed"
            else:
                # Clip exactly: solvers hold the box up to their tolerance.
                reached = total + step if iterations > 1 else step
                total = np.maximum(np.minimum(reached, upper), lower)
                last_step = length
            first = total if iterations == 1 else first
            # Displace from the start rather than step by step, so that a floating wrist's twist
            # keeps its limits exactly.
            configuration.displace(start, total)
        if collisions is not None and near is not None:
            # The gate keeps the measurement: the next sample starts from it.
            end_pairs = collisions.measure_end(configuration, margins, dt, near, total)
        # The result hands it out too.
        total = frozen(gate.admit(total, first, dt, near, end_pairs))
        self._catch_up()
        return IkResult(
            end,
            configuration.points.copy(),
            point_targets,
            options.point_tolerance,
            total,
            lower,
            upper,
            self.hand.joint_columns,
            iterations,
            last_step,
        )

    def hold(self, dt: float) -> IkResult:
        """Bring the hand to a stop within its acceleration limit, without targets.

        Args:
            dt: Time since the last sample [s].
        """
        displacement = frozen(self.gate.brake(dt))
        self._catch_up()
        points, free = self.configuration.points.copy(), np.full(self.configuration.nv, np.inf)
        columns, tolerance = self.hand.joint_columns, self.options.point_tolerance
        return IkResult(
            "released", points, points, tolerance, displacement, -free, free, columns, 0, 0.0
        )

    def problem(
        self,
        point_targets: np.ndarray,
        wrist_target: np.ndarray | None,
        dt: float,
        *,
        rest: np.ndarray | None = None,
        tasks: Sequence[Task] = (),
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the QP of the first iteration; arguments as of `solve`.

        Returns:
            H, shape (k, k); c, lower and upper bound, shape (k,) each.
        """
        resting = (self.hand.rest if rest is None else rest)[self._order]
        self._linearise(point_targets, self._pose_of(wrist_target), resting, tasks)
        if self._is_smooth:
            self._smooth(self._zero_step, dt)
        lower, upper = self.gate.bounds(max(dt, SHORTEST_DT))
        return self._H.copy(), self._c.copy(), lower, upper

    def _pose_of(self, wrist_target: np.ndarray | None) -> pin.SE3 | None:
        """Return a matrix as Pinocchio's pose, in memory that the next call overwrites."""
        if wrist_target is None:
            return None
        self._target_columns[:] = wrist_target[:3].T
        return self._target

    def _catch_up(self) -> None:
        """Place the hand where the gate has it."""
        if self.configuration.q.tobytes() != self.gate.motion.q.tobytes():
            self.configuration.place_with_jacobians(self.gate.motion.q)

    def _smooth(self, total: np.ndarray, dt: float) -> None:
        """Add the costs of speed and acceleration, given the displacement so far."""
        so_far = total[self._first_joint :]
        self._c_joints += self._speed_cost * so_far
        self._c_joints += self._acceleration_cost * (
            so_far - dt * self.gate.motion.velocity[self._first_joint :]
        )

    def _linearise(
        self,
        point_targets: np.ndarray,
        wrist_target: pin.SE3 | None,
        rest: np.ndarray,
        tasks: Sequence[Task],
    ) -> None:
        """Write H and c of the QP at the present configuration."""
        configuration, error, weighted_error = self.configuration, self._error, self._weighted_error
        np.subtract(configuration.points, point_targets, out=self._point_error)
        if wrist_target is None:
            self._wrist_error[:] = 0.0
            jacobian = configuration.stacked_jacobian(_NO_WRIST)
        else:
            offset = wrist_target.actInv(configuration.wrist)
            self._wrist_error[:] = pin.log6(offset).vector
            jacobian = configuration.stacked_jacobian(pin.Jlog6(offset))
        np.multiply(jacobian, self._mask, out=self._weighted_all)
        weighted = configuration.contracted(self._weighted_all)
        np.multiply(error, self._row_weights, out=weighted_error)
        weighted.T.dot(weighted, out=self._H)
        # Damp by error times lever, the curvature that the linearisation neglects. The root of the
        # diagonal is the lever.
        damping = np.sqrt(self._H_turning)
        damping *= self._error_damping * math.sqrt(weighted_error.dot(weighted_error))
        self._H_turning += damping
        self._H_diagonal += self._diagonal
        weighted_error.dot(weighted, out=self._c)
        away = configuration.q[self._joint_angles] - rest
        away *= self._rest_weights
        self._c_joints += away
        for task in tasks:
            residual, rows, damping = task.linearise(configuration)
            self._H += rows.T.dot(rows)
            self._H_diagonal += damping
            self._c += residual.dot(rows)


_NO_WRIST = frozen(np.zeros((6, 6)))
