"""Edit the joints of a URDF: hold them still, set their limits, make them mimic others."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping

import numpy as np

from handmap_qp.errors import HandError
from handmap_qp.hands.spec import LimitSpec, MimicSpec
from handmap_qp.hands.urdf.elements import axis_of, get_numbers, origin_of, set_numbers
from handmap_qp.hands.urdf.tree import MOVABLE, joints_by_name
from handmap_qp.se3 import affine, rpy_from_rotation

# A mimicking joint without limits of its own passes none on to its leader.
_NO_LIMIT = LimitSpec(lower=-1e6, upper=1e6, velocity=1e6)
# What a fixed joint does not have; its origin is written again.
_NOT_OF_FIXED_JOINTS = (
    "axis",
    "limit",
    "mimic",
    "origin",
    "calibration",
    "safety_controller",
    "dynamics",
)


def lock_joints(robot: ET.Element, positions: Mapping[str, float]) -> dict[str, float]:
    """Make joints fixed ones, at given positions.

    Joints that mimic a locked one are locked where they then stand.

    Args:
        robot: The `<robot>` element, changed in place.
        positions: Position by joint name [rad or m].

    Returns:
        Positions of all joints that were made fixed, in the order of the file [rad or m].

    Raises:
        HandError: If there is no such joint, or it has more than one coordinate.
    """
    joints = joints_by_name(robot)
    pending, locked = dict(positions), {}
    while pending:
        name, position = pending.popitem()
        if name not in joints:
            raise HandError(f"the URDF has no joint {name!r}", key="locked", value=name)
        if joints[name].get("type") == "fixed":
            continue
        _lock(joints[name], position)
        locked[name] = position
        for follower, joint in joints.items():
            mimic = joint.find("mimic")
            if mimic is not None and mimic.get("joint") == name and follower not in positions:
                (multiplier,) = get_numbers(mimic, "multiplier", 1, "1")
                (offset,) = get_numbers(mimic, "offset", 1, "0")
                pending[follower] = multiplier * position + offset
    return {name: locked[name] for name in joints if name in locked}


def set_limits(robot: ET.Element, limits: Mapping[str, LimitSpec]) -> None:
    """Write limits into a URDF; a continuous joint that gets both becomes a revolute one.

    Args:
        robot: The `<robot>` element, changed in place.
        limits: Limits by joint name; a value of None leaves the URDF's.

    Raises:
        HandError: If there is no such movable joint.
    """
    for name, limit in limits.items():
        joint = _movable_joint(robot, name, "limits")
        element = _limit_of(joint)
        for key in ("lower", "upper", "velocity"):
            if (value := getattr(limit, key)) is not None:
                set_numbers(element, key, [value])
        for key in ("effort", "velocity"):
            element.attrib.setdefault(key, "0")
        is_bounded = limit.lower is not None and limit.upper is not None
        if is_bounded and joint.get("type") == "continuous":
            joint.set("type", "revolute")


def set_mimic_rules(robot: ET.Element, rules: Mapping[str, MimicSpec | None]) -> None:
    """Replace the mimic rules of joints, and give every mimicking joint a limit element.

    Args:
        robot: The `<robot>` element, changed in place.
        rules: Rules by follower; None removes the joint's own rule.

    Raises:
        HandError: If there is no such movable joint.
    """
    for name, rule in rules.items():
        joint = _movable_joint(robot, name, "mimic")
        for old in joint.findall("mimic"):
            joint.remove(old)
        if rule is not None:
            numbers = {"multiplier": repr(rule.multiplier), "offset": repr(rule.offset)}
            ET.SubElement(joint, "mimic", {"joint": rule.joint, **numbers})


def complete_followers(robot: ET.Element) -> None:
    """Give mimicking joints the limit elements that URDF readers require.

    A follower without position limits gets very wide ones, so that it does not bound its leader. A
    continuous one becomes revolute.

    Args:
        robot: The `<robot>` element, changed in place.
    """
    for joint in robot.iterfind("joint"):
        if joint.find("mimic") is None or joint.get("type") not in MOVABLE:
            continue
        limit = _limit_of(joint)
        missing = ["velocity"]
        if "lower" not in limit.attrib and "upper" not in limit.attrib:
            missing += ["lower", "upper"]
        for key in missing:
            if key not in limit.attrib:
                set_numbers(limit, key, [getattr(_NO_LIMIT, key)])
        limit.attrib.setdefault("effort", "0")
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")


def fix_free_joints(robot: ET.Element) -> list[str]:
    """Make floating and planar joints fixed ones, where their origins are.

    No single number moves them; an object or a whole robot hangs from them, not a finger.

    Args:
        robot: The `<robot>` element, changed in place.

    Returns:
        Names of these joints.
    """
    found = []
    for joint in robot.iterfind("joint"):
        if joint.get("type") in ("floating", "planar"):
            for tag in _NOT_OF_FIXED_JOINTS:
                for element in joint.findall(tag) if tag != "origin" else ():
                    joint.remove(element)
            joint.set("type", "fixed")
            found.append(joint.get("name", ""))
    return found


def _movable_joint(robot: ET.Element, name: str, section: str) -> ET.Element:
    joint = joints_by_name(robot).get(name)
    if joint is None or joint.get("type") not in MOVABLE:
        message = f"the URDF has no movable joint {name!r}"
        raise HandError(message, key=f"{section}.{name}", value=name)
    return joint


def _limit_of(joint: ET.Element) -> ET.Element:
    """Return the joint's limit element, which is added where it is missing."""
    limit = joint.find("limit")
    return ET.SubElement(joint, "limit") if limit is None else limit


def _lock(joint: ET.Element, position: float) -> None:
    """Make one joint a fixed one, its position in its origin."""
    joint_type = joint.get("type")
    if joint_type not in MOVABLE:
        message = f"a {joint_type} joint cannot be locked at one number"
        raise HandError(message, key=f"locked.{joint.get('name')}", value=position)
    axis = axis_of(joint)
    if joint_type == "prismatic":
        motion = affine(np.eye(3), position * axis)
    else:
        motion = affine(_rotation_about(axis, position), np.zeros(3))
    pose = origin_of(joint) @ motion
    for tag in _NOT_OF_FIXED_JOINTS:
        for element in joint.findall(tag):
            joint.remove(element)
    origin = ET.SubElement(joint, "origin")
    set_numbers(origin, "xyz", pose[:3, 3].tolist())
    set_numbers(origin, "rpy", rpy_from_rotation(pose[:3, :3]).tolist())
    joint.set("type", "fixed")


def _rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation about a unit axis by Rodrigues' formula, shape (3, 3)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
