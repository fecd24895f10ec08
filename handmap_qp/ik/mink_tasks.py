"""The QP's terms as `mink` tasks, over a configuration that Pinocchio backs.

Each class is one term of `handmap_qp.ik.qp`, so that `mink.build_ik` composes the same QP, together
with tasks of your own (subclass `mink.Task`). mink's error convention holds: a task asks for
`J dq = -gain * error`. Its Levenberg-Marquardt term grows with the square of the error. Ours, in
`DampingTask`, grows with the error (see `IkOptions.error_damping`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import mink
import numpy as np
import pinocchio as pin

from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.costs import point_costs, wrist_costs
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.tasks import Task


class PointTask(mink.Task):
    """All reference points to their targets, as one stacked task.

    Args:
        targets: Targets of the points [m], shape (m, 3).
        cost: Weight of each point's error [cost]/[m], shape (m,).
    """

    def __init__(self, targets: np.ndarray, cost: np.ndarray) -> None:
        super().__init__(cost=np.repeat(cost, 3))
        self.targets = targets

    def compute_error(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
        """Return point minus target [m], shape (3 m,)."""
        return (configuration.points - self.targets).ravel()

    def compute_jacobian(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
        """Return the derivative of the points, world axes, shape (3 m, nv)."""
        return configuration.point_jacobian()


class WristTask(mink.Task):
    """The wrist frame to a pose, by the SE(3) logarithm in the wrist's own axes.

    Args:
        target: Target of the wrist frame, shape (4, 4).
        position_cost: Weight of the translational error [cost]/[m].
        orientation_cost: Weight of the rotational error [cost]/[rad].
    """

    def __init__(self, target: np.ndarray, position_cost: float, orientation_cost: float) -> None:
        super().__init__(cost=np.array([position_cost] * 3 + [orientation_cost] * 3))
        self.target = pin.SE3(target)

    def compute_error(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
        """Return minus the twist from the wrist to its target, shape (6,)."""
        return -pin.log6(configuration.wrist.actInv(self.target)).vector

    def compute_jacobian(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
        """Return the derivative of the error, shape (6, nv)."""
        return configuration.wrist_jacobian(pin.Jlog6(self.target.actInv(configuration.wrist)))


class RestTask(mink.Task):
    """All joints to their rest positions: the null-space term of eq. (8).

    Args:
        hand: The hand.
        cost: Weight of every joint's error [cost]/[rad].
        rest: Joint positions to pull to, shape (n,); the hand's rest posture if omitted.
    """

    def __init__(self, hand: Hand, cost: float, rest: np.ndarray | None = None) -> None:
        super().__init__(cost=np.full(len(hand.joint_names), cost))
        self._hand = hand
        self._rest = hand.rest if rest is None else rest
        self._jacobian = np.zeros((len(hand.joint_names), len(hand.active_columns)))
        self._jacobian[np.arange(len(hand.joint_names)), hand.joint_columns] = 1.0

    def compute_error(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
        """Return joint angle minus rest angle [rad], shape (n,)."""
        return configuration.q[self._hand.q_indices] - self._rest

    def compute_jacobian(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
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
        self._jacobian = np.eye(nv)
        self._error_damping = error_damping
        self._of = tuple(of)
        self._turns = np.arange(nv) >= free_translations

    def compute_qp_residual(
        self, configuration: Configuration
    ) -> tuple[np.ndarray, np.ndarray, float]:  # ty: ignore[incompatible-method-override]
        """Return the diagonal weighted Jacobian and a zero error."""
        errors = [task.cost * task.compute_error(configuration) for task in self._of]  # ty: ignore[invalid-argument-type]
        levers = [task.cost[:, None] * task.compute_jacobian(configuration) for task in self._of]  # ty: ignore[invalid-argument-type]
        error = math.sqrt(sum(e @ e for e in errors))
        lever = np.sqrt(sum(((J**2).sum(axis=0) for J in levers), np.zeros(len(self._jacobian))))
        squared_cost = self.cost**2 + self._error_damping * error * lever * self._turns
        return np.diag(np.sqrt(squared_cost)), np.zeros(len(self._jacobian)), 0.0

    def compute_error(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
        """Return zero, shape (nv,)."""
        return np.zeros(len(self._jacobian))

    def compute_jacobian(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
        """Return the identity, shape (nv, nv)."""
        return self._jacobian


class ExtraTask(mink.Task):
    """A `Task` as a `mink.Task`: its rows, and its damping as further rows without an error.

    Args:
        task: The task.
    """

    def __init__(self, task: Task) -> None:
        super().__init__(cost=np.ones(1))
        self._task = task

    def compute_qp_residual(
        self, configuration: Configuration
    ) -> tuple[np.ndarray, np.ndarray, float]:  # ty: ignore[incompatible-method-override]
        """Return weighted Jacobian and negative weighted error, with the rows of damping below."""
        residual, jacobian, damping = self._task.linearise(configuration)
        roots = np.sqrt(np.broadcast_to(damping, (configuration.nv,)))
        return (
            np.vstack([jacobian, np.diag(roots)]),
            np.concatenate([-residual, np.zeros(configuration.nv)]),
            0.0,
        )

    def compute_error(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
        """Return the task's weighted error, shape (k,)."""
        return self._task.linearise(configuration).residual

    def compute_jacobian(self, configuration: Configuration) -> np.ndarray:  # ty: ignore[incompatible-method-override]
        """Return its weighted Jacobian, shape (k, nv)."""
        return self._task.linearise(configuration).jacobian


def make_tasks(
    hand: Hand,
    options: IkOptions,
    point_targets: np.ndarray,
    wrist_target: np.ndarray | None,
    *,
    rest: np.ndarray | None = None,
    tasks: Sequence[Task] = (),
) -> list[mink.Task]:
    """Return the tasks whose sum is the cost of `handmap_qp.ik.qp.PointIk`.

    Args:
        hand: The hand.
        options: The weights.
        point_targets: Targets of the reference points [m], shape (m, 3).
        wrist_target: Target of the wrist frame, shape (4, 4); None leaves it free.
        rest: Joint positions that the rest term pulls to, shape (n,).
        tasks: Further tasks, as of `PointIk.solve`.

    Returns:
        Point, wrist (unless free), rest and damping task, and the further ones.
    """
    followed: list[mink.Task] = [PointTask(point_targets, point_costs(hand, options))]
    if wrist_target is not None:
        followed.append(WristTask(wrist_target, *wrist_costs(options)))
    free = 3 if hand.is_floating else 0
    damping = DampingTask(
        len(hand.active_columns), options.damping, options.error_damping, followed, free
    )
    resting = RestTask(hand, options.rest_weight, rest)
    return [*followed, resting, damping, *map(ExtraTask, tasks)]
