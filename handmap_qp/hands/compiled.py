"""The compiled core of a hand: its kinematics, made of the hand's model.

The core (`core`, C++) has kinematics, distances and a QP solver of its own.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np
import pinocchio as pin

from handmap_core.core import core
from handmap_core.errors import HandError
from handmap_core.models import (
    FrameModel,
    HandModel,
    JointModel,
    PlaceModel,
    encode,
)
from .spec import PointSpec

if TYPE_CHECKING:
    from .hand import Hand

_FRAMES: dict[pin.FrameType, Literal["joint", "fixed_joint", "link"]] = {
    pin.FrameType.JOINT: "joint",
    pin.FrameType.FIXED_JOINT: "fixed_joint",
    pin.FrameType.BODY: "link",
}


@lru_cache(maxsize=16)
def core_tree(hand: Hand) -> core.Tree:
    """Return the core's kinematics of a hand.

    Raises:
        HandError: If the hand has a joint that is neither revolute, prismatic nor floating.
    """
    if hand.unscaled:
        origins, rolls = zip(*hand.moves.values(), strict=True)
        standard = core_tree(_standard_hand(hand.unscaled, hand.reference_points))
        return standard.moved([*hand.moves], np.array(origins), np.array(rolls))
    return core.Tree(encode(hand_model(hand)))


@lru_cache(maxsize=16)
def _standard_hand(hand: Hand, points: tuple[PointSpec, ...]) -> Hand:
    """Return a hand that is not scaled, with the reference points of one that is."""
    return hand.with_points(points)


def hand_model(hand: Hand) -> HandModel:
    """Return the model of a hand, or of the hands of a robot as one.

    Raises:
        HandError: If it has a joint that is neither revolute, prismatic nor floating.
    """
    model = hand.model
    points = hand.point_frames
    links = [point.link for point in hand.reference_points]
    offsets = [frame.placement.translation for frame in points]
    return HandModel(
        nq=model.nq,
        nv=model.nv,
        joints=tuple(_joint_model(hand, joint) for joint in range(1, model.njoints)),
        frames=tuple(
            FrameModel(
                name=frame.name,
                kind=_FRAMES.get(frame.type, "other"),
                joint=frame.parentJoint - 1,
                parent=frame.parentFrame,
                placement=frame.placement.homogeneous,
            )
            for frame in model.frames
        ),
        spread=hand.spread,
        q_indices=hand.q_indices,
        joint_columns=hand.joint_columns,
        configuration=hand.configuration_vector(hand.rest),
        moving_q=hand._moving_q,
        motion=hand._motion,
        shift=hand._shift,
        rest=hand.rest,
        lower=hand.lower_limits,
        upper=hand.upper_limits,
        joint_weights=hand.joint_weights,
        wrists=tuple(_place_model(each.wrist_frame) for each in hand.hands),
        palm=_place_model(hand.palm_frame),
        point_counts=np.array([len(each.reference_points) for each in hand.hands]),
        point_joints=np.array([frame.parentJoint - 1 for frame in points]),
        point_offsets=np.array(offsets),
        point_frames=np.array([model.getFrameId(link, pin.BODY) for link in links]),
        fingers=hand.finger_joints.astype(float),
    )


def _joint_model(hand: Hand, index: int) -> JointModel:
    model = hand.model
    joint = model.joints[index]
    kind = "floating"
    axis = np.zeros(3)
    if (joint.nq, joint.nv) == (1, 1):
        linear, angular = np.reshape(joint.createData().S, (2, 3))
        kind, axis = ("revolute", angular) if angular.any() else ("prismatic", linear)
    elif (joint.nq, joint.nv) != (7, 6):
        problem = "a joint that is neither revolute, prismatic nor floating"
        raise HandError(f"{hand.name}: {model.names[index]!r} is {problem}", key="urdf")
    return JointModel(
        kind=kind,
        parent=model.parents[index] - 1,
        axis=axis,
        placement=model.jointPlacements[index].homogeneous,
        q=joint.idx_q,
        v=joint.idx_v,
    )


def _place_model(frame: pin.Frame) -> PlaceModel:
    return PlaceModel(
        joint=frame.parentJoint - 1, placement=frame.placement.homogeneous
    )
