"""Corrections of a hand's description: each takes a hand, and returns its new description."""

from collections.abc import Collection
from contextlib import suppress
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from handmap_core.errors import HandError
from handmap_core.se3 import Array
from handmap_qp.hands import (
    OTHER_SIDE,
    THUMB,
    Hand,
    HandSpec,
    ends_of,
    find_fingers,
    finger_tips,
    load_hand,
    urdf_path,
)
from .check import check_places, check_shapes, check_speeds
from .collision_pairs import colliding_links, with_collision_pairs
from .detect import REST_MOST, REST_SHARE, Detection, detect
from .findings import HandReport, warning
from .measure import check_fist
from .speeds import with_origin
from .write import FOUND, RobotSource


def open_description(hand: str | Path | HandSpec) -> Detection:
    """Load a description, and detect the same hand for its evidence; errors as in `load_hand`."""
    built = load_hand(hand)
    spec = built.spec
    if not finger_tips(built):
        raise spec.error("no point names its finger", "points")
    found = Detection(spec, (), (), {})
    # A description may be of a hand that the detection does not find.
    with suppress(HandError):
        found = detect(urdf_path(spec), root=spec.wrist.link)
        found = with_collision_pairs(found, built).doubted(check_fist(built))
        found = found._replace(notes=(*found.notes, *_wrong(built)))
    return corrected(found, spec)


def described(found: Detection, source: RobotSource) -> Detection:
    """Complete a hand found in a file: a free thumb at rest, pairs of links, doubts, and notes."""
    spec = replace(found.spec, urdf=source.reference)
    spec = with_origin(spec, source.speeds)
    hand = load_hand(spec)
    way = ~hand.moves_wrist * (hand.zero - hand.rest)
    postures = hand.rest + np.linspace(0.0, 1.0, 5)[:, None] * way
    doubts = [*check_fist(hand)]
    # A hand of one finger has none.
    thumb = [finger.own for name, finger in find_fingers(hand).items() if name == THUMB]
    own = {*chain(*thumb)}

    def is_free(q: Array) -> bool:
        met = chain(*colliding_links(hand, q)) if own else ()
        return not any(hand.frames[link].parentJoint in own for link in met)

    with suppress(HandError):
        if ((q := next(filter(is_free, postures), hand.rest)) != hand.rest).any():
            what = "the thumb met links there: it is nearer to zero"
            doubts.append(warning("rest", what, "look at it"))
            hand = load_hand(with_rest(hand, q))
    found = with_collision_pairs(found._replace(spec=hand.spec), hand)
    notes = (*source.notes, *found.notes, *_wrong(hand))
    return found.doubted(doubts)._replace(notes=notes)


def _wrong(hand: Hand) -> list[str]:
    """Return a note for each finding about speeds and shapes that says what to change."""
    report = HandReport("")
    for check in (check_speeds, check_shapes):
        report.add(check(hand))
    return [f"{f.key}: {f.text}: {f.change}" for f in report.findings if f.change]


def corrected(found: Detection, spec: HandSpec, *known: str) -> Detection:
    """Return a detection with another description, and the evidence for what stays the same.

    Evidence with the names `known` is left out too. Chains stay if the fingertips are the same, the
    next hypothesis if palm and side are too.
    """
    before, after = map(_values, (found.spec, spec))
    clues = tuple(
        clue
        for clue in found.clues
        if clue.what not in known and before.get(clue.what) == after.get(clue.what)
    )
    chains = found.chains if before.keys() == after.keys() else {}
    is_same = chains and (spec.palm, spec.side) == (found.spec.palm, found.spec.side)
    runner_up = found.runner_up if is_same else None
    return found._replace(spec=spec, clues=clues, chains=chains, runner_up=runner_up)


def with_other_side(hand: Hand) -> HandSpec:
    """Return a left hand as a right one, and a right one as a left one."""
    return replace(hand.spec, side=OTHER_SIDE[hand.side])


def with_palm_turned(hand: Hand) -> HandSpec:
    """Return a hand whose back is where its palm was.

    Joints that curl a finger equally far both ways then rest as far to the other side.
    """
    q = hand.rest
    for finger in find_fingers(hand).values():
        flexion = finger.flexion
        if flexion and flexion.sense == 0.0:
            q = np.where(flexion.signs, 2.0 * flexion.straight - q, q)
    spec = with_rest(hand, q)
    dorsal = 0.0 - np.array(spec.palm.dorsal)
    return replace(spec, palm=replace(spec.palm, dorsal=dorsal))


def with_other_palm(hand: Hand) -> HandSpec:
    """Return the other hand that the thumb's place allows: turned over, of the other side."""
    return with_other_side(load_hand(with_palm_turned(hand)))


def with_rest(hand: Hand, q: Array) -> HandSpec:
    """Return a hand that rests at joint angles q [rad or m], shape (n,), rounded to 1e-4."""
    joints = hand.spec.joints
    # Joints of an arm come first.
    inside = np.clip(q.round(4) + 0.0, *hand.limits)[-len(joints) :]
    return replace(hand.spec, rest=dict(zip(joints, inside, strict=True)))


def with_bend_reversed(hand: Hand, names: Collection[str]) -> HandSpec:
    """Return a hand whose fingers rest half bent to the other side.

    Straight fingers bend to the side to which they close. Jaws, which do not curl, rest as far from
    the other end of their range.

    Args:
        hand: The hand.
        names: The fingers; a joint that moves several of them is turned once.
    """
    fingers = find_fingers(hand)
    q = hand.rest.copy()
    left = ~hand.moves_wrist
    for finger in (fingers[name] for name in names if name in fingers):
        flexion = finger.flexion
        if flexion and flexion.curls:
            turned = left & (flexion.signs != 0.0)
            side = np.sign(flexion.signs @ (hand.rest - flexion.straight))
            senses = -side * flexion.signs if side else finger.closing
            _, ends = ends_of(hand, flexion.straight, senses)
            step = REST_SHARE * (ends - flexion.straight)
            there = flexion.straight + np.clip(step, -REST_MOST, REST_MOST)
        else:
            turned = left & finger.moves
            there = hand.limits.sum(axis=0) - hand.rest
        q = np.where(turned, there, q)
        left &= ~turned
    return with_rest(hand, q)


def with_tip(hand: Hand, finger: str, xyz: Array) -> HandSpec:
    """Return a hand with a fingertip at a place on its link [m], rounded to 0.1 mm.

    Raises:
        HandError: If it is far outside the shape of its link.
    """
    tip = finger_tips(hand)[finger]
    place = np.round(xyz, 4) + 0.0
    points = [
        replace(point, xyz=place) if point == tip else point
        for point in hand.spec.points
    ]
    spec = replace(hand.spec, points=points)
    for wrong in check_places(load_hand(spec, points=[tip.name])):
        raise spec.error(wrong.text, wrong.key, place)
    return spec


def _values(spec: HandSpec) -> dict[str, Any]:
    """Return the values of a description by the names of their clues."""
    values = {what: attrgetter(key)(spec) for key, (what, _) in FOUND.items()}
    return values | {point.name: point.xyz for point in spec.points}
