"""The URDF of a hand as a document: read, check, cut, edit, mount and mirror it.

All changes are made to the document, so that every reader of `Hand.urdf_text` (Pinocchio, MuJoCo, a
picture) sees the same robot.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from xml.parsers import expat

import msgspec
import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError
from handmap_qp.hands.sources import find_mesh, urdf_path
from handmap_qp.hands.spec import ArmSpec, HandSpec, LimitSpec, MimicSpec
from handmap_qp.se3 import affine, rotation_from_rpy, rpy_from_rotation

MOVABLE = ("revolute", "continuous", "prismatic")
"""Types of joints with one coordinate."""
_FREE = ("planar", "floating")
# Pinocchio reads a chain by recursion, and crashes at about 4,000 links.
_DEEPEST = 2000
NO_LIMIT = 1e6
"""Written where a joint has no position limit, which URDF readers require [rad or m]."""
# Attributes of a joint's elements that hold numbers, and how many.
_NUMBERS = {
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "limit": {"lower": 1, "upper": 1, "velocity": 1},
}
_NOT_OF_FIXED_JOINTS = (
    "axis",
    "limit",
    "mimic",
    "calibration",
    "safety_controller",
    "dynamics",
)


def parse_urdf(text: str | bytes) -> ET.Element:
    """Parse a URDF, and return the `<robot>` element.

    Robot software writes `<sensor:camera>` or `<controller:gazebo>` without declaring the prefix,
    so namespaces are not resolved; the element becomes `<sensor_camera>`.

    Args:
        text: A string, or bytes in any encoding that a byte-order mark or a declaration tells.

    Raises:
        HandError: If the text is not XML, is xacro, or its root is another element.
    """
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(text, True)
    # LookupError: an unknown encoding; ValueError: a character that XML cannot have.
    except (expat.ExpatError, LookupError, ValueError) as error:
        raise HandError(f"the URDF is not valid XML: {error}") from error
    robot = builder.close()
    for element in robot.iter():
        if element.tag.startswith("xacro:"):
            message = "the file is xacro, not URDF: convert it with `xacro FILE.xacro > FILE.urdf`"
            raise HandError(message)
        element.tag = element.tag.replace(":", "_")
        for key in [key for key in element.keys() if ":" in key]:  # noqa: SIM118
            del element.attrib[key]
    if robot.tag != "robot":
        message = f"expected a URDF with the root <robot>, got <{robot.tag}>"
        raise HandError(message, value=robot.tag)
    return robot


# -- numbers of elements


def get_numbers(
    element: ET.Element, key: str, count: int, default: str | None = None
) -> list[float]:
    """Read `count` numbers in an attribute; NaN and infinity are passed on.

    Raises:
        HandError: If it is missing without a default, or does not hold `count` numbers.
    """
    text = element.get(key, default)
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        message = f"expected {count} number(s), got {text!r}"
        raise HandError(message, key=f"<{element.tag} {key}>", value=text)
    return numbers


def set_numbers(
    element: ET.Element, key: str, numbers: Sequence[float] | np.ndarray
) -> None:
    """Write numbers into an attribute with all their digits, and minus zero as zero."""
    element.set(key, " ".join(repr(float(number) + 0.0) for number in numbers))


def child_of(element: ET.Element, tag: str) -> ET.Element:
    """Return the first child with a tag, which is added where it is missing."""
    found = element.find(tag)
    return ET.SubElement(element, tag) if found is None else found


def origin_of(element: ET.Element) -> np.ndarray:
    """Read the pose in an element's `<origin>`, shape (4, 4); the identity where there is none.

    Raises:
        HandError: If it does not hold finite numbers.
    """
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    xyz, rpy = (
        np.array(get_numbers(origin, key, 3, "0 0 0")) for key in ("xyz", "rpy")
    )
    if not np.isfinite([xyz, rpy]).all():
        message = (
            f"expected finite numbers, got xyz {xyz.tolist()} and rpy {rpy.tolist()}"
        )
        raise HandError(message, key=f"<{element.tag} origin>")
    return affine(rotation_from_rpy(rpy), xyz)


def set_origin(element: ET.Element, pose: np.ndarray) -> None:
    """Write a pose [m], shape (4, 4), into an element's `<origin>`."""
    origin = child_of(element, "origin")
    set_numbers(origin, "xyz", pose[:3, 3])
    set_numbers(origin, "rpy", rpy_from_rotation(pose[:3, :3]))


