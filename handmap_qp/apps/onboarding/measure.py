"""Measure a hand: reach, size, fist, pinches, self-collisions, and a standard motion."""

from __future__ import annotations

from itertools import compress, pairwise, product
from statistics import mode
from typing import Any, NamedTuple

import msgspec
import numpy as np

from handmap_qp.apps.onboarding.anatomy import angle_between
from handmap_qp.apps.onboarding.flexion import HandFlexion
from handmap_qp.errors import HandmapError
from handmap_qp.hands.fingers import (
    Finger,
    PalmKinematics,
    find_fingers,
    zero_posture,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS, THUMB
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.pads import Pad, find_pads
from handmap_qp.hands.shape_pairs import random_postures
from handmap_qp.human.recording import upright_axes
from handmap_qp.human.sample import human_name
from handmap_qp.mapping.alignment import rotation_onto
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.method import MapStep
from handmap_qp.se3 import affine, lengths, unit

HUMAN_LENGTH = 0.19
"""Length of a person's hand, from the wrist crease to the middle fingertip [m]."""
# Least singular value of a fingertip's Jacobian that counts as a direction of motion [m/rad].
_LEAST_MOTION = 0.003
_SAMPLES = 200
# Random postures of an arm, directions in which its reach is measured, and cosine of their cones.
_ARM_SAMPLES = 1500
_DIRECTIONS = unit(np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)]))
_CONE = np.cos(np.radians(25.0))
_DT = 1.0 / 60.0
# The axes of `upright_axes`, and those against them.
_WAYS = ("forward", "left", "up", "back", "right", "down")
# Thumb and finger meet in this part of a fist.
_PINCHED = 0.65
# Contacts move a joint aside by more than this part of its range.
_ASIDE = 0.25
# The fingers' planes have a common normal if the mean of these unit vectors is this long.
_COMMON = 0.8
# Random postures in which the search for a pinch starts.
_STARTS = 6
# Surfaces that come this near touch [m].
_TOUCHING = 0.002
# Radius of a pad without shapes [m].
_RADIUS = 0.006


class _Row(msgspec.Struct, rename=lambda name: name.replace("_", " ")):
    """A row of a table, whose columns are its fields."""


class FingerReach(_Row):
    """How the reference point of a finger with the largest span moves.

    Attributes:
        point: Its name.
        span_mm: Largest distance between two positions that it reaches [mm].
        moves_in: Number of directions in which it can move at rest, of three.
        slowest: Smallest singular value of its Jacobian among these directions [mm per rad or m].
        manipulability: Yoshikawa's measure at rest, the product of these singular values
            [(m/rad)^directions].
    """

    point: str
    span_mm: float
    moves_in: str
    slowest: float = msgspec.field(name="slowest direction, mm per rad or m")
    manipulability: str


class Size(NamedTuple):
    """Size of a hand.

    Attributes:
        length: Distance from the palm's origin to the farthest fingertip, with the fingers straight
            or at rest, whichever is longer [m].
        cloud: RMS distance of the fingertips from their mean at rest [m].
        human_cloud: The same for a human hand of length `HUMAN_LENGTH` [m].
    """

    length: float
    cloud: float
    human_cloud: float

    @property
    def ratio(self) -> float:
        """Length of the hand divided by a human hand's."""
        return self.length / HUMAN_LENGTH


class MotionPart(_Row):
    """How well a robot follows one part of the standard motion.

    Attributes:
        posture: What the human hand does.
        worst_point: The point farthest from its target at the end of the part.
        error_mm: Its distance from the target [mm].
        joints_at_a_position_limit: Their names.
    """

    posture: str
    worst_point: str
    error_mm: float
    joints_at_a_position_limit: str


class JointRange(_Row):
    """How far a joint moves in a tour of gestures.

    Attributes:
        joint: Its name.
        without_contacts: Its range without contacts [rad or m].
        with_contacts: Its range with contacts [rad or m].
        held_by: Links that hold the hand most often where contacts move the joint aside.
    """

    joint: str
    without_contacts: float
    with_contacts: float
    held_by: str


