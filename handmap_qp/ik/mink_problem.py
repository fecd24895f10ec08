"""The QP as published: built by `mink.build_ik` over Pinocchio, solved by `qpsolvers`.

`IkOptions(formulation="mink", solver=...)` takes it in place of the direct formulation of
`handmap_qp.ik.qp`, which is equal to it and faster. Each class is one term of the cost or one
limit, so `mink.build_ik` composes them with tasks and limits of your own (subclass `mink.Task` and
`mink.Limit`). mink's error convention holds: a task asks for `J dq = -gain * error`. Its
Levenberg-Marquardt term grows with the square of the error. Ours, in `DampingTask`, grows with the
error (see `IkOptions.error_damping`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import mink
import numpy as np
import pinocchio as pin
import qpsolvers

from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.solvers import Rows
from handmap_qp.ik.tasks import Goal, Task


class PointTask(mink.Task):
    """All reference points to their targets, as one stacked task.

    Args:
        targets: Targets of the points [m], shape (m, 3).
        cost: Weight of each point's error [cost]/[m], shape (m,).
    """

    def __init__(self, targets: np.ndarray, cost: np.ndarray) -> None:
        super().__init__(cost=np.repeat(cost, 3))
        self.targets = targets

    def compute_error(self, configuration: Any) -> np.ndarray:
        """Return point minus target [m], shape (3 m,)."""
        return (configuration.points - self.targets).ravel()

    def compute_jacobian(self, configuration: Any) -> np.ndarray:
        """Return the derivative of the points, world axes, shape (3 m, nv)."""
        return configuration.point_jacobian()


class WristTask(mink.Task):
    """The wrist frame to a pose, by the SE(3) logarithm in the wrist's own axes.

    Args:
        target: Target of the wrist frame.
        position_cost: Weight of the translational error [cost]/[m].
        orientation_cost: Weight of the rotational error [cost]/[rad].
    """

    def __init__(
        self, target: pin.SE3, position_cost: float, orientation_cost: float
    ) -> None:
        super().__init__(cost=np.repeat([position_cost, orientation_cost], 3))
        self.target = target

    def compute_error(self, configuration: Any) -> np.ndarray:
        """Return minus the twist from the wrist to its target, shape (6,)."""
        return -pin.log6(configuration.wrist.actInv(self.target)).vector

    def compute_jacobian(self, configuration: Any) -> np.ndarray:
        """Return the derivative of the error, shape (6, nv)."""
        return configuration.wrist_jacobian(
            pin.Jlog6(self.target.actInv(configuration.wrist))
        )


class PostureTask(mink.Task):
    """All joints to a posture: the null-space term of eq. (8), and costs of speed.

    Args:
        hand: The hand.
        cost: Weight of every joint's error [cost]/[rad].
        posture: Joint positions to pull to, shape (n,).
    """

    def __init__(self, hand: Hand, cost: float, posture: np.ndarray) -> None:
        super().__init__(cost=np.full(len(posture), cost))
        self._indices, self._posture = hand.q_indices, posture
        self._jacobian = np.eye(len(hand.active_columns))[hand.joint_columns]

    def compute_error(self, configuration: Any) -> np.ndarray:
        """Return joint position minus posture [rad or m], shape (n,)."""
        return configuration.q[self._indices] - self._posture

    def compute_jacobian(self, configuration: Any) -> np.ndarray:
        """Return the selection of the joints, shape (n, nv)."""
        return self._jacobian


class DampingTask(mink.Task):
    """Damping: zero displacement as a target.

    It keeps the step short near singular postures, and shorter with larger errors.

    Args:
        nv: Number of velocity coordinates.
        cost: Weight of every coordinate's displacement.
        error_damping: Further squared cost of every coordinate, per weighted error and per weighted
            norm of its Jacobian column, of the tasks in `of`.
        of: Tasks whose errors and Jacobians count.
        free_translations: Number of leading coordinates that translate, without this damping.
    """

    def __init__(
        self,
        nv: int,
        cost: float,
        error_damping: float = 0.0,
        of: Sequence[mink.Task] = (),
        free_translations: int = 0,
    ) -> None:
        super().__init__(cost=np.full(nv, cost))
        self._error_damping, self._of = error_damping, of
        self._turns = np.arange(nv) >= free_translations

    def compute_qp_residual(
        self, configuration: Any
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the diagonal weighted Jacobian and a zero error."""
        errors = [task.cost * task.compute_error(configuration) for task in self._of]
        levers = [
            task.cost[:, None] * task.compute_jacobian(configuration)
            for task in self._of
        ]
        error = math.sqrt(sum(e @ e for e in errors))
        lever = np.sqrt(
            sum(((J**2).sum(axis=0) for J in levers), np.zeros(len(self.cost)))
        )
        squared_cost = self.cost**2 + self._error_damping * error * lever * self._turns
        return np.diag(np.sqrt(squared_cost)), np.zeros(len(self.cost)), 0.0

    def compute_error(self, configuration: Any) -> np.ndarray:
        """Return zero, shape (nv,)."""
        return np.zeros(len(self.cost))

    def compute_jacobian(self, configuration: Any) -> np.ndarray:
        """Return the identity, shape (nv, nv)."""
        return np.eye(len(self.cost))