def axis_of(joint: ET.Element) -> np.ndarray:
    """Read a joint's axis, a unit vector of shape (3,); x where none is given, as URDF says.

    Raises:
        HandError: If it is zero or not finite.
    """
    element = joint.find("axis")
    axis = np.array(
        [1.0, 0.0, 0.0] if element is None else get_numbers(element, "xyz", 3, "1 0 0")
    )
    length = np.linalg.norm(axis)
    if not (np.isfinite(axis).all() and length > 1e-9):
        message = f"expected an axis longer than zero, got {axis.tolist()}"
        raise HandError(message, key=joint.get("name"), value=axis.tolist())
    return axis / length


# -- the tree of links and joints


def edges(robot: ET.Element) -> Iterator[tuple[ET.Element, str, str]]:
    """Iterate over the joints, with the names of their parent and child links.

    Raises:
        HandError: If a joint lacks one of them.
    """
    for joint in robot.iterfind("joint"):
        above, below = joint.find("parent"), joint.find("child")
        if above is None or below is None:
            name = joint.get("name")
            raise HandError(
                f"the joint {name!r} needs a parent and a child link", value=name
            )
        yield joint, above.get("link", ""), below.get("link", "")


def link_names(robot: ET.Element) -> list[str]:
    """Return the names of all links, in the order of the file."""
    return [link.get("name", "") for link in robot.iterfind("link")]


def joints_by_name(robot: ET.Element) -> dict[str, ET.Element]:
    """Return the joints by their names, in the order of the file."""
    return {joint.get("name", ""): joint for joint in robot.iterfind("joint")}


def root_links(robot: ET.Element) -> list[str]:
    """Return the links that are not the child of a joint."""
    below = {child for _, _, child in edges(robot)}
    return [name for name in link_names(robot) if name not in below]


def _levels(robot: ET.Element, starts: Collection[str]) -> Iterator[list[str]]:
    """Iterate over the given links, their children, the children of these, and so on."""
    children: dict[str, list[str]] = {}
    for _, parent, child in edges(robot):
        children.setdefault(parent, []).append(child)
    level = list(starts)
    while level:
        yield level
        level = [child for link in level for child in children.get(link, ())]


def cut_subtree(robot: ET.Element, root: str) -> None:
    """Keep one link and its descendants, and materials; remove everything else.

    Raises:
        HandError: If there is no such link.
    """
    _check_link(robot, root, "root")
    _remove_links(robot, set(link_names(robot)).difference(*_levels(robot, [root])))
    for element in list(robot):
        if element.tag not in ("link", "joint", "material"):
            robot.remove(element)


def remove_subtrees(robot: ET.Element, roots: Collection[str]) -> None:
    """Remove links of an arm, their descendants and the joints between them.

    Raises:
        HandError: If there is no such link.
    """
    for root in roots:
        _check_link(robot, root, "arm.without")
    _remove_links(robot, set().union(*_levels(robot, roots)))


def _check_link(robot: ET.Element, link: str, key: str) -> None:
    if link not in link_names(robot):
        raise HandError(f"the URDF has no link {link!r}", key=key, value=link)


def _remove_links(robot: ET.Element, names: set[str]) -> None:
    """Remove links and all joints that touch them."""
    for joint, parent, child in list(edges(robot)):
        if parent in names or child in names:
            robot.remove(joint)
    for link in robot.findall("link"):
        if link.get("name") in names:
            robot.remove(link)


# -- checks: URDF readers print faults to stderr and raise a general error


