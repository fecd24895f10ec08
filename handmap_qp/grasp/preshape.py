"""Preshape of a grasp: start posture and closing direction of each joint (`default_preshape`).

Also the centre of the palm and the joints of each finger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.paper_cube import REFERENCE_HANDS, read_cube_figures
from handmap_qp.hands.hand import Hand
from handmap_qp.transform import inverse_pose, transform_points

# Smallest |cosine| between the axes of joints that bend a finger in one plane.
_PARALLEL = 0.99
# Clearance of hands without a `grasp_cube50.json` [m].
_CLEARANCE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Preshape:
    """Posture from which a hand closes, and the direction in which each joint closes.

    Attributes:
        start: Joint angles of the open hand [rad], shape (n,).
        direction: 1 or -1, the sense in which each joint closes; 0 for a joint that keeps its
            angle. Shape (n,).
        clearance: Initial gap between the centre of the palm and the circumscribed sphere of the
            object, for a planner [m].
    """

    start: np.ndarray
    direction: np.ndarray
    clearance: float


def default_preshape(hand: Hand) -> Preshape:
    """Preshape of a hand, derived from its geometry where none is published.

    For the two hands of the paper, and the left human hand, it is the toolbox's
    (`grasp_cube50.json`). For any other hand, the distal joint of each finger closes, and so do the
    joints proximal to it with parallel axes. They start stretched and close towards the farther
    limit. All other joints (abduction, spread, opposition) stay at their rest angles.

    Args:
        hand: The hand.

    Returns:
        The preshape.
    """
    name = "human" if hand.name == "human_left" else hand.name
    if name in REFERENCE_HANDS:
        figures = read_cube_figures(name)["closing"]
        start = np.array([figures["start"].get(joint, 0.0) for joint in hand.joint_names])
        direction = np.array([float(joint in figures["joints"]) for joint in hand.joint_names])
        return Preshape(start, direction, figures["clearance"])
    direction = np.zeros(len(hand.joint_names))
    axes, _ = _joint_axes(hand, hand.rest)
    for finger in finger_joints(hand):
        for joint in reversed(finger):
            if abs(axes[joint] @ axes[finger[-1]]) < _PARALLEL:
                break
            direction[joint] = (
                1.0 if hand.upper_limits[joint] + hand.lower_limits[joint] >= 0.0 else -1.0
            )
    stretched = np.clip(0.0, hand.lower_limits, hand.upper_limits)
    return Preshape(np.where(direction == 0.0, hand.rest, stretched), direction, _CLEARANCE)


def palm_centre(hand: Hand, preshape: Preshape | None = None) -> np.ndarray:
    """Centre of the palm: mean origin of the most proximal closing joint of each finger.

    Args:
        hand: The hand.
        preshape: The preshape; `default_preshape` if omitted.

    Returns:
        Point in the palm frame [m], shape (3,).

    Raises:
        InvalidInputError: If no joint closes.
    """
    how = preshape or default_preshape(hand)
    _, origins = _joint_axes(hand, how.start)
    innermost = [
        next((joint for joint in finger if how.direction[joint]), None)
        for finger in finger_joints(hand)
    ]
    points = np.array([origins[joint] for joint in innermost if joint is not None])
    if len(points) == 0:
        raise InvalidInputError(
            argument="preshape.direction",
            expected=f"a closing finger joint of {hand.name}",
            got="none",
        )
    return transform_points(inverse_pose(hand.frame_pose("palm", how.start)), points).mean(axis=0)


def finger_joints(hand: Hand) -> list[list[int]]:
    """Indices of the joints of each finger in `joint_names`.

    A finger is the subtree of one joint attached to the palm. Joints of an arm belong to no finger.

    Args:
        hand: The hand.

    Returns:
        One list per finger, proximal joint first; fingers in the order of their first joints in
        `joint_names`.
    """
    fingers: dict[int, list[int]] = {}
    depth = {}
    for joint, name in enumerate(hand.joint_names):
        beyond = _beyond_palm(hand, hand.model.getJointId(name))
        if beyond:
            fingers.setdefault(beyond[0], []).append(joint)
            depth[joint] = len(beyond)
    return [sorted(finger, key=depth.__getitem__) for finger in fingers.values()]


def finger_names(hand: Hand) -> dict[int, str]:
    """Anatomical finger name of each joint of the model, from the names of the hand's points.

    Args:
        hand: The hand.

    Returns:
        Names by joint index of the Pinocchio model, mimic and locked joints included. Joints of
        unnamed fingers are left out.
    """
    roots: dict[int, str] = {}
    for point in hand.spec.points:
        parent = hand.model.frames[
            hand.model.getFrameId(point.link, pin.FrameType.BODY)
        ].parentJoint
        beyond = _beyond_palm(hand, parent)
        if point.finger is not None and beyond:
            roots[beyond[0]] = point.finger
    chains = ((joint, _beyond_palm(hand, joint)) for joint in range(1, hand.model.njoints))
    return {joint: roots[beyond[0]] for joint, beyond in chains if beyond and beyond[0] in roots}


def _beyond_palm(hand: Hand, joint: int) -> list[int]:
    """Joints of the model from the palm to this one, proximal first; empty for an arm's joints."""
    palm = hand.model.frames[hand.palm_frame_id].parentJoint
    chain = list(hand.model.supports[joint])
    return chain[chain.index(palm) + 1 :] if palm in chain else []


def _joint_axes(hand: Hand, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes and origins [m] of the joints, shapes (n, 3), with the wrist at the identity."""
    data = hand.model.createData()
    pin.computeJointJacobians(hand.model, data, hand.configuration_vector(q))
    joints = [hand.model.getJointId(name) for name in hand.joint_names]
    frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    columns = [
        pin.getJointJacobian(hand.model, data, j, frame)[:, hand.model.joints[j].idx_v]
        for j in joints
    ]
    return np.array(columns)[:, 3:], np.array([data.oMi[j].translation for j in joints])
