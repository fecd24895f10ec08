"""The URDF of a hand as a document: read, check, cut, edit, mount and mirror it.

All readers of `Hand.urdf_text` (Pinocchio, MuJoCo, a picture) see the same robot.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import deepcopy
from functools import lru_cache
from itertools import chain
from typing import Literal, NamedTuple, get_args
from xml.etree.ElementTree import Element, SubElement, TreeBuilder
from xml.parsers import expat

import msgspec
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from handmap_core.errors import HandError
from handmap_core.se3 import Array, affine, rotation_from_rpy, rpy_from_rotation
from .sources import find_mesh, other_kind, read_urdf, urdf_path
from .spec import ArmSpec, HandSpec, LimitSpec, MimicSpec, Positions, Rules, repeated

MOVABLE = ("revolute", "continuous", "prismatic")
"""Types of joints with one coordinate."""
USUAL_SPEEDS = {"revolute": 5.0, "continuous": 5.0, "prismatic": 0.1}
"""Speeds of joints whose file gives none, by their type [rad/s or m/s]."""
FASTEST_SPEEDS = {"revolute": 20.0, "prismatic": 1.0}
"""Speeds that hardly any motor of a robot exceeds, by the type of joint [rad/s or m/s].

The fastest joints that makers of hands name do 14.4 rad/s (XHand1's URDF) and 0.25 m/s (Robotiq's
manual of the 2F-140).
"""
LOOP_END = "loop_end"
"""Element of a link that a constraint of an MJCF joins to another one: a bar, and no finger."""
_HELD = "held"
_FREE = ("planar", "floating")
_KINDS = (*MOVABLE, "fixed", *_FREE)
_DEFAULT_AXIS = "1 0 0"
# Pinocchio reads a chain by recursion, and crashes at about 4,000 links.
_DEEPEST = 2000
NO_LIMIT = 1e6
"""Written where a joint has no position limit, which URDF readers require [rad or m]."""
# Attributes of a joint's elements that hold numbers, and how many.
_NUMBERS = {
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "limit": {"lower": 1, "upper": 1, "velocity": 1, "effort": 1},
    "mimic": {"multiplier": 1, "offset": 1},
}
_XACRO = "xacro:"
_OF_FIXED_JOINTS = ("origin", "parent", "child")


HeldKind = Literal["limits", "loop", "motor"]
"""What keeps a coupled joint from following: its own limits, a loop that is no line, no motor."""
_NEXT_STEPS: dict[HeldKind, str] = {
    "limits": "correct its range or the coupling in the MJCF file, and describe the hand again; "
    "or couple it under `mimic` in place of `locked`, with its true `limits`",
    "loop": "if one line is near enough, couple it under `mimic` in place of `locked`",
    "motor": "if it follows another joint, couple it under `mimic` in place of `locked`",
}


class HeldReason(NamedTuple):
    """Why a joint of an MJCF file does not move in the URDF, where its limits are equal.

    Attributes:
        kind: What keeps it from following.
        text: The same with names and numbers, without a full stop.
    """

    kind: HeldKind
    text: str

    @property
    def next_step(self) -> str:
        """What its owner can do about it."""
        return _NEXT_STEPS[self.kind]

    def held_at(self, position: float) -> str:
        """Return a sentence about a joint, which is its subject, at a position [rad or m]."""
        return f"is held at {position:.4g}: {self.text}"


def read_tree(spec: HandSpec | ArmSpec, text: str | bytes | None = None) -> Element:
    """Read the URDF of a hand or an arm, and check it.

    Args:
        spec: The description of the hand or the arm.
        text: The URDF; that of the description's file if omitted.

    Raises:
        HandError: If it cannot be read, or is not a tree in which a joint moves.
        MissingExtraError: If it lies in a package that is not installed.
    """
    robot = parse_urdf(read_urdf(spec) if text is None else text)
    check_tree(robot)
    return robot


def parse_urdf(text: str | bytes) -> Element:
    """Parse a URDF, and return the `<robot>` element.

    Many files do not declare their prefixes, so `<sensor:camera>` becomes `<sensor_camera>`.

    Args:
        text: A string, or bytes in any encoding that a byte-order mark or a declaration tells.

    Raises:
        HandError: If the text is not XML, is xacro, or its root is another element.
    """
    return deepcopy(_parsed(text))


# The same robot is read several times: as a hand, its shapes, and what collides.
@lru_cache(maxsize=16)
def _parsed(text: str | bytes) -> Element:
    """Return what `parse_urdf` does, not to be changed: a copy takes a quarter of the time."""
    if kind := other_kind(text.encode() if isinstance(text, str) else text):
        raise HandError(f"the file {kind}")
    builder = TreeBuilder()
    parser = expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(text, True)
    # LookupError: an unknown encoding; ValueError: a character that XML cannot have.
    except (expat.ExpatError, LookupError, ValueError) as error:
        raise HandError(f"the URDF is not valid XML: {error}") from error
    robot = builder.close()
    if problem := _xacro_problem(robot):
        raise HandError(problem)
    for element in [*robot.iter()]:
        # Of a link with half of one, Pinocchio's parser would drop the shapes too.
        for inertial in element.findall("inertial"):
            if inertial not in element.findall("inertial[mass][inertia]"):
                element.remove(inertial)
        element.tag = element.tag.replace(":", "_")
        element.attrib = {k: v for k, v in element.attrib.items() if ":" not in k}
    if robot.tag != "robot":
        problem = f"expected a URDF with the root <robot>, got <{robot.tag}>"
        if robot.tag == "mujoco":
            problem += ": an MJCF file's name has to end in .xml"
        raise HandError(problem, value=robot.tag)
    return robot


def _xacro_problem(robot: Element) -> str:
    """Return what to do about a file of xacro; empty for a URDF."""
    tags = {element.tag for element in robot.iter()}
    if not any(tag.startswith(_XACRO) for tag in tags):
        return ""
    macros = [macro.get("name", "") for macro in robot.iter(f"{_XACRO}macro")]
    is_called = any(f"{_XACRO}{name}" in tags for name in macros)
    if not macros or is_called or robot.find("link") is not None:
        return "the file is xacro, not URDF: convert it with `xacro FILE.xacro > FILE.urdf`"
    names = ", ".join(macros[:6])
    return (
        f"the file only defines xacro macros, {names}, and calls none: convert a file that calls "
        f"one. Such a file has <xacro:include filename='FILE'/> and <xacro:{macros[0]} .../>"
    )


# -- numbers of elements


def get_numbers(
    element: Element, key: str, count: int, default: str | None = None
) -> list[float]:
    """Read `count` numbers in an attribute.

    Raises:
        HandError: If it does not hold `count` finite numbers; limits may be infinite.
    """
    text = element.get(key, default)
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise HandError(
            f"expected {count} number(s), got {text!r}",
            key=f"<{element.tag} {key}>",
            value=text,
        )
    faults = np.isnan(numbers) if element.tag == "limit" else ~np.isfinite(numbers)
    if faults.any():
        raise HandError(
            f"<{element.tag} {key}={text!r}> is not a finite number", value=text
        )
    return numbers


def set_numbers(element: Element, **numbers: ArrayLike) -> Element:
    """Write numbers into attributes, minus zero as zero, and return the element."""
    for key, values in numbers.items():
        words = (repr(float(number) + 0.0) for number in np.ravel(values))
        element.set(key, " ".join(words))
    return element


def child_of(element: Element, tag: str) -> Element:
    """Return the first child with a tag, which is added where it is missing."""
    found = element.find(tag)
    return SubElement(element, tag) if found is None else found


def origin_of(element: Element) -> Array:
    """Read the pose in an element's `<origin>`, shape (4, 4); the identity where there is none.

    Raises:
        HandError: If it does not hold finite numbers.
    """
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    xyz, rpy = (get_numbers(origin, key, 3, "0 0 0") for key in ("xyz", "rpy"))
    return affine(rotation_from_rpy(rpy), xyz)


def set_origin(element: Element, pose: Array) -> None:
    """Write a pose [m], shape (4, 4), into an element's `<origin>`."""
    origin = child_of(element, "origin")
    set_numbers(origin, xyz=pose[:3, 3], rpy=rpy_from_rotation(pose[:3, :3]))


