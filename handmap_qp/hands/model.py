"""From the description of a hand and its URDF to a checked Pinocchio model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError, InvalidInputError
from handmap_qp.hands.mimic import Expansion, MimicRule, read_mimic_rules
from handmap_qp.hands.spec import HandSpec, Mount
from handmap_qp.hands.urdf.elements import parse_urdf
from handmap_qp.se3 import affine

FLOATING_JOINT = "wrist_mount"
"""Name of the free-flyer that carries a floating hand."""


def choose_mount(spec: HandSpec, mount: Mount | None) -> Mount:
    """Choose how the root of the model is held.

    Args:
        spec: The hand.
        mount: The caller's choice; the spec's own if None.

    Returns:
        `floating` or `fixed`; a hand on an arm stands on the arm's root.

    Raises:
        InvalidInputError: If there is no such mount.
        HandError: If a hand on an arm is asked to float.
    """
    if not (mount is None or (isinstance(mount, str) and mount in get_args(Mount))):
        raise InvalidInputError(argument="mount", expected="'floating' or 'fixed'", value=mount)
    if spec.arm is None:
        return mount or spec.wrist.mount
    if mount == "floating":
        message = f"{spec.name} is mounted on {spec.arm.name}, and cannot float"
        raise spec.error(message, key="arm", value=mount)
    return "fixed"


def mimic_rules(spec: HandSpec, urdf_text: str) -> tuple[MimicRule, ...]:
    """Read the mimic rules of a composed URDF.

    Returns:
        One rule per follower, resolved to leaders that follow no other joint.

    Raises:
        HandError: If a rule cannot be resolved, or a follower is one of the spec's joints.
    """
    try:
        rules = read_mimic_rules(parse_urdf(urdf_text))
    except HandError as error:
        raise spec.located(error) from error
    for rule in rules:
        if rule.follower in spec.all_joints:
            message = (
                f"{rule.follower!r} mimics {rule.leader!r} and cannot be set: leave it out, "
                f"or give mimic.{rule.follower}: null"
            )
            raise spec.error(message, key="joints", value=rule.follower)
    return rules


def build_model(
    spec: HandSpec, urdf_text: str, mount: Mount, followers: Sequence[str]
) -> pin.Model:
    """Build the Pinocchio model of a composed URDF.

    Args:
        spec: The hand.
        urdf_text: Its composed URDF.
        mount: A floating hand gets a free-flyer above its root link.
        followers: Names of the joints that mimic others.

    Returns:
        The model: every movable joint of the URDF is a variable, followers included.

    Raises:
        HandError: If Pinocchio cannot read the URDF, or its joints are not those of the spec.
    """
    try:
        if mount == "floating":
            model = pin.buildModelFromXML(urdf_text, pin.JointModelFreeFlyer(), FLOATING_JOINT)
        else:
            model = pin.buildModelFromXML(urdf_text)
    except (RuntimeError, ValueError) as error:
        message = f"Pinocchio cannot read the URDF: {' '.join(str(error).split())}"
        raise spec.error(message, key="urdf") from error
    for name, joint in zip(model.names, model.joints, strict=True):
        if name in ("universe", FLOATING_JOINT):
            continue
        if name not in spec.all_joints and name not in followers:
            message = f"the URDF's joint {name!r} is missing: name it here or in `locked`"
            raise spec.error(message, key="joints", value=name)
        if joint.nq != 1:
            kind = joint.shortname()
            message = f"{name!r} is a {kind}; only joints with one coordinate can be used"
            raise spec.error(message, key="joints")
    for name in spec.all_joints:
        if not model.existJointName(name):
            message = f"the URDF has no movable joint {name!r}"
            raise spec.error(message, key="joints", value=name)
    return model


def move_joint(model: pin.Model, name: str, origin: np.ndarray, roll: float) -> None:
    """Place a joint elsewhere on its parent link.

    Args:
        model: The model, changed in place.
        name: Name of the joint; a fixed one takes the frames beyond it along, and does not turn.
        origin: Its position on the parent link [m], shape (3,).
        roll: Turn about its own x axis [rad].
    """
    is_movable = model.existFrame(name, pin.FrameType.JOINT)
    kind = pin.FrameType.JOINT if is_movable else pin.FrameType.FIXED_JOINT
    index = model.getFrameId(name, kind)
    frame = model.frames[index]
    place = model.frames[frame.parentFrame].placement.act(origin)
    if is_movable:
        placement = model.jointPlacements[frame.parentJoint]
        placement.translation = place
        if roll != 0.0:
            placement.rotation = placement.rotation @ pin.utils.rotate("x", roll)
        return
    before, moved = frame.placement.translation.copy(), {index}
    for i in range(index, len(model.frames)):
        each = model.frames[i]
        if i in moved or each.parentFrame in moved:
            moved.add(i)
            each.placement.translation = place + (each.placement.translation - before)


def add_frame(
    model: pin.Model, spec: HandSpec, name: str, link: str, placement: np.ndarray, key: str
) -> int:
    """Add a frame that is fixed to a link.

    Args:
        model: The model, changed in place.
        spec: The hand.
        name: Name of the frame, which no other frame of the model has.
        link: URDF link that carries it.
        placement: Its pose in the link, shape (4, 4).
        key: Key of the spec that names the link.

    Returns:
        Index of the frame.

    Raises:
        HandError: If there is no such link.
    """
    # By kind as well as by name: in many URDFs a joint has the name of its link.
    if not model.existFrame(link, pin.FrameType.BODY):
        raise spec.error(f"the URDF has no link {link!r}", key=key, value=link)
    parent_id = model.getFrameId(link, pin.FrameType.BODY)
    parent = model.frames[parent_id]
    pose = parent.placement * pin.SE3(placement)
    frame = pin.Frame(name, parent.parentJoint, parent_id, pose, pin.FrameType.OP_FRAME)
    return model.addFrame(frame)


def with_frames(model: pin.Model, frames: Sequence[int]) -> pin.Model:
    """Return a model with the same joints and some of the frames: the others take time to place.

    Args:
        model: The model, such as that of a URDF with a link for every part.
        frames: Indices of the frames to keep.
    """
    few = pin.Model()
    for joint in range(1, model.njoints):
        place = model.jointPlacements[joint]
        few.addJoint(model.parents[joint], model.joints[joint], place, model.names[joint])
    for index in frames:
        frame = model.frames[index]
        kind = pin.FrameType.OP_FRAME
        few.addFrame(pin.Frame(frame.name, frame.parentJoint, 0, frame.placement, kind))
    return few


def palm_in_link(spec: HandSpec) -> np.ndarray:
    """Return the pose of the palm frame in its link, shape (4, 4)."""
    distal, dorsal = np.array(spec.palm.distal), np.array(spec.palm.dorsal)
    axes = np.column_stack([np.cross(distal, dorsal), distal, dorsal])
    return affine(axes, np.array(spec.palm.xyz))


def check_limits(
    spec: HandSpec,
    lower_limits: np.ndarray,
    upper_limits: np.ndarray,
    velocity_limits: np.ndarray,
    postures: dict[str, np.ndarray],
) -> None:
    """Check that limits are finite and that the description's postures lie inside them.

    Args:
        spec: The hand.
        lower_limits: In the order of `spec.all_joints` [rad or m], shape (n,), like the others.
        upper_limits: Upper position limits [rad or m].
        velocity_limits: Speed limits [rad/s or m/s].
        postures: Rest posture and others by key [rad or m].

    Raises:
        HandError: With the joint at fault.
    """
    columns = zip(spec.all_joints, lower_limits, upper_limits, velocity_limits, strict=True)
    for i, (name, lower, upper, speed) in enumerate(columns):
        interval = f"[{lower:.6g}, {upper:.6g}]"
        if not (np.isfinite(lower) and np.isfinite(upper) and lower < upper):
            message = f"{name!r} needs limits with lower < upper, got {interval}"
            raise spec.error(f"{message}: give them in `limits`", key="urdf")
        if not (np.isfinite(speed) and speed > 0.0):
            message = f"{name!r} needs a velocity limit > 0, got {speed:.6g}"
            raise spec.error(f"{message}: give it in `limits`", key="urdf")
        for key, posture in postures.items():
            if not lower <= posture[i] <= upper:
                message = f"{posture[i]:.6g} is outside the joint's limits {interval}"
                raise spec.error(message, key=f"{key}.{name}", value=float(posture[i]))


def check_wrist(model: pin.Model, spec: HandSpec, mount: Mount, wrist: int, palm: int) -> None:
    """Reject a wrist or palm that moves with the fingers.

    Only the free-flyer or the joints of an arm may move them, and both together.

    Args:
        model: The model.
        spec: The hand.
        mount: How it is mounted.
        wrist: Index of the wrist frame.
        palm: Index of the palm frame.

    Raises:
        HandError: With the key of the link at fault.
    """
    joints = [model.frames[frame].parentJoint for frame in (wrist, palm)]
    links = (("wrist.link", spec.wrist.link), ("palm.link", spec.palm.link))
    for (key, link), joint in zip(links, joints, strict=True):
        if mount == "floating" and joint != 1:
            message = f"{link!r} moves with joints; on a floating hand it must be fixed to the root"
            raise spec.error(message, key=key, value=link)
        if not _moves_all_fingers(model, joint):
            message = f"{link!r} moves with the fingers; it must be fixed to the root or to an arm"
            raise spec.error(message, key=key, value=link)
    if joints[0] != joints[1]:
        message = f"{spec.palm.link!r} moves against the wrist's link {spec.wrist.link!r}"
        raise spec.error(message, key="palm.link", value=spec.palm.link)


def tangent_expansion(
    joints: Expansion, active: np.ndarray, columns: np.ndarray, follower_v: Sequence[int]
) -> Expansion:
    """Extend the map from active joints to all joints to the model's tangent space.

    Args:
        joints: The map over joints: the active ones first, then the followers.
        active: Indices of the active coordinates in the tangent space, shape (k,).
        columns: Indices of the joints in the active coordinates, shape (n,).
        follower_v: Indices of the followers in the tangent space.

    Returns:
        S, shape (nv, k), with the identity for the wrist's coordinates, and the followers' offsets,
        shape (nv,).
    """
    nv, count = len(active) + len(follower_v), len(columns)
    matrix, offset = np.eye(nv)[:, active], np.zeros(nv)
    matrix[np.ix_(list(follower_v), columns.tolist())] = joints.matrix[count:]
    offset[list(follower_v)] = joints.offset[count:]
    return Expansion(matrix, offset)


def _moves_all_fingers(model: pin.Model, joint: int) -> bool:
    """Whether every joint is above this one or below it."""
    above = set(model.supports[joint])
    return all(
        other in above or joint in model.supports[other] for other in range(1, model.njoints)
    )
