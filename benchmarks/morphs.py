"""Hands between two hands: kinematics that change step by step from one hand's to another's.

Each finger is lines in space, its joints' axes where all joints are at zero, and a tip. A hand
between has lines, tips, limits and rest postures between those of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import pinocchio as pin

from handmap_qp import Hand
from handmap_qp.hands import (
    HandSpec,
    PalmKinematics,
    PalmSpec,
    PointSpec,
    WristSpec,
    find_fingers,
)
from handmap_qp.mapping.hand_pair import HandPair, resting_posture
from handmap_qp.se3 import Array, unit

# Speed of all joints [rad/s], fast enough for every posture here to be reached.
_SPEED = 20.0


class FingerLines(NamedTuple):
    """A finger of k turning joints where all are at zero, in palm axes.

    Attributes:
        axes: Axes of its joints, shape (k, 3).
        places: Point of each axis that is nearest to the tip [m], shape (k, 3).
        tip: The fingertip [m], shape (3,).
        lower: Lower limits [rad], shape (k,).
        upper: Upper limits [rad], shape (k,).
        rest: The rest posture [rad], shape (k,).
    """

    axes: Array
    places: Array
    tip: Array
    lower: Array
    upper: Array
    rest: Array

    def turned_like(self, other: FingerLines) -> FingerLines:
        """Return the same finger, its joints counted in the senses of another finger's.

        Where a knuckle bends before it spreads, the other finger's spreads before it bends:
        the other one's first two axes have changed places then, see `in_order_of`.
        """
        signs = np.where((self.axes * other.axes).sum(axis=1) < 0.0, -1.0, 1.0)
        limits = np.array([self.lower, self.upper]) * signs
        return self._replace(
            axes=signs[:, None] * self.axes,
            lower=limits.min(axis=0),
            upper=limits.max(axis=0),
            rest=signs * self.rest,
        )

    def in_order_of(self, other: FingerLines) -> FingerLines:
        """Return the finger with its first two joints in the order of another finger's.

        The axes of a knuckle meet, so it is nearly the same knuckle.
        """
        kept, swapped = (
            np.abs((self.axes[order] * other.axes[:2]).sum(axis=1)).sum()
            for order in ([0, 1], [1, 0])
        )
        if kept >= swapped:
            return self
        order = [1, 0, *range(2, len(self.axes))]
        lines = (self.axes, self.places)
        ends = (self.lower, self.upper, self.rest)
        return FingerLines(
            *(each[order] for each in lines), self.tip, *(each[order] for each in ends)
        )

    def between(self, other: FingerLines, share: float) -> FingerLines:
        """Return the finger at a share of the way to another one."""
        axes = [
            turn_between(axis, end, share)
            for axis, end in zip(self.axes, other.axes, strict=True)
        ]
        mixed = (
            (1.0 - share) * a + share * b
            for a, b in zip(self[1:], other[1:], strict=True)
        )
        return FingerLines(np.array(axes), *mixed)


def turn_between(start: Array, end: Array, share: float) -> Array:
    """Return the unit vector at a share of the turn from one to another, shape (3,)."""
    normal = np.cross(start, end)
    angle = np.arctan2(np.linalg.norm(normal), start @ end)
    return pin.exp3(share * angle * unit(normal)) @ start if angle > 1e-9 else start


class Morph:
    """Hands between a person's and a robot's, with the fingers that both have.

    Args:
        pair: Both hands. Their fingers have equally many turning joints, each its own.
    """

    def __init__(self, pair: HandPair) -> None:
        self.fingers = pair.fingers
        sides: list[list[FingerLines]] = []
        for hand, posture in (
            (pair.human, resting_posture(pair.human)),
            (pair.measured.hand, pair.matched),
        ):
            sides.append([lines_of(hand, name, posture) for name in pair.fingers])
        persons, robots = sides
        self._pairs = []
        for person, robot in zip(persons, robots, strict=True):
            ordered = person.in_order_of(robot)
            self._pairs.append((ordered, robot.turned_like(ordered)))

    def hand_at(self, share: float) -> Hand:
        """Return the hand at a share of the way, which rests as both do."""
        lines = [person.between(robot, share) for person, robot in self._pairs]
        names = [
            [f"{finger}_{k}" for k in range(len(each.axes))]
            for finger, each in zip(self.fingers, lines, strict=True)
        ]
        tree = Element("robot", name="morph")
        SubElement(tree, "link", name="palm")
        for joints, each in zip(names, lines, strict=True):
            _append_finger(tree, joints, each)
        every = [joint for joints in names for joint in joints]
        rests = [np.clip(each.rest, each.lower, each.upper) for each in lines]
        spec = HandSpec(
            name=f"morph_{share:.3f}",
            urdf="morph.urdf",
            side="right",
            palm=PalmSpec("palm", distal=(0.0, 1.0, 0.0), dorsal=(0.0, 0.0, 1.0)),
            wrist=WristSpec("palm"),
            joints=tuple(every),
            rest=dict(zip(every, np.concatenate(rests), strict=True)),
            points=tuple(
                PointSpec(f"{finger}_tip", f"{joints[-1]}_tip", finger=finger)
                for finger, joints in zip(self.fingers, names, strict=True)
            ),
            sets={"fingertips": tuple(f"{finger}_tip" for finger in self.fingers)},
            reference="fingertips",
        )
        return Hand(spec, urdf_text=tostring(tree, encoding="unicode"))


def lines_of(hand: Hand, name: str, posture: Array) -> FingerLines:
    """Return a finger of a hand that rests in a posture, shape (n,)."""
    chain = find_fingers(hand)[name]
    view = PalmKinematics(hand)
    zero = np.zeros(len(posture))
    axes, places = view.axes(zero, chain.joints, near=chain.tip)
    (tip,) = view.points(zero, [chain.tip])
    columns = [hand.joint_names.index(hand.model.names[j]) for j in chain.joints]
    limits = hand.limits[:, columns]
    return FingerLines(axes, places, tip, *limits, posture[columns])


def _append_finger(tree: Element, joints: Sequence[str], lines: FingerLines) -> None:
    """Append the links and joints of a finger to a URDF, all with the axes of the palm."""
    parent, before = "palm", np.zeros(3)
    for k, (joint, place) in enumerate(zip(joints, lines.places, strict=True)):
        link = f"{joint}_link"
        element = _append_link(tree, joint, "revolute", parent, link, place - before)
        SubElement(element, "axis", xyz=_text(lines.axes[k]))
        limits = {"lower": f"{lines.lower[k]:.9f}", "upper": f"{lines.upper[k]:.9f}"}
        SubElement(element, "limit", limits, velocity=f"{_SPEED}", effort="1")
        parent, before = link, place
    tip = f"{joints[-1]}_tip"
    _append_link(tree, f"{tip}_joint", "fixed", parent, tip, lines.tip - before)


def _append_link(
    tree: Element, joint: str, kind: str, parent: str, link: str, offset: Array
) -> Element:
    """Append a link at an offset from its parent [m], (3,), and return the joint between both."""
    SubElement(tree, "link", name=link)
    element = SubElement(tree, "joint", name=joint, type=kind)
    SubElement(element, "parent", link=parent)
    SubElement(element, "child", link=link)
    SubElement(element, "origin", xyz=_text(offset))
    return element


def _text(vector: Array) -> str:
    return " ".join(f"{x:.9f}" for x in vector)
