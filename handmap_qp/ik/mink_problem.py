"""The QP as published: built by `mink.build_ik` over Pinocchio, solved by `qpsolvers`.

`IkOptions(formulation="mink", solver=...)` takes it in place of the direct formulation of
`handmap_qp.ik.qp`, which is equal to it and faster. Each `Term` is one term of the cost, so
`mink.build_ik` composes them with tasks and limits of your own (subclass `mink.Task` and
`mink.Limit`). mink's error convention holds: a task asks for `J dq = -gain * error`. Its
Levenberg-Marquardt term grows with the square of the error. Ours, in `damping_term`, grows with the
error (see `IkOptions.error_damping`).
"""

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import mink
import numpy as np
import pinocchio as pin
import qpsolvers

from handmap_qp.hands import Configuration, Hand
from handmap_qp.se3 import Array, lengths
from .limits import Rows
from .options import IkOptions
from .qp import carriers, point_rows, wrist_rows
from .tasks import Goal, Task

ErrorAndJacobian = tuple[Array, Array]


class Term(mink.Task):
    """A term `|diag(cost) (J dq + e)|^2` of the cost.

    Args:
        cost: Weight of each row, shape (r,), or one for all, shape (1,).
        linearise: Returns e, shape (r,), and J, shape (r, nv), at a configuration.
    """

    def __init__(
        self, cost: Array, linearise: Callable[[Any], ErrorAndJacobian]
    ) -> None:
        super().__init__(cost=cost)
        self.linearise = linearise

    def compute_error(self, configuration: Any) -> Array:
        """Return e, shape (r,)."""
        return self.linearise(configuration)[0]

    def compute_jacobian(self, configuration: Any) -> Array:
        """Return J, shape (r, nv)."""
        return self.linearise(configuration)[1]


def point_term(
    targets: Array, cost: Array, wrist: pin.SE3 | None = None, part: int = 0
) -> Term:
    """Return the term of a hand's p reference points to their targets.

    Args:
        targets: Targets of all points [m], shape (m, 3).
        cost: Weight of the error of each of its own [cost]/[m], shape (p,).
        wrist: Target of the wrist, if they go with it.
        part: Index of the hand.
    """
    return Term(np.repeat(cost, 3), lambda hand: point_rows(hand, targets, wrist, part))


def wrist_term(target: pin.SE3, costs: tuple[float, float], part: int = 0) -> Term:
    """Return the term of the wrist frame to a pose, by the SE(3) logarithm in the wrist's own axes.

    Args:
        target: Target of the wrist frame.
        costs: Weights of the translational error [cost]/[m] and the rotational one [cost]/[rad].
        part: Index of the hand.
    """
    return Term(np.repeat(costs, 3), lambda hand: wrist_rows(hand, target, part))


def posture_term(hand: Hand, cost: float | Array, posture: Array) -> Term:
    """Return the term of all joints to a posture: the null-space term of eq. (8), costs of speed.

    Args:
        hand: The hand.
        cost: Weight of every joint's error [cost]/[rad].
        posture: Joint positions to pull to, shape (n,).
    """
    jacobian = np.eye(len(hand.active_columns))[hand.joint_columns]
    return Term(
        np.full(len(posture), cost),
        lambda placed: (placed.q[hand.q_indices] - posture, jacobian),
    )


def damping_term(
    nv: int,
    cost: float,
    error_damping: float = 0.0,
    of: Sequence[Term] = (),
    free_translations: int = 0,
) -> Term:
    """Return damping: zero displacement as a target, in shorter steps with larger errors.

    Args:
        nv: Number of velocity coordinates.
        cost: Weight of every coordinate's displacement.
        error_damping: Further squared cost of every coordinate, per weighted error and per weighted
            norm of its Jacobian column, of the terms in `of`.
        of: Terms whose errors and Jacobians count.
        free_translations: Number of leading coordinates that translate, without this damping.
    """

    def linearise(hand: Configuration) -> ErrorAndJacobian:
        further = np.zeros(nv)
        for term in of:
            error, jacobian = term.linearise(hand)
            levers = lengths((term.cost[:, None] * jacobian).T)
            further += error_damping * lengths(term.cost * error) * levers
        further[:free_translations] = 0.0
        return np.zeros(nv), np.diag(np.sqrt(cost**2 + further))

    return Term(np.ones(1), linearise)


