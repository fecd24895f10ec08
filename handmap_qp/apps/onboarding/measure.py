"""Checks that measure a hand: reach, size, fist, pinches, an arm, contacts and motions."""

from functools import partial
from itertools import compress, pairwise, product
from statistics import mode
from typing import Any

import numpy as np

from handmap_core.se3 import Array, affine, lengths, unit
from handmap_qp.apps.offline.fidelity import assess_fidelity
from handmap_qp.apps.offline.hand_trace import trace_human, trace_robot
from handmap_qp.apps.tables import rows_of, table_rows
from handmap_qp.hands import (
    FINGERS,
    THUMB,
    Hand,
    HumanLengths,
    all_pairs,
    are_prismatic,
    find_fingers,
    load_hand,
    random_postures,
)
from handmap_qp.human import human_name, standard_postures, upright_axes
from handmap_qp.mapping import (
    PERSON_FIST_TIME,
    HandMapper,
    MapStep,
    fist_time,
    points_in_palm,
    robot_fingers,
    rotation_onto,
    touching_distances,
)
from handmap_qp.trackers import first_of
from .collision_pairs import joined_notes
from .findings import MOST_NAMES, Found, Rows, advice, fine, warning
from .flexion import HandFlexion
from .speeds import with_speed
from .vectors import angle_between

HUMAN_LENGTH = 0.19
"""Length of a person's hand, from the wrist crease to the middle fingertip [m]."""
# Least singular value of a fingertip's Jacobian that counts as a direction of motion [m/rad].
_LEAST_MOTION = 0.003
_SAMPLES = 200
# Random postures of an arm, directions in which its reach is measured, and cosine of their cones.
_ARM_SAMPLES = 1500
_DIRECTIONS = unit(np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)]))
_CONE = np.cos(np.radians(25.0))
# A person's hand moves this far [m]; an arm follows that does so in this share of directions.
_ARM_MOTION = 0.25
_MOST_DIRECTIONS = 0.8
_DT = 1.0 / 60.0
# A point this far from its target is out of reach [mm].
_OUT_OF_REACH = 20.0
# The axes of `upright_axes`, and those against them.
_WAYS = ("forward", "left", "up", "back", "right", "down")
# A direction of the hand that an arm misses by more is worth saying [deg].
_ASTRAY = 30.0
# So is a shorter way for one of 50 mm [mm].
_SHORT = 25.0
# Thumb and finger meet in this part of a fist.
_PINCHED = 0.65
# A hand whose joints are this fast is not slow [rad/s]; slower ones cost more than this.
_FAST = 4.0
_SLOWER = 0.03
# Contacts move a joint aside by more than this part of its range.
_ASIDE = 0.25
# A joint moves if its range is more than this [rad or m].
_MOVES = 0.2
# The fingers' planes have a common normal if the mean of these unit vectors is this long.
_COMMON = 0.8
# Largest angles of the axis of flexion and of the straight fingers to the palm's axes [deg].
_ACROSS = 25.0
_DISTAL = 35.0
# Surfaces that come this near touch [m].
_TOUCHING = 0.002
# A thumb whose pad stays farther than this from every other opposes none of them [m].
_OPPOSING = 0.015
# A share of the last phalanx that no pad has.
_LARGEST_PAD = 0.8


def check_reach(hand: Hand) -> Found:
    """Measure how each finger's reference point with the largest span moves; an arm stays at rest.

    The slowest direction is the smallest singular value of its Jacobian, manipulability Yoshikawa's
    measure at rest, the product of these singular values [(m/rad)^directions].
    """
    own = ~hand.moves_wrist
    generator = np.random.default_rng(0)
    size = (_SAMPLES, len(hand.rest))
    shares = np.vstack([generator.random(size), generator.integers(0, 2, size)])
    ranges = hand.upper_limits - hand.lower_limits
    postures = np.where(own, hand.lower_limits + shares * ranges, hand.rest)
    places = np.array([hand.points(q) for q in postures])
    gaps = places[:, None] - places[::4]
    spans = 1e3 * lengths(gaps).max(axis=(0, 1))
    jacobians = hand.point_jacobian(hand.rest)[:, own].reshape(len(spans), 3, -1)
    points = hand.reference_points
    # Of the points of a finger, the one with the largest span comes last.
    best = {points[i].finger: i for i in np.argsort(spans) if points[i].finger}
    rows = []
    for i in sorted(best.values()):
        point = points[i].name
        motions = np.linalg.svd(jacobians[i], compute_uv=False)
        motions = motions[motions > _LEAST_MOTION]
        slowest = 1e3 * min(motions, default=0.0)
        rows.append(
            {
                "point": point,
                "span mm": spans[i],
                "moves in": f"{len(motions)} of 3 directions",
                "slowest direction, mm per rad or m": slowest,
                "manipulability": f"{motions.prod() * motions.any():.2e}",
            }
        )
        # One of two may be a fixed jaw.
        if not len(motions) and len(best) != 2:
            change = "put it on a link that moves, or leave it out"
            yield warning("points", f"no joint moves {point}", change)
    yield "Fingers", rows


