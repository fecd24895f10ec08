"""The tree of links and joints of a URDF: reading it, and cutting parts off it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator

from handmap_qp.errors import HandError

MOVABLE = ("revolute", "continuous", "prismatic")
"""Types of joints with one coordinate."""
JOINT_TYPES = (*MOVABLE, "fixed", "planar", "floating")
"""All joint types of the URDF specification."""


def edges(robot: ET.Element) -> Iterator[tuple[ET.Element, str, str]]:
    """Iterate over the joints of a URDF, with the names of their parent and child links.

    Raises:
        HandError: If a joint lacks one of them.
    """
    for joint in robot.iterfind("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is None or child is None:
            name = joint.get("name")
            raise HandError(f"the joint {name!r} needs a parent and a child link", value=name)
        yield joint, parent.get("link", ""), child.get("link", "")


def link_names(robot: ET.Element) -> list[str]:
    """Return the names of all links, in the order of the file."""
    return [link.get("name", "") for link in robot.iterfind("link")]


def joints_by_name(robot: ET.Element) -> dict[str, ET.Element]:
    """Return the joints by their names, in the order of the file."""
    return {joint.get("name", ""): joint for joint in robot.iterfind("joint")}


def root_links(robot: ET.Element) -> list[str]:
    """Return the links that are not the child of a joint."""
    children = {child for _, _, child in edges(robot)}
    return [name for name in link_names(robot) if name not in children]


def links_from(robot: ET.Element, starts: Collection[str]) -> set[str]:
    """Return the given links and all their descendants."""
    children: dict[str, list[str]] = {}
    for _, parent, child in edges(robot):
        children.setdefault(parent, []).append(child)
    found, pending = set(starts), list(starts)
    while pending:
        new = [child for child in children.get(pending.pop(), []) if child not in found]
        found.update(new)
        pending.extend(new)
    return found


def cut_subtree(robot: ET.Element, root: str) -> None:
    """Keep one link and its descendants, and remove everything else.

    Args:
        robot: The `<robot>` element, changed in place. Materials are kept; other elements, such as
            `<transmission>`, are removed.
        root: Name of the link.

    Raises:
        HandError: If there is no such link.
    """
    if root not in link_names(robot):
        raise HandError(f"the URDF has no link {root!r}", key="root", value=root)
    kept = links_from(robot, [root])
    _remove_links(robot, set(link_names(robot)) - kept)
    for element in list(robot):
        if element.tag not in ("link", "joint", "material"):
            robot.remove(element)


def remove_subtrees(robot: ET.Element, roots: Collection[str]) -> None:
    """Remove links, their descendants and the joints between them.

    Args:
        robot: The `<robot>` element, changed in place.
        roots: Names of the links; those that the URDF does not have are ignored.
    """
    _remove_links(robot, links_from(robot, roots))


def _remove_links(robot: ET.Element, names: Collection[str]) -> None:
    """Remove links and all joints that touch them."""
    for joint, parent, child in list(edges(robot)):
        if parent in names or child in names:
            robot.remove(joint)
    for link in robot.findall("link"):
        if link.get("name") in names:
            robot.remove(link)
