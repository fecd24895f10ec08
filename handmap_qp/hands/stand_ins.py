"""What stands for meshes of a URDF that cannot be had: a hand can be mapped without its files."""

from collections import defaultdict
from collections.abc import Callable
from copy import deepcopy
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from handmap_qp.se3 import Array, affine
from .urdf import edges, origin_of, set_numbers, set_origin

_OTHER = {"collision": "visual", "visual": "collision"}
_RADIUS = 0.006
"""Radius of cylinders and balls in the place of a link's shapes [m]."""


def add_stand_ins(robot: Element, is_lost: Callable[[Element], bool]) -> None:
    """Replace shapes whose mesh is lost.

    A link that has no collision shape left gets its visual ones, and the reverse. One that has lost
    all of them gets cylinders from its joint to those that it carries, or a ball.

    Args:
        robot: The URDF, changed in place.
        is_lost: Tells of a `<mesh>` whether it cannot be read.
    """
    ends = defaultdict(list)
    for joint, parent, _ in edges(robot):
        ends[parent].append(origin_of(joint)[:3, 3])
    for link in robot.iterfind("link"):
        lost = [
            shape
            for shape in link
            if shape.tag in _OTHER
            and any(map(is_lost, shape.iterfind("geometry/mesh")))
        ]
        for shape in lost:
            link.remove(shape)
        for tag in {shape.tag: None for shape in lost}:
            if link.find(tag) is None:
                link.extend(_stands(link, tag, ends[link.get("name", "")]))


def _stands(link: Element, tag: str, ends: list[Array]) -> list[Element]:
    """Return shapes of one kind for a link that has none, with the joints at its ends."""
    stands = deepcopy(link.findall(_OTHER[tag])) or _along(ends)
    for shape in stands:
        shape.tag = tag
    return stands


def _along(ends: list[Array]) -> list[Element]:
    """Return cylinders from a joint to others, (3,) each; a ball if there are none."""
    made = [_shape("cylinder", end, length=np.linalg.norm(end)) for end in ends]
    return made or [_shape("sphere", np.zeros(3))]


def _shape(kind: str, end: Array, **size: ArrayLike) -> Element:
    element = Element("collision")
    # A cylinder is along z.
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), end)
    set_origin(element, affine(turn.matrix(), end / 2.0))
    solid = SubElement(SubElement(element, "geometry"), kind)
    set_numbers(solid, radius=_RADIUS, **size)
    return element