def measure_arm(hand: Hand) -> Array:
    """Measure how far an arm moves the wrist from rest, by random postures.

    Returns:
        Distance that it reaches in each of 26 directions around rest [m]; 0 where rest is at the
        edge of its range, and without an arm.
    """
    postures = [hand.rest, *random_postures(hand, _ARM_SAMPLES)]
    start, *ends = (hand.frame_pose("wrist", q)[:3, 3] for q in postures)
    moved = ends - start
    # In each direction, the farthest wrist within a cone.
    near = _DIRECTIONS @ unit(moved).T > _CONE
    return (near * lengths(moved)).max(axis=1)


def check_arm(hand: Hand) -> Found:
    """Compare the reach of an arm with that of a person's hand in front of the body."""
    if not hand.moves_wrist.any():
        return
    reach = measure_arm(hand)
    far = (reach >= _ARM_MOTION).sum()
    what = (
        f"the arm moves the wrist by {1e3 * _ARM_MOTION:.0f} mm in {far} of {len(reach)} "
        f"directions from rest, and by {1e3 * np.median(reach):.0f} mm in half of them"
    )
    if far >= _MOST_DIRECTIONS * len(reach):
        yield fine("rest", what)
        return
    change = "rest in the middle of the arm's range"
    scale = np.floor(20.0 * min(1.0, np.quantile(reach, 0.2) / _ARM_MOTION)) / 20.0
    if scale >= 0.05:
        what += f"; a scale of {scale:.2g} fits"
        change += f", or map with --scale {scale:.2g}"
    yield advice("rest", what, change)


def check_size(hand: Hand) -> Found:
    """Compare with a person's hand: palm to fingertip, straight or at rest, and the fingertips."""
    human = load_hand("human", points="fingertips", hand_length=HUMAN_LENGTH)
    tips = hand.with_points("fingertips") if "fingertips" in hand.spec.sets else hand
    length = max(
        lengths(tips.points(q) - tips.frame_pose("palm", q)[:3, 3]).max()
        for q in (tips.rest, tips.zero)
    )
    cloud, human_cloud = 1e3 * tips.extent, 1e3 * human.extent
    ratio = length / HUMAN_LENGTH
    sizes = {
        "length, palm to fingertip": f"{1e3 * length:.0f} mm, {ratio:.2f} of a human hand",
        "RMS distance of fingertips from their mean": f"{cloud:.0f} mm; a person's: "
        f"{human_cloud:.0f} mm",
        "suggested scale": "1 (translations as the human's), or "
        f"{ratio:.2f} (in proportion to the hand)",
    }
    yield "Size", table_rows(sizes)
    if not 0.3 < ratio < 4.0:
        what = f"palm to fingertip is {length:.3g} m, {ratio:.2g} of a human hand"
        change = "check the URDF's unit (metres) and the palm's origin"
        yield warning("palm.xyz", what, change)