def mimics_of(robot: Element) -> Rules:
    """Read the mimic rules of a URDF as they are, by follower.

    Raises:
        HandError: If one does not hold finite numbers.
    """
    rules = {}
    for name, joint in joints_by_name(robot).items():
        if (mimic := joint.find("mimic")) is not None:
            (multiplier,) = get_numbers(mimic, "multiplier", 1, "1")
            (offset,) = get_numbers(mimic, "offset", 1, "0")
            rules[name] = MimicSpec(mimic.get("joint", ""), multiplier, offset)
    return rules


def add_mimic(joint: Element, rule: MimicSpec) -> None:
    """Add a mimic rule to a joint."""
    element = SubElement(joint, "mimic", joint=rule.joint)
    set_numbers(element, multiplier=rule.multiplier, offset=rule.offset)


def add_held(joint: Element, reason: HeldReason) -> None:
    """Say in a joint why it is held, where `held_joints` reads it."""
    SubElement(joint, _HELD, kind=reason.kind, why=reason.text)


def held_joints(robot: Element) -> dict[str, HeldReason]:
    """Return why joints are held that an MJCF file couples to others, by their names."""
    found = dict[str, HeldReason]()
    for joint in robot.iterfind(f"joint[{_HELD}]"):
        held = child_of(joint, _HELD)
        for kind in get_args(HeldKind):
            if held.get("kind") == kind:
                found[joint.get("name", "")] = HeldReason(kind, held.get("why", ""))
    return found