class RowsTask(mink.Task):
    """A `Task` as a `mink.Task`: its rows, and its damping as further rows without an error."""

    def __init__(self, task: Task) -> None:
        super().__init__(cost=np.ones(1))
        self._task = task

    def compute_error(self, configuration: Any) -> np.ndarray:
        """Return the task's weighted error, with zeros for its damping, shape (r + nv,)."""
        residual = self._task.linearise(configuration).residual
        return np.concatenate([residual, np.zeros(configuration.nv)])

    def compute_jacobian(self, configuration: Any) -> np.ndarray:
        """Return its weighted Jacobian, with the rows of its damping, shape (r + nv, nv)."""
        _, jacobian, damping = self._task.linearise(configuration)
        roots = np.sqrt(np.broadcast_to(damping, (configuration.nv,)))
        return np.vstack([jacobian, np.diag(roots)])


class BoxLimit(mink.Limit):
    """Bounds of the displacement as rows `[I; -I] dq <= [upper; -lower]`, without infinite ones.

    Args:
        lower: Lower bound of the displacement, shape (nv,).
        upper: Upper bound, shape (nv,).
    """

    def __init__(self, lower: np.ndarray, upper: np.ndarray) -> None:
        self._lower, self._upper = lower, upper

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> mink.Constraint:
        """Return the rows, upper bounds first."""
        eye = np.eye(len(self._upper))
        G, h = np.vstack([eye, -eye]), np.concatenate([self._upper, -self._lower])
        finite = np.isfinite(h)
        return (
            mink.Constraint(G[finite], h[finite]) if finite.any() else mink.Constraint()
        )


class RowsLimit(mink.Limit):
    """Rows `G dq <= h`: self-collision avoidance.

    Args:
        rows: G, shape (r, nv), and h, shape (r,).
    """

    def __init__(self, rows: Rows) -> None:
        self._rows = rows

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> mink.Constraint:
        """Return the rows."""
        return mink.Constraint(*self._rows)


class _ActiveConfiguration:
    """A configuration for `mink.build_ik`: its `model.nv` counts only the active coordinates."""

    def __init__(self, configuration: Configuration) -> None:
        self._configuration = configuration
        self.model = SimpleNamespace(nv=configuration.nv)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._configuration, name)


def make_limits(
    lower: np.ndarray, upper: np.ndarray, rows: Rows | None
) -> list[mink.Limit]:
    """Return the box, and the rows of self-collision avoidance if there are any."""
    return [BoxLimit(lower, upper), *([] if rows is None else [RowsLimit(rows)])]


def make_tasks(hand: Hand, options: IkOptions, goal: Goal) -> list[mink.Task]:
    """Return the tasks whose sum is the cost of one sample."""
    followed: list[mink.Task] = [PointTask(goal.points, options.point_costs(hand))]
    if goal.wrist is not None:
        followed.append(WristTask(goal.wrist, *options.wrist_costs))
    nv, free = len(hand.active_columns), 3 if hand.is_floating else 0
    damping = DampingTask(nv, options.damping, options.error_damping, followed, free)
    postures = [PostureTask(hand, *posture) for posture in goal.postures]
    return [*followed, damping, *postures, *map(RowsTask, goal.tasks)]


def build_problem(
    hand: Hand,
    options: IkOptions,
    configuration: Configuration,
    goal: Goal,
    limits: Sequence[mink.Limit],
    *,
    extra_tasks: Sequence[mink.Task] = (),
) -> qpsolvers.Problem:
    """Return the QP of one iteration at a configuration.

    Args:
        hand: The hand.
        options: The weights.
        configuration: Of the hand, placed with Jacobians.
        goal: What the cost asks for.
        limits: Limits of the displacement.
        extra_tasks: Further terms of the cost as tasks of mink.

    Returns:
        The problem in dq, shape (nv,).
    """
    # Our configuration has the attributes that build_ik and our tasks read of mink's, which is one
    # of MuJoCo. The limits are of displacements, so the time has no meaning.
    active: Any = _ActiveConfiguration(configuration)
    tasks = [*make_tasks(hand, options, goal), *extra_tasks]
    return mink.build_ik(active, tasks, 1.0, damping=0.0, limits=limits)
