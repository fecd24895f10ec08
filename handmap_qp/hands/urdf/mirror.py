"""Reflect a URDF: a left hand is a right one in a mirror.

With `M = diag(-1, 1, 1)` applied to the coordinates of every link, a pose `T` becomes
`M T M`: translations change the sign of x, rotations `R` become `M R M`. Angular velocity is a
pseudovector, so a revolute joint's axis `a` becomes `-M a`; a prismatic one's is a vector and
becomes `M a`. The same q then gives the mirrored posture.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

from handmap_qp.errors import HandError
from handmap_qp.hands.urdf.elements import get_numbers, parse_urdf, set_numbers

_AXIS_SIGNS = {
    "revolute": (1.0, -1.0, -1.0),
    "continuous": (1.0, -1.0, -1.0),
    "prismatic": (-1.0, 1.0, 1.0),
}
_PRIMITIVES = ("box", "cylinder", "sphere", "capsule")


def mirrored_urdf(text: str) -> str:
    """Reflect a URDF in the plane x = 0 of its root link.

    Every link's own coordinates are reflected as well: a point `(x, y, z)` of a link becomes `(-x,
    y, z)`. Names, limits and the meaning of q stay. Comments are dropped.

    Args:
        text: URDF of boxes, cylinders, spheres and capsules, with revolute, continuous, prismatic
            and fixed joints.

    Returns:
        The reflected URDF.

    Raises:
        HandError: If the text is no URDF, or holds a mesh (its file cannot be reflected here) or
            another kind of joint.
    """
    robot = parse_urdf(text)
    for geometry in robot.iter("geometry"):
        for shape in geometry:
            if shape.tag not in _PRIMITIVES:
                raise HandError(
                    f"a hand can be mirrored only if its shapes are primitives, not <{shape.tag}>",
                    value=shape.tag,
                )
    for origin in robot.iter("origin"):
        _reflect(origin, "xyz", (-1.0, 1.0, 1.0))
        # M Rz(y) Ry(p) Rx(r) M = Rz(-y) Ry(-p) Rx(r): rotations about the mirror's normal stay, the
        # others turn round.
        _reflect(origin, "rpy", (1.0, -1.0, -1.0))
    for inertia in robot.iter("inertia"):
        for key in ("ixy", "ixz"):
            _reflect(inertia, key, (-1.0,))
    for joint in robot.iterfind("joint"):
        _reflect_axis(joint)
    return ET.tostring(robot, encoding="unicode")


def _reflect(element: ET.Element, key: str, signs: tuple[float, ...]) -> None:
    if key in element.attrib:
        values = get_numbers(element, key, len(signs))
        set_numbers(element, key, [sign * value for sign, value in zip(signs, values, strict=True)])


def _reflect_axis(joint: ET.Element) -> None:
    kind = joint.get("type", "")
    if kind == "fixed":
        return
    if kind not in _AXIS_SIGNS:
        raise HandError(
            f"a {kind or 'nameless'} joint cannot be mirrored", key=joint.get("name"), value=kind
        )
    axis = joint.find("axis")
    if axis is None:
        # URDF's default axis is x, which the mirror turns round on a prismatic joint.
        axis = ET.SubElement(joint, "axis", {"xyz": "1 0 0"})
    _reflect(axis, "xyz", _AXIS_SIGNS[kind])
