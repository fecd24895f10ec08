"""Faults of URDFs, each named in one line, and parts cut out of URDFs."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import pytest

from handmap_qp import Hand, HandError, load_hand
from handmap_qp.hands.urdf import (
    check_tree,
    cut_subtree,
    joints_by_name,
    link_names,
    parse_urdf,
    remove_subtrees,
    root_links,
)

LIMIT = '<limit lower="0" upper="1" effort="1" velocity="1"/>'


def joint(
    name: str, parent: str, child: str, kind: str = "revolute", inside: str = LIMIT
) -> str:
    links = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{links}{inside}</joint>'


def robot(links: str, *parts: str) -> ET.Element:
    """Return the URDF of a robot with links named by letters, and further elements."""
    named = "".join(f'<link name="{name}"/>' for name in links)
    return ET.fromstring(f'<robot name="r">{named}{"".join(parts)}</robot>')


FAULTS = {
    "two links": (robot("aab", joint("j", "a", "b")), "two links 'a'"),
    "two joints": (
        robot("abc", joint("j", "a", "b"), joint("j", "b", "c")),
        "two joints 'j'",
    ),
    "no child": (
        robot("a", '<joint name="j"><parent link="a"/></joint>'),
        "parent and a child",
    ),
    "no such link": (
        robot("a", joint("j", "a", "b")),
        "'b', which it does not have",
    ),
    "two parents": (
        robot("abc", joint("j", "a", "c"), joint("k", "b", "c")),
        "'c' is the child of two joints",
    ),
    "two roots": (robot("abc", joint("j", "a", "b")), "2 roots, expected one: a, c"),
    "no link": (robot(""), "no links: if xacro made it"),
    "loop": (
        robot("ab", joint("j", "a", "b"), joint("k", "b", "a")),
        "0 roots, expected one",
    ),
    "loop beside a tree": (
        robot("abcd", joint("j", "a", "b"), joint("k", "c", "d"), joint("l", "d", "c")),
        "loops contain or carry c, d",
    ),
    "joint type": (robot("ab", joint("j", "a", "b", "ball")), "of type 'ball'"),
    "words for numbers": (
        robot("ab", joint("j", "a", "b", inside='<origin xyz="0 0 up"/>')),
        "'j': <origin xyz>: expected 3",
    ),
    "infinite place": (
        robot("ab", joint("j", "a", "b", inside='<origin xyz="0 0 inf"/>')),
        "not a finite number",
    ),
    "NaN limit": (
        robot("ab", joint("j", "a", "b", inside='<limit upper="nan"/>')),
        "<limit upper='nan'>",
    ),
    "nothing moves": (
        robot("ab", joint("j", "a", "b", "fixed")),
        "no joint that moves",
    ),
}


@pytest.mark.parametrize(("urdf", "message"), FAULTS.values(), ids=FAULTS.keys())
def test_a_fault_is_named_in_one_line(urdf: ET.Element, message: str) -> None:
    with pytest.raises(HandError) as caught:
        check_tree(urdf)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_tree_passes_and_may_have_infinite_limits() -> None:
    wide = '<limit lower="-inf" upper="inf" effort="1" velocity="1"/>'
    check_tree(robot("abc", joint("j", "a", "b"), joint("k", "b", "c", inside=wide)))


@pytest.mark.parametrize(("kind", "inside"), [("continuous", LIMIT), ("revolute", "")])
def test_a_joint_without_limits_is_named_by_its_key(kind: str, inside: str) -> None:
    hand = load_hand("three_finger")
    text, name = hand.urdf_text, hand.joint_names[0]
    part = parse_urdf(text)
    free = joints_by_name(part)[name]
    free.set("type", kind)
    for limit in free.findall("limit"):
        free.remove(limit)
    free.extend([ET.fromstring(inside)] if inside else [])
    with pytest.raises(HandError, match="no limits in the URDF") as caught:
        Hand(hand.spec, urdf_text=ET.tostring(part, encoding="unicode"))
    assert caught.value.key == f"limits.{name}"


def tree() -> ET.Element:
    """Return a chain a-b-c and a branch a-d, with a transmission and a material."""
    return robot(
        "abcd",
        joint("ab", "a", "b"),
        joint("bc", "b", "c"),
        joint("ad", "a", "d"),
        '<transmission name="t"><joint name="ad"/></transmission><material name="m"/>',
    )


def test_cutting_keeps_a_link_and_its_descendants() -> None:
    part = tree()
    cut_subtree(part, "b")
    assert link_names(part) == ["b", "c"]
    assert root_links(part) == ["b"]
    assert [element.get("name") for element in part] == ["b", "c", "bc", "m"]


def test_removing_takes_a_link_and_its_descendants() -> None:
    part = tree()
    remove_subtrees(part, ["b"])
    assert link_names(part) == ["a", "d"]
    assert [element.get("name") for element in part.iterfind("joint")] == ["ad"]
