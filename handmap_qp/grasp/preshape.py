"""How a hand closes: from which posture, by which joints, which way (`default_closing`).

And where its palm and fingers are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.paper_cube import REFERENCE_HANDS, read_cube_figures
from handmap_qp.hands.hand import Hand
from handmap_qp.transform import inverse_pose, transform_points

# Joints whose axes are this parallel bend a finger in one plane.
_PARALLEL = 0.99
# A hand that has no figures of its own starts this far from the sphere round the object [m].
_CLEARANCE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Closing:
    """How a hand closes.

    Attributes:
        start: Joint angles to begin with [rad], shape (n,).
        direction: Sense in which each joint closes, 1 or -1; 0 for one that keeps its angle. Shape
            (n,).
        clearance: Where a planner puts the hand first: gap between the middle of the palm and the
            sphere round the object [m].
    """

    start: np.ndarray
    direction: np.ndarray
    clearance: float


def default_closing(hand: Hand) -> Closing:
    """How a hand closes unless the caller says otherwise.

    The hands of the paper have the toolbox's preshape and closing joints (`grasp_cube50.json`), a
    left human hand the right one's. For any other hand the geometry tells: the outermost joint of
    each finger closes, and so do the joints before it that turn about the same direction; they
    start stretched and close towards the farther limit. All others (abduction, spread, opposition)
    rest.

    Args:
        hand: The hand.

    Returns:
        Its closing.
    """
    name = "human" if hand.name == "human_left" else hand.name
    if name in REFERENCE_HANDS:
        figures = read_cube_figures(name)["closing"]
        start = np.array([figures["start"].get(joint, 0.0) for joint in hand.joint_names])
        direction = np.array([float(joint in figures["joints"]) for joint in hand.joint_names])
        return Closing(start, direction, figures["clearance"])
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
    return Closing(np.where(direction == 0.0, hand.rest, stretched), direction, _CLEARANCE)


def palm_centre(hand: Hand, closing: Closing | None = None) -> np.ndarray:
    """The middle of the palm: the mean place of the innermost closing joint of each finger.

    Args:
        hand: The hand.
        closing: How it closes; `default_closing` if omitted.

    Returns:
        Point in the palm frame [m], shape (3,).

    Raises:
        InvalidInputError: If no joint closes.
    """
    how = closing or default_closing(hand)
    _, origins = _joint_axes(hand, how.start)
    innermost = [
        next((joint for joint in finger if how.direction[joint]), None)
        for finger in finger_joints(hand)
    ]
    places = np.array([origins[joint] for joint in innermost if joint is not None])
    if len(places) == 0:
        raise InvalidInputError(f"{hand.name}: no joint closes")
    return transform_points(inverse_pose(hand.frame_pose("palm", how.start)), places).mean(axis=0)


def finger_joints(hand: Hand) -> list[list[int]]:
    """The joints of each finger, as places in `joint_names`.

    A finger is all that hangs from one joint of the palm; an arm's joints are part of none.

    Args:
        hand: The hand.

    Returns:
        One list a finger, outwards; fingers in the order of their first joints in `joint_names`.
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
    """The anatomical name of the finger that each of the model's joints is part of, as far as the hand's points tell.

    Args:
        hand: The hand.

    Returns:
        Names by joint of the Pinocchio model, followers and locked ones included; joints of no
        named finger are left out.
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
    """The model's joints from the palm to this one, outwards.

    None for the joints that carry the palm.
    """
    palm = hand.model.frames[hand.palm_frame_id].parentJoint
    chain = list(hand.model.supports[joint])
    return chain[chain.index(palm) + 1 :] if palm in chain else []


def _joint_axes(hand: Hand, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes and origins of the joints with the wrist at the identity, in the order of `joint_names`, shapes (n, 3)."""
    data = hand.model.createData()
    pin.computeJointJacobians(hand.model, data, hand.configuration_vector(q))
    joints = [hand.model.getJointId(name) for name in hand.joint_names]
    frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    columns = [
        pin.getJointJacobian(hand.model, data, j, frame)[:, hand.model.joints[j].idx_v]
        for j in joints
    ]
    return np.array(columns)[:, 3:], np.array([data.oMi[j].translation for j in joints])
