"""What a URDF must be for a hand to be built from it, each fault told in one line.

`check_tree`, `check_limits`.

URDF readers print faults piecemeal to stderr and return a general one; the checks here come before
them.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator

from handmap_qp.errors import HandError
from handmap_qp.hands.urdf.elements import get_numbers

MOVABLE = ("revolute", "continuous", "prismatic")
"""Kinds of joints with one coordinate."""
KINDS = (*MOVABLE, "fixed", "planar", "floating")
"""All kinds that URDF knows."""


def edges(robot: ET.Element) -> Iterator[tuple[ET.Element, str, str]]:
    """Every joint of a URDF with the names of its parent link and its child link.

    Raises:
        HandError: If a joint lacks one of them.
    """
    for joint in robot.iterfind("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is None or child is None:
            raise HandError(
                f"the joint {joint.get('name')!r} needs a parent and a child link",
                value=joint.get("name"),
            )
        yield joint, parent.get("link", ""), child.get("link", "")


def link_names(robot: ET.Element) -> list[str]:
    """Names of all links, in the order of the file."""
    return [link.get("name", "") for link in robot.iterfind("link")]


def root_links(robot: ET.Element) -> list[str]:
    """Links that are no joint's child."""
    children = {child for _, _, child in edges(robot)}
    return [name for name in link_names(robot) if name not in children]


def check_tree(robot: ET.Element) -> None:
    """Refuse a URDF whose links and joints are no tree, or that has no joint that moves.

    Args:
        robot: The `<robot>` element.

    Raises:
        HandError: In one line: names given twice, links that are not there, loops, several roots,
            numbers that are none, no joint.
    """
    links = link_names(robot)
    joints = [joint.get("name", "") for joint in robot.iterfind("joint")]
    for kind, names in (("links", links), ("joints", joints)):
        seen = set()
        for name in names:
            if name in seen:
                raise HandError(f"the URDF has two {kind} {name!r}", value=name)
            seen.add(name)
    hangs_from: dict[str, tuple[str, str]] = {}
    for joint, parent, child in edges(robot):
        name = joint.get("name", "")
        for link in (parent, child):
            if link not in links:
                raise HandError(
                    f"the joint {name!r} names the link {link!r}, which the URDF does not have",
                    value=link,
                )
        if child in hangs_from:
            both = f"{hangs_from[child][0]!r} and {name!r}"
            raise HandError(
                f"the URDF is no tree: the link {child!r} hangs from two joints, {both}",
                value=child,
            )
        hangs_from[child] = (name, parent)
        _check_joint(joint)
    roots = [link for link in links if link not in hangs_from]
    if len(roots) > 1:
        raise HandError(
            f"the URDF has {len(roots)} roots, expected one: {', '.join(roots[:6])}", value=roots
        )
    if not roots:
        what = "its links hang from each other in a circle" if links else "it has no link"
        raise HandError(f"the URDF is no tree: {what}")
    _check_circles(links, hangs_from)
    if not any(joint.get("type") in MOVABLE for joint in robot.iterfind("joint")):
        raise HandError("the URDF has no joint that moves")


def check_limits(robot: ET.Element) -> None:
    """Refuse joints without position limits; followers of other joints need none.

    Args:
        robot: The `<robot>` element.

    Raises:
        HandError: With the joint as the key.
    """
    for joint in robot.iterfind("joint"):
        name, kind = joint.get("name", ""), joint.get("type", "")
        if kind not in MOVABLE or joint.find("mimic") is not None:
            continue
        limit = joint.find("limit")
        if (
            kind == "continuous"
            or limit is None
            or ("lower" not in limit.attrib and "upper" not in limit.attrib)
        ):
            what = "turns without end" if kind == "continuous" else "has no limits in the URDF"
            raise HandError(
                f"{name!r} {what}: give lower, upper and velocity", key=f"limits.{name}", value=name
            )


def _check_joint(joint: ET.Element) -> None:
    """Refuse an unknown kind of joint, and numbers that are none."""
    name, kind = joint.get("name", ""), joint.get("type", "")
    if kind not in KINDS:
        raise HandError(
            f"the joint {name!r} is of the kind {kind!r}; expected one of {', '.join(KINDS)}",
            value=kind,
        )
    vectors = [
        (joint.find(tag), key, 3)
        for tag, key in (("origin", "xyz"), ("origin", "rpy"), ("axis", "xyz"))
    ]
    numbers = [(joint.find("limit"), key, 1) for key in ("lower", "upper", "velocity")]
    for element, key, count in (*vectors, *numbers):
        if element is None or key not in element.attrib:
            continue
        try:
            values = get_numbers(element, key, count)
        except HandError as error:
            raise HandError(f"the joint {name!r}: {error}", value=error.value) from error
        # A limit at infinity means none; a joint somewhere at infinity means nothing.
        if any(math.isnan(value) or (count == 3 and math.isinf(value)) for value in values):
            raise HandError(
                f"the joint {name!r} has <{element.tag} {key}={element.get(key)!r}>, which is no number",
                value=name,
            )


def _check_circles(links: list[str], hangs_from: dict[str, tuple[str, str]]) -> None:
    """Refuse links that hang from each other, beside a tree with a root."""
    for link in links:
        passed = {link}
        at = link
        while at in hangs_from:
            at = hangs_from[at][1]
            if at in passed:
                raise HandError(
                    f"the URDF is no tree: the link {at!r} hangs from itself through others",
                    value=at,
                )
            passed.add(at)
