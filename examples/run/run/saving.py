"""`saved`: what the core is made of, for a computer without `handmap_qp`."""

from __future__ import annotations

import zlib
from typing import Any

import msgspec
import numpy as np
import pinocchio as pin

import handmap_qp
from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands import Hand
from handmap_qp.hands.compiled import hand_model
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.mapping import (
    HandMapper,
    RobotMapper,
    TargetSource,
    robot_fingers,
)
from handmap_qp.models import Model, encode
from handmap_qp.options import Options
from handmap_qp.stream import can_grip
from handmap_qp.trackers import LAYOUTS
from .form import HAND, KIND, ROBOT, File

_HAND = """
name side mount is_floating joint_names all_joint_names limits lower_limits upper_limits
velocity_limits rest spread active_columns joint_columns q_indices point_weights palm_frame
wrist_frame wrist_to_palm point_frames reference_points spec model moves_wrist finger_joints
has_moving_wrist has_floating_base rules palm_weights _moving_q _motion _shift _wrist_to_root
"""
_ATTRIBUTES = {
    "Hand": _HAND,
    "HandSpec": "side wrist upright",
    "WristSpec": "max_linear_speed max_angular_speed",
    "PointSpec": "name link xyz",
    "Frame": "parentJoint placement",
    "MotionEstimator": "ridge centroid shares centred gain prior_gain _singular_values",
    "PointDistances": "points first second distances weights",
    "AttachedPoints": "joints offsets",
    "BoundHomogeneous": """
        alignment options renews_reference needs_wrist reference_needs_wrist partners
        wrist_to_palm
    """,
    "BoundTeleoperation": """
        alignment choices model estimator distances human_anchor robot_anchor wrist_to_palm
    """,
    "Pad": "joint offset radius cover",
    "Finger": "columns is_jaw",
}
"""What the core, the guard and the maps read of each class; both sides have the same names."""


def saved(mapper: HandMapper | RobotMapper) -> bytes:
    """Return the file of a mapper's hands, and of how the one follows the other.

    References, the posture and the person's samples are not in it.

    Args:
        mapper: The mapper; its human hands must be scaled to the person.

    Raises:
        InvalidOptionsError: If it moves the robot in Python: by another method than those of the
            core, with tasks, or by another solver.
        HandError: If a human hand has no landmarks.
    """
    if not mapper.ik.is_compiled:
        _refuse("formulation", "the compiled core does not move this hand as asked")
    collisions = _collisions(mapper.robot, mapper.point_ik.gate.collisions)
    if isinstance(mapper, RobotMapper):
        form, tree = ROBOT, _robot(mapper, collisions)
    else:
        contacts = mapper.bound.contacts is not None
        form, tree = HAND, _hand(mapper.source, mapper, contacts, collisions)
    body = encode(tree)
    version = handmap_qp.__version__
    file = File(KIND, version, zlib.crc32(body), body, form)
    return msgspec.msgpack.encode(file)


def _robot(mapper: RobotMapper, collisions: Any) -> dict[str, Any]:
    """Return a robot, and each of its hands as if it was alone, but for the collisions."""
    # Which pairs of a hand pinch, among those of all hands and among its own.
    sources = mapper.sources.values()
    contacts = mapper.pinching or [()] * len(sources)
    hands = zip(sources, contacts, strict=True)
    robot = _hand_of(mapper.robot) | {"collisions": collisions}
    return {
        "": "Saved",
        "robot": robot,
        "hands": [_hand(source, mapper, [*rows], None) for source, rows in hands],
        "turns_in": mapper.turns_in,
    }