# -- the tree of links and joints


def edges(robot: Element) -> Iterator[tuple[Element, str, str]]:
    """Iterate over the joints, with the names of their parent and child links.

    Raises:
        HandError: If a joint lacks one of them.
    """
    for joint in robot.iterfind("joint"):
        above = joint.find("parent")
        below = joint.find("child")
        if above is None or below is None:
            name = joint.get("name")
            raise HandError(
                f"the joint {name!r} needs a parent and a child link", value=name
            )
        yield joint, above.get("link", ""), below.get("link", "")


def link_names(robot: Element) -> list[str]:
    """Return the names of all links, in the order of the file."""
    return [link.get("name", "") for link in robot.iterfind("link")]


def joints_by_name(robot: Element, of: Collection[str] = _KINDS) -> dict[str, Element]:
    """Return the joints of some types by their names, in the order of the file."""
    return {
        joint.get("name", ""): joint
        for joint in robot.iterfind("joint")
        if joint.get("type") in of
    }


def root_links(robot: Element) -> list[str]:
    """Return the links that are not the child of a joint."""
    below = {child for _, _, child in edges(robot)}
    return [name for name in link_names(robot) if name not in below]


def _levels(robot: Element, starts: Collection[str]) -> Iterator[list[str]]:
    """Iterate over the given links, their children, the children of these, and so on."""
    children = defaultdict(list)
    for _, parent, child in edges(robot):
        children[parent].append(child)
    level = list(starts)
    while level:
        yield level
        level = [child for link in level for child in children[link]]


def cut_subtree(robot: Element, root: str) -> None:
    """Keep one link and its descendants, and materials; remove everything else.

    Raises:
        HandError: If there is no such link.
    """
    links = link_names(robot)
    _require(root, links, "link", "root")
    _remove_links(robot, set(links).difference(*_levels(robot, [root])))
    for element in list(robot):
        if element.tag not in ("link", "joint", "material"):
            robot.remove(element)


def remove_subtrees(robot: Element, roots: Collection[str]) -> None:
    """Remove links of an arm, their descendants and the joints between them.

    Raises:
        HandError: If there is no such link.
    """
    for root in roots:
        _require(root, link_names(robot), "link", "arm.without")
    _remove_links(robot, set().union(*_levels(robot, roots)))


def _require(name: str, known: Collection[str], what: str, key: str) -> None:
    """Reject a name of a description that is not among those of the URDF."""
    if name not in known:
        raise HandError(f"the URDF has no {what} {name!r}", key=key, value=name)


def _remove_links(robot: Element, names: set[str]) -> None:
    """Remove links and all joints that touch them."""
    for joint, parent, child in list(edges(robot)):
        if parent in names or child in names:
            robot.remove(joint)
    for link in robot.findall("link"):
        if link.get("name") in names:
            robot.remove(link)


# -- checks: URDF readers print faults to stderr and raise a general error


