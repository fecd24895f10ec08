"""Read and write elements of a URDF: numbers in attributes, origins and axes."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np

from handmap_qp.errors import HandError
from handmap_qp.hands.urdf.xml_text import parse_xml
from handmap_qp.se3 import affine, rotation_from_rpy

# An element that the program xacro replaces.
_XACRO = re.compile(r"<xacro:[a-z]")


def parse_urdf(text: str) -> ET.Element:
    """Parse a URDF.

    Args:
        text: The URDF; it may start with an XML declaration of any encoding.

    Returns:
        The `<robot>` element.

    Raises:
        HandError: If the text is not XML, is xacro, or its root is another element.
    """
    if isinstance(text, str) and _XACRO.search(text):
        message = "the file is xacro, not URDF: convert it with `xacro FILE.xacro > FILE.urdf`"
        raise HandError(message)
    try:
        robot = parse_xml(text)
    except (ET.ParseError, TypeError, ValueError) as error:
        raise HandError(f"the URDF is not valid XML: {error}") from error
    if robot.tag != "robot":
        message = f"expected a URDF with the root <robot>, got <{robot.tag}>"
        raise HandError(message, value=robot.tag)
    return robot


def get_numbers(
    element: ET.Element, key: str, count: int, default: str | None = None
) -> list[float]:
    """Read the numbers in an attribute.

    Args:
        element: An element of a URDF.
        key: The attribute.
        count: How many numbers it must hold.
        default: Its text where it is missing.

    Returns:
        The numbers; NaN and infinity are passed on.

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


def set_numbers(element: ET.Element, key: str, numbers: list[float]) -> None:
    """Write numbers into an attribute with all their digits, and minus zero as zero."""
    element.set(key, " ".join(repr(float(number) + 0.0) for number in numbers))


def origin_of(element: ET.Element) -> np.ndarray:
    """Read the pose in an element's `<origin>`.

    Returns:
        Pose, shape (4, 4); the identity where there is no origin.

    Raises:
        HandError: If it does not hold finite numbers.
    """
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    xyz, rpy = (np.array(get_numbers(origin, key, 3, "0 0 0")) for key in ("xyz", "rpy"))
    if not (np.isfinite(xyz).all() and np.isfinite(rpy).all()):
        message = f"expected finite numbers, got xyz {xyz.tolist()} and rpy {rpy.tolist()}"
        raise HandError(message, key=f"<{element.tag} origin>")
    return affine(rotation_from_rpy(rpy), xyz)


def axis_of(joint: ET.Element) -> np.ndarray:
    """Read a joint's axis.

    Returns:
        Unit vector, shape (3,); x where none is given, as URDF specifies.

    Raises:
        HandError: If it is zero or not finite.
    """
    element = joint.find("axis")
    axis = np.array([1.0, 0.0, 0.0] if element is None else get_numbers(element, "xyz", 3, "1 0 0"))
    length = np.linalg.norm(axis)
    if not (np.isfinite(axis).all() and length > 1e-9):
        message = f"expected an axis longer than zero, got {axis.tolist()}"
        raise HandError(message, key=joint.get("name"), value=axis.tolist())
    return axis / length
