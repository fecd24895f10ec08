"""Mount a hand on an arm: one URDF out of two."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from handmap_qp.errors import HandError
from handmap_qp.hands.spec import ArmSpec
from handmap_qp.hands.urdf.elements import set_numbers
from handmap_qp.hands.urdf.files import set_mesh_paths, urdf_path
from handmap_qp.hands.urdf.tree import link_names, remove_subtrees, root_links

_MOUNT_JOINT = "hand_mount"


def remove_tools(arm: ET.Element, spec: ArmSpec) -> None:
    """Remove the links named in `without`, with all their descendants.

    Args:
        arm: The arm's `<robot>` element, changed in place.
        spec: The arm.

    Raises:
        HandError: If there is no such link.
    """
    links = link_names(arm)
    for name in spec.without:
        if name not in links:
            raise HandError(f"the arm has no link {name!r}", key="arm.without", value=name)
    remove_subtrees(arm, spec.without)


def mount_on_arm(arm: ET.Element, hand: ET.Element, spec: ArmSpec) -> ET.Element:
    """Join an arm and a hand to one robot.

    Args:
        arm: The arm's `<robot>` element, which becomes the whole robot. Its links, fixed joints and
            materials are renamed where the hand has the same names.
        hand: The hand's `<robot>` element.
        spec: The arm: which of its links carries the hand, and the pose of the hand's root link
            there.

    Returns:
        The `<robot>` element of both.

    Raises:
        HandError: If the arm has no such link, or both have a movable joint of the same name.
    """
    if spec.tip not in link_names(arm):
        raise HandError(f"the arm has no link {spec.tip!r}", key="arm.tip", value=spec.tip)
    tip = f"{spec.name}_{spec.tip}" if spec.tip in link_names(hand) else spec.tip
    (root,) = root_links(hand)
    _rename_duplicates(arm, hand, spec.name)
    # The composed URDF counts as the hand's file, so relative names would be looked for there.
    set_mesh_paths(arm, urdf_path(spec).parent)
    mount = ET.SubElement(arm, "joint", {"name": _MOUNT_JOINT, "type": "fixed"})
    ET.SubElement(mount, "parent", {"link": tip})
    ET.SubElement(mount, "child", {"link": root})
    origin = ET.SubElement(mount, "origin")
    set_numbers(origin, "xyz", list(spec.xyz))
    set_numbers(origin, "rpy", list(spec.rpy))
    arm.extend(list(hand))
    return arm


def _rename_duplicates(arm: ET.Element, hand: ET.Element, prefix: str) -> None:
    """Put a prefix before the arm's names that the hand has too.

    Raises:
        HandError: If one of them is the name of a movable joint, which a user sets by name.
    """
    taken = {
        tag: {element.get("name", "") for element in hand.iter(tag)}
        for tag in ("link", "joint", "material")
    }
    for joint in arm.iterfind("joint"):
        name = joint.get("name", "")
        if name in taken["joint"] and joint.get("type") != "fixed":
            message = f"arm and hand both have a joint {name!r}"
            raise HandError(message, key="arm.joints", value=name)
    for tag, names in taken.items():
        for element in arm.iter(tag):
            _prefix(element, "name", names, prefix)
    for tag in ("parent", "child"):
        for element in arm.iter(tag):
            _prefix(element, "link", taken["link"], prefix)


def _prefix(element: ET.Element, key: str, names: set[str], prefix: str) -> None:
    if element.get(key) in names:
        element.set(key, f"{prefix}_{element.get(key)}")
