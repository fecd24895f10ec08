"""`StepTable`: the numbers of many steps, a row a sample, which the compiled core writes too."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.human.sample import Rule
from handmap_qp.ik.core import Parts
from handmap_qp.ik.qp import Status
from handmap_qp.mapping.method import MapStep

STATUS_NAMES: tuple[str, ...] = (*get_args(Status), "held", "gliding")
"""Outcomes of a step (`MapStep.status`); rows have the index."""
RULE_NAMES: tuple[str, ...] = get_args(Rule)
"""Names of what is wrong with a sample (`MapStep.rule`), likewise."""


class StepTable:
    """Numbers of the steps of T samples.

    Args:
        robot: The robot hand.
        count: Number of samples.

    Attributes:
        rows: The numbers, shape (T, k); NaN where a sample was not looked at.
    """

    def __init__(self, robot: Hand, count: int) -> None:
        n = len(robot.joint_names)
        m = len(robot.reference_points)
        pose = (4, 4)
        self._parts = Parts(n, pose, pose, (m, 3), (m, 3), n, (), (), (), (), (), ())
        self.rows = np.full((count, self._parts.size), np.nan)

    def write(self, index: int, step: MapStep | None, cpu: float) -> None:
        """Write the step of a sample.

        Args:
            index: Which sample.
            step: Its step; None for one that the tracker did not see and nothing judged.
            cpu: CPU time of the step [s].
        """
        views = self._parts.of(self.rows[index])
        judged = "missing", True, math.nan, 1.0
        numbers = []
        status = "held"
        if step is not None:
            command = step.command
            status = step.status
            judged = step.rule, step.is_held, step.consistency, step.confidence
            numbers = [command.q, command.wrist, step.wrist_target]
            numbers += [step.targets, step.points, step.at_bound]
        rule, *others = judged
        for view, number in zip(views, numbers, strict=False):
            view[...] = number
        scalars = STATUS_NAMES.index(status), RULE_NAMES.index(rule), *others, cpu
        for view, number in zip(views[6:], scalars, strict=True):
            view[...] = number

    @property
    def columns(self) -> list[np.ndarray]:
        """Columns of the rows, shape (T, ...) each.

        Joint angles, wrist, its target, targets of the points, points, whether each joint is at a
        bound; indices of status and rule; whether the sample was held, its consistency, its
        confidence, and CPU time; see `MapStep`.
        """
        return self._parts.of(self.rows)