def check_motion(hand: Hand) -> Found:
    """Map a standard motion of a human hand: from rest to each of `standard_postures`."""
    rigid = "wrist" if hand.has_moving_wrist else "none"
    # A floating hand can turn as a whole; a hand that is held cannot, and its world's axes need not
    # be the human's.
    alignment = "world" if hand.is_floating else "palm"
    mapper = _mapper(hand, rigid_from=rigid, alignment=alignment)
    rows = []
    for name, posture in standard_postures(mapper.human).items():
        *_, last = _follow(mapper, posture)
        point = hand.reference_points[np.argmax(last.point_error)].name
        error = 1e3 * last.point_error.max()
        stops = [*compress(hand.joint_names, hand.at_position_limit(last.command.q))]
        rows.append(
            {
                "posture": name,
                "worst point": point,
                "error mm": error,
                "joints at a position limit": ", ".join(stops),
            }
        )
        if error > _OUT_OF_REACH:
            what = f"{name}: {point} stays {error:.0f} mm from its target"
            if stops:
                what += f", {first_of(stops, MOST_NAMES)} at a position limit"
            yield advice("reach", what)
    yield "A standard motion", rows


def check_directions(hand: Hand, upright: str = "+y up, -z forward") -> Found:
    """Move a person's hand by 5 cm in six directions, and measure where an arm takes the robot's.

    The table has for each direction the robot's nearest one, the angle between both [deg], and how
    far the robot's hand goes in its world [mm]; with a waist, how far its joints go [deg, or mm of
    one that slides]. There is none without an arm.

    Args:
        hand: The robot hand.
        upright: The axes of the tracker's world; a headset's if omitted.
    """
    turn = rotation_onto(hand, upright)
    if turn is None:
        return
    mapper = _mapper(hand, alignment=turn)
    units = np.where(are_prismatic(hand), 1e3, np.degrees(1.0))
    start = hand.frame_pose("palm", hand.rest)[:3, 3]
    rows = []
    for name, way in zip(_WAYS, [*np.eye(3), *-np.eye(3)], strict=True):
        place = 0.05 * way @ upright_axes(upright)
        q = _follow(mapper, mapper.human.rest, place=place)[-1].command.q
        end = hand.frame_pose("palm", q)[:3, 3]
        moved = 1e3 * (end - start)
        seen = upright_axes(hand.spec.upright) @ moved
        nearest = _WAYS[np.argmax([*seen, *-seen])] if seen.any() else "nowhere"
        direction = f"hand {name} -> robot {nearest}"
        off = round(angle_between(seen, way), 1)
        row = {
            "direction": direction,
            "degrees off": off,
            "robot moved, mm": [*map(round, moved)],
        }
        if hand.carries_limbs.any():
            bent = (units * (q - hand.rest))[hand.carries_limbs]
            row["waist moved"] = [*map(round, bent)]
        rows.append(row)
        if off > _ASTRAY or lengths(moved) < _SHORT:
            far = f"{off:.0f} degrees off and {lengths(moved):.0f} of 50 mm"
            yield advice("reach", f"{direction}, {far}: the arm cannot go there")
    yield "Directions", rows


def _mapper(hand: Hand, points: str | None = None, **options: Any) -> HandMapper:
    """Return a mapper from a person's hand with some points, or those of the standard set."""
    human = load_hand(human_name(hand.side), points=points, hand_length=HUMAN_LENGTH)
    return HandMapper(human, hand, dt=_DT, **options)


def _follow(
    mapper: HandMapper, *postures: Array, place: Array | float = 0.0
) -> list[MapStep]:
    """Lead to each posture in 0.75 s, with the wrist to a place [m], and 0.25 s to settle."""
    shares = 0.5 - 0.5 * np.cos(np.pi * np.minimum(np.arange(60) / 44, 1.0))
    mapper.reset()
    return [
        mapper.map_step(
            before + share * (after - before), affine(np.eye(3), share * place)
        )
        for before, after in pairwise([mapper.human.rest, *postures])
        for share in shares
    ]