def check_tree(robot: Element) -> None:
    """Reject a URDF whose links and joints are not a tree, or in which no joint moves.

    Raises:
        HandError: On missing or duplicate names, missing links, loops, several roots, too long a
            chain, other attributes than numbers, unknown joint types, or no joint that moves.
    """
    links = link_names(robot)
    joints = [*robot.iterfind("joint")]
    ends = [(parent, child) for _, parent, child in edges(robot)]
    unknown = [link for link in chain(*ends) if link not in links]
    _reject(
        "has a {} without a name",
        [e.tag for e in robot if e.tag in ("link", "joint") and not e.get("name")],
    )
    _reject("has two links {!r}", repeated(links))
    _reject("has two joints {!r}", repeated([j.get("name", "") for j in joints]))
    _reject("has a joint with the link {!r}, which it does not have", unknown)
    children = repeated([child for _, child in ends])
    _reject("is not a tree: the link {!r} is the child of two joints", children)
    roots = root_links(robot)
    if not links:
        advice = "if xacro made it, convert a file that calls the robot's macro"
        raise HandError(f"the URDF has no links: {advice}")
    if len(roots) != 1:
        first = f": {', '.join(roots[:6])}" if roots else ""
        advice = "join all links to one tree, or leave out what is no part of the robot"
        problem = f"the URDF has {len(roots)} roots, expected one{first}; {advice}"
        raise HandError(problem, value=roots)
    levels = [*_levels(robot, roots)]
    if len(levels) > _DEEPEST:
        message = f"a chain of {len(levels)} links ends at {levels[-1][0]!r}"
        raise HandError(f"{message}; expected at most {_DEEPEST}", value=levels[-1])
    apart = sorted(set(links).difference(*levels))
    names = ", ".join(apart[:6])
    _reject(f"is not a tree: loops contain or carry {names}", apart)
    if {_checked_kind(joint) for joint in joints}.isdisjoint(MOVABLE):
        count = f": all {len(joints)} joints are fixed" if joints else ""
        raise HandError(f"the URDF has no joint that moves{count}")


def _reject(message: str, culprits: Sequence[object]) -> None:
    """Raise an error about a URDF and the first of its culprits, if there are any."""
    if culprits:
        raise HandError(f"the URDF {message.format(culprits[0])}", value=culprits)


def _checked_kind(joint: Element) -> str:
    """Return a joint's type; reject an unknown one, and attributes that are not numbers."""
    name = joint.get("name", "")
    kind = joint.get("type", "")
    if kind not in _KINDS:
        expected = ", ".join(_KINDS)
        raise HandError(
            f"the joint {name!r} is of type {kind!r}; expected one of {expected}",
            value=kind,
        )
    try:
        for element in joint:
            counts = _NUMBERS.get(element.tag, {})
            # In the order of the table: the same file always has the same message.
            for key, count in counts.items():
                if key in element.attrib:
                    get_numbers(element, key, count)
    except HandError as error:
        raise HandError(f"the joint {name!r}: {error}", value=error.value) from error
    return kind


# -- edits of joints


def prepare_urdf(robot: Element, spec: HandSpec | ArmSpec) -> Positions:
    """Keep the part from `root` outwards, and write mimic rules, locked joints and limits into it.

    Paths of meshes become absolute, because later readers know no folder. Where a leader is given a
    speed, it is bound by none of its followers' but given ones.

    Args:
        robot: The `<robot>` element, changed in place.
        spec: The description of the hand or the arm.

    Returns:
        Positions of all joints that were locked [rad or m].

    Raises:
        HandError: If a link or joint does not exist.
    """
    if spec.root is not None:
        cut_subtree(robot, spec.root)
    joints = joints_by_name(robot, MOVABLE)
    for name, rule in spec.mimic.items():
        _require(name, joints, "movable joint", f"mimic.{name}")
        for old in joints[name].findall("mimic"):
            joints[name].remove(old)
        if rule:
            add_mimic(joints[name], rule)
    positions = lock_joints(robot, spec.locked)
    fix_free_joints(robot)
    joints = joints_by_name(robot, MOVABLE)
    for name in spec.limits:
        _require(name, joints, "movable joint", f"limits.{name}")
    rules = mimics_of(robot)
    for name, joint in joints.items():
        limits = spec.limits.get(name)
        _complete_limits(joint, limits or _followed(name, rules, spec.limits))
    folder = urdf_path(spec).parent
    # Most meshes are there twice, to be seen and to collide.
    paths: dict[str, str] = {}
    for mesh in robot.iter("mesh"):
        file = mesh.get("filename")
        if not file:
            continue
        if file not in paths:
            paths[file] = str(find_mesh(file, folder).resolve())
        mesh.set("filename", paths[file])
    return positions


