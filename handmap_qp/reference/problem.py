"""The cost of one iteration over Pinocchio, and as matrices: `min 1/2 dq^T H dq + c^T dq`.

Each block of rows is a term `|J dq + e|^2` with its weights multiplied in. `handmap_qp.ik.qp` has
the whole problem.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pinocchio as pin

from handmap_core.ik.gate import IkGate
from handmap_core.ik.tasks import Goal
from handmap_core.se3 import Array, frozen, lengths, transform_points
from handmap_qp.hands import Hand, PinocchioConfiguration
from handmap_qp.ik import IkOptions, JointPositions, TaskRows
from .task_rows import task_rows


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


def posture_terms(gate: IkGate, goal: Goal) -> list[JointPositions]:
    """Return the terms that pull to postures: rest, where the hand is, and where it is going."""
    hand = gate.hand
    options = gate.options
    every = slice(None)
    weights = hand.joint_weights
    of_rest = options.rest_weight * weights
    if goal.regularisation is not None:
        of_rest = of_rest * goal.regularisation
    terms = [JointPositions(hand, every, goal.rest, of_rest)]
    if options.speed_weight == 0.0 and options.acceleration_weight == 0.0:
        return terms
    # The whole displacement of a sample costs, and its difference from the last one's.
    motion = gate.motion
    start = motion.q[hand.q_indices]
    dt = gate.interval(goal.dt).granted
    ahead = start + dt * motion.velocity[hand.joint_columns]
    return [
        *terms,
        JointPositions(hand, every, start, options.speed_weight * weights),
        JointPositions(hand, every, ahead, options.acceleration_weight * weights),
    ]


def cost_rows(
    gate: IkGate, configuration: PinocchioConfiguration, goal: Goal
) -> list[TaskRows]:
    """Return the rows of every term of the cost at a configuration, with their weights.

    Args:
        gate: The gate of the hand, whose options have the weights.
        configuration: Of the hand, placed with Jacobians.
        goal: What the cost asks for.
    """
    hand = gate.hand
    options = gate.options
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
    tasks = *posture_terms(gate, goal), *goal.tasks
    return [*terms, *(task_rows(task, configuration) for task in tasks)]


def squared_damping(gate: IkGate, goal: Goal, size: int) -> Array:
    """Return the squared cost of any motion of each of k coordinates, shape (k,)."""
    damping = np.full(size, gate.options.damping**2)
    damping[gate.hand.joint_columns] *= gate.hand.joint_weights**2
    if goal.regularisation is not None:
        damping[gate.hand.joint_columns] *= goal.regularisation**2
    return damping


def direct_cost(
    gate: IkGate, configuration: PinocchioConfiguration, goal: Goal
) -> tuple[Array, Array]:
    """Return H, shape (k, k), and c, shape (k,), of the QP; arguments as of `cost_rows`."""
    eye = np.eye(configuration.nv)
    H = squared_damping(gate, goal, configuration.nv) * eye
    c = np.zeros(len(H))
    for residual, rows, damping in cost_rows(gate, configuration, goal):
        H += rows.T.dot(rows) + damping * eye
        c += residual.dot(rows)
    return H, c