class Fist(NamedTuple):
    """Where the fingertips go as the hand closes, in palm axes.

    Attributes:
        across_deg: Angle between the fingers' common axis of flexion and the palm's x axis, 0 in a
            hand whose axes are right, 180 if the fingers close to the back [deg].
        distal_deg: Angle between the mean direction of the stretched fingers and distal [deg].
        fingers: Fingers that close.
    """

    across_deg: float
    distal_deg: float
    fingers: tuple[str, ...]


class Pinch(_Row):
    """How near the thumb's pad comes to a finger's.

    Attributes:
        finger: The finger.
        gap: Smallest distance between the surfaces of both pads [mm]; 0 if they overlap.
        touch: Whether they touch: `yes` or `no`.
    """

    finger: str = msgspec.field(name="thumb and")
    gap: float = msgspec.field(name="nearest, mm between pads")
    touch: str


def measure_reach(hand: Hand) -> list[FingerReach]:
    """Measure reach and manipulability of each finger's reference point with the largest span.

    Args:
        hand: The hand; an arm stays at rest.
    """
    own = ~hand.moves_wrist
    generator = np.random.default_rng(0)
    size = (_SAMPLES, len(hand.rest))
    shares = np.vstack([generator.random(size), generator.integers(0, 2, size)])
    ranges = hand.upper_limits - hand.lower_limits
    postures = np.where(own, hand.lower_limits + shares * ranges, hand.rest)
    places = np.array([hand.points(q) for q in postures])
    gaps = places[:, None] - places[:: max(1, len(places) // 100)]
    spans = 1e3 * lengths(gaps).max(axis=(0, 1))
    jacobians = hand.point_jacobian(hand.rest)[:, own].reshape(len(spans), 3, -1)
    best: dict[str, FingerReach] = {}
    for point, span, jacobian in zip(
        hand.reference_points, spans.tolist(), jacobians, strict=True
    ):
        finger = point.finger
        if finger and (finger not in best or span > best[finger].span_mm):
            motions = np.linalg.svd(jacobian, compute_uv=False)
            motions = motions[motions > _LEAST_MOTION]
            best[finger] = FingerReach(
                point=point.name,
                span_mm=span,
                moves_in=f"{len(motions)} of 3 directions",
                slowest=1e3 * min(motions.tolist(), default=0.0),
                manipulability=f"{motions.prod() * motions.any():.2e}",
            )
    return [*best.values()]


def measure_arm(hand: Hand) -> np.ndarray | None:
    """Measure how far an arm moves the wrist from rest, by random postures.

    Returns:
        Distance that it reaches in each of 26 directions around rest [m]; 0 where rest is at the
        edge of its range. None without an arm.
    """
    if hand.is_floating or not hand.has_moving_wrist:
        return None
    postures = [hand.rest, *random_postures(hand, _ARM_SAMPLES)]
    start, *ends = (hand.frame_pose("wrist", q)[:3, 3] for q in postures)
    moved = np.array(ends) - start
    # In each direction, the farthest wrist within a cone.
    near = _DIRECTIONS @ unit(moved).T > _CONE
    return (near * lengths(moved)).max(axis=1)


def measure_size(hand: Hand) -> Size:
    """Measure the size of a hand relative to a person's.

    Args:
        hand: The hand, with fingertips as reference points.
    """
    human = load_hand("human", points="fingertips", hand_length=HUMAN_LENGTH)
    sizes = [
        lengths(hand.points(q) - hand.frame_pose("palm", q)[:3, 3]).max()
        for q in (hand.rest, zero_posture(hand))
    ]
    clouds = [
        float(np.sqrt(one.points(one.rest).var(axis=0).sum())) for one in (hand, human)
    ]
    return Size(max(sizes), *clouds)


def try_motion(hand: Hand) -> list[MotionPart]:
    """Map a standard motion of a human hand: from rest to each of `standard_postures`."""
    human = load_hand(human_name(hand.side), hand_length=HUMAN_LENGTH)
    rigid = "wrist" if hand.has_moving_wrist else "none"
    # A floating hand can turn as a whole; a hand that is held cannot, and its world's axes need not
    # be the human's.
    alignment = "world" if hand.is_floating else "palm"
    parts = []
    mapper = HandMapper(human, hand, rigid_from=rigid, alignment=alignment, dt=_DT)
    for name, posture in standard_postures(human).items():
        *_, last = _follow(mapper, posture)
        error = last.point_error
        worst = np.argmax(error)
        limited = compress(hand.joint_names, hand.at_position_limit(last.command.q))
        parts.append(
            MotionPart(
                name,
                hand.reference_points[worst].name,
                1e3 * float(error[worst]),
                ", ".join(limited),
            )
        )
    return parts


def measure_directions(
    hand: Hand, upright: str = "+y up, -z forward"
) -> list[dict[str, Any]]:
    """Move a person's hand by 5 cm in six directions, and measure where an arm takes the robot's.

    Args:
        hand: The robot hand.
        upright: The axes of the tracker's world; a headset's if omitted.

    Returns:
        For each direction the robot's nearest one, the angle between both [deg], and how far the
        robot's hand goes in its world [mm]; none without an arm.
    """
    turn = rotation_onto(hand, upright)
    if turn is None:
        return []
    human = load_hand(human_name(hand.side), hand_length=HUMAN_LENGTH)
    mapper = HandMapper(human, hand, alignment=turn, dt=_DT)
    rows = []
    for name, way in zip(_WAYS, [*np.eye(3), *-np.eye(3)], strict=True):
        place = 0.05 * way @ upright_axes(upright)
        q = _follow(mapper, human.rest, place=place)[-1].command.q
        start, end = (hand.frame_pose("palm", each)[:3, 3] for each in (hand.rest, q))
        moved = end - start
        seen = upright_axes(hand.spec.upright) @ moved
        nearest = _WAYS[np.argmax([*seen, *-seen])] if seen.any() else "nowhere"
        rows.append(
            {
                "direction": f"hand {name} -> robot {nearest}",
                "degrees off": round(angle_between(seen, way), 1),
                "robot moved, mm": [*map(round, 1e3 * moved)],
            }
        )
    return rows


def _follow(
    mapper: HandMapper, *postures: np.ndarray, place: np.ndarray | float = 0.0
) -> list[MapStep]:
    """Lead from rest to posture after posture, each in 0.75 s and 0.25 s to settle.

    The wrist moves from the origin to a place with each [m].
    """
    shares = 0.5 - 0.5 * np.cos(np.pi * np.clip(np.arange(60) / 44, 0.0, 1.0))
    mapper.reset()
    return [
        mapper.map_step(
            before + share * (after - before), affine(np.eye(3), share * place)
        )
        for before, after in pairwise([mapper.human.rest, *postures])
        for share in shares
    ]


def tour_gestures(hand: Hand) -> list[JointRange]:
    """Map gestures after one another, two of them from rest each time, with and without contacts.

    Returns:
        The range of each joint; none if the hand's preset avoids no contacts.
    """
    human = load_hand(
        human_name(hand.side), points="landmarks", hand_length=HUMAN_LENGTH
    )
    mapper = HandMapper(human, hand, dt=_DT)
    method: Any = mapper.method
    if not getattr(method, "avoids_contact", False):
        return []
    pairs = gestures(human).reshape(-1, 2, len(human.rest))
    tours = []
    # A detour would lead around what locks.
    plain = mapper.ik.replaced(takes_detours=False)
    for avoids in (False, True):
        mapper.configure(method.replaced(avoids_contact=avoids), ik=plain)
        tours.append([step for pair in pairs for step in _follow(mapper, *pair)])
    q = np.array([[step.command.q for step in tour] for tour in tours])
    ranges = np.ptp(q, axis=1).T
    is_aside = np.abs(q[1] - q[0]) > _ASIDE * ranges[:, 0]
    links = [" and ".join(step.held_by) for step in tours[1]]
    return [
        JointRange(joint, *ends, mode([*filter(None, compress(links, aside)), ""]))
        for joint, ends, aside in zip(
            hand.joint_names, ranges.tolist(), is_aside.T, strict=True
        )
    ]


def gestures(human: Hand) -> np.ndarray:
    """Return gestures: spread fingers, any of them bent, each at the thumb, shape (k, 20)."""
    flat, spread, fist, *_ = standard_postures(human).values()
    fingers = [FINGERS.index(name.partition("_")[0]) for name in human.joint_names]
    each = np.eye(len(FINGERS))
    pinches = _PINCHED * np.maximum(each, each[FINGERS.index(THUMB)])
    bends = np.array([*product((0.0, 1.0), repeat=len(each)), *pinches])
    return np.vstack([spread, flat + bends[:, fingers] * (fist - flat)])


def standard_postures(human: Hand) -> dict[str, np.ndarray]:
    """Return common postures of the human hand, inside its limits [rad], shape (20,) each."""

    def posture(spread: float = 1.0, **flexions: float) -> np.ndarray:
        q = human.rest.copy()
        for i, name in enumerate(human.joint_names):
            finger, _, joint = name.partition("_")
            if finger in flexions and "flexion" in joint:
                share = {"DIP_flexion": 0.8, "IP_flexion": -0.6}.get(joint, 1.0)
                q[i] = share * flexions[finger]
            elif joint == "MCP_abduction":
                q[i] *= spread
        return np.clip(q, human.lower_limits, human.upper_limits)

    fingers = dict.fromkeys(FINGERS[1:], 0.05)
    fist = dict.fromkeys(fingers, 1.4)
    return {
        "flat hand": posture(thumb=0.1, **fingers),
        "spread": posture(thumb=0.0, spread=3.0, **fingers),
        "fist": posture(thumb=0.7, **fist),
        "pointing": posture(thumb=0.7, **{**fist, "index": 0.05}),
        "pinch": posture(thumb=0.6, index=0.9),
    }


def make_fist(hand: Hand) -> Fist | None:
    """Compare the way in which the fingers, but the thumb, close with the palm's axes.

    Returns:
        The directions; None if fewer than two fingers close, or they close about different axes.
    """
    fingers = {
        name: finger
        for name, finger in find_fingers(hand).items()
        if name != THUMB and (found := finger.flexion) and found.curls and found.sense
    }
    if len(fingers) < 2:
        return None
    flexion = HandFlexion(hand, [*fingers.values()])
    axis = flexion.axes.mean(axis=0)
    direction = flexion.directions.mean(axis=0)
    if min(lengths(axis), lengths(direction)) < _COMMON:
        return None
    # Flexion turns distal (y) towards palmar (-z), about -x.
    across, distal, _ = np.eye(3)
    turn = angle_between(axis, -across)
    return Fist(turn, angle_between(direction, distal), tuple(fingers))


def measure_pinches(hand: Hand) -> list[Pinch]:
    """Find how near the thumb's pad can come to every other finger's, within the joint limits.

    Args:
        hand: The hand; an arm stays at rest.

    Returns:
        One entry per finger; none if the hand has no thumb or no second finger.
    """
    fingers = find_fingers(hand)
    if THUMB not in fingers:
        return []
    pads = fingertip_pads(hand, fingers)
    thumb = pads.pop(THUMB)
    pinches = []
    for name, pad in pads.items():
        columns = np.union1d(fingers[THUMB].columns, fingers[name].columns)
        radii = thumb.radius + pad.radius
        gap = _nearest(hand, (thumb, pad), columns, radii) - radii
        touch = "yes" if gap < _TOUCHING else "no"
        nearest = max(0.0, round(1e3 * gap, 1))
        pinches.append(Pinch(finger=name, gap=nearest, touch=touch))
    return pinches


def fingertip_pads(hand: Hand, chains: dict[str, Finger]) -> dict[str, Pad]:
    """Return the pad of each fingertip; a ball of 6 mm around it if the shapes cannot be read."""
    try:
        return find_pads(hand, chains)
    except HandmapError:
        return {name: Pad(*chain.tip, _RADIUS) for name, chain in chains.items()}


def _nearest(
    hand: Hand,
    pads: tuple[Pad, Pad],
    columns: np.ndarray,
    near: float,
) -> float:
    """Return the smallest distance of two pads' centres, or one below `near` [m]."""
    from scipy.optimize import least_squares

    view = PalmKinematics(hand)
    places = [(pad.joint, pad.offset) for pad in pads]
    q = hand.rest.copy()

    def gap(positions: np.ndarray) -> np.ndarray:
        q[columns] = positions
        return np.subtract(*view.points(q, places))

    limits = np.array([hand.lower_limits, hand.upper_limits])
    first = [hand.rest, limits.mean(axis=0), zero_posture(hand)]
    best = np.inf
    for start in np.vstack([first, random_postures(hand, _STARTS)])[:, columns]:
        if best >= near:
            found = least_squares(
                gap, start, bounds=limits[:, columns], ftol=1e-4, xtol=1e-4
            )
            best = min(best, float(lengths(found.fun)))
    return best
