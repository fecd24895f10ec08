"""From the description of a hand and its URDF to a checked Pinocchio model."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from typing import get_args

import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError, InvalidInputError
from handmap_qp.hands.mimic import read_mimic_rules
from handmap_qp.hands.sources import read_urdf
from handmap_qp.hands.spec import HandSpec, MimicSpec, Mount
from handmap_qp.hands.urdf import (
    NO_LIMIT,
    check_tree,
    mirror,
    mount_on_arm,
    parse_urdf,
    prepare_urdf,
    remove_subtrees,
)
from handmap_qp.se3 import affine

FLOATING_JOINT = "wrist_mount"
"""Name of the free-flyer that carries a floating hand."""


def choose_mount(spec: HandSpec, mount: Mount | None) -> Mount:
    """Return the caller's mount, else the spec's own; a hand on an arm stands on the arm's root.

    Raises:
        InvalidInputError: If there is no such mount.
        HandError: If a hand on an arm is asked to float.
    """
    if not (mount is None or (isinstance(mount, str) and mount in get_args(Mount))):
        raise InvalidInputError(
            argument="mount", expected="'floating' or 'fixed'", value=mount
        )
    if spec.arm is None:
        return mount or spec.wrist.mount
    if mount == "floating":
        raise spec.error(
            f"{spec.name} is mounted on {spec.arm.name}, and cannot float",
            key="arm",
            value=mount,
        )
    return "fixed"


def compose_urdf(
    spec: HandSpec, text: str | bytes
) -> tuple[str, dict[str, float], dict[str, MimicSpec]]:
    """Compose the URDF that a hand's model is built from.

    The steps: keep only the part from `root` outwards; write `mimic`, `locked` and `limits` into
    it; mount it on the arm, if the spec has one; mirror all of it.

    Returns:
        The URDF, the position of every joint that was made a fixed one [rad or m] (those that the
        spec locks, and the joints that mimic them), and the mimic rules that are left.

    Raises:
        HandError: If a URDF is not a tree, or the spec names links or joints that do not exist.
        MissingExtraError: If the arm's URDF lies in a package that is not installed.
    """
    try:
        robot = parse_urdf(text)
        check_tree(robot)
        locked = prepare_urdf(robot, spec.root, spec.mimic, spec.locked, spec.limits)
        if (arm := spec.arm) is not None:
            hand = robot
            robot = parse_urdf(read_urdf(arm))
            check_tree(robot)
            remove_subtrees(robot, arm.without)
            locked = prepare_urdf(robot, arm.root, {}, arm.locked, arm.limits) | locked
            mount_on_arm(robot, hand, arm)
        if spec.mirror:
            mirror(robot)
        return ET.tostring(robot, encoding="unicode"), locked, read_mimic_rules(robot)
    except HandError as error:
        raise spec.located(error) from error


def build_model(
    spec: HandSpec, urdf_text: str, mount: Mount, rules: Mapping[str, MimicSpec]
) -> pin.Model:
    """Build the Pinocchio model of a composed URDF: every movable joint is a variable.

    A floating hand gets a free-flyer above its root link.

    Raises:
        HandError: If Pinocchio cannot read the URDF, or its joints are not those of the spec and
            their followers.
    """
    root = (pin.JointModelFreeFlyer(), FLOATING_JOINT) if mount == "floating" else ()
    try:
        model = pin.buildModelFromXML(urdf_text, *root)
    except (RuntimeError, ValueError) as error:
        raise spec.error(
            f"Pinocchio cannot read the URDF: {' '.join(str(error).split())}",
            key="urdf",
        ) from error
    own = set(spec.all_joints)
    movable = {*model.names} - {"universe", FLOATING_JOINT}
    for message, names in (
        (
            "mimics {}: leave it out, or give its rule in `mimic`",
            own & rules.keys(),
        ),
        ("is missing: name it here or in `locked`", movable - own - rules.keys()),
        ("is not a movable joint of the URDF", own - movable),
    ):
        for name in sorted(names):
            leader = repr(rules[name].joint) if name in rules else ""
            raise spec.error(
                f"{name!r} {message.format(leader)}", key="joints", value=name
            )
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
    before = frame.placement.translation.copy()
    moved = {index}
    for i in range(index, len(model.frames)):
        each = model.frames[i]
        if i in moved or each.parentFrame in moved:
            moved.add(i)
            each.placement.translation = place + (each.placement.translation - before)


def link_frame(
    model: pin.Model,
    spec: HandSpec,
    name: str,
    link: str,
    placement: np.ndarray,
    key: str,
) -> pin.Frame:
    """Return a frame with a name of its own and a placement (4, 4) on a link; it is not added.

    Raises:
        HandError: If there is no such link, with the key of the spec that names it.
    """
    # By kind as well as by name: in many URDFs a joint has the name of its link.
    if not model.existFrame(link, pin.FrameType.BODY):
        raise spec.error(f"the URDF has no link {link!r}", key=key, value=link)
    parent_id = model.getFrameId(link, pin.FrameType.BODY)
    parent = model.frames[parent_id]
    pose = parent.placement * pin.SE3(placement)
    return pin.Frame(name, parent.parentJoint, parent_id, pose, pin.FrameType.OP_FRAME)


def with_frames(model: pin.Model, frames: Iterable[pin.Frame]) -> pin.Model:
    """Return a model with the same joints and only these frames: others take time to place."""
    few = pin.Model()
    for joint in range(1, model.njoints):
        place = model.jointPlacements[joint]
        few.addJoint(
            model.parents[joint], model.joints[joint], place, model.names[joint]
        )
    kind = pin.FrameType.OP_FRAME
    for frame in frames:
        few.addFrame(pin.Frame(frame.name, frame.parentJoint, 0, frame.placement, kind))
    return few


def palm_in_link(spec: HandSpec) -> np.ndarray:
    """Return the pose of the palm frame in its link, shape (4, 4)."""
    distal = np.array(spec.palm.distal)
    dorsal = np.array(spec.palm.dorsal)
    axes = np.column_stack([np.cross(distal, dorsal), distal, dorsal])
    return affine(axes, np.array(spec.palm.xyz))


def check_limits(
    spec: HandSpec, limits: Sequence[np.ndarray], postures: dict[str, np.ndarray | None]
) -> None:
    """Check that limits are finite and that the description's postures lie inside them.

    Args:
        spec: The hand.
        limits: Lower and upper position limits [rad or m] and speed limits [rad/s or m/s], in the
            order of `spec.all_joints`, shape (n,) each.
        postures: Rest posture and others by key [rad or m]; None where there is none.

    Raises:
        HandError: With the joint at fault, and the key that gives its limits.
    """
    for i, (name, *numbers) in enumerate(zip(spec.all_joints, *limits, strict=True)):
        lower, upper, speed = numbers
        interval = f"[{lower:.6g}, {upper:.6g}]"
        key = f"limits.{name}"
        if not max(-lower, upper) < NO_LIMIT:
            raise spec.error(
                f"{name!r} has no limits in the URDF: give lower, upper and velocity",
                key=key,
                value=name,
            )
        if not lower < upper:
            raise spec.error(
                f"{name!r} needs limits with lower < upper, got {interval}", key=key
            )
        if not (np.isfinite(speed) and speed > 0.0):
            raise spec.error(
                f"{name!r} needs a velocity limit > 0, got {speed:.6g}", key=key
            )
        for key, posture in postures.items():
            if posture is not None and not lower <= posture[i] <= upper:
                raise spec.error(
                    f"{posture[i]:.6g} is outside the joint's limits {interval}",
                    key=f"{key}.{name}",
                    value=float(posture[i]),
                )


def check_wrist(
    model: pin.Model, spec: HandSpec, mount: Mount, wrist: int, palm: int
) -> None:
    """Reject a wrist or palm that moves with the fingers.

    Only the free-flyer or the joints of an arm may move them, and both together.

    Raises:
        HandError: With the key of the link at fault.
    """
    joints = [model.frames[frame].parentJoint for frame in (wrist, palm)]
    links = (("wrist.link", spec.wrist.link), ("palm.link", spec.palm.link))
    for (key, link), joint in zip(links, joints, strict=True):
        below = [i for i in range(model.njoints) if joint in model.supports[i]]
        # All other joints hang from it or carry it.
        is_trunk = len(below) + len(model.supports[joint]) - 1 == model.njoints
        if not is_trunk or (mount == "floating" and joint != 1):
            message = (
                f"{link!r} moves with joints of the hand; it must be fixed to the root"
            )
            raise spec.error(f"{message}, or to an arm", key=key, value=link)
    if joints[0] != joints[1]:
        raise spec.error(
            f"{spec.palm.link!r} moves against the wrist's link {spec.wrist.link!r}",
            key="palm.link",
            value=spec.palm.link,
        )