def _followed(name: str, rules: Rules, limits: Mapping[str, LimitSpec]) -> LimitSpec:
    """Return no speed, 0, for a joint whose leader is given one; else no limits."""
    # Rules that lead in a circle are rejected later.
    for _ in rules:
        if rule := rules.get(name):
            name = rule.joint
        if limits.get(name, LimitSpec()).velocity:
            return LimitSpec(velocity=0.0)
    return LimitSpec()


def _complete_limits(joint: Element, limits: LimitSpec) -> None:
    """Write limits, and give a movable joint all that URDF readers require.

    A continuous joint becomes a revolute one, without limits one with `NO_LIMIT`.
    """
    element = child_of(joint, "limit")
    if joint.get("type") == "continuous":
        joint.set("type", "revolute")
        element.attrib.pop("lower", None)
        element.attrib.pop("upper", None)
    given = msgspec.structs.asdict(limits)
    set_numbers(element, **{k: v for k, v in given.items() if v is not None})
    if not {"lower", "upper"} & element.attrib.keys():
        set_numbers(element, lower=-NO_LIMIT, upper=NO_LIMIT)
    element.attrib.setdefault("velocity", "0")
    # Written for none: -1, infinity.
    if not 0.0 <= float(element.get("effort", -1.0)) < math.inf:
        set_numbers(element, effort=0.0)


def lock_joints(robot: Element, positions: Positions) -> Positions:
    """Make joints fixed ones at given positions, and those that mimic them where they then stand.

    Returns:
        Positions of all joints that were made fixed, in the order of the file [rad or m].

    Raises:
        HandError: If there is no such joint, or it has several coordinates.
    """
    joints = joints_by_name(robot)
    rules = mimics_of(robot)
    pending = [*positions.items()]
    locked: Positions = {}
    for name, position in pending:
        _require(name, joints, "joint", "locked")
        if joints[name].get("type") != "fixed":
            _lock(joints[name], position)
            locked[name] = position
            pending += [
                (follower, rule.multiplier * position + rule.offset)
                for follower, rule in rules.items()
                if rule.joint == name and follower not in positions
            ]
    return {name: locked[name] for name in joints if name in locked}


def _lock(joint: Element, position: float) -> None:
    """Make one joint a fixed one, its position in its origin."""
    kind = joint.get("type")
    name = joint.get("name")
    if kind not in MOVABLE:
        raise HandError(
            f"a {kind} joint cannot be locked at one number",
            key=f"locked.{name}",
            value=position,
        )
    axis = get_numbers(child_of(joint, "axis"), "xyz", 3, _DEFAULT_AXIS)
    length = math.hypot(*axis)
    if not length > 1e-9:
        raise HandError(
            f"expected an axis longer than zero, got {axis}", key=name, value=axis
        )
    # Linear and angular part of the motion.
    twist = np.zeros((2, 3))
    twist[0 if kind == "prismatic" else 1] = np.array(axis) * position / length
    set_origin(joint, origin_of(joint) @ pin.exp6(twist.ravel()).homogeneous)
    _fix(joint)


def fix_free_joints(robot: Element) -> list[str]:
    """Make floating and planar joints, from which no finger hangs, fixed; return their names."""
    free = joints_by_name(robot, _FREE)
    for joint in free.values():
        _fix(joint)
    return [*free]


def _fix(joint: Element) -> None:
    for element in list(joint):
        if element.tag not in _OF_FIXED_JOINTS:
            joint.remove(element)
    joint.set("type", "fixed")