def _hand(
    source: TargetSource,
    mapper: HandMapper | RobotMapper,
    contacts: Any,
    collisions: Any,
) -> dict[str, Any]:
    """Return a hand, the person's, and how the one follows the other.

    Args:
        source: The human's side of the hand.
        mapper: Moves it.
        contacts: As of `BoundMethod`, as the core needs them.
        collisions: As of `_collisions`.
    """
    kind = type(source.bound).__name__
    if kind not in ("BoundHomogeneous", "BoundTeleoperation"):
        _refuse("method", f"{kind.removeprefix('Bound')} is in Python alone")
    if source.tasks or mapper.ik.tasks:
        _refuse("tasks", "further tasks are in Python alone")
    robot = _hand_of(source.robot) | {"collisions": collisions}
    if can_grip(source):
        robot["grasp"] = _grasp(source.robot)
    landmarks = source.human.with_points("landmarks").reference_points
    human = _hand_of(source.human) | {"landmarks": _packed(landmarks)}
    orders = {
        name: np.array(layout.order("right"))
        for name, layout in LAYOUTS.items()
        if layout.shapes[0][0] == 21 and layout.order("right") is not None
    }
    return {
        "": "Saved",
        "human": human,
        "robot": robot,
        "bound": _packed(source.bound) | {"contacts": contacts},
        "ik": _packed(mapper.ik),
        "dt": mapper.moving_robot.usual_dt,
        "joint_tolerance": source.joint_tolerance,
        "quat_order": source.quat_order,
        "orders": orders,
    }


def _hand_of(hand: Hand) -> dict[str, Any]:
    """Return what is read of a hand in Python, and its model for the core."""
    return _packed(hand) | {"tree_model": encode(hand_model(hand))}


def _collisions(hand: Hand, limit: CollisionLimit | None) -> dict[str, Any] | None:
    """Return the pairs of shapes that a hand keeps apart, and how."""
    if limit is None:
        return None
    return {
        "": "CollisionLimit",
        "pairs": encode(limit.bounds.model()),
        "model": encode(limit.model),
        "links": limit.bounds.links,
        "columns": limit.bounds.moving_columns(hand.spread),
    }


def _grasp(robot: Hand) -> dict[str, Any]:
    """Return what grips of a robot hand need of its fingers."""
    fingers = robot_fingers(robot)
    names = fingers.names
    return {
        "": "Grasp",
        "names": names,
        "has_jaws": fingers.has_jaws,
        "pads": {name: _packed(fingers.pads[name]) for name in names},
        "used": {name: _packed(fingers.used[name]) for name in names},
    }


def _refuse(option: str, problem: str) -> None:
    raise InvalidOptionsError(
        problem,
        option=option,
        advice="a saved hand is moved by the compiled core alone",
    )


def _packed(value: Any) -> Any:
    """Return an object as names and numbers; its class is under the name ""."""
    kind = type(value).__name__
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, np.ndarray | bool | int | float | str):
        return value
    if isinstance(value, pin.SE3):
        return {"": "Pose", "homogeneous": value.homogeneous}
    if isinstance(value, Model):
        names = value.__struct_fields__
        return {"": kind} | {name: _packed(getattr(value, name)) for name in names}
    if isinstance(value, Options):
        return {"": kind} | {name: _packed(each) for name, each in value.values.items()}
    if make := _MADE.get(kind):
        return {"": kind} | make(value)
    if kind in _ATTRIBUTES:
        names = _ATTRIBUTES[kind].split()
        return {"": kind} | {name: _packed(getattr(value, name)) for name in names}
    return [_packed(each) for each in value]


def _model(model: pin.Model) -> dict[str, Any]:
    return {
        "nq": model.nq,
        "nv": model.nv,
        "njoints": model.njoints,
        "joints": _packed(model.joints),
        "jointPlacements": _packed(model.jointPlacements),
        "parents": [*model.parents],
        "frames": [],
        "neutral": pin.neutral(model),
    }


def _joint(joint: pin.JointModel) -> dict[str, Any]:
    # The core asks for the axis of joints that have one.
    axis = np.ravel(joint.createData().S) if joint.nv == 1 else None
    return {
        "nq": joint.nq,
        "nv": joint.nv,
        "idx_q": joint.idx_q,
        "idx_v": joint.idx_v,
        "S": axis,
    }


_MADE = {"Model": _model, "JointModel": _joint}
"""What the core reads of classes of Pinocchio and coal by their methods."""
