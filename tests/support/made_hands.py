"""Robot hands of random anatomy with known palm, side and fingers, as URDFs.

Base frames are rotated at random. Fingers have an abduction joint before, behind or without the
knuckle, two to five flexing joints, and joint origins anywhere along their axes. Ranges are
one-sided or symmetric. Names are anatomical or absent. `ODDITIES` are hands that a laboratory may
well have, and that show less or something else than these.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from handmap_qp.se3 import rpy_from_rotation

FINGERS = ("index", "middle", "ring", "little", "finger6")
ODDITIES = {
    "shuffled": "fingers in any order of the file, names that only count",
    "six": "six fingers, no names",
    "two": "thumb and one finger, no names",
    "no tips": "no frames at the fingertips, no shapes, no names",
    "bent zero": "the zero position is half a fist",
    "curved": "phalanges bent towards the palm, which cannot be stretched",
    "coupled": "every finger's joints follow its first one",
    "wrist": "two wrist joints above the palm",
    "slides": "every finger on a slide along its direction",
    "wrong names": "names of the other side, as in a copied file",
    "side by side": "a thumb like the fingers and beside them, no names",
    "far origin": "the palm's origin up to 0.17 m from the wrist, no names",
    "degrees": "limits in degrees, no names",
    "opposed": "a thumb that faces the fingers from the other side, no names",
}
"""Kinds of `make_odd_hand`, and what they are."""
# Bend from phalanx to phalanx of curved fingers [rad].
_CURVE = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class MadeHand:
    """A URDF and the truth about it.

    Attributes:
        urdf: The text.
        distal: Direction of the straight fingers, in the frame of the link `palm_link`, shape (3,).
        dorsal: Direction out of the back of the hand there, shape (3,).
        side: `right` or `left`.
        tips: Link of each fingertip by anatomical name.
        palm: Name of the palm's link.
        has_names: Whether links and joints have anatomical names.
        is_one_sided: Whether the ranges show where fingers flex.
    """

    urdf: str
    distal: np.ndarray
    dorsal: np.ndarray
    side: Literal["right", "left"]
    tips: dict[str, str]
    palm: str
    has_names: bool
    is_one_sided: bool


@dataclass(slots=True)
class _Finger:
    name: str
    base: np.ndarray
    direction: np.ndarray
    axis: np.ndarray
    lengths: list[float]
    abducts: str
    opposes: bool


def make_odd_hand(generator: np.random.Generator, kind: str) -> MadeHand:
    """Make a hand of a kind of `ODDITIES`."""
    return make_hand(generator, kind)


def make_hand(generator: np.random.Generator, kind: str = "") -> MadeHand:
    """Make a hand.

    In the hand's own axes x points across to the right side seen from the back, y distal, and z
    dorsal; the thumb of a right hand is at -x.
    """
    side: Literal["right", "left"] = "right" if generator.random() < 0.5 else "left"
    has_names = bool(generator.random() < 0.5)
    is_one_sided = bool(generator.random() < 0.75)
    radial = -1.0 if side == "right" else 1.0
    size = generator.uniform(0.7, 1.8)
    count = int(generator.integers(2, 5))
    abducts = str(generator.choice(["none", "before", "behind"]))
    flexing = int(generator.integers(2, 5))
    if kind:
        has_names, is_one_sided = kind in ("wrist", "wrong names", "slides"), True
        count = {"six": 5, "two": 1}.get(kind, count)
    fingers = [_thumb(generator, radial, size)]
    for i in range(count):
        place = radial * (0.5 * (count - 1) - i) * generator.uniform(0.018, 0.024)
        splay = radial * (0.5 * (count - 1) - i) * generator.uniform(0.0, 0.08)
        fingers.append(
            _Finger(
                FINGERS[i],
                size * np.array([place, generator.uniform(0.085, 0.095), 0.0]),
                np.array([np.sin(splay), np.cos(splay), 0.0]),
                np.array([-np.cos(splay), np.sin(splay), 0.0]),
                [size * generator.uniform(0.07, 0.1) / flexing] * flexing,
                abducts,
                False,
            )
        )
    if kind == "side by side":
        first = fingers[1]
        at = first.base + size * np.array([0.03 * radial, -0.005, 0.0])
        fingers[0] = replace(first, name="thumb", base=at)
    if kind == "opposed":
        first = fingers[1]
        at = size * np.array([0.0, 0.09, -0.1])
        fingers[0] = replace(first, name="thumb", base=at, axis=-first.axis)
    turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    named = side if kind != "wrong names" else "left" if side == "right" else "right"
    prefix = f"{named}_" if has_names else ""
    writer = _Writer(generator, turn, prefix, has_names, is_one_sided, kind)
    order = (
        generator.permutation(len(fingers))
        if kind == "shuffled"
        else range(len(fingers))
    )
    for i in order:
        writer.add(fingers[i])
    return MadeHand(
        writer.text(),
        turn @ np.array([0.0, 1.0, 0.0]),
        turn @ np.array([0.0, 0.0, 1.0]),
        side,
        writer.tips,
        writer.palm,
        has_names,
        is_one_sided,
    )


def _thumb(generator: np.random.Generator, radial: float, size: float) -> _Finger:
    """A thumb at the radial side, that points radially and distally, and opposes."""
    direction = np.array(
        [radial * generator.uniform(0.6, 1.0), generator.uniform(0.5, 0.9), -0.2]
    )
    direction /= np.linalg.norm(direction)
    # It bends across the palm and towards the palmar side.
    towards = np.array([-radial, 0.2, -0.8])
    axis = np.cross(direction, towards)
    return _Finger(
        "thumb",
        size * np.array([radial * generator.uniform(0.02, 0.035), 0.03, -0.005]),
        direction,
        axis / np.linalg.norm(axis),
        [size * length for length in (0.035, 0.03, 0.025)],
        "none",
        True,
    )


class _Writer:
    """Writes fingers, given in the hand's axes, as links and joints with rotated frames."""

    def __init__(
        self,
        generator: np.random.Generator,
        turn: np.ndarray,
        prefix: str,
        has_names: bool,
        is_one_sided: bool,
        kind: str = "",
    ) -> None:
        self._kind, self._count = kind, 0
        self._origin = np.zeros(3)
        if kind == "far origin":
            self._origin = generator.uniform(-0.1, 0.1, 3)
        self._generator, self._turn = generator, turn
        self._prefix, self._has_names = prefix, has_names
        self._is_one_sided = is_one_sided
        self._numbers = iter(generator.permutation(1000).tolist())
        self.palm = f"{prefix}palm" if has_names else "n1000"
        self._parts = [f'<link name="{self.palm}"/>']
        self.tips: dict[str, str] = {}

    def add(self, finger: _Finger) -> None:
        """Add a finger: joints from the palm outwards, and a frame at its tip."""
        lateral = np.cross(finger.direction, finger.axis)
        # Each phalanx of a curved finger is bent about the flexion axis.
        curve = _CURVE if self._kind == "curved" else 0.0
        ways = [
            _bent(finger.direction, finger.axis, k * curve)
            for k in range(len(finger.lengths))
        ]
        steps = [length * way for length, way in zip(finger.lengths, ways, strict=True)]
        joints: list[tuple[np.ndarray, str]] = [(finger.axis, "flex")] * len(
            finger.lengths
        )
        places = [
            finger.base + np.sum(steps[:k], axis=0) for k in range(len(finger.lengths))
        ]
        tip = finger.base + np.sum(steps, axis=0)
        if finger.opposes:
            joints.insert(0, (finger.direction * 0.3 + lateral * 0.95, "oppose"))
            places.insert(0, finger.base)
        if finger.abducts != "none":
            at = 0 if finger.abducts == "before" else 1
            joints.insert(at, (lateral, "abduct"))
            places.insert(
                at, finger.base + (0.15 * finger.lengths[0] * finger.direction) * at
            )
        if self._kind == "slides":
            joints.insert(0, (finger.direction, "slide"))
            places.insert(0, finger.base)
        parent, frame, origin = self.palm, self._turn, self._origin
        self._leader: tuple[str, float] | None = None
        for k, ((axis, kind), place) in enumerate(zip(joints, places, strict=True)):
            axis = axis / np.linalg.norm(axis)
            # The origin of a joint is anywhere on its axis.
            place = place + self._generator.uniform(-0.01, 0.01) * axis
            parent, frame, origin = self._joint(
                finger.name,
                k,
                kind,
                axis,
                place,
                parent,
                frame,
                origin,
                len(finger.lengths),
            )
        if self._kind == "no tips":
            self.tips[finger.name] = parent
            return
        self.tips[finger.name] = self._name(finger.name, "tip")
        xyz = frame @ (tip - origin)
        self._fixed(parent, self.tips[finger.name], xyz)

    def _joint(
        self,
        finger: str,
        k: int,
        kind: str,
        axis: np.ndarray,
        place: np.ndarray,
        parent: str,
        frame: np.ndarray,
        origin: np.ndarray,
        flexing: int,
    ) -> tuple[str, np.ndarray, np.ndarray]:
        """Add one joint; `frame` turns the hand's axes into the parent link's."""
        turned = np.linalg.qr(self._generator.normal(size=(3, 3)))[0]
        turned *= np.sign(np.linalg.det(turned))
        child = self._name(finger, f"link_{k}")
        rotation = frame @ turned.T
        xyz = frame @ (place - origin)
        sense = 1.0 if self._generator.random() < 0.5 else -1.0
        own = sense * (turned @ axis)
        lower, upper = self._range(kind, flexing)
        mimic = ""
        if self._kind == "bent zero" and kind == "flex":
            # At zero the link is turned by half of its range.
            half = 0.5 * upper
            lower, upper = lower - half, upper - half
            rotation = rotation @ _rotation(turned @ axis, half)
        if sense < 0.0:
            lower, upper = -upper, -lower
        if self._kind == "degrees":
            lower, upper = np.degrees(lower), np.degrees(upper)
        text = " ".join(f"{value:.9f}" for value in xyz)
        angles = " ".join(f"{value:.9f}" for value in rpy_from_rotation(rotation))
        about = " ".join(f"{value:.9f}" for value in own)
        name = self._name(finger, f"joint_{k}")
        if self._kind == "coupled" and kind == "flex":
            if self._leader is None:
                self._leader = (name, sense)
            else:
                leader, other = self._leader
                mimic = f'<mimic joint="{leader}" multiplier="{sense * other:.1f}"/>'
        moves = "prismatic" if kind == "slide" else "revolute"
        self._parts.append(
            f'<link name="{child}"/><joint name="{name}" type="{moves}">{mimic}'
            f'<parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{text}" rpy="{angles}"/><axis xyz="{about}"/>'
            f'<limit lower="{lower:.4f}" upper="{upper:.4f}" effort="1" velocity="5"/></joint>'
        )
        return child, turned, place

    def _range(self, kind: str, flexing: int) -> tuple[float, float]:
        """Return limits, positive towards the palm."""
        if kind == "abduct":
            side = self._generator.uniform(0.3, 1.05)
            return -side, side
        if kind == "oppose":
            return 0.0, 1.4
        if kind == "slide":
            return 0.0, 0.01
        bend = min(1.9, 4.5 / flexing)
        return (-0.2 / flexing, bend) if self._is_one_sided else (-bend, bend)

    def _fixed(self, parent: str, child: str, xyz: np.ndarray) -> None:
        text = " ".join(f"{value:.9f}" for value in xyz)
        name = f"fix_{child}"
        self._parts.append(
            f'<link name="{child}"/><joint name="{name}" type="fixed"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{text}"/></joint>'
        )

    def _name(self, finger: str, part: str) -> str:
        if self._has_names:
            return f"{self._prefix}{'pinky' if finger == 'little' else finger}_{part}"
        if self._kind == "shuffled":
            self._count += 1
            return f"{'joint' if 'joint' in part else 'link'}_{self._count}"
        return f"n{next(self._numbers)}"

    def text(self) -> str:
        """Return the URDF."""
        parts = [*self._wrist(), *self._parts] if self._kind == "wrist" else self._parts
        return f'<robot name="{self._prefix or "n"}hand">{"".join(parts)}</robot>'

    def _wrist(self) -> list[str]:
        """Return a forearm and two joints above the palm."""
        limit = '<limit lower="-0.6" upper="0.6" effort="1" velocity="2"/>'
        places = ((0.0, 0.0, 0.0), (0.0, -0.03, 0.0))
        links = [f"{self._prefix}forearm", f"{self._prefix}carpus", self.palm]
        parts = [f'<link name="{link}"/>' for link in links[:2]]
        for k, (axis, place) in enumerate(zip(np.eye(3)[[0, 2]], places, strict=True)):
            about = " ".join(f"{value:.9f}" for value in self._turn @ axis)
            xyz = " ".join(f"{value:.9f}" for value in self._turn @ np.array(place))
            parts.append(
                f'<joint name="{self._prefix}wrist_{k}" type="revolute"><parent link="{links[k]}"/>'
                f'<child link="{links[k + 1]}"/><origin xyz="{xyz}"/><axis xyz="{about}"/>{limit}'
                "</joint>"
            )
        return parts