def move_shapes(robot: Element, moves: Mapping[str, ArrayLike]) -> None:
    """Displace shapes in their links [m], by the names of their elements.

    Raises:
        HandError: If no shape has a name.
    """
    for name, way in moves.items():
        named = [
            shape for shape in robot.iterfind("link/*") if shape.get("name") == name
        ]
        for shape in named:
            pose = origin_of(shape)
            pose[:3, 3] += way
            set_origin(shape, pose)
        if not named:
            message = f"no shape of the URDF is named {name!r}"
            raise HandError(message, key="shapes", value=name)


# -- a hand on an arm, a mirrored hand


# The kinds of things that have names, and the attribute of each tag that holds one.
_NAMES = {
    "link": ("link", "name"),
    "parent": ("link", "link"),
    "child": ("link", "link"),
    "joint": ("joint", "name"),
    "mimic": ("joint", "joint"),
    "material": ("material", "name"),
}


def rename(
    robot: Element, prefix: str, only: Collection[tuple[str, str]] | None = None
) -> None:
    """Put a prefix before the names of links, joints and materials.

    Args:
        robot: The URDF.
        prefix: The prefix.
        only: Kinds and names of those to rename; all if omitted.
    """
    for element in robot.iter():
        kind, key = _NAMES.get(element.tag, ("", ""))
        name = element.get(key)
        if name and (only is None or (kind, name) in only):
            element.set(key, f"{prefix}{name}")


def mount_on_arm(arm: Element, hand: Element, spec: ArmSpec) -> None:
    """Join an arm, which becomes the whole robot, and a hand.

    The arm's links, joints and materials are renamed where the hand has the same names.

    Raises:
        HandError: If the arm has no such link.
    """
    _require(spec.tip, link_names(arm), "link", "arm.tip")
    mount = SubElement(arm, "joint", name="hand_mount", type="fixed")
    SubElement(mount, "parent", link=spec.tip)
    set_numbers(SubElement(mount, "origin"), xyz=spec.xyz, rpy=spec.rpy)
    taken = {
        (kind, each.get(key, ""))
        for tag, (kind, key) in _NAMES.items()
        for each in hand.iter(tag)
    }
    rename(arm, f"{spec.name}_", taken)
    SubElement(mount, "child", link=root_links(hand)[0])
    arm.extend(list(hand))


# With M = diag(-1, 1, 1), a pose T becomes M T M: translations change the sign of x, and
# M Rz(y) Ry(p) Rx(r) M = Rz(-y) Ry(-p) Rx(r).
_MIRRORED = {
    "origin": {"xyz": (-1.0, 1.0, 1.0), "rpy": (1.0, -1.0, -1.0)},
    "inertia": {"ixy": (-1.0,), "ixz": (-1.0,)},
}


def mirror(robot: Element) -> None:
    """Mirror a URDF in the plane x = 0 of its root link: a right hand becomes a left one.

    A point `(x, y, z)` of a link becomes `(-x, y, z)`. Names and limits stay, and the same q gives
    the mirrored posture: with `M = diag(-1, 1, 1)`, the axis `a` of a prismatic joint becomes
    `M a`, and that of a turning joint, a pseudovector, `-M a`.

    Raises:
        HandError: If it holds a mesh, or a joint with more than one coordinate.
    """
    for shape in robot.iterfind(".//geometry/*"):
        if shape.tag not in ("box", "cylinder", "sphere", "capsule"):
            message = "a hand can be mirrored only if its shapes are primitives"
            raise HandError(f"{message}, not <{shape.tag}>", value=shape.tag)
    for element in robot.iter():
        for key, signs in _MIRRORED.get(element.tag, {}).items():
            if key in element.attrib:
                _flip(element, key, signs)
    for joint in robot.iterfind("joint"):
        kind = joint.get("type", "nameless")
        if kind not in (*MOVABLE, "fixed"):
            problem = f"a {kind} joint cannot be mirrored"
            raise HandError(problem, key=joint.get("name"), value=kind)
        if kind != "fixed":
            signs = _MIRRORED["origin"]["xyz" if kind == "prismatic" else "rpy"]
            _flip(child_of(joint, "axis"), "xyz", signs, _DEFAULT_AXIS)


def _flip(
    element: Element, key: str, signs: Sequence[float], default: str | None = None
) -> None:
    numbers = get_numbers(element, key, len(signs), default)
    set_numbers(element, **{key: np.multiply(signs, numbers)})
