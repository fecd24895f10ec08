"""From the URDF in the file to the URDF of the model.

Cut out a part, hold joints still, set limits, mount on an arm.

All of it is done on the text, so that whoever reads `Hand.urdf_text` afterwards (Pinocchio, MuJoCo,
a picture) sees the same robot.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from handmap_qp.errors import HandError
from handmap_qp.hands.spec import ArmSpec, HandSpec, LimitSpec, MimicSpec, Vector
from handmap_qp.hands.urdf.check import (
    MOVABLE,
    check_limits,
    check_tree,
    edges,
    link_names,
    root_links,
)
from handmap_qp.hands.urdf.elements import (
    axis_of,
    get_numbers,
    origin_of,
    parse_urdf,
    set_numbers,
)
from handmap_qp.hands.urdf.mirror import mirrored_urdf
from handmap_qp.transform import affine, rpy_from_rotation

# A follower without limits of its own has none to pass on to its leader.
_NO_LIMIT = LimitSpec(lower=-1e6, upper=1e6, velocity=1e6)
_HAND_JOINT = "hand_mount"


class ComposedUrdf(NamedTuple):
    """What a hand's model is built from.

    Attributes:
        text: The URDF.
        locked: Position of every joint that was made a fixed one [rad or m]: those that the spec
            locks, and their followers.
    """

    text: str
    locked: dict[str, float]


def compose_urdf(spec: HandSpec, text: str, arm_text: str | None = None) -> ComposedUrdf:
    """The URDF that a hand's model is built from.

    Args:
        spec: The hand.
        text: Its URDF as in the file (or scaled).
        arm_text: The URDF of its arm; needed where the spec has one.

    Returns:
        The URDF: only the part outwards from `root`, `locked` joints fixed, `limits` and `mimic`
            written in, mounted on the arm,
        and all of it mirrored if asked for.

    Raises:
        HandError: If the URDF is no tree, the spec names links or joints that are not there, a
            joint is left without limits, or arm and hand have joints of the same name.
    """
    try:
        robot = parse_urdf(text)
        check_tree(robot)
        locked = prepare_urdf(robot, spec.root, spec.mimic, spec.locked, spec.limits)
        if spec.arm is not None and arm_text is not None:
            arm = parse_urdf(arm_text)
            check_tree(arm)
            _take_off(arm, spec.arm)
            locked = {
                **prepare_urdf(arm, spec.arm.root, {}, spec.arm.locked, spec.arm.limits),
                **locked,
            }
            robot = mount_on_arm(arm, robot, spec.arm)
        check_limits(robot)
        text = ET.tostring(robot, encoding="unicode")
        return ComposedUrdf(mirrored_urdf(text) if spec.mirror else text, locked)
    except HandError as error:
        raise spec.error(
            str(error).removeprefix(f"{error.key}: "), key=error.key or "urdf", value=error.value
        ) from error


def mounted(
    hand: HandSpec,
    arm: ArmSpec,
    *,
    xyz: Vector | None = None,
    rpy: Vector | None = None,
    name: str = "",
) -> HandSpec:
    """The description of a hand on an arm.

    Args:
        hand: The hand.
        arm: The arm.
        xyz: Origin of the hand's root link in the frame of the arm's tip [m]; the arm's own if
            omitted.
        rpy: Its roll, pitch and yaw there [rad]; the arm's own if omitted.
        name: Name of the two; `ARM_HAND` if omitted.

    Returns:
        The description: the arm's joints come first in every `q`.
    """
    arm = msgspec.structs.replace(arm, xyz=xyz or arm.xyz, rpy=rpy or arm.rpy)
    return msgspec.structs.replace(hand, name=name or f"{arm.name}_{hand.name}", arm=arm)


def cut_subtree(robot: ET.Element, root: str) -> None:
    """Leave away everything that is not at a link or outwards from it.

    Args:
        robot: The `<robot>` element, changed in place.
        root: Name of the link.

    Raises:
        HandError: If there is no such link.
    """
    if root not in link_names(robot):
        raise HandError(f"the URDF has no link {root!r}", key="root", value=root)
    outwards: dict[str, list[str]] = {}
    for _, parent, child in edges(robot):
        outwards.setdefault(parent, []).append(child)
    kept, todo = {root}, [root]
    while todo:
        found = [child for child in outwards.get(todo.pop(), []) if child not in kept]
        kept.update(found)
        todo.extend(found)
    for link in robot.findall("link"):
        if link.get("name") not in kept:
            robot.remove(link)
    for joint, parent, _ in list(edges(robot)):
        if parent not in kept:
            robot.remove(joint)
    for other in (
        element for element in list(robot) if element.tag not in ("link", "joint", "material")
    ):
        robot.remove(other)


def _take_off(arm: ET.Element, spec: ArmSpec) -> None:
    """Remove what an arm carries and shall not.

    The links of `without` and all that hangs from them.
    """
    links = link_names(arm)
    for name in spec.without:
        if name not in links:
            raise HandError(f"the arm has no link {name!r}", key="arm.without", value=name)
    outwards = list(edges(arm))
    gone, todo = set(spec.without), list(spec.without)
    while todo:
        parent = todo.pop()
        found = [child for _, other, child in outwards if other == parent]
        gone.update(found)
        todo.extend(found)
    for link in arm.findall("link"):
        if link.get("name") in gone:
            arm.remove(link)
    for joint, parent, child in outwards:
        if parent in gone or child in gone:
            arm.remove(joint)


def lock_joints(robot: ET.Element, positions: Mapping[str, float]) -> dict[str, float]:
    """Make joints fixed ones, at given positions.

    Followers of a locked leader are locked where they then stand.

    Args:
        robot: The `<robot>` element, changed in place.
        positions: Position by joint name [rad or m].

    Returns:
        Positions of all that were made fixed.

    Raises:
        HandError: If there is no such joint, or it is of a kind with more than one coordinate.
    """
    joints = {joint.get("name", ""): joint for joint in robot.iterfind("joint")}
    todo, locked = dict(positions), {}
    while todo:
        name, position = todo.popitem()
        if name not in joints:
            raise HandError(f"the URDF has no joint {name!r}", key="locked", value=name)
        joint = joints[name]
        if joint.get("type") == "fixed":
            continue
        _fix(joint, position)
        locked[name] = position
        for follower, other in joints.items():
            mimic = other.find("mimic")
            if mimic is not None and mimic.get("joint") == name and follower not in positions:
                (multiplier,), (offset,) = (
                    get_numbers(mimic, "multiplier", 1, "1"),
                    get_numbers(mimic, "offset", 1, "0"),
                )
                todo[follower] = multiplier * position + offset
    return {name: locked[name] for name in joints if name in locked}


def set_limits(robot: ET.Element, limits: Mapping[str, LimitSpec]) -> None:
    """Write limits into a URDF; a continuous joint becomes a revolute one by it.

    Args:
        robot: The `<robot>` element, changed in place.
        limits: Limits by joint name; what a limit leaves out stays as it is.

    Raises:
        HandError: If there is no such movable joint.
    """
    joints = {joint.get("name", ""): joint for joint in robot.iterfind("joint")}
    for name, limit in limits.items():
        if name not in joints or joints[name].get("type") not in MOVABLE:
            raise HandError(
                f"the URDF has no movable joint {name!r}", key=f"limits.{name}", value=name
            )
        element = joints[name].find("limit")
        if element is None:
            element = ET.SubElement(joints[name], "limit")
        for key in ("lower", "upper", "velocity"):
            if (value := getattr(limit, key)) is not None:
                set_numbers(element, key, [value])
        for key in ("effort", "velocity"):
            element.attrib.setdefault(key, "0")
        if (
            limit.lower is not None
            and limit.upper is not None
            and joints[name].get("type") == "continuous"
        ):
            joints[name].set("type", "revolute")


def mount_on_arm(arm: ET.Element, hand: ET.Element, spec: ArmSpec) -> ET.Element:
    """One robot out of an arm and a hand.

    Args:
        arm: The arm's `<robot>` element; becomes the whole. Its links and materials are renamed
            where the hand has the same names.
        hand: The hand's.
        spec: The arm: which of its links carries the hand, and how the hand's root link lies in it.

    Returns:
        The `<robot>` element of both.

    Raises:
        HandError: If the arm has no such link, or both have a movable joint of the same name.
    """
    if spec.tip not in link_names(arm):
        raise HandError(f"the arm has no link {spec.tip!r}", key="arm.tip", value=spec.tip)
    taken = {
        kind: {element.get("name", "") for element in hand.iter(kind)}
        for kind in ("link", "joint", "material")
    }
    for joint in arm.iterfind("joint"):
        name = joint.get("name", "")
        if name in taken["joint"] and joint.get("type") != "fixed":
            raise HandError(
                f"arm and hand both have a joint {name!r}", key="arm.joints", value=name
            )
    for kind, references in (("link", ("parent", "child")), ("joint", ()), ("material", ())):
        for element in arm.iter(kind):
            if element.get("name") in taken[kind] and not (
                kind == "joint" and element.get("type") != "fixed"
            ):
                element.set("name", f"{spec.name}_{element.get('name')}")
        for element in (found for tag in references for found in arm.iter(tag)):
            if element.get("link") in taken["link"]:
                element.set("link", f"{spec.name}_{element.get('link')}")
    tip = f"{spec.name}_{spec.tip}" if spec.tip in taken["link"] else spec.tip
    (root,) = root_links(hand)
    _make_meshes_absolute(arm, spec)
    mount = ET.SubElement(arm, "joint", {"name": _HAND_JOINT, "type": "fixed"})
    ET.SubElement(mount, "parent", {"link": tip})
    ET.SubElement(mount, "child", {"link": root})
    origin = ET.SubElement(mount, "origin")
    set_numbers(origin, "xyz", list(spec.xyz))
    set_numbers(origin, "rpy", list(spec.rpy))
    arm.extend(list(hand))
    return arm


def movable_joints(robot: ET.Element) -> list[str]:
    """Names of the joints that move, in the order of the file."""
    return [
        joint.get("name", "") for joint in robot.iterfind("joint") if joint.get("type") != "fixed"
    ]


def prepare_urdf(
    robot: ET.Element,
    root: str | None,
    mimic: Mapping[str, MimicSpec | None],
    locked: Mapping[str, float],
    limits: Mapping[str, LimitSpec],
) -> dict[str, float]:
    """Make one URDF what its spec wants of it; gives what is locked."""
    if root is not None:
        cut_subtree(robot, root)
    _set_mimic(robot, mimic)
    positions = lock_joints(robot, locked)
    set_limits(robot, limits)
    for joint in robot.iterfind("joint"):
        if joint.find("mimic") is not None and joint.get("type") in MOVABLE:
            _free(joint)
    return positions


def _set_mimic(robot: ET.Element, rules: Mapping[str, MimicSpec | None]) -> None:
    joints = {joint.get("name", ""): joint for joint in robot.iterfind("joint")}
    for name, rule in rules.items():
        if name not in joints or joints[name].get("type") not in MOVABLE:
            raise HandError(
                f"the URDF has no movable joint {name!r}", key=f"mimic.{name}", value=name
            )
        for old in joints[name].findall("mimic"):
            joints[name].remove(old)
        if rule is not None:
            values = {
                "joint": rule.joint,
                "multiplier": repr(rule.multiplier),
                "offset": repr(rule.offset),
            }
            ET.SubElement(joints[name], "mimic", values)


def _free(follower: ET.Element) -> None:
    """Give a follower what URDF readers want of a joint, without bounding it where its file does not."""
    limit = follower.find("limit")
    if limit is None:
        limit = ET.SubElement(follower, "limit")
    is_bounded = "lower" in limit.attrib or "upper" in limit.attrib
    for key in ("lower", "upper", "velocity"):
        if key not in limit.attrib and (key == "velocity" or not is_bounded):
            set_numbers(limit, key, [getattr(_NO_LIMIT, key)])
    limit.attrib.setdefault("effort", "0")
    follower.set("type", "prismatic" if follower.get("type") == "prismatic" else "revolute")


def _fix(joint: ET.Element, position: float) -> None:
    kind = joint.get("type")
    if kind not in MOVABLE:
        raise HandError(
            f"a {kind} joint cannot be held at one number",
            key=f"locked.{joint.get('name')}",
            value=position,
        )
    axis, origin = axis_of(joint), origin_of(joint)
    if kind == "prismatic":
        motion = affine(np.eye(3), position * axis)
    else:
        x, y, z = axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        # Rodrigues' formula.
        motion = affine(
            np.eye(3) + math.sin(position) * cross + (1.0 - math.cos(position)) * cross @ cross,
            np.zeros(3),
        )
    pose = origin @ motion
    for tag in ("axis", "limit", "mimic", "origin", "calibration", "safety_controller", "dynamics"):
        for element in joint.findall(tag):
            joint.remove(element)
    element = ET.SubElement(joint, "origin")
    set_numbers(element, "xyz", pose[:3, 3].tolist())
    set_numbers(element, "rpy", rpy_from_rotation(pose[:3, :3]).tolist())
    joint.set("type", "fixed")


def _make_meshes_absolute(arm: ET.Element, spec: ArmSpec) -> None:
    """The whole robot's URDF lies where the hand's does, so the arm's meshes are named from the root of the disk."""
    if spec.urdf.startswith("package://"):
        return
    folder = ((spec.directory or Path()) / spec.urdf).resolve().parent
    for mesh in arm.iter("mesh"):
        name = mesh.get("filename", "")
        if name and "://" not in name:
            mesh.set("filename", str(folder / name))
