"""Rows of the tasks that the core has too, over Pinocchio; see `handmap_core.ik.tasks`."""

from __future__ import annotations

import numpy as np

from handmap_core.se3 import lengths
from handmap_qp.hands import PinocchioConfiguration
from handmap_qp.ik import LENGTH_UNIT, PointDistances, PointOffset, Task, TaskRows

_SHORTEST = 1e-9
"""Distance below which two points have no direction from one to the other [m]."""


def task_rows(task: Task, hand: PinocchioConfiguration) -> TaskRows:
    """Return the rows of any task; see `Task.linearise`.

    Args:
        task: The task. One of another class, such as a subclass, has rows of its own.
        hand: The hand, placed with Jacobians.
    """
    if type(task) is PointDistances:
        return distance_rows(task, hand)
    if type(task) is PointOffset:
        return offset_rows(task, hand)
    return task.linearise(hand)


def distance_rows(task: PointDistances, hand: PinocchioConfiguration) -> TaskRows:
    """Return a row a pair, and three a pair of its curvature.

    Args:
        task: Distances of p pairs of points.
        hand: The hand, placed with Jacobians.
    """
    positions = task.points.positions(hand)
    offsets = positions[task.first] - positions[task.second]
    apart = np.maximum(lengths(offsets), _SHORTEST)
    # Points in one place have no direction: any will do to part them.
    offsets[apart == _SHORTEST] = 0.0, 0.0, _SHORTEST
    directions = (offsets / apart[:, None])[:, None]
    # What moves both, such as a wrist, leaves their distance.
    moves_one = task.points.moved[task.first] != task.points.moved[task.second]
    columns = task.points.velocities(hand)
    levers = (columns[task.first] - columns[task.second]) * moves_one
    levers = hand.contracted(levers)
    turns = hand.contracted(hand.data.J[3:] * moves_one)
    weights = task.weights / LENGTH_UNIT
    residual = weights * (apart - task.distances)
    force = weights * residual
    slopes = directions @ levers
    # The second derivatives: of the offset's length, and of the offset along itself.
    pulls = np.sqrt(np.maximum(force / apart, 0.0))[:, None, None]
    across = pulls * (levers - directions.swapaxes(1, 2) * slopes)
    bends = (directions @ np.cross(turns, levers, axis=1))[:, 0]
    bends = np.maximum(force[:, None] * bends, 0.0)
    rows = np.vstack([weights[:, None] * slopes[:, 0], *across.swapaxes(0, 1)])
    return TaskRows(
        np.append(residual, np.zeros(3 * len(residual))), rows, bends.sum(axis=0)
    )


def offset_rows(task: PointOffset, hand: PinocchioConfiguration) -> TaskRows:
    """Return a row an axis.

    Args:
        task: The offset of one point from another.
        hand: The hand, placed with Jacobians.
    """
    positions = task.points.positions(hand)
    first, other = task.points.jacobians(hand)
    weight = task.weight / LENGTH_UNIT
    residual = weight * (positions[1] - positions[0] - task.aim)
    return TaskRows(residual, weight * (other - first))
