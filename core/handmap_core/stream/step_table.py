"""`StepTable`: the numbers of many steps, a row a sample, which the compiled core writes too."""

from typing import get_args

import numpy as np

from handmap_core.core import core
from handmap_core.hands import Hand, Names
from handmap_core.ik import Status
from handmap_core.mapping import MapStep
from handmap_core.se3 import Array

STATUS_NAMES: Names = (*get_args(Status), "held", "gliding")
"""Outcomes of a step (`MapStep.status`); rows have the index."""
RULE_NAMES: Names = core.RULES
"""Names of what is wrong with a sample (`MapStep.rule`), likewise."""


class StepTable:
    """Numbers of the steps of T samples.

    Args:
        robot: The robot hand.
        count: Number of samples.

    Attributes:
        rows: The numbers, shape (T, k); at first, no sample was seen, and places are NaN.
    """

    def __init__(self, robot: Hand, count: int) -> None:
        n = len(robot.joint_names)
        m = len(robot.reference_points)
        pose = (4, 4)
        points = (m, 3)
        shapes = (n,), pose, pose, points, points, (n,), *[()] * 6
        self._kind = np.dtype([("", float, shape) for shape in shapes])
        self.rows = np.full((count, self._kind.itemsize // 8), np.nan)
        held, missing = STATUS_NAMES.index("held"), RULE_NAMES.index("missing")
        self.rows[:, -6:] = held, missing, 1, np.nan, 1, 0

    def write(self, index: int, step: MapStep, cpu: float) -> None:
        """Write the step of a sample, which took some CPU time [s]."""
        command = step.command
        self._table[index] = (
            command.q,
            command.wrist,
            step.wrist_target,
            step.targets,
            step.points,
            step.at_bound,
            STATUS_NAMES.index(step.status),
            RULE_NAMES.index(step.rule),
            step.is_held,
            step.consistency,
            step.confidence,
            cpu,
        )

    @property
    def _table(self) -> Array:
        return self.rows.view(self._kind)[:, 0]

    @property
    def columns(self) -> list[Array]:
        """Columns of the rows, shape (T, ...) each.

        Joint angles, wrist, its target, targets of the points, points, whether each joint is at a
        bound; indices of status and rule; whether the sample was held, its consistency, its
        confidence, and CPU time; see `MapStep`.
        """
        table = self._table
        return [table[name] for name in self._kind.names or ()]
