"""Hands between two hands: kinematics that change step by step from one hand's to another's.

Each finger is lines in space, its joints' axes where all joints are at zero, and a tip. A hand
between has lines, tips, limits and rest postures between those of both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import pinocchio as pin

from handmap_qp import Hand, HandMapper
from handmap_qp.hands import (
    HandSpec,
    PalmKinematics,
    PalmSpec,
    PointSpec,
    WristSpec,
    find_fingers,
)
from handmap_qp.mapping.hand_pair import (
    HandPair,
    hand_pair,
    points_in_palm,
    resting_posture,
)
from handmap_qp.se3 import Array, lengths, smoothstep, unit

# Speed of all joints [rad/s], fast enough for every posture here to be reached.
_SPEED = 20.0
# Samples in which a posture is reached, and in which the robot comes to rest, of 20 ms each.
_MOVING, _RESTING = 25, 50
_DT = 0.02
# Part of the way from rest to a limit that a joint of the person goes at most.
_FARTHEST = 0.35


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


@dataclass(frozen=True)
class MorphStep:
    """What a hand between two hands does in p postures of the person.

    Attributes:
        share: Share of the way from the person's kinematics to the robot's.
        palms: Likeness of the palms.
        fingers: Likeness of the fingers, the thumb's first, shape (f,).
        directions: Angles between the person's fingers and the hand's, knuckle to tip [deg], shape
            (p, f).
        missed: From each fingertip's place to the fingertip [% of the reach], shape (p, f, 3).
        joints: Joint positions [deg], shape (p, n).
    """

    share: float
    palms: float
    fingers: Array
    directions: Array
    missed: Array
    joints: Array

    @property
    def tips(self) -> Array:
        """Distances of the fingertips from their places [% of the reach], shape (p, f)."""
        return lengths(self.missed)

    def moved_since(self, before: MorphStep) -> Array:
        """Return how far tips went about their places since then [% of the reach], (p, f)."""
        return lengths(self.missed - before.missed)

    def turned_since(self, before: MorphStep) -> Array:
        """Return how far joints turned since another step [deg], shape (p, n)."""
        return np.abs(self.joints - before.joints)


def usual_postures(human: Hand, count: int, seed: int) -> Array:
    """Return random postures about a person's rest, shape (count, n)."""
    rest = resting_posture(human)
    lower, upper = human.limits
    ways = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, len(rest)))
    ranges = np.where(ways > 0.0, upper - rest, rest - lower)
    return rest + _FARTHEST * ways * ranges


def follow_morph(
    human: Hand, robot: Hand, postures: Array, steps: int
) -> Iterator[MorphStep]:
    """Yield what hands do on the way from a person's to a robot's, whose ends come too."""
    morph = Morph(hand_pair(human, robot))
    for share in np.linspace(0.0, 1.0, steps + 1):
        yield shown_by(human, morph.hand_at(float(share)), postures, float(share))


def shown_by(human: Hand, robot: Hand, postures: Array, share: float) -> MorphStep:
    """Let a hand follow a person from rest to each posture, and look at it at rest there."""
    mapper = HandMapper(human, robot, preset="teleoperation")
    pair = hand_pair(human, robot)
    rest = resting_posture(human)
    path = np.append(smoothstep(np.linspace(0.0, 1.0, _MOVING)), np.ones(_RESTING))
    joints = []
    for posture in postures:
        mapper.reset()
        reached = pair.matched
        for part in path:
            shown = rest + part * (posture - rest)
            reached = mapper.map_step(shown, np.eye(4), dt=_DT).command.q
        joints.append(reached)
    count = len(pair.fingers)
    tips = points_in_palm(pair.robot, np.array(joints))[:, :count]
    people = points_in_palm(human, postures) @ pair.palms.turn.T
    places = pair.places_of(people)[:, :count]
    wanted = unit(people[:, pair.tips] - people[:, pair.knuckles])
    cosines = (wanted * unit(tips - pair.robot_bases)).sum(axis=-1)
    return MorphStep(
        share,
        pair.palms.likeness,
        pair.finger_likeness,
        np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))),
        100.0 * (tips - places) / pair.robot_reach[:, None],
        np.degrees(joints),
    )


def draw_morph(steps: Sequence[MorphStep], file: Path) -> None:
    """Draw likeness, errors and the largest turns of joints over the way between both hands."""
    from matplotlib.figure import Figure

    shares = [each.share for each in steps]
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    like, errors, turns = figure.subplots(3, 1, sharex=True)
    like.plot(shares, [each.palms for each in steps], label="palms")
    like.plot(shares, [each.fingers[0] for each in steps], label="thumb")
    like.plot(shares, [each.fingers[1:].min() for each in steps], label="least finger")
    like.set_ylabel("likeness")
    for name, values in (
        ("directions [deg]", [each.directions for each in steps]),
        ("tips [% of reach]", [each.tips for each in steps]),
    ):
        errors.plot(
            shares, [np.median(each) for each in values], label=f"{name}, median"
        )
        errors.plot(shares, [np.percentile(each, 95) for each in values], label="95 %")
    errors.set_ylabel("error")
    for name, values in (
        ("joints [deg]", [b.turned_since(a).max() for a, b in pairwise(steps)]),
        ("tips [% of reach]", [b.moved_since(a).max() for a, b in pairwise(steps)]),
    ):
        turns.plot(shares[1:], values, label=name)
    turns.set_ylabel("most from\nstep to step")
    turns.set_xlabel("share of the way to the robot's kinematics")
    for axes in (like, errors, turns):
        axes.legend(fontsize="small")
    figure.savefig(file)