def check_tree(robot: ET.Element) -> None:
    """Reject a URDF whose links and joints are not a tree, or in which no joint moves.

    Raises:
        HandError: On duplicate names, missing links, loops, several roots, a chain that overflows
            the stack of URDF readers, attributes that are not numbers, unknown joint types, or a
            URDF without a movable joint.
    """
    links, joints = link_names(robot), list(robot.iterfind("joint"))
    known = set(links)
    names = [joint.get("name", "") for joint in joints]
    ends = [(parent, child) for _, parent, child in edges(robot)]
    below = [child for _, child in ends]
    for message, culprits in (
        ("has two links {!r}", _repeated(links)),
        ("has two joints {!r}", _repeated(names)),
        (
            "has a joint with the link {!r}, which it does not have",
            [link for pair in ends for link in pair if link not in known],
        ),
        ("is not a tree: the link {!r} is the child of two joints", _repeated(below)),
    ):
        if culprits:
            raise HandError(f"the URDF {message.format(culprits[0])}", value=culprits)
    roots = root_links(robot)
    if len(roots) != 1:
        message = f"{len(roots)} roots, expected one: {', '.join(roots[:6])}"
        raise HandError(f"the URDF has {message}", value=roots)
    levels = list(_levels(robot, roots))
    if len(levels) > _DEEPEST:
        message = f"a chain of {len(levels)} links ends at {levels[-1][0]!r}"
        raise HandError(f"{message}; expected at most {_DEEPEST}", value=levels[-1])
    if apart := sorted(known.difference(*levels)):
        message = (
            f"the URDF is not a tree: loops contain or carry {', '.join(apart[:6])}"
        )
        raise HandError(message, value=apart)
    for joint in joints:
        _check_joint(joint)
    if not any(joint.get("type") in MOVABLE for joint in joints):
        raise HandError("the URDF has no joint that moves")


def _repeated(names: Sequence[str]) -> list[str]:
    return [name for name, count in Counter(names).items() if count > 1]


def _check_joint(joint: ET.Element) -> None:
    """Reject an unknown joint type, and attributes that are not numbers."""
    name, kind = joint.get("name", ""), joint.get("type", "")
    if kind not in (*MOVABLE, "fixed", *_FREE):
        expected = ", ".join((*MOVABLE, "fixed", *_FREE))
        message = f"the joint {name!r} is of type {kind!r}; expected one of {expected}"
        raise HandError(message, value=kind)
    for element in joint:
        for key in _NUMBERS.get(element.tag, {}).keys() & element.keys():
            try:
                values = get_numbers(element, key, _NUMBERS[element.tag][key])
            except HandError as error:
                message = f"the joint {name!r}: {error}"
                raise HandError(message, value=error.value) from error
            # An infinite limit means none; an infinite origin or axis means nothing.
            is_limit = element.tag == "limit"
            if np.isnan(values).any() or not (is_limit or np.isfinite(values).all()):
                fault = f"<{element.tag} {key}={element.get(key)!r}>"
                message = (
                    f"the joint {name!r} has {fault}, which is not a finite number"
                )
                raise HandError(message, value=values)


# -- edits of joints


def prepare_urdf(
    robot: ET.Element,
    root: str | None,
    mimic: Mapping[str, MimicSpec | None],
    locked: Mapping[str, float],
    limits: Mapping[str, LimitSpec],
) -> dict[str, float]:
    """Keep the part from `root` outwards, and write mimic rules, locked joints and limits into it.

    Args:
        robot: The `<robot>` element, changed in place.
        root: Link at which the part begins; all of it if None.
        mimic: Mimic rules by follower, as of `HandSpec`.
        locked: Positions of joints to lock [rad or m].
        limits: Limits by joint name.

    Returns:
        Positions of all joints that were locked [rad or m].

    Raises:
        HandError: If a link or joint does not exist.
    """
    if root is not None:
        cut_subtree(robot, root)
    for name, rule in mimic.items():
        joint = _movable_joint(robot, name, "mimic")
        for old in joint.findall("mimic"):
            joint.remove(old)
        if rule is not None:
            numbers = {"multiplier": repr(rule.multiplier), "offset": repr(rule.offset)}
            ET.SubElement(joint, "mimic", {"joint": rule.joint, **numbers})
    positions = lock_joints(robot, locked)
    fix_free_joints(robot)
    _write_limits(robot, limits)
    return positions


