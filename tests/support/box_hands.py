"""Hands and jaws of boxes with known palm and side: plain fingers along an axis, as URDFs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

NAMES = ("thumb", "index", "middle", "ring", "little")
# Distal, radial of a right hand, and dorsal.
_AXES = np.eye(3)


def turns() -> Iterator[np.ndarray]:
    """Yield all 24 rotations of the axes to axes, shape (3, 3)."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = _AXES[list(order)] * signs
            if np.linalg.det(turn) > 0.0:
                yield turn


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxHand:
    """A hand whose fingers are rows of boxes along its x axis; z is dorsal.

    Attributes:
        names: Name of each finger, which its links and joints begin with; the thumb is the first.
        palm: Name of the palm's link.
        joints: Joints of each finger.
        span: Range of each joint in flexion [rad].
        sense: Sense of the joints' axes: -1 for joints that flex towards negative positions.
        turn: Rotation of the hand in its palm's frame, shape (3, 3).
        is_left: Whether it is a left hand.
        thumb: Place of the thumb's joint [m].
    """

    names: tuple[str, ...] = NAMES
    palm: str = "palm"
    joints: int = 2
    span: tuple[float, float] = (0.0, 1.2)
    sense: float = 1.0
    turn: np.ndarray
    is_left: bool = False
    thumb: tuple[float, float, float] = (0.02, 0.05, -0.01)

    def parts(self) -> str:
        """Return its links and joints, without the robot around them."""
        side = -1.0 if self.is_left else 1.0
        row = [(0.09, 0.05 - 0.02 * k, 0.0) for k in range(1, len(self.names))]
        places = (self.thumb, *row)
        fingers = (
            self._finger(name, np.array(place) * [1.0, side, 1.0])
            for name, place in zip(self.names, places, strict=True)
        )
        shape = self._box((0.045, 0.0, 0.0), (0.09, 0.08, 0.02))
        return f'<link name="{self.palm}">{shape}</link>' + "".join(fingers)

    def urdf(self, name: str = "x") -> str:
        """Return a URDF of this hand alone."""
        return f'<robot name="{name}">{self.parts()}</robot>'

    def _finger(self, name: str, place: np.ndarray) -> str:
        size = 0.08 / self.joints
        text, parent = "", self.palm
        limits = sorted(self.sense * end for end in self.span)
        for k in range(self.joints):
            link = f"{name}_{k}"
            shape = self._box((0.5 * size, 0.0, 0.0), (size, 0.014, 0.014))
            text += (
                f'<link name="{link}">{shape}</link><joint name="{link}_joint" type="revolute">'
                f'<parent link="{parent}"/><child link="{link}"/>'
                f'<origin xyz="{self._turned(place)}"/>'
                f'<axis xyz="{self._turned((0.0, self.sense, 0.0))}"/>'
                f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="1" velocity="2"/></joint>'
            )
            parent, place = link, np.array([size, 0.0, 0.0])
        return text

    def _turned(self, vector: np.ndarray | tuple[float, ...]) -> str:
        return " ".join(f"{number:g}" for number in self.turn @ np.array(vector) + 0.0)

    def _box(self, centre: tuple[float, ...], size: tuple[float, ...]) -> str:
        sides = " ".join(f"{side:g}" for side in np.abs(self.turn) @ np.array(size))
        return (
            f'<visual><origin xyz="{self._turned(centre)}"/><geometry><box size="{sides}"/>'
            "</geometry></visual>"
        )


def pair_against_one(
    gap: float = 0.03,
    span: tuple[float, float] = (0.0, 0.5),
    sense: float = 1.0,
    lean: float = 0.0,
) -> str:
    """Return a URDF of two jaws beside each other, `ja` and `jb`, against a third one, `jc`.

    They are boxes along x, which close along z.

    Args:
        gap: Height of their joints over the middle [m].
        span: Range of each joint; they close towards positive positions [rad].
        sense: -1 for joints that open towards positive positions.
        lean: Angle by which each jaw leans to the middle at zero [rad].
    """
    parts = '<link name="base"/>'
    for name, y, z in (("a", 0.02, gap), ("b", -0.02, gap), ("c", 0.0, -gap)):
        parts += (
            f'<link name="{name}"><visual><origin xyz=".04 0 0"/><geometry>'
            f'<box size=".08 .02 .01"/></geometry></visual></link>'
            f'<joint name="j{name}" type="revolute"><parent link="base"/><child link="{name}"/>'
            f'<origin xyz=".05 {y} {z}" rpy="0 {np.sign(z) * lean} 0"/>'
            f'<axis xyz="0 {sense * np.sign(z)} 0"/>'
            f'<limit lower="{span[0]}" upper="{span[1]}" effort="1" velocity="2"/></joint>'
        )
    return f'<robot name="x">{parts}</robot>'


def slides_without_shapes(
    turn: np.ndarray = _AXES, arm: str = "", base: str = "base"
) -> str:
    """Return a URDF of two jaws on slides along y, `ja` and `jb`, whose meshes are not there.

    They begin beside the palm's z axis, which is ahead: their places do not tell it.

    Args:
        turn: Rotation of all frames, shape (3, 3).
        arm: Links and joints that carry the palm, in place of none.
        base: The palm's link.
    """

    def turned(*values: float) -> str:
        return " ".join(f"{value:g}" for value in turn @ np.array(values) + 0.0)

    parts = arm or f'<link name="{base}"/>'
    for name, sign in (("a", 1.0), ("b", -1.0)):
        parts += (
            f'<link name="{name}"><visual><geometry><mesh filename="lost_{name}.stl"/></geometry>'
            f'</visual></link><joint name="j{name}" type="prismatic"><parent link="{base}"/>'
            f'<child link="{name}"/><origin xyz="{turned(-0.02, sign * 0.01, 0.03)}"/>'
            f'<axis xyz="{turned(0.0, -sign, 0.0)}"/>'
            '<limit lower="-0.04" upper="0" effort="1" velocity="1"/></joint>'
        )
    return f'<robot name="x">{parts}</robot>'