def task_term(task: Task) -> Term:
    """Return the rows of a `Task`, with its damping as further rows without an error."""

    def linearise(hand: Configuration) -> ErrorAndJacobian:
        residual, jacobian, damping = task.linearise(hand)
        roots = np.sqrt(np.broadcast_to(damping, (hand.nv,)))
        error = np.append(residual, np.zeros(hand.nv))
        return error, np.vstack([jacobian, np.diag(roots)])

    return Term(np.ones(1), linearise)


class RowsLimit(mink.Limit):
    """Bounds as rows `[I; -I] dq <= [upper; -lower]`, without infinite ones, and further rows.

    Args:
        lower: Lower bound of the displacement, shape (nv,).
        upper: Upper bound, shape (nv,).
        rows: G, shape (r, nv), and h, shape (r,), of self-collision avoidance; none if omitted.
    """

    def __init__(self, lower: Array, upper: Array, rows: Rows | None = None) -> None:
        eye = np.eye(len(upper))
        further, least = (np.zeros((0, len(upper))), ()) if rows is None else rows
        G = np.vstack([eye, -eye, further])
        h = np.concatenate([upper, -lower, least])
        finite = np.isfinite(h)
        self._rows = mink.Constraint()
        if finite.any():
            self._rows = mink.Constraint(G[finite], h[finite])

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> mink.Constraint:
        """Return the rows, upper bounds first."""
        return self._rows


class _ActiveConfiguration:
    """A configuration for `mink.build_ik`: its `model.nv` counts only the active coordinates."""

    def __init__(self, configuration: Configuration) -> None:
        self._configuration = configuration
        self.model = SimpleNamespace(nv=configuration.nv)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._configuration, name)


def make_terms(hand: Hand, options: IkOptions, goal: Goal) -> list[Term]:
    """Return the terms whose sum is the cost of one sample."""
    costs = options.point_costs(hand)
    on = dict(enumerate(carriers(options, goal)))
    first = 0
    followed = []
    for part, each in enumerate(hand.hands):
        end = first + len(each.reference_points)
        term = point_term(goal.points, costs[first:end], on.get(part), part)
        followed.append(term)
        first = end
    for part, wrist in enumerate(() if goal.wrists is None else goal.wrists):
        followed.append(wrist_term(pin.SE3(wrist), options.wrist_costs, part))
    nv = len(hand.active_columns)
    free = 3 if hand.is_floating else 0
    damping = damping_term(nv, options.damping, options.error_damping, followed, free)
    postures = [posture_term(hand, *posture) for posture in goal.postures]
    return [*followed, damping, *postures, *map(task_term, goal.tasks)]


def build_problem(
    hand: Hand,
    options: IkOptions,
    configuration: Configuration,
    goal: Goal,
    limit: mink.Limit,
    *,
    extra_tasks: Sequence[mink.Task] = (),
) -> qpsolvers.Problem:
    """Return the QP of one iteration at a configuration.

    Args:
        hand: The hand.
        options: The weights.
        configuration: Of the hand, placed with Jacobians.
        goal: What the cost asks for.
        limit: Limit of the displacement.
        extra_tasks: Further terms of the cost as tasks of mink.

    Returns:
        The problem in dq, shape (nv,).
    """
    # Our configuration has the attributes that build_ik and our tasks read of mink's, which is one
    # of MuJoCo. The limits are of displacements, so the time has no meaning.
    active: Any = _ActiveConfiguration(configuration)
    tasks = [*make_terms(hand, options, goal), *extra_tasks]
    return mink.build_ik(active, tasks, 1.0, damping=0.0, limits=[limit])