def _write_limits(robot: ET.Element, limits: Mapping[str, LimitSpec]) -> None:
    """Write limits, and give every movable joint all that URDF readers require.

    A continuous joint becomes a revolute one. Without position limits, a joint gets `NO_LIMIT`.
    """
    movable = [j for j in robot.iterfind("joint") if j.get("type") in MOVABLE]
    for joint in movable:
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")
            for key in ("lower", "upper"):
                child_of(joint, "limit").attrib.pop(key, None)
    for name, limit in limits.items():
        element = child_of(_movable_joint(robot, name, "limits"), "limit")
        for key, value in msgspec.structs.asdict(limit).items():
            if value is not None:
                set_numbers(element, key, [value])
    for joint in movable:
        limit = child_of(joint, "limit").attrib
        if not {"lower", "upper"} & limit.keys():
            limit |= {"lower": repr(-NO_LIMIT), "upper": repr(NO_LIMIT)}
        for key in ("velocity", "effort"):
            limit.setdefault(key, "0")


def lock_joints(robot: ET.Element, positions: Mapping[str, float]) -> dict[str, float]:
    """Make joints fixed ones at given positions, and those that mimic them where they then stand.

    Returns:
        Positions of all joints that were made fixed, in the order of the file [rad or m].

    Raises:
        HandError: If there is no such joint, or it has more than one coordinate.
    """
    joints = joints_by_name(robot)
    pending, locked = list(positions.items()), {}
    for name, position in pending:
        if name not in joints:
            raise HandError(f"the URDF has no joint {name!r}", key="locked", value=name)
        if joints[name].get("type") == "fixed":
            continue
        _lock(joints[name], position)
        locked[name] = position
        for follower, joint in joints.items():
            mimic = joint.find("mimic")
            follows = mimic is not None and mimic.get("joint") == name
            if mimic is not None and follows and follower not in positions:
                (multiplier,) = get_numbers(mimic, "multiplier", 1, "1")
                (offset,) = get_numbers(mimic, "offset", 1, "0")
                pending.append((follower, multiplier * position + offset))
    return {name: locked[name] for name in joints if name in locked}


def _lock(joint: ET.Element, position: float) -> None:
    """Make one joint a fixed one, its position in its origin."""
    kind, motion = joint.get("type"), pin.SE3.Identity()
    if kind not in MOVABLE:
        message = f"a {kind} joint cannot be locked at one number"
        raise HandError(message, key=f"locked.{joint.get('name')}", value=position)
    if kind == "prismatic":
        motion.translation = position * axis_of(joint)
    else:
        motion.rotation = pin.exp3(position * axis_of(joint))
    set_origin(joint, origin_of(joint) @ motion.homogeneous)
    _fix(joint)


def fix_free_joints(robot: ET.Element) -> list[str]:
    """Make floating and planar joints fixed ones, where their origins are; return their names.

    No single number moves them; an object or a whole robot hangs from them, not a finger.
    """
    free = {
        name: j for name, j in joints_by_name(robot).items() if j.get("type") in _FREE
    }
    for joint in free.values():
        _fix(joint)
    return list(free)


def _fix(joint: ET.Element) -> None:
    for element in list(joint):
        if element.tag in _NOT_OF_FIXED_JOINTS:
            joint.remove(element)
    joint.set("type", "fixed")


def _movable_joint(robot: ET.Element, name: str, section: str) -> ET.Element:
    joint = joints_by_name(robot).get(name)
    if joint is None or joint.get("type") not in MOVABLE:
        message = f"the URDF has no movable joint {name!r}"
        raise HandError(message, key=f"{section}.{name}", value=name)
    return joint


# -- meshes


def set_mesh_paths(robot: ET.Element, folder: Path) -> None:
    """Replace the file names of all meshes by absolute paths, as `find_mesh` finds them."""
    for mesh in robot.iter("mesh"):
        if name := mesh.get("filename"):
            mesh.set("filename", str(find_mesh(name, folder).resolve()))