def check_contacts(hand: Hand) -> Found:
    """Find joints that links lock by lying on each other, in a tour of gestures.

    Gestures are mapped after one another, two of them from rest each time, with and without
    contacts. The table has the range of each joint [rad or m], and the links that hold the hand
    most often where contacts move the joint aside; none if the hand's preset avoids no contacts.
    """
    joined = joined_notes(all_pairs(hand))
    yield from map(partial(fine, "collision"), joined)
    mapper = _mapper(hand, points="landmarks")
    method: Any = mapper.method
    if not getattr(method, "avoids_contact", False):
        return
    tours = []
    steps = list[MapStep]()
    # A detour would lead around what locks.
    plain = mapper.ik.replaced(takes_detours=False)
    for avoids in (False, True):
        mapper.configure(method.replaced(avoids_contact=avoids), ik=plain)
        steps = _tour(mapper)
        tours.append([step.command.q for step in steps])
    q = np.array(tours)
    free, held = np.ptp(q, axis=1)
    is_aside = np.abs(q[1] - q[0]) > _ASIDE * free
    links = [" and ".join(step.held_by) for step in steps]
    held_by = [mode([*filter(None, compress(links, at)), ""]) for at in is_aside.T]
    columns = {
        "joint": hand.joint_names,
        "without contacts": free,
        "with contacts": held,
        "held by": held_by,
    }
    yield "A tour of gestures", rows_of(columns)
    for i in np.flatnonzero((free > _MOVES) & (held < 0.5 * free)):
        what = (
            f"contacts narrow the range of {hand.joint_names[i]} in a tour of gestures from "
            f"{free[i]:.2g} to {held[i]:.2g}: {held_by[i] or 'some links'} meet"
        )
        yield warning("urdf", what, "correct the collision shapes of these links")


def check_following(hand: Hand) -> Found:
    """Correlate fingers' extensions with a person's in a tour of gestures, also at 4 rad/s."""
    if not any(finger.flexion for finger in find_fingers(hand).values()):
        return
    person = HumanLengths.from_hand_length(HUMAN_LENGTH)
    found = []
    # Joints of an arm come first.
    speeds = hand.velocity_limits[-len(hand.spec.joints) :].clip(_FAST)
    for given in (hand, load_hand(with_speed(hand.spec, speeds))):
        steps = _tour(_mapper(given, points="landmarks"))
        points = np.array([step.human_points for step in steps])
        q = np.array([step.command.q for step in steps])
        human = trace_human(points, person, hand.side)
        time = _DT * np.arange(len(q))
        fidelity = assess_fidelity(human, trace_robot(hand, q), time, time >= 0.0)
        found.append(fidelity.values["extension_correlation"])
    own, fast = found
    what = f"follows {own:.2f} of your fingers (extension) with its speed limits"
    if fast > own + _SLOWER:
        what += f", {fast:.2f} if the joints could do {_FAST:g} rad/s"
        yield advice("limits", what, "check that these limits are true")
    else:
        yield fine("limits", what)


def check_fist_time(hand: Hand) -> Found:
    """Say how long the hand takes from a flat hand to a fist, and whether a person is faster.

    The table has the slowest joint of each finger, and its time [s].
    """
    human = load_hand(human_name(hand.side))
    found = fist_time(human, hand)
    rows = []
    for name, finger in find_fingers(hand).items():
        if len(finger.columns):
            times = found.joint_times[finger.columns]
            slowest = int(np.argmax(times))
            joint = hand.joint_names[finger.columns[slowest]]
            rows.append(
                {"finger": name, "slowest joint": joint, "s": round(times[slowest], 2)}
            )
    yield "From a flat hand to a fist", rows
    key = f"limits.{found.joint}"
    speeds = "speed limits, which are assumed" if found.is_assumed else "speed limits"
    what = f"takes {found.time:.2f} s from a flat hand to a fist at its {speeds}"
    if not found.is_slow:
        yield fine(key, what)
        return
    what += (
        f": a person is faster, in {PERSON_FIST_TIME:.2g} s or less in 95 % of closings, and the "
        "robot's fingers follow late"
    )
    is_sure = hand.spec.speeds == "maker"
    change = "move more slowly" + ("" if is_sure else ", or give true limits")
    yield advice(key, what, change)


def _tour(mapper: HandMapper) -> list[MapStep]:
    """Map gestures, two from rest each time: spread, any fingers bent, each at the thumb."""
    flat, spread, fist, *_ = standard_postures(mapper.human).values()
    each = np.eye(len(FINGERS))
    # The thumb comes first.
    pinches = _PINCHED * np.maximum(each, each[0])
    bends = np.array([*product((0.0, 1.0), repeat=len(each)), *pinches])
    postures = np.vstack([spread, flat + bends.repeat(4, axis=1) * (fist - flat)])
    pairs = postures.reshape(-1, 2, len(flat))
    return [step for pair in pairs for step in _follow(mapper, *pair)]


