"""Turn the palm's axes of a description: the given axes are held, the rest is derived again."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from msgspec.structs import replace

from handmap_core.se3 import Array, inverse_pose, transform_points
from handmap_qp.hands import (
    FINGERS,
    THUMB,
    Finger,
    Hand,
    HandSpec,
    PalmKinematics,
    PalmSpec,
    Side,
    find_fingers,
    load_hand,
)
from .finger_names import named_fingers
from .finger_order import NARROW
from .finger_permutation import with_names

Turn = Literal["x", "y", "z", "dorsal", "distal"]
"""A quarter turn about an axis of the palm, or a half turn that reverses a direction."""
# Quarter turns about the axis with this index.
_TURNS: dict[Turn, tuple[int, int]] = {
    "x": (0, 1),
    "y": (1, 1),
    "z": (2, 1),
    "dorsal": (1, 2),
    "distal": (2, 2),
}
# The thumb is in the middle if it is nearer to it than this, in half widths of the palm.
_CENTRAL = 0.1
# Least half width of a palm, in lengths of the fingers.
_NARROWEST = 0.25
# Share of the knuckle in the place of a finger across the palm; the rest is the tip's.
_KNUCKLE = 0.7
# A dragged axis this near to one of the link's is that one [deg].
_SNAP = 6.0


class Held(NamedTuple):
    """What the user has given: it is not derived again."""

    axes: bool = False
    side: bool = False
    names: bool = False


NOTHING_HELD = Held()


def palm_axes(spec: HandSpec) -> Array:
    """Return the palm's axes in its link's coordinates: across, distal, dorsal; shape (3, 3)."""
    distal = np.array(spec.palm.distal)
    dorsal = np.array(spec.palm.dorsal)
    return np.column_stack([np.cross(distal, dorsal), distal, dorsal])


def turned_axes(axes: Array, turn: Turn) -> Array:
    """Return axes, the columns of a matrix (3, 3), after a turn about one of them."""
    index, quarters = _TURNS[turn]
    quarter = np.zeros((3, 3))
    quarter[index, index] = 1.0
    first, second = (index + 1) % 3, (index + 2) % 3
    quarter[second, first] = 1.0
    quarter[first, second] = -1.0
    return axes @ np.linalg.matrix_power(quarter, quarters) + 0.0


def snapped_axes(axes: Array) -> Array:
    """Return the axes of the palm's link if all of (3, 3) are near to them, else the same axes."""
    nearest = np.abs(axes).argmax(axis=0)
    if len({*nearest.tolist()}) < 3:
        return axes
    link = np.zeros((3, 3))
    link[nearest, range(3)] = np.sign(axes[nearest, range(3)])
    is_near = (axes * link).sum(axis=0) > np.cos(np.radians(_SNAP))
    return link if is_near.all() else axes


def with_turn(hand: Hand, turn: Turn, held: Held = NOTHING_HELD) -> HandSpec:
    """Return a hand whose palm's axes are turned; see `with_palm_axes`."""
    return with_palm_axes(hand, turned_axes(palm_axes(hand.spec), turn), held)


def with_palm_axes(hand: Hand, axes: Array, held: Held = NOTHING_HELD) -> HandSpec:
    """Return a hand with other axes of its palm, and what follows from them.

    The origin stays behind the knuckles. Joints that curl a finger equally far both ways rest on
    the side of the palm. The side follows from the thumb's place, unless that is in the middle, and
    the names of the other fingers from their order, unless links and joints are named by fingers.

    Args:
        hand: The hand.
        axes: Across, distal and dorsal in the palm link's coordinates, the columns of a rotation,
            shape (3, 3).
        held: What is not derived again.
    """
    spec = hand.spec
    before = palm_axes(spec)
    origin = np.array(spec.palm.xyz)
    fingers = find_fingers(hand)
    bases = _knuckles(hand, fingers)
    others = [name for name in fingers if name != THUMB] or [*fingers]
    if np.abs(axes[:, 1] - before[:, 1]).max() > 1e-9:
        middle = before @ np.mean([bases[name] for name in others], axis=0) + origin
        origin = middle + axes @ before.T @ (origin - middle)
    _, distal, dorsal = map(_vector, axes.T, (9, 9, 9))
    palm = replace(spec.palm, distal=distal, dorsal=dorsal, xyz=_vector(origin, 4))
    hand = load_hand(replace(spec, palm=palm))
    hand = load_hand(replace(hand.spec, rest=_rest_to_palm(hand)))
    fingers = find_fingers(hand)
    radial = thumb_side(hand)
    if radial and not held.side:
        side: Side = "right" if radial < 0.0 else "left"
        hand = load_hand(replace(hand.spec, side=side))
    if held.names:
        return hand.spec
    across = radial or (-1.0 if hand.side == "right" else 1.0)
    names = _names_in_order(hand, across)
    return with_names(hand, names) if names else hand.spec


