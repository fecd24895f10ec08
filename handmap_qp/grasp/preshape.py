"""Preshape of a grasp: start posture and closing direction of each joint (`default_preshape`).

Also the centre of the palm and the joints of each finger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.paper_cube import REFERENCE_HANDS, read_cube_figures
from handmap_qp.hands.fingers import Finger, PalmKinematics, open_and_closing, place_of
from handmap_qp.hands.hand import Hand

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
    (`grasp_cube50.json`). For any other hand, the joints that flex each finger start straight and
    close, and jaws start open. All other joints (abduction, spread, opposition) stay at their rest
    angles.

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
    return Preshape(*open_and_closing(hand, _fingers(hand)), _CLEARANCE)


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
    how, model = preshape or default_preshape(hand), hand.model
    proximal = [
        next((column for column in finger.columns if how.direction[column]), None)
        for finger in _fingers(hand)
    ]
    joints = [model.getJointId(hand.joint_names[i]) for i in proximal if i is not None]
    points = PalmKinematics(hand).axes(how.start, joints)[1]
    if len(points) == 0:
        raise InvalidInputError(
            argument="preshape.direction",
            expected=f"a closing finger joint of {hand.name}",
            got="none",
        )
    return points.mean(axis=0)


def finger_names(hand: Hand) -> dict[int, str]:
    """Anatomical finger name of each joint of the model, from the names of the hand's points.

    Args:
        hand: The hand.

    Returns:
        Names by joint index of the Pinocchio model, mimic and locked joints included. Joints of
        unnamed fingers are left out.
    """
    chains = {joint: _beyond_palm(hand, joint) for joint in range(1, hand.model.njoints)}
    roots: dict[int, str] = {}
    for point in hand.spec.points:
        beyond = chains.get(place_of(hand, point)[0])
        if point.finger is not None and beyond:
            roots[beyond[0]] = point.finger
    return {joint: roots[way[0]] for joint, way in chains.items() if way and way[0] in roots}


def _fingers(hand: Hand) -> list[Finger]:
    """Return a finger for each joint attached to the palm, with the point farthest out as its tip.

    Joints of an arm belong to no finger.
    """
    found: dict[int, Finger] = {}
    for point in hand.spec.points:
        tip = place_of(hand, point)
        joints = _beyond_palm(hand, tip[0])
        if joints and (joints[0] not in found or len(joints) > len(found[joints[0]].joints)):
            found[joints[0]] = Finger(hand, joints, tip)
    return list(found.values())


def _beyond_palm(hand: Hand, joint: int) -> list[int]:
    """Return the joints from the palm to this one, proximal first; none for an arm's joints."""
    palm = hand.model.frames[hand.palm_frame_id].parentJoint
    chain = list(hand.model.supports[joint])
    return chain[chain.index(palm) + 1 :] if palm in chain else []