def check_fist(hand: Hand) -> Found:
    """Close the fingers, but the thumb: their tips must go to the palm, about an axis across it.

    Nothing is found if fewer than two of them close, or they close about different axes.
    """
    chains = find_fingers(hand).copy()
    chains.pop(THUMB, None)
    fingers = [
        finger
        for finger in chains.values()
        if (found := finger.flexion) and found.curls and found.sense
    ]
    if len(fingers) < 2:
        return
    flexion = HandFlexion(hand, fingers)
    means = np.mean([flexion.axes, flexion.directions], axis=1)
    if lengths(means).min() < _COMMON:
        return
    # Flexion turns distal (y) towards palmar (-z), about -x.
    across, distal, _ = np.eye(3)
    turn, tilt = map(angle_between, means, (-across, distal))
    off = f"{turn:.0f} degrees off"
    if turn > 180.0 - _ACROSS:
        what = "a fist brings the fingertips to the back of the hand"
        yield warning("palm.dorsal", what, "turn dorsal over, or change side")
    elif turn > _ACROSS:
        what = f"the fingers close about an axis {off} the palm's x axis"
        yield warning("palm.dorsal", what, "correct distal and dorsal")
    elif tilt > _DISTAL:
        what = f"the straight fingers point {tilt:.0f} degrees off it"
        yield warning("palm.distal", what, "correct distal")
    else:
        what = f"{len(fingers)} fingers close to the palm, {off} its x axis"
        yield fine("palm", what)


def check_pinches(hand: Hand) -> Found:
    """Find how near the thumb's pad can come to every other finger's; an arm stays at rest."""
    measured = robot_fingers(hand)
    pads = measured.pads
    rows: Rows = [
        {
            "finger": finger,
            "on the link of": hand.model.names[pad.joint],
            "centre, mm": _joined(1e3 * pad.offset, 1),
            "radius, mm": round(1e3 * pad.radius, 1),
        }
        for finger, pad in pads.items()
    ]
    yield "Pads", rows
    for finger, pad in pads.items():
        if pad.radius > _LARGEST_PAD * lengths(measured.chains[finger].tip[1]):
            what = f"the pad has a radius of {1e3 * pad.radius:.0f} mm, too much for its phalanx"
            yield warning(f"points.{finger}", what, "check the shapes of its last link")
    if THUMB not in pads:
        yield advice("points", "no point is on a thumb: pinches are not mapped")
        return
    _, *fingers = pads
    if not fingers:
        return
    places = [pad.place for pad in pads.values()]
    points = points_in_palm(hand, np.array(measured.pinches), places)
    apart = lengths(points[:, 1:] - points[:, :1]).diagonal()
    gaps = apart - touching_distances([*pads.values()])
    touches = gaps < _TOUCHING
    columns = {
        "thumb and": fingers,
        "nearest, mm between pads": (1e3 * gaps).clip(0.0).round(1),
        "touch": np.where(touches, "yes", "no"),
    }
    yield "Pinches", rows_of(columns)
    if touches.any():
        touched = compress(fingers, touches)
        yield fine("points", f"the thumb can touch {', '.join(touched)}")
    else:
        gap, nearest = min(zip(gaps, fingers, strict=True))
        what = f"the thumb touches no finger; nearest is the {nearest}, {1e3 * gap:.0f} mm away"
        finding = warning if gap > _OPPOSING else advice
        yield finding("points", what, "check the thumb, the tips, and the limits")


def palm_rows(robot: Hand) -> Rows:
    """Return a row for each hand: its palm at rest in the robot's base, and its wrist's reach."""
    rows = []
    for side, hand in robot.by_side.items():
        pose = hand.frame_pose("palm", hand.rest)
        rows.append(
            {
                "side": side,
                "palm": hand.spec.palm.link,
                "at, m": _joined(pose[:3, 3], 3),
                "fingers point": _joined(pose[:3, 1], 2),
                "reach, m": np.median(measure_arm(hand)),
            }
        )
    return rows


def _joined(values: Array, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