def thumb_side(hand: Hand) -> float:
    """Return to which side of the palm the thumb is: 1 or -1 along its x axis; 0 if central."""
    fingers = find_fingers(hand)
    if THUMB not in fingers or len(fingers) < 2:
        return 0.0
    bases = _knuckles(hand, fingers)
    thumb = bases.pop(THUMB)
    row = np.array([*bases.values()])[:, 0]
    (tip,) = PalmKinematics(hand).points(hand.rest, [fingers[THUMB].tip])
    reach = np.mean([fingers[name].reach for name in bases])
    width = max(0.5 * float(np.ptp(row)), _NARROWEST * float(reach), 1e-6)
    place = (0.5 * (thumb[0] + tip[0]) - row.mean()) / width
    return float(np.sign(place)) if abs(place) > _CENTRAL else 0.0


def _knuckles(hand: Hand, fingers: Mapping[str, Finger]) -> dict[str, Array]:
    """Return the knuckle of each finger at zero in palm axes [m], shape (3,)."""
    places = [finger.knuckle for finger in fingers.values()]
    points = PalmKinematics(hand).points(hand.zero, places)
    return dict(zip(fingers, points, strict=True))


def _rest_to_palm(hand: Hand) -> dict[str, float]:
    """Return the rest posture; fingers that curl equally far both ways rest towards the palm."""
    q = hand.rest.copy()
    view = PalmKinematics(hand)
    for finger in find_fingers(hand).values():
        flexion = finger.flexion
        if flexion is None or flexion.sense != 0.0:
            continue
        curled = np.where(flexion.signs != 0.0, hand.rest, flexion.straight)
        rest, straight = view.points(np.array([curled, flexion.straight]), [finger.tip])
        motion = view.motion(flexion.straight, finger.tip)[2]
        bend = motion @ (curled - flexion.straight)
        if bend > 1e-6 and not np.allclose(rest, straight):
            mirrored = 2.0 * flexion.straight - q
            q = np.where(flexion.signs != 0.0, mirrored, q)
    q = np.clip(q.round(4) + 0.0, *hand.limits)
    joints = hand.spec.joints
    # Joints of an arm come first. A value that stays is kept to its last digit.
    moved = dict(zip(joints, q[-len(joints) :].tolist(), strict=True))
    rest = hand.spec.rest
    return {
        joint: moved[joint] if abs(moved[joint] - rest[joint]) > 1e-4 else rest[joint]
        for joint in joints
    }


def _names_in_order(hand: Hand, radial: float) -> dict[str, str | None]:
    """Return the names of the fingers by their tips' links, in their order across the palm.

    Args:
        hand: The hand.
        radial: The sign of the thumb's side along the palm's x axis.

    Returns:
        Nothing if the order is unclear, or if links and joints are named by fingers.
    """
    fingers = {name: one for name, one in find_fingers(hand).items() if name != THUMB}
    if len(fingers) < 2:
        return {}
    named = hand.model.names
    links = {
        name: [link for link, frame in hand.frames.items() if frame.parentJoint in one.own]
        for name, one in fingers.items()
    }  # fmt: skip
    chains = [
        [*(named[joint] for joint in one.own), *links[name]]
        for name, one in fingers.items()
    ]
    if all(named_fingers(chains)):
        return {}
    bases = _knuckles(hand, fingers)
    view = PalmKinematics(hand)
    tips = view.points(hand.rest, [one.tip for one in fingers.values()])
    places = {
        name: radial * (_KNUCKLE * bases[name][0] + (1.0 - _KNUCKLE) * tip[0])
        for name, tip in zip(fingers, tips, strict=True)
    }
    order = sorted(fingers, key=lambda name: -places[name])
    if -np.diff([places[name] for name in order]).max() < NARROW:
        return {}
    known = [name for name in FINGERS if name in fingers]
    names = [*known, *sorted(fingers.keys() - {*known})]
    tip_links = {
        point.finger: point.link
        for point in hand.spec.points
        if point.name.endswith("_tip")
    }
    return {tip_links[old]: new for old, new in zip(order, names, strict=True)}


def with_palm_link(hand: Hand, link: str) -> HandSpec:
    """Return a hand whose palm is fixed to another link, with the same axes at zero."""
    pose, frame = hand.link_poses([link, hand.spec.palm.link], hand.zero)
    palm = palm_on(hand.spec.palm, link, inverse_pose(pose) @ frame)
    return replace(hand.spec, palm=palm)


def palm_on(palm: PalmSpec, link: str, pose: Array) -> PalmSpec:
    """Return a palm with the same axes on another link.

    Args:
        palm: The palm.
        link: The other link.
        pose: Pose of the palm's link in the other one's frame, shape (4, 4).
    """
    axes = np.array([palm.distal, palm.dorsal]) @ pose[:3, :3].T
    distal, dorsal = map(_vector, axes, (9, 9))
    xyz = _vector(transform_points(pose, np.array(palm.xyz)), 4)
    return replace(palm, link=link, distal=distal, dorsal=dorsal, xyz=xyz)


def _vector(values: Array, digits: int) -> tuple[float, float, float]:
    x, y, z = (np.round(values, digits) + 0.0).tolist()
    return x, y, z