def _bent(direction: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    """Return a direction turned about an axis [rad]."""
    return _rotation(axis / np.linalg.norm(axis), angle) @ direction


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation about a unit axis by an angle [rad] (Rodrigues' formula)."""
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def two_hands_mjcf(mirrored: float = -1.0) -> str:
    """Make a torso on a waist with two arms of two joints, and hands of three fingers.

    Args:
        mirrored: Sign of the right hand's places across the palm: 1 for two left hands.
    """

    def body(name: str, pos: str, axis: str, length: float, inside: str = "") -> str:
        end = f"0 0 {-length}"
        return (
            f'<body name="{name}" pos="{pos}"><joint name="{name}_joint" axis="{axis}" '
            f'range="-0.1 1.5"/><geom type="capsule" size="0.008" fromto="0 0 0 {end}"/>'
            f"{inside}</body>"
        )

    arms = ""
    for side, y, sign in (("left", 0.2, 1.0), ("right", -0.2, mirrored)):
        fingers = ""
        for finger, x, turn in (("thumb", 0.03, "0 1 0"), ("index", -0.03, "0 -1 0"),
                                ("middle", -0.03, "0 -1 0")):  # fmt: skip
            across = {"thumb": 0.0, "index": 0.02, "middle": -0.02}[finger]
            tip = body(f"{side}_{finger}_2", "0 0 -0.04", turn, 0.03)
            place = f"{x} {sign * across} -0.08"
            fingers += body(f"{side}_{finger}_1", place, turn, 0.04, tip)
        palm = body(f"{side}_palm", "0 0 -0.3", "0 0 1", 0.08, fingers)
        arms += body(f"{side}_arm", f"0 {y} 0.4", "1 0 0", 0.3, palm)
    torso = body("torso", "0 0 1", "0 0 1", -0.4, arms)
    return (
        '<mujoco model="two"><compiler angle="radian"/><worldbody>'
        f"{torso}</worldbody></mujoco>"
    )
