"""Name all fingers of a description at once, drop some, and add chains that were left out."""

from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from msgspec.structs import replace

from handmap_core.errors import HandError, expect
from handmap_qp.hands import (
    FINGERS,
    THUMB,
    Hand,
    HandSpec,
    PointSpec,
    finger_tips,
    urdf_path,
)
from .robot import Robot
from .structure import RobotFinger

T = TypeVar("T")
# The middle joint of a thumb has another name than that of a finger.
_KINDS = {"ip": "pip", "pip": "ip"}


def with_names(hand: Hand, names: Mapping[str, str | None]) -> HandSpec:
    """Return a hand with its fingers named by the links of their tips, all at once.

    A finger that is dropped keeps its joints at rest, locked. A chain of `left_out` is added with
    its fingertip, and its joints are no longer locked.

    Args:
        hand: The hand.
        names: Name of the finger by its tip's link; None drops it. Other fingers keep theirs.

    Raises:
        HandError: If the description cannot be loaded.
        InvalidInputError: If two fingers have one name, none would be the thumb, or a link ends no
            chain of the palm.
    """
    tips = all_tips(hand)
    now = {tip.link: finger for finger, tip in tips.items()}
    every: dict[str, str | None] = {**now, **names}
    given = [name for name in every.values() if name is not None]
    twice = sorted({name for name in given if given.count(name) > 1})
    expect(not twice, "fingers", "each name once", got=", ".join(twice))
    has_thumb = THUMB in given or THUMB not in tips
    advice = "call another finger the thumb"
    expect(has_thumb, "finger", "one that is the thumb", got="none", advice=advice)
    spec = _renamed(hand.spec, {old: every[link] for link, old in now.items()})
    dropped = [old for link, old in now.items() if every[link] is None]
    if dropped:
        spec = _with_locked(hand, spec, dropped)
    added = {
        link: name
        for link, name in every.items()
        if name is not None and link not in now
    }
    if not added:
        return spec
    chains = left_out(hand.spec)
    for link, name in added.items():
        expect(link in chains, "fingers", "links that end a chain", got=link)
        spec = _with_chain(spec, chains[link], name)
    return spec


def exchanged(hand: Hand, finger: str, name: str) -> dict[str, str | None]:
    """Return names by tip's link in which a finger is renamed, and another one takes its name."""
    tips = all_tips(hand)
    both = {finger: name, name: finger}
    return {tips[old].link: new for old, new in both.items() if old in tips}


def all_tips(hand: Hand) -> dict[str, PointSpec]:
    """Return the point at each finger's tip by its name, additional fingers last."""
    more = {
        point.finger: point
        for point in reversed(hand.spec.points)
        if point.finger and point.finger not in FINGERS
    }
    return finger_tips(hand) | more


def left_out(spec: HandSpec) -> dict[str, RobotFinger]:
    """Return the chains of the palm that end in no fingertip, by the link of their own tip.

    There are none of a mirrored hand, and of a palm that the URDF lacks.
    """
    if spec.mirror:
        return {}
    try:
        robot = Robot(urdf_path(spec), root=spec.root)
    except HandError:
        return {}
    if spec.palm.link not in robot.frames:
        return {}
    body = robot.frames[spec.palm.link].parentJoint
    ends = {
        robot.frames[point.link].parentJoint
        for point in spec.points
        if point.link in robot.frames
    }
    chains = (
        RobotFinger(robot, leaf, body) for leaf in robot.leaves(body) if leaf != body
    )
    return {each.end.answer: each for each in chains if ends.isdisjoint(each.joints)}


def _renamed(spec: HandSpec, names: Mapping[str, str | None]) -> HandSpec:
    """Return a description whose points and sets follow the names of fingers; None drops one."""
    called: dict[str, str] = {}
    points: list[PointSpec] = []
    for point in spec.points:
        old = point.finger
        if old is None or old not in names:
            points.append(point)
            continue
        new = names[old]
        if new is None:
            continue
        name = _called(point.name, old, new)
        partner = point.partner and _partner(point.partner, old, new)
        if partner is None and new not in FINGERS:
            partner = f"little_{name.rpartition('_')[2]}"
        called[point.name] = name
        points.append(replace(point, name=name, finger=new, partner=partner))
    gone = {point.name for point in spec.points if point.finger in names} - {*called}
    sets = {
        key: tuple(called.get(name, name) for name in members if name not in gone)
        for key, members in spec.sets.items()
    }
    kept = {key: members for key, members in sets.items() if members}
    return replace(spec, points=tuple(points), sets=kept)


