"""The QP as published: built by `mink.build_ik` over Pinocchio.

`IkOptions(formulation="mink", solver=...)` takes it in place of the compiled core, which is equal
to it and faster. Each `Term` is one term of the cost, so
`mink.build_ik` composes them with tasks and limits of your own (subclass `mink.Task` and
`mink.Limit`). mink's error convention holds: a task asks for `J dq = -gain * error`. Its
Levenberg-Marquardt term grows with the square of the error. Ours, a term of its own, grows with the
error (see `IkOptions.error_damping`).
"""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import mink
import numpy as np
import qpsolvers

from handmap_core.ik.gate import IkGate
from handmap_core.ik.tasks import Goal
from handmap_core.se3 import Array
from handmap_qp.hands import PinocchioConfiguration
from .problem import cost_rows, squared_damping


class Term(mink.Task):
    """A term `|diag(cost) (J dq + e)|^2` of the cost, at one configuration.

    Args:
        cost: Weight of each row, shape (r,), or one for all, shape (1,).
        error: e, shape (r,).
        jacobian: J, shape (r, nv).
    """

    def __init__(self, cost: Array, error: Array, jacobian: Array) -> None:
        super().__init__(cost=cost)
        self.error = error
        self.jacobian = jacobian

    def compute_error(self, configuration: Any) -> Array:
        """Return e, shape (r,)."""
        return self.error

    def compute_jacobian(self, configuration: Any) -> Array:
        """Return J, shape (r, nv)."""
        return self.jacobian


class _ActiveConfiguration:
    """A configuration for `mink.build_ik`: its `model.nv` counts only the active coordinates."""

    def __init__(self, configuration: PinocchioConfiguration) -> None:
        self._configuration = configuration
        self.model = SimpleNamespace(nv=configuration.nv)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._configuration, name)


def build_problem(
    gate: IkGate,
    configuration: PinocchioConfiguration,
    goal: Goal,
    *,
    extra_tasks: Sequence[mink.Task] = (),
    limits: Sequence[mink.Limit] = (),
) -> qpsolvers.Problem:
    """Return the QP of one iteration at a configuration, without the hand's own limits.

    Args:
        gate: The gate of the hand, whose options have the weights.
        configuration: Of the hand, placed with Jacobians.
        goal: What the cost asks for.
        extra_tasks: Further terms of the cost as tasks of mink.
        limits: Limits of mink.

    Returns:
        The problem in dq, shape (nv,).
    """
    # Our configuration has the attributes that build_ik and our tasks read of mink's, which is one
    # of MuJoCo. The limits are of displacements, so the time has no meaning.
    active: Any = _ActiveConfiguration(configuration)
    nv = configuration.nv
    terms = []
    damping = squared_damping(gate, goal, nv)
    for residual, jacobian, further in cost_rows(gate, configuration, goal):
        terms.append(Term(np.ones(1), residual, jacobian))
        damping += further
    still = Term(np.sqrt(damping), np.zeros(nv), np.eye(nv))
    tasks = [*terms, still, *extra_tasks]
    return mink.build_ik(active, tasks, 1.0, damping=0.0, limits=limits)
