"""From the description of a hand and its URDF to a checked Pinocchio model.

Mimic joints follow a leader, `q_follower = multiplier * q_leader + offset`. All movable joints are
variables of the model, and the rules one linear map on top of it,

    q_all = S q_active + offset,        v_all = S v_active,        J_active = J_all S,

so followers are not variables of the QP. A leader may follow another joint itself.
"""

import math
from collections.abc import Mapping
from typing import get_args
from xml.etree.ElementTree import Element, tostring

import numpy as np
import pinocchio as pin

from handmap_core.errors import HandError, expect, reason_of
from handmap_core.hands import Names
from handmap_core.se3 import frozen
from .follower_limits import LEAST_SHARE, Interval, leaves, range_left
from .human import JointMove
from .spec import HandSpec, MimicSpec, Mount, Positions, Rules
from .urdf import (
    MOVABLE,
    joints_by_name,
    mimics_of,
    mirror,
    mount_on_arm,
    move_shapes,
    prepare_urdf,
    read_tree,
    remove_subtrees,
)

FLOATING_JOINT = "wrist_mount"
"""Name of the free-flyer that carries a floating hand."""
_JOINT = pin.FrameType.JOINT
_FIXED_JOINT = pin.FrameType.FIXED_JOINT
_X_AXIS = frozen(np.array([1.0, 0.0, 0.0]))


def choose_mount(spec: HandSpec, mount: Mount | None) -> Mount:
    """Return the caller's mount, else the spec's own; a hand on an arm stands on the arm's root.

    Raises:
        InvalidInputError: If there is no such mount.
        HandError: If a hand on an arm is asked to float.
    """
    is_known = isinstance(mount, str | None) and mount in (None, *get_args(Mount))
    expect(is_known, "mount", "'floating' or 'fixed'", value=mount)
    if spec.arm is None:
        return mount or spec.wrist.mount
    if mount == "floating":
        problem = f"{spec.name} is mounted on {spec.arm.name}, and cannot float"
        raise spec.error(problem, "arm", mount)
    return "fixed"


def compose_urdf(
    spec: HandSpec, text: str | None = None
) -> tuple[str, Positions, Rules]:
    """Compose the URDF that a hand's model is built from, of its file or of a text.

    Keep the part from `root` outwards; write `mimic`, `locked`, `limits` and `shapes` into it;
    mount it on the arm, if there is one; mirror all of it.

    Returns:
        The URDF, with absolute paths of meshes; positions of locked joints and those that mimic
        them [rad or m]; and other rules.

    Raises:
        HandError: If a URDF is not a tree, or the spec names links or joints that do not exist.
        MissingExtraError: If a URDF lies in a package that is not installed.
    """
    try:
        robot = read_tree(spec, text)
        locked = prepare_urdf(robot, spec)
        move_shapes(robot, spec.shapes)
        if arm := spec.arm:
            hand = robot
            robot = read_tree(arm)
            remove_subtrees(robot, arm.without)
            locked = prepare_urdf(robot, arm) | locked
            mount_on_arm(robot, hand, arm)
        if spec.mirror:
            mirror(robot)
        return tostring(robot, encoding="unicode"), locked, read_mimic_rules(robot)
    except HandError as error:
        raise spec.error(error.problem, error.key or "urdf", error.value) from error


def build_model(
    spec: HandSpec, urdf_text: str, mount: Mount, rules: Rules
) -> pin.Model:
    """Build the Pinocchio model of a composed URDF: every movable joint is a variable.

    Raises:
        HandError: If Pinocchio cannot read the URDF, or it has other joints than the spec.
    """
    root = (pin.JointModelFreeFlyer(), FLOATING_JOINT) if mount == "floating" else ()
    try:
        model = pin.buildModelFromXML(urdf_text, *root)
    except (RuntimeError, ValueError) as error:
        problem = f"Pinocchio cannot read the URDF: {reason_of(error)}"
        raise spec.error(problem, "urdf") from error
    own = {*spec.all_joints}
    movable = {*model.names} - {"universe", FLOATING_JOINT}
    for name in sorted(own & rules.keys()):
        mimics = f"{name!r} mimics {rules[name].joint!r}"
        advice = "leave it out, or give its rule in `mimic`"
        raise spec.error(f"{mimics}: {advice}", "joints", name)
    for name in sorted(movable - own - rules.keys()):
        missing = f"{name!r} is missing: name it here or in `locked`"
        raise spec.error(missing, "joints", name)
    for name in sorted(own - movable):
        unknown = f"{name!r} is not a movable joint of the URDF"
        raise spec.error(unknown, "joints", name)
    return model


