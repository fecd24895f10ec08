"""Targets of the hands of a robot as one, for one QP; and its result as that of each hand.

The `RobotMapper` of the compiled core has the same for hands that it maps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import structs

from handmap_core.hands import Hand
from handmap_core.ik import IkResult
from handmap_core.se3 import Array
from .hand_request import AnyRequest
from .step import Stages
from .targets import HumanPose, Targets


def targets_as_one(targets: Sequence[Targets], robot: Hand) -> Targets:
    """Return the targets of all hands as those of the robot, without tasks and margins.

    Args:
        targets: The targets of each hand.
        robot: The robot.

    Returns:
        The targets; `wrist` has the shape (h, 4, 4).
    """
    regularisation = np.ones(len(robot.rest))
    for fingers, hand in zip(robot.finger_joints, targets, strict=True):
        if hand.regularisation is not None:
            regularisation[fingers] = hand.regularisation[fingers]
    return Targets(
        np.concatenate([hand.points for hand in targets]),
        np.array([hand.wrist for hand in targets]),
        regularisation=regularisation,
    )


def rest_as_one(requests: Sequence[AnyRequest], robot: Hand) -> Array:
    """Return the posture that the QP's rest term pulls to [rad or m], shape (n,).

    Args:
        requests: What each hand asks.
        robot: The robot.
    """
    rest = robot.rest.copy()
    for fingers, request in zip(robot.finger_joints, requests, strict=True):
        rest[fingers] = request.rest[fingers]
    return rest


def stages_as_one(
    requests: Sequence[AnyRequest],
    targets: Sequence[Targets],
    result: IkResult,
    rows: Sequence[slice],
) -> tuple[Stages, list[Stages]]:
    """Return the stages of a robot that has moved, and those of each hand.

    Args:
        requests: What each hand asks.
        targets: Where each hand goes for it.
        result: Result of the inverse kinematics of the robot.
        rows: Which points of the robot are those of each hand.
    """
    parts = []
    for k, points in enumerate(rows):
        part = structs.replace(
            result,
            points=result.points[points],
            targets=result.targets[points],
            wrists=result.wrists[k : k + 1],
            hand=result.hand.hands[k],
        )
        moved = structs.replace(targets[k], points=part.targets)
        parts.append(Stages.of(requests[k].pose, moved, part))
    flags = dict.fromkeys(flag for hand in targets for flag in hand.flags)
    whole = Targets(result.targets, targets[0].wrist, flags=tuple(flags))
    pose = HumanPose(
        np.concatenate([request.pose.points for request in requests]),
        requests[0].pose.wrist,
    )
    return Stages.of(pose, whole, result), parts
