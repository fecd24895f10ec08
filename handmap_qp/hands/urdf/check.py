"""Checks of a URDF before a hand is built from it: `check_tree`, `check_limits`.

URDF readers print faults to stderr and raise a general error. The checks here come first and name
each fault in one line.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable

from handmap_qp.errors import HandError
from handmap_qp.hands.urdf.elements import get_numbers
from handmap_qp.hands.urdf.tree import JOINT_TYPES, MOVABLE, edges, link_names

_VECTORS = (("origin", "xyz"), ("origin", "rpy"), ("axis", "xyz"))
_LIMITS = ("lower", "upper", "velocity")
# Pinocchio reads a chain by recursion, and crashes at about 4,000 links.
_DEEPEST = 2000


def check_tree(robot: ET.Element) -> None:
    """Reject a URDF whose links and joints are not a tree, or in which no joint moves.

    Args:
        robot: The `<robot>` element.

    Raises:
        HandError: On duplicate names, missing links, loops, several roots, attributes that are not
            numbers, unknown joint types, or a URDF without a movable joint.
    """
    links = link_names(robot)
    joints = list(robot.iterfind("joint"))
    _check_unique("links", links)
    _check_unique("joints", [joint.get("name", "") for joint in joints])
    parents = _parents(robot, links)
    for joint in joints:
        _check_joint(joint)
    _check_root(links, parents)
    _check_loops(links, parents)
    if not any(joint.get("type") in MOVABLE for joint in joints):
        raise HandError("the URDF has no joint that moves")


def check_limits(robot: ET.Element) -> None:
    """Reject joints without position limits; joints that mimic others need none.

    Args:
        robot: The `<robot>` element.

    Raises:
        HandError: With the key in `limits` that gives them.
    """
    for joint in robot.iterfind("joint"):
        name, joint_type = joint.get("name", ""), joint.get("type", "")
        if joint_type not in MOVABLE or joint.find("mimic") is not None:
            continue
        limit = joint.find("limit")
        has_limits = limit is not None and ("lower" in limit.attrib or "upper" in limit.attrib)
        if joint_type == "continuous" or not has_limits:
            what = "is continuous" if joint_type == "continuous" else "has no limits in the URDF"
            message = f"{name!r} {what}: give lower, upper and velocity"
            raise HandError(message, key=f"limits.{name}", value=name)


def _check_unique(what: str, names: list[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise HandError(f"the URDF has two {what} {name!r}", value=name)
        seen.add(name)


def _parents(robot: ET.Element, links: list[str]) -> dict[str, str]:
    """Return the parent link of every link that has one.

    Raises:
        HandError: If a joint names a link that does not exist, or a link has two parents.
    """
    parents: dict[str, str] = {}
    known = set(links)
    joint_above: dict[str, str] = {}
    for joint, parent, child in edges(robot):
        name = joint.get("name", "")
        for link in (parent, child):
            if link not in known:
                message = (
                    f"the joint {name!r} names the link {link!r}, which the URDF does not have"
                )
                raise HandError(message, value=link)
        if child in parents:
            both = f"{joint_above[child]!r} and {name!r}"
            message = (
                f"the URDF is not a tree: the link {child!r} is the child of two joints, {both}"
            )
            raise HandError(message, value=child)
        parents[child], joint_above[child] = parent, name
    return parents


def _check_joint(joint: ET.Element) -> None:
    """Reject an unknown joint type, and attributes that are not numbers."""
    name, joint_type = joint.get("name", ""), joint.get("type", "")
    if joint_type not in JOINT_TYPES:
        expected = ", ".join(JOINT_TYPES)
        message = f"the joint {name!r} is of type {joint_type!r}; expected one of {expected}"
        raise HandError(message, value=joint_type)
    for tag, key in _VECTORS:
        # An infinite limit means none; an infinite origin or axis means nothing.
        _check_numbers(joint, tag, key, 3, math.isfinite)
    for key in _LIMITS:
        _check_numbers(joint, "limit", key, 1, lambda value: not math.isnan(value))


def _check_numbers(
    joint: ET.Element, tag: str, key: str, count: int, is_valid: Callable[[float], bool]
) -> None:
    """Reject an attribute of a joint that does not hold valid numbers; it may be missing."""
    name, element = joint.get("name", ""), joint.find(tag)
    if element is None or key not in element.attrib:
        return
    try:
        values = get_numbers(element, key, count)
    except HandError as error:
        raise HandError(f"the joint {name!r}: {error}", value=error.value) from error
    if not all(map(is_valid, values)):
        text = element.get(key)
        message = f"the joint {name!r} has <{tag} {key}={text!r}>, which is not a finite number"
        raise HandError(message, value=text)


def _check_root(links: list[str], parents: dict[str, str]) -> None:
    """Reject a URDF without exactly one root link."""
    roots = [link for link in links if link not in parents]
    if len(roots) > 1:
        message = f"the URDF has {len(roots)} roots, expected one: {', '.join(roots[:6])}"
        raise HandError(message, value=roots)
    if not roots:
        what = "its links form a loop" if links else "it has no link"
        raise HandError(f"the URDF is not a tree: {what}")


def _check_loops(links: list[str], parents: dict[str, str]) -> None:
    """Reject a link among its own ancestors, and a chain that overflows the stack of URDF readers.

    Raises:
        HandError: If there is one.
    """
    depths: dict[str, int] = {}
    for link in links:
        passed: dict[str, None] = {}
        at = link
        while at in parents and at not in depths:
            if at in passed:
                message = f"the URDF is not a tree: a loop contains the link {at!r}"
                raise HandError(message, value=at)
            passed[at] = None
            at = parents[at]
        depth = depths.setdefault(at, 0)
        for below in reversed(passed):
            depth += 1
            depths[below] = depth
        if depth > _DEEPEST:
            message = f"the link {link!r} is at the end of a chain of {depth} links"
            raise HandError(f"{message}; expected at most {_DEEPEST}", value=link)
