"""Faults that descriptions of robots come with, made on purpose: dropped links, exchanged axes, ...

Each takes the root element of a URDF or an MJCF, and changes one thing in it. What remains may be
a robot or not.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from itertools import pairwise
from xml.etree import ElementTree as ET

import numpy as np

Mutation = Callable[[ET.Element, np.random.Generator], None]
"""Changes one thing below a root element."""

ODD_NUMBERS = ("0", "-1", "1e9", "1e-9", "1e400", "nan", "-inf", "", "1 2", "0x1", "½")
ODD_NAMES = (
    *("", " ", "palm", "thumb_tip", "left_thumb", "no", "3.5", "a: b", "- x", "#"),
    *("é/ø", "a" * 300, "{}", "universe", "root_joint", "a\nb"),
)
KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "screw")
MJCF_KINDS = ("hinge", "slide", "ball", "free")
# Attributes of numbers, and of names.
_NUMBERS = (
    *("xyz", "rpy", "lower", "upper", "velocity", "effort", "multiplier", "offset"),
    *("size", "radius", "length", "scale", "pos", "axis", "range", "quat", "euler"),
    *("polycoef", "coef", "anchor", "ref", "fromto", "mass", "value", "ixx", "damping"),
)
_NAMES = ("name", "link", "joint", "joint1", "joint2", "body1", "body2", "filename")


def _parents(root: ET.Element) -> dict[ET.Element, ET.Element]:
    return {child: parent for parent in root.iter() for child in parent}


def _chosen(
    found: list[ET.Element], random: np.random.Generator, count: int = 1
) -> list[ET.Element]:
    """Return some elements; none if there are not as many."""
    if len(found) < count:
        return []
    places = random.choice(len(found), count, replace=False)
    return [found[place] for place in places]


def _with(root: ET.Element, *keys: str) -> list[tuple[ET.Element, str]]:
    """Return the elements below a root that have one of some attributes, with its name."""
    return [(each, key) for each in root.iter() for key in keys if key in each.attrib]


def _one(
    root: ET.Element, random: np.random.Generator, *keys: str
) -> Iterator[tuple[ET.Element, str]]:
    """Yield one of the elements that have one of some attributes, if there is one."""
    if found := _with(root, *keys):
        yield found[random.integers(len(found))]


def drop_part(root: ET.Element, random: np.random.Generator) -> None:
    """Drop a link or a body, and leave what names it."""
    _drop(root, random, "link", "body")


def drop_joint(root: ET.Element, random: np.random.Generator) -> None:
    """Drop a joint."""
    _drop(root, random, "joint")


def drop_anything(root: ET.Element, random: np.random.Generator) -> None:
    """Drop one element of any kind."""
    _drop(root, random)


def _drop(root: ET.Element, random: np.random.Generator, *tags: str) -> None:
    parents = _parents(root)
    found = [each for each in parents if not tags or each.tag in tags]
    for each in _chosen(found, random):
        parents[each].remove(each)


def drop_branch(root: ET.Element, random: np.random.Generator) -> None:
    """Drop a joint, and all that hangs from it."""
    for joint in _chosen(root.findall("joint[child]"), random):
        lost = [joint]
        names = set[str]()
        while lost:
            for each in lost:
                names |= {child.get("link", "") for child in each.iterfind("child")}
                root.remove(each)
            lost = [
                each
                for each in root.findall("joint[parent]")
                if any(parent.get("link") in names for parent in each.iter("parent"))
            ]
        for link in root.findall("link"):
            if link.get("name") in names:
                root.remove(link)


def drop_attribute(root: ET.Element, random: np.random.Generator) -> None:
    """Drop an attribute."""
    for each in _chosen([each for each in root.iter() if each.attrib], random):
        del each.attrib[random.choice([*each.attrib])]


def drop_all_of_a_kind(root: ET.Element, random: np.random.Generator) -> None:
    """Drop all elements with the tag of one: all limits, all shapes, all names of meshes."""
    for chosen in _chosen([*_parents(root)], random):
        for each, parent in _parents(root).items():
            if each.tag == chosen.tag and each in parent:
                parent.remove(each)


def exchange_axes(root: ET.Element, random: np.random.Generator) -> None:
    """Exchange the axes of two joints."""
    _exchange(root, random, "axis", "xyz")


def exchange_parents(root: ET.Element, random: np.random.Generator) -> None:
    """Exchange what carries two links, or two joints that lead."""
    _exchange(root, random, str(random.choice(["parent", "mimic"])), "link")


def exchange_ends(root: ET.Element, random: np.random.Generator) -> None:
    """Exchange one of the numbers or names of two elements with the same tag."""
    for each in _chosen([each for each in root.iter() if each.attrib], random):
        _exchange(root, random, each.tag, str(random.choice([*each.attrib])))


def _exchange(
    root: ET.Element, random: np.random.Generator, tag: str, key: str
) -> None:
    found = [each for each in root.iter(tag) if key in each.attrib]
    if pair := _chosen(found, random, 2):
        one, other = pair
        one.attrib[key], other.attrib[key] = other.attrib[key], one.attrib[key]


def scale_meshes(root: ET.Element, random: np.random.Generator) -> None:
    """Scale all meshes, or other shapes, by one odd factor: millimetres as metres, mirrored, 0."""
    factor = float(random.choice([1000.0, 0.001, -1.0, 0.0, 25.4, 1e12]))
    for mesh in root.iter("mesh"):
        mesh.set("scale", f"{factor} {factor} {abs(factor)}")
    for each, key in _with(root, "size", "radius", "length"):
        each.set(key, _times(each.get(key, ""), factor))


def scale_lengths(root: ET.Element, random: np.random.Generator) -> None:
    """Scale all distances."""
    factor = float(random.choice([1000.0, 0.001, -1.0, 0.0, 25.4, 1e12]))
    for each, key in _with(root, "xyz", "pos"):
        if each.tag != "axis":
            each.set(key, _times(each.get(key, ""), factor))


def _times(text: str, factor: float) -> str:
    try:
        return " ".join(repr(float(word) * factor) for word in text.split())
    except ValueError:
        return text


def set_number(root: ET.Element, random: np.random.Generator) -> None:
    """Give an attribute an odd number."""
    for each, key in _one(root, random, *_NUMBERS):
        words = each.get(key, "").split() or [""]
        words[random.integers(len(words))] = str(random.choice(ODD_NUMBERS))
        each.set(key, " ".join(words))


def set_all_numbers(root: ET.Element, random: np.random.Generator) -> None:
    """Give an attribute the same odd number in all elements: every limit, every axis."""
    number = str(random.choice(ODD_NUMBERS))
    for _, key in _one(root, random, *_NUMBERS):
        for each, _ in _with(root, key):
            count = len(each.get(key, "").split()) or 1
            each.set(key, " ".join([number] * count))


def rename(root: ET.Element, random: np.random.Generator) -> None:
    """Rename one thing, and leave what names it."""
    for each, key in _one(root, random, *_NAMES):
        each.set(key, str(random.choice(ODD_NAMES)))


def rename_joint(root: ET.Element, random: np.random.Generator) -> None:
    """Rename a joint or a link everywhere, also to the name of another."""
    for each, key in _one(root, random, "name"):
        old = each.get(key, "")
        others = [other.get("name", "") for other, _ in _with(root, "name")]
        new = str(random.choice([*ODD_NAMES, *others]))
        for named, key in _with(root, *_NAMES):
            if named.get(key) == old:
                named.set(key, new)


def change_kind(root: ET.Element, random: np.random.Generator) -> None:
    """Make a joint one of another type."""
    kinds = MJCF_KINDS if root.tag == "mujoco" else KINDS
    joints = [each for each in root.iter("joint") if not each.get("joint")]
    for joint in _chosen(joints, random):
        joint.set("type", str(random.choice(kinds)))


def change_all_kinds(root: ET.Element, random: np.random.Generator) -> None:
    """Make all joints that move of one type."""
    kinds = MJCF_KINDS if root.tag == "mujoco" else KINDS
    kind = str(random.choice(kinds))
    for joint in root.iter("joint"):
        if joint.get("type", "hinge") != "fixed":
            joint.set("type", kind)


def close_range(root: ET.Element, random: np.random.Generator) -> None:
    """Give joints, one or all of them, a range without a width, or a reversed one."""
    low, high = random.choice([("0", "0"), ("1", "-1"), ("0.3", "0.3")])
    found = [*root.iter("limit"), *(each for each, _ in _with(root, "range"))]
    for each in found if random.random() < 0.5 else _chosen(found, random):
        if "range" in each.attrib:
            each.set("range", f"{low} {high}")
        else:
            each.set("lower", str(low))
            each.set("upper", str(high))


def follow(root: ET.Element, random: np.random.Generator) -> None:
    """Let a joint follow another, itself, or none that there is."""
    names = [joint.get("name", "") for joint in root.findall("joint")]
    for joint in _chosen(root.findall("joint"), random):
        factor = str(random.choice(["1", "0", "-2.5", "1e9"]))
        leader = str(random.choice([*names, "gone"]))
        ET.SubElement(joint, "mimic", joint=leader, multiplier=factor)


def follow_in_a_row(root: ET.Element, random: np.random.Generator) -> None:
    """Let every joint follow the one before it in the file."""
    for before, joint in pairwise(root.findall("joint")):
        ET.SubElement(joint, "mimic", joint=before.get("name", ""))


def put_twice(root: ET.Element, random: np.random.Generator) -> None:
    """Put an element there twice."""
    parents = _parents(root)
    for each in _chosen([*parents], random):
        parents[each].append(copy.deepcopy(each))


def put_elsewhere(root: ET.Element, random: np.random.Generator) -> None:
    """Move an element into another one that does not lie in it."""
    parents = _parents(root)
    for each in _chosen([*parents], random):
        inside = {*each.iter()}
        others = [other for other in root.iter() if other not in inside]
        parents[each].remove(each)
        others[random.integers(len(others))].append(each)


MUTATIONS: dict[str, Mutation] = {
    "drop part": drop_part,
    "drop joint": drop_joint,
    "drop anything": drop_anything,
    "drop branch": drop_branch,
    "drop attribute": drop_attribute,
    "drop all of a kind": drop_all_of_a_kind,
    "exchange axes": exchange_axes,
    "exchange parents": exchange_parents,
    "exchange ends": exchange_ends,
    "scale meshes": scale_meshes,
    "scale lengths": scale_lengths,
    "set number": set_number,
    "set all numbers": set_all_numbers,
    "rename": rename,
    "rename joint": rename_joint,
    "change kind": change_kind,
    "change all kinds": change_all_kinds,
    "close range": close_range,
    "follow": follow,
    "follow in a row": follow_in_a_row,
    "put twice": put_twice,
    "put elsewhere": put_elsewhere,
}
"""Mutations by their names."""


def mutated(text: str, random: np.random.Generator) -> tuple[str, str]:
    """Return a description with one to three faults, and what was done.

    Args:
        text: A URDF or an MJCF.
        random: Where the choice comes from.
    """
    root = ET.fromstring(text)
    done = []
    for _ in range(random.choice([1, 1, 1, 2, 3])):
        name = str(random.choice([*MUTATIONS]))
        MUTATIONS[name](root, random)
        done.append(name)
    changed = ET.tostring(root, encoding="unicode")
    if random.random() < 0.03:
        done.append("cut off")
        changed = changed[: random.integers(len(changed))]
    return ", ".join(done), changed