def parse_with_meshes(spec: HandSpec, urdf_text: str) -> ET.Element:
    """Parse a hand's URDF, with absolute paths of its meshes for readers that know no folder.

    Raises:
        HandError: If the text is not a URDF.
        MissingExtraError: If the URDF lies in a package that is not installed.
    """
    robot = parse_urdf(urdf_text)
    set_mesh_paths(robot, urdf_path(spec).parent)
    return robot


# -- a hand on an arm, a mirrored hand


def mount_on_arm(arm: ET.Element, hand: ET.Element, spec: ArmSpec) -> None:
    """Join an arm, which becomes the whole robot, and a hand.

    The arm's links, joints and materials are renamed where the hand has the same names.

    Raises:
        HandError: If the arm has no such link.
    """
    _check_link(arm, spec.tip, "arm.tip")
    (root,), tip = root_links(hand), spec.tip
    if tip in link_names(hand):
        tip = f"{spec.name}_{tip}"
    tags = ("link", "joint", "material")
    taken = {tag: {each.get("name") for each in hand.iter(tag)} for tag in tags}
    taken |= dict.fromkeys(("parent", "child"), taken["link"])
    for element in arm.iter():
        key = "link" if element.tag in ("parent", "child") else "name"
        if (name := element.get(key)) in taken.get(element.tag, ()):
            element.set(key, f"{spec.name}_{name}")
    # The composed URDF counts as the hand's file, so relative names would be looked for there.
    set_mesh_paths(arm, urdf_path(spec).parent)
    mount = ET.SubElement(arm, "joint", name="hand_mount", type="fixed")
    ET.SubElement(mount, "parent", link=tip)
    ET.SubElement(mount, "child", link=root)
    set_origin(mount, affine(rotation_from_rpy(spec.rpy), spec.xyz))
    arm.extend(list(hand))


# With M = diag(-1, 1, 1), a pose T becomes M T M: translations change the sign of x, and
# M Rz(y) Ry(p) Rx(r) M = Rz(-y) Ry(-p) Rx(r).
_MIRRORED = {
    "origin": {"xyz": (-1.0, 1.0, 1.0), "rpy": (1.0, -1.0, -1.0)},
    "inertia": {"ixy": (-1.0,), "ixz": (-1.0,)},
}
_AXIS = (-1.0, 1.0, 1.0)


def mirrored_urdf(text: str) -> str:
    """Mirror a URDF as text: `mirror`."""
    robot = parse_urdf(text)
    mirror(robot)
    return ET.tostring(robot, encoding="unicode")


def mirror(robot: ET.Element) -> None:
    """Mirror a URDF in the plane x = 0 of its root link: a right hand becomes a left one.

    The coordinates of every link are mirrored as well: a point `(x, y, z)` of a link becomes `(-x,
    y, z)`. Names, limits and the meaning of q stay, and the same q gives the mirrored posture:
    with `M = diag(-1, 1, 1)`, the axis `a` of a prismatic joint becomes `M a`, and that of a
    turning joint, a pseudovector, `-M a`.

    Raises:
        HandError: If it holds a mesh (its file cannot be mirrored here) or a joint that is neither
            fixed nor has one coordinate.
    """
    for shape in robot.iterfind(".//geometry/*"):
        if shape.tag not in ("box", "cylinder", "sphere", "capsule"):
            message = "a hand can be mirrored only if its shapes are primitives"
            raise HandError(f"{message}, not <{shape.tag}>", value=shape.tag)
    for element in robot.iter():
        for key, signs in _MIRRORED.get(element.tag, {}).items():
            if key in element.attrib:
                numbers = get_numbers(element, key, len(signs))
                set_numbers(element, key, np.multiply(signs, numbers))
    for joint in robot.iterfind("joint"):
        kind = joint.get("type", "")
        if kind in MOVABLE:
            axis = child_of(joint, "axis")
            signs = _AXIS if kind == "prismatic" else np.negative(_AXIS)
            numbers = get_numbers(axis, "xyz", 3, "1 0 0")
            set_numbers(axis, "xyz", np.multiply(signs, numbers))
        elif kind != "fixed":
            message = f"a {kind or 'nameless'} joint cannot be mirrored"
            raise HandError(message, key=joint.get("name"), value=kind)