def moved_model(model: pin.Model, moves: Mapping[str, JointMove]) -> pin.Model:
    """Return a copy of a model in which joints sit elsewhere on their parent links.

    The compiled core does the same to its kinematics (`Tree.move_joint`).

    Args:
        model: The model, which is not changed.
        moves: New place of joints, movable or fixed, by their names: see `JointMove`.

    Returns:
        The model that Pinocchio would build of a URDF with these origins.
    """
    moved = model.copy()
    frames = moved.frames
    for name, (xyz, turn) in moves.items():
        is_fixed = not moved.existJointName(name)
        k = moved.getFrameId(name, _FIXED_JOINT if is_fixed else _JOINT)
        frame = frames[k]
        joint = frame.parentJoint
        old = frame.placement if is_fixed else moved.jointPlacements[joint]
        about_x = pin.AngleAxis(turn, _X_AXIS).toRotationMatrix()
        position = frames[frame.parentFrame].placement.act(xyz)
        new = pin.SE3(old.rotation @ about_x, position)
        if is_fixed:
            _displace(moved, k, new * old.inverse())
        else:
            moved.jointPlacements[joint] = new
    return moved


def _displace(model: pin.Model, first: int, displacement: pin.SE3) -> None:
    """Displace the frame of a fixed joint, and the frames that it carries, on their joint."""
    carried = {first}
    frames = model.frames
    # Frames are in depth-first order.
    for k in range(first, model.nframes):
        frame = frames[k]
        if k > first and frame.parentFrame not in carried:
            break
        carried.add(k)
        frame.placement = displacement * frame.placement


def read_mimic_rules(robot: Element) -> Rules:
    """Read the mimic rules of a URDF, resolved to leaders that follow no other joint.

    Returns:
        Rules by follower, in the order of the file, without those of fixed joints.

    Raises:
        HandError: If a leader is missing or fixed, or rules are a circle or not finite.
    """
    movable = joints_by_name(robot, MOVABLE)
    direct = {n: rule for n, rule in mimics_of(robot).items() if n in movable}
    for follower, rule in direct.items():
        if rule.joint not in movable:
            absent = "does not exist in this part of the robot"
            what = "cannot move" if rule.joint in joints_by_name(robot) else absent
            message = (
                f"it mimics {rule.joint!r}, which {what}: "
                "give its rule in `mimic`, or hold it still in `locked`"
            )
            raise HandError(message, key=f"mimic.{follower}", value=rule.joint)
    return {follower: resolve_rule(follower, direct) for follower in direct}


def resolve_rule(follower: str, direct: Rules) -> MimicSpec:
    """Follow the leaders to one that follows no other: a (b q + c) + d = (a b) q + (a c + d).

    Args:
        follower: The joint.
        direct: Rules as they are written, by follower.

    Raises:
        HandError: If rules are a circle.
    """
    passed = [follower]
    rule = direct[follower]
    while rule.joint in direct:
        if rule.joint in passed:
            circle = " -> ".join([*passed[passed.index(rule.joint) :], rule.joint])
            raise HandError(
                f"joints mimic each other in a circle: {circle}",
                key=f"mimic.{follower}",
                value=rule.joint,
            )
        passed.append(rule.joint)
        leader = direct[rule.joint]
        factor = rule.multiplier
        offset = factor * leader.offset + rule.offset
        rule = MimicSpec(leader.joint, factor * leader.multiplier, offset)
    return rule


def tighten_model(model: pin.Model, rules: Rules) -> Names:
    """Tighten the limits of leaders in a model so that their followers stay inside theirs.

    Limits that would leave a leader almost no range contradict the rule, and are dropped. A
    follower without a speed limit passes none on.

    Returns:
        A sentence for each follower whose limits were dropped.
    """
    lower = model.lowerPositionLimit
    upper = model.upperPositionLimit
    velocity = model.velocityLimit
    notes = []
    for name, rule in rules.items():
        if rule.multiplier == 0.0:
            continue
        leader, own = (model.joints[model.getJointId(n)] for n in (rule.joint, name))
        q = leader.idx_q
        limits = Interval(lower[own.idx_q], upper[own.idx_q])
        given = Interval(lower[q], upper[q])
        left = range_left(rule, limits, given)
        if not leaves(LEAST_SHARE, left, given):
            notes.append(
                f"the limits [{limits[0]:.4g}, {limits[1]:.4g}] of {name!r} are ignored: with "
                f"its rule {rule.multiplier:.4g} * {rule.joint} + {rule.offset:.4g} they "
                f"would leave the leader no range in [{lower[q]:.4g}, {upper[q]:.4g}]"
            )
        else:
            lower[q], upper[q] = left
        speed = velocity[own.idx_v] / abs(rule.multiplier)
        if 0.0 < speed < math.inf:
            velocity[leader.idx_v] = min(velocity[leader.idx_v], speed)
    return tuple(notes)
