"""The QP as published: built by `mink.build_ik`, solved by `qpsolvers`.

This formulation is slower. It is the reference in tests of `handmap_qp.ik.qp`, and accepts tasks
and limits of mink.

    problem = build_problem(hand, options, configuration, point_targets, wrist_target, dt)
    dq = qpsolvers.solve_problem(problem, solver="daqp").x
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import mink
import numpy as np
import qpsolvers
from scipy.sparse import csc_matrix

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.ik.limits import BoxLimits
from handmap_qp.ik.mink_tasks import make_tasks
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.solvers import EXACT
from handmap_qp.ik.tasks import Task


class BoxLimit(mink.Limit):
    """Position, speed and acceleration limits as rows, without infinite ones.

    The rows are `[I; -I] dq <= [upper; -lower]`.

    Args:
        limits: The box.
        previous_velocity: Of the last sample, shape (nv,), for acceleration limits; at rest if
            omitted.
    """

    def __init__(
        self,
        limits: BoxLimits,
        previous_velocity: np.ndarray | None = None,
    ) -> None:
        self._limits = limits
        self._velocity = np.zeros(limits.size) if previous_velocity is None else previous_velocity

    def bounds(self, configuration: Configuration, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bound, shape (nv,) each."""
        return self._limits.bounds(configuration.q, dt, self._velocity)

    def stopping(self, dt: float) -> float:
        """Return the part of a displacement that the hand needs to stop behind it."""
        return self._limits.stopping(self._velocity, dt)

    def compute_qp_inequalities(self, configuration: Configuration, dt: float) -> mink.Constraint:  # ty: ignore[incompatible-method-override]
        """Return the rows of the box at this configuration, upper bounds first."""
        lower, upper = self.bounds(configuration, dt)
        eye = np.eye(len(upper))
        G, h = np.vstack([eye, -eye]), np.concatenate([upper, -lower])
        finite = np.isfinite(h)
        return mink.Constraint(G[finite], h[finite]) if finite.any() else mink.Constraint()


class SelfCollisionLimit(mink.Limit):
    """Self-collision avoidance as the rows of `CollisionLimit.feasible_rows`.

    Args:
        collisions: The pairs to keep apart.
        box: The limits of the same problem, with which the rows must be compatible.
    """

    def __init__(self, collisions: CollisionLimit, box: BoxLimit) -> None:
        self._collisions = collisions
        self._box = box

    def compute_qp_inequalities(self, configuration: Configuration, dt: float) -> mink.Constraint:  # ty: ignore[incompatible-method-override]
        """Return one row per pair."""
        box, stopping = self._box.bounds(configuration, dt), self._box.stopping(dt)
        rows = self._collisions.feasible_rows(configuration, *box, stopping=stopping)
        return mink.Constraint(*rows)


def make_limits(
    hand: Hand, options: IkOptions, previous_velocity: np.ndarray | None = None
) -> list[mink.Limit]:
    """Return the limits of `handmap_qp.ik.qp.PointIk`.

    Args:
        hand: The hand.
        options: Which limits hold.
        previous_velocity: Of the last sample, shape (nv,), for acceleration limits; at rest if
            omitted.

    Returns:
        The box, and the rows of self-collision avoidance if the options include it.
    """
    collisions = CollisionLimit(hand) if options.avoids_self_collision else None
    limits = BoxLimits(
        hand,
        has_velocity_limits=options.has_velocity_limits,
        max_acceleration=options.max_acceleration,
        together=None if collisions is None else collisions.path.columns,
    )
    box = BoxLimit(limits, previous_velocity)
    return [box] if collisions is None else [box, SelfCollisionLimit(collisions, box)]


class _ActiveConfiguration:
    """A configuration for `mink.build_ik`: its `model.nv` counts only the active coordinates."""

    def __init__(self, configuration: Configuration) -> None:
        self._configuration = configuration
        self.model = SimpleNamespace(nv=configuration.nv)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._configuration, name)


def build_problem(
    hand: Hand,
    options: IkOptions,
    configuration: Configuration,
    point_targets: np.ndarray,
    wrist_target: np.ndarray | None,
    dt: float,
    *,
    rest: np.ndarray | None = None,
    tasks: Sequence[Task] = (),
    extra_tasks: Sequence[mink.Task] = (),
    limits: Sequence[mink.Limit] | None = None,
) -> qpsolvers.Problem:
    """Return the QP of one iteration at a configuration.

    Args:
        hand: The hand.
        options: The weights.
        configuration: Of the hand, placed with Jacobians.
        point_targets: Targets of the reference points [m], shape (m, 3).
        wrist_target: Target of the wrist frame, shape (4, 4); None leaves it free.
        dt: Time for the displacement [s].
        rest: Joint positions that the rest term pulls to, shape (n,); the hand's if omitted.
        tasks: Further terms of the cost, as of `PointIk.solve`.
        extra_tasks: Further terms of the cost as tasks of mink.
        limits: Limits instead of those of `make_limits`.

    Returns:
        The problem in dq, shape (nv,).
    """
    own = make_tasks(hand, options, point_targets, wrist_target, rest=rest, tasks=tasks)
    if limits is None:
        limits = make_limits(hand, options)
    # Our configuration has the attributes that build_ik and our tasks read of mink's, which is
    # one of MuJoCo.
    return mink.build_ik(
        _ActiveConfiguration(configuration),  # ty: ignore[invalid-argument-type]
        [*own, *extra_tasks],
        dt,
        damping=0.0,
        limits=limits,
    )


def solve_problem(problem: qpsolvers.Problem, solver: str = "daqp") -> np.ndarray | None:
    """Return the minimiser, at the highest accuracy of the solver.

    Args:
        problem: The QP.
        solver: Name of a solver that `qpsolvers` finds.

    Returns:
        Displacement, shape (nv,); None if the solver fails.

    Raises:
        InvalidOptionsError: If no such solver is installed.
    """
    if solver not in qpsolvers.available_solvers:
        known = ", ".join(qpsolvers.available_solvers)
        raise InvalidOptionsError(option="solver", expected=f"one of {known}", value=solver)
    if solver not in qpsolvers.dense_solvers:
        G = None if problem.G is None else csc_matrix(problem.G)
        problem = qpsolvers.Problem(csc_matrix(problem.P), problem.q, G, problem.h)
    solution = qpsolvers.solve_problem(problem, solver=solver, **EXACT.get(solver, {}))
    return solution.x if solution.found else None
