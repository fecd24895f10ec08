"""Mirror a URDF: a right hand becomes a left one.

With `M = diag(-1, 1, 1)` applied to the coordinates of every link, a pose `T` becomes
`M T M`: translations change the sign of x, rotations `R` become `M R M`. Angular velocity is a
pseudovector, so the axis `a` of a revolute joint becomes `-M a`. The axis of a prismatic joint is a
vector and becomes `M a`. The same q then gives the mirrored posture.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

from handmap_qp.errors import HandError
from handmap_qp.hands.urdf.elements import get_numbers, parse_urdf, set_numbers

_TRANSLATION_SIGNS = (-1.0, 1.0, 1.0)
# M Rz(y) Ry(p) Rx(r) M = Rz(-y) Ry(-p) Rx(r)
_RPY_SIGNS = (1.0, -1.0, -1.0)
_AXIS_SIGNS = {
    "revolute": (1.0, -1.0, -1.0),
    "continuous": (1.0, -1.0, -1.0),
    "prismatic": (-1.0, 1.0, 1.0),
}
# Products of inertia that hold one x.
_INERTIA_KEYS = ("ixy", "ixz")
_PRIMITIVES = ("box", "cylinder", "sphere", "capsule")


def mirrored_urdf(text: str) -> str:
    """Mirror a URDF in the plane x = 0 of its root link.

    The coordinates of every link are mirrored as well: a point `(x, y, z)` of a link becomes `(-x,
    y, z)`. Names, limits and the meaning of q stay.

    Args:
        text: URDF of boxes, cylinders, spheres and capsules, with revolute, continuous, prismatic
            and fixed joints.

    Returns:
        The mirrored URDF, without comments.

    Raises:
        HandError: If the text is not a URDF, or holds a mesh (its file cannot be mirrored here) or
            another type of joint.
    """
    robot = parse_urdf(text)
    _check_shapes(robot)
    for origin in robot.iter("origin"):
        _flip(origin, "xyz", _TRANSLATION_SIGNS)
        _flip(origin, "rpy", _RPY_SIGNS)
    for inertia in robot.iter("inertia"):
        for key in _INERTIA_KEYS:
            _flip(inertia, key, (-1.0,))
    for joint in robot.iterfind("joint"):
        _flip_axis(joint)
    return ET.tostring(robot, encoding="unicode")


def _check_shapes(robot: ET.Element) -> None:
    for geometry in robot.iter("geometry"):
        for shape in geometry:
            if shape.tag not in _PRIMITIVES:
                message = "a hand can be mirrored only if its shapes are primitives"
                raise HandError(f"{message}, not <{shape.tag}>", value=shape.tag)


def _flip(element: ET.Element, key: str, signs: tuple[float, ...]) -> None:
    """Multiply the numbers of an attribute by signs; it may be missing."""
    if key in element.attrib:
        values = get_numbers(element, key, len(signs))
        set_numbers(element, key, [sign * value for sign, value in zip(signs, values, strict=True)])


def _flip_axis(joint: ET.Element) -> None:
    joint_type = joint.get("type", "")
    if joint_type == "fixed":
        return
    if joint_type not in _AXIS_SIGNS:
        message = f"a {joint_type or 'nameless'} joint cannot be mirrored"
        raise HandError(message, key=joint.get("name"), value=joint_type)
    axis = joint.find("axis")
    if axis is None:
        # The default axis of URDF is x, which the mirror reverses on a prismatic joint.
        axis = ET.SubElement(joint, "axis", {"xyz": "1 0 0"})
    _flip(axis, "xyz", _AXIS_SIGNS[joint_type])
