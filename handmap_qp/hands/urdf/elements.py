"""Read and write elements of a URDF: numbers in attributes, origins, axes, rotations."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from handmap_qp.errors import HandError
from handmap_qp.transform import affine, rotation_from_rpy


def parse_urdf(text: str) -> ET.Element:
    """The `<robot>` element of a URDF.

    Args:
        text: The URDF; one that starts with an XML declaration is fine, whatever encoding that
            names.

    Raises:
        HandError: If the text is no XML or its root is another element.
    """
    try:
        robot = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise HandError(f"the URDF is no XML: {error}") from error
    if robot.tag != "robot":
        raise HandError(
            f"expected a URDF with the root <robot>, got <{robot.tag}>", value=robot.tag
        )
    return robot


def get_numbers(
    element: ET.Element, key: str, count: int, default: str | None = None
) -> list[float]:
    """The numbers in an attribute.

    Args:
        element: An element of a URDF.
        key: The attribute.
        count: How many numbers it should hold.
        default: Its text where it is missing.

    Raises:
        HandError: If it is missing without a default, or holds anything but `count` numbers.
    """
    text = element.get(key, default)
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise HandError(
            f"expected {count} number(s), got {text!r}", key=f"<{element.tag} {key}>", value=text
        )
    return numbers


def set_numbers(element: ET.Element, key: str, numbers: list[float]) -> None:
    """Write numbers into an attribute with all their digits, minus zero as zero."""
    element.set(key, " ".join(repr(float(number) + 0.0) for number in numbers))


def origin_of(element: ET.Element) -> np.ndarray:
    """The pose in an element's `<origin>`, shape (4, 4); the identity without one."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    return affine(
        rotation_from_rpy(get_numbers(origin, "rpy", 3, "0 0 0")),
        np.array(get_numbers(origin, "xyz", 3, "0 0 0")),
    )


def axis_of(joint: ET.Element) -> np.ndarray:
    """A joint's axis as a unit vector, shape (3,); x, as URDF has it, where none is given."""
    element = joint.find("axis")
    axis = np.array([1.0, 0.0, 0.0] if element is None else get_numbers(element, "xyz", 3, "1 0 0"))
    length = np.linalg.norm(axis)
    if not (np.isfinite(axis).all() and length > 1e-9):
        raise HandError(
            f"expected an axis of some length, got {axis.tolist()}",
            key=joint.get("name"),
            value=axis.tolist(),
        )
    return axis / length