def _called(text: str, old: str, new: str) -> str:
    """Return the name of a point of a finger after it was renamed."""
    stem, _, kind = text.partition("_")
    if stem != old:
        return text
    if (old == THUMB) != (new == THUMB):
        kind = _KINDS.get(kind, kind)
    return f"{new}_{kind}"


def _partner(text: str, old: str, new: str) -> str | None:
    """Return the human partner of a renamed point; None if it is that of its name."""
    stem, _, _ = text.partition("_")
    if old not in FINGERS and new in FINGERS:
        return None
    return _called(text, old, new) if stem == old else text


def _with_locked(hand: Hand, spec: HandSpec, dropped: list[str]) -> HandSpec:
    """Return a description with the joints locked at rest that only dropped fingers have."""
    tips = all_tips(hand)
    frames = {name: hand.frames[tip.link] for name, tip in tips.items()}
    moves = {name: hand.carries(frame) for name, frame in frames.items()}
    used = [moves[name] for name in tips if name not in dropped]
    is_used = np.any([hand.carries(hand.palm_frame), *used], axis=0)
    is_lost = np.any([moves[name] for name in dropped], axis=0) & ~is_used
    columns = np.flatnonzero(is_lost)
    # An arm is no part of a finger.
    still = {
        hand.joint_names[i]: round(float(hand.rest[i]), 6)
        for i in columns
        if hand.joint_names[i] in spec.joints
    }
    expect(len(still) < len(spec.joints), "fingers", "one that moves", got="none")
    supports = hand.model.supports
    ways = {name: {*supports[frame.parentJoint]} for name, frame in frames.items()}
    bodies = set[int]().union(*(ways[name] for name in dropped))
    bodies -= {*supports[hand.palm_frame.parentJoint]}
    bodies = bodies.difference(*(ways[name] for name in tips if name not in dropped))
    collision = spec.collision
    if collision:
        pairs = tuple(
            pair
            for pair in collision.pairs
            if not any(hand.frames[link].parentJoint in bodies for link in pair)
        )
        collision = replace(collision, pairs=pairs) if pairs else None
    neutral = spec.neutral_match
    return replace(
        spec,
        joints=tuple(joint for joint in spec.joints if joint not in still),
        rest=_without(spec.rest, still),
        limits=_without(spec.limits, still),
        joint_weights=_without(spec.joint_weights, still),
        neutral_match=neutral and _without(neutral, still),
        locked={**spec.locked, **still},
        collision=collision,
    )


def _without(values: Mapping[str, T], names: Mapping[str, float]) -> dict[str, T]:
    return {key: value for key, value in values.items() if key not in names}


def _with_chain(spec: HandSpec, finger: RobotFinger, name: str) -> HandSpec:
    """Return a description with one more finger."""
    robot = finger.robot
    joints = [joint for joint in finger.drivers if joint not in spec.all_joints]
    start = robot.positions(robot.rest)
    rest = {joint: spec.locked.get(joint, start[joint]) for joint in joints}
    x, y, z = (np.round(finger.xyz, 4) + 0.0).tolist()
    partner = None if name in FINGERS else "little_tip"
    tip = PointSpec(f"{name}_tip", finger.end.answer, (x, y, z), name, partner=partner)
    last = sum(point.name.endswith("_tip") for point in spec.points)
    sets = {
        key: (*members, tip.name)
        if any(member.endswith("_tip") for member in members)
        else members
        for key, members in spec.sets.items()
    }
    return replace(
        spec,
        points=(*spec.points[:last], tip, *spec.points[last:]),
        sets=sets,
        joints=(*spec.joints, *joints),
        rest={**spec.rest, **rest},
        neutral_match=None,
        limits=spec.limits
        | {
            joint: robot.spec.limits[joint]
            for joint in joints
            if joint in robot.spec.limits
        },
        mimic=spec.mimic
        | {
            joint: robot.spec.mimic[joint]
            for joint in joints
            if joint in robot.spec.mimic
        },
        locked={key: at for key, at in spec.locked.items() if key not in joints},
    )
