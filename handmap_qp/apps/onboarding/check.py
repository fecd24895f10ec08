"""Check a `hand.yaml` or a `robot.yaml`: `check_hand` and `check_robot` report what they find.

Each check yields findings, and may yield tables. Those here compare the description with names,
limits, files, shapes and a detection; those of `measure` move the hand.
"""

import warnings
from collections.abc import Iterator
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

from handmap_core.errors import HandError
from handmap_core.se3 import Array, box_of, lengths
from handmap_qp.apps.tables import rows_of
from handmap_qp.hands import (
    FASTEST_SPEEDS,
    Hand,
    HandSpec,
    Links,
    Names,
    PalmKinematics,
    are_prismatic,
    edges,
    find_fingers,
    held_joints,
    is_lost,
    is_missing,
    load_hand,
    load_robot,
    named_pairs,
    parse_urdf,
    partner_names,
    place_of,
    read_collision_shapes,
    read_urdf,
    urdf_path,
)
from handmap_qp.mapping import distance
from handmap_qp.trackers import first_of
from .collision_pairs import colliding_links
from .detect import detect, left_out_wrist
from .findings import MOST_NAMES, Found, HandFinding, HandReport, advice, fine, warning
from .finger_order import FINGERS, NARROW
from .measure import (
    check_arm,
    check_contacts,
    check_directions,
    check_fist,
    check_fist_time,
    check_following,
    check_motion,
    check_pinches,
    check_reach,
    check_size,
    palm_rows,
)
from .robot import Robot, carriers
from .speeds import maker_speed
from .structure import Clue
from .vectors import angle_between

# A person makes a fist in this time [s], and flexes each joint by up to this angle [rad].
_FIST_TIME = 0.5
# A slower one, at one speed of all joints, is what a file says that does not know them [s].
_PLACEHOLDER = 1.0
_FIST_ANGLE = 1.5
# A slower joint is in another unit [rad/s or m/s].
_SLOWEST = 0.02
# Where speeds are from that are not the robot's: words for `HandSpec.speeds`.
_ORIGINS = {
    "assumed": "assumed",
    "estimated": "estimated from the actuators of the MJCF file",
    "given": "given by `--speed`",
}
# A larger range is in degrees or millimetres [rad or m].
_LARGEST_TURN = 2.0 * np.pi + 0.01
_LARGEST_SLIDE = 2.0
# Allowed distance of a reference point from its link's shape, for example a sensor's frame [m].
_OFF_THE_LINK = 0.02
# A fingertip this far from its link's collision shapes hints at a misplaced shape; beyond
# `_OFF_THE_LINK`, the tip itself is wrong [m].
_OFF_THE_TIP = 0.003
# Least confidence of fingers and side, and of a direction, and largest angles by certainty [deg].
_SURE = 0.65
_WORTH = 0.45
_ANGLES = {"certain": 20.0, "likely": 40.0, "a guess: check it": 60.0}


def check_hand(hand: str | Path, *, has_motion: bool = True) -> HandReport:
    """Check a description.

    Args:
        hand: Path of a `hand.yaml` or name of a hand.
        has_motion: Whether to map a standard motion to it, and an arm's six directions.

    Returns:
        All findings; the only one is an error if the hand cannot be built.
    """
    report = HandReport(str(hand))
    with warnings.catch_warnings():
        # Warnings of the loader are among `hand.notes`, which become findings.
        warnings.simplefilter("ignore")
        try:
            report.hand = built = load_hand(hand)
        except HandError as error:
            report.error = error
            report.add([HandFinding("error", error.key or "hand", str(error))])
            return report
        report.name = built.name
        for check in _CHECKS + _MOTIONS * has_motion:
            report.add(check(built))
    # The worst is first.
    if report.findings[0].level != "warning":
        what = (
            "no contradiction between description, names, limits, shapes and gestures"
        )
        report.add([fine("", what)])
    return report


def check_robot(given: str | Path, *, has_motion: bool = True) -> HandReport:
    """Check the descriptions of a robot's hands, and what overlaps at rest.

    Args:
        given: Path of a `robot.yaml` or name of a robot; errors are those of `load_robot`.
        has_motion: Whether to map a standard motion to each hand.
    """
    robot = load_robot(given)
    report = HandReport(robot.name, robot)
    report.add([("Hands", palm_rows(robot))])
    for side, hand in robot.by_side.items():
        found = check_hand(str(hand.spec.file), has_motion=has_motion)
        report.error = report.error or found.error
        report.add(one._replace(key=f"{side}: {one.key}") for one in found.findings)
    whole = robot.hands[0]
    wrists = [whole.frames[h.spec.wrist.link].parentJoint for h in robot.hands]
    # Links of one hand are among its own findings.
    pairs = colliding_links(whole, whole.rest, wrists)
    report.add([_overlap(pairs, "move the arms apart, and away from the body")])
    return report


def _list_joints(hand: Hand) -> Found:
    """List all joints of the URDF: role, limits of active joints, rest angle."""
    # Followers, which come last, have no limits of their own.
    columns = {
        "joint": hand.all_joint_names,
        "role": hand.all_joint_roles,
        "limits": [f"[{lower:.3g}, {upper:.3g}]" for lower, upper in hand.limits.T],
        "speed": [f"{speed:.3g}" for speed in hand.velocity_limits],
        "rest": hand.all_joints(hand.rest),
    }
    yield "Joints", rows_of(columns)


def _check_limits(hand: Hand) -> Found:
    """Check rest angles, ranges and speeds; joints of an arm may turn twice."""
    change = "correct the URDF, or give the rule in `mimic` or the limits in `limits`"
    yield from (warning("mimic", note, change) for note in hand.notes)
    names = hand.joint_names
    width = hand.upper_limits - hand.lower_limits
    inside = np.minimum(hand.rest - hand.lower_limits, hand.upper_limits - hand.rest)
    for i in np.flatnonzero(inside < 0.01 * width):
        what = "rests at its limit, so it can move in one direction only"
        yield advice(f"rest.{names[i]}", what, "move it inwards")
    for i in np.flatnonzero(width < 0.002):
        what = f"{names[i]} has a range of {width[i]:.2g}"
        yield warning("limits", what, "give its true limits, or lock it")
    # `check_speeds` finds fast ones.
    for i, speed in enumerate(hand.velocity_limits):
        if speed < _SLOWEST:
            what = f"a speed of {speed:.3g} per second is unusual"
            yield advice(f"limits.{names[i]}", what, "check its unit")
    turns, _ = PalmKinematics(hand).axes(hand.rest, hand.joints)
    largest = np.where(turns.any(axis=1), _LARGEST_TURN, _LARGEST_SLIDE)
    is_wide = ~hand.moves_wrist & (width > largest)
    for limit, unit in ((_LARGEST_TURN, "degrees"), (_LARGEST_SLIDE, "millimetres")):
        wide = np.flatnonzero(is_wide & (largest == limit))
        if count := len(wide):
            what = f"{count} joint(s) have ranges of up to {width[wide].max():.3g}: in {unit}?"
            yield warning(f"limits.{names[wide[0]]}", what, "give limits in rad and m")


def check_speeds(hand: Hand) -> Iterator[HandFinding]:
    """Find speeds that are too slow for a fist, or no motor's, and those that are not the robot's.

    Each kind is one finding, whose key names the joint that shows it best.
    """
    found = [*_slow_joints(hand), *_fast_joints(hand)]
    # A finding about a joint says whether its speed is assumed.
    yield from found or _unsure_speeds(hand)


def _slow_joints(hand: Hand) -> Iterator[HandFinding]:
    """Find joints of the fingers that are too slow for a fist in half a second."""
    times = _fist_times(hand)
    worst = np.argmax(times)
    if not (count := (times > _FIST_TIME).sum()):
        return
    key = f"limits.{hand.joint_names[worst]}"
    what = (
        f"{count} {'joints are' if count > 1 else 'joint is'} too slow for a fist in half a "
        f"second; at {hand.velocity_limits[worst]:.3g} per second this one needs "
        f"{times[worst]:.2g} s"
    )
    if hand.spec.speeds == "maker":
        yield fine(key, f"{what}, as its maker says")
        return
    # Followers that turn further than their leaders slow them, whatever the URDF says.
    plain = pin.buildModelFromXML(hand.urdf_text)
    given = plain.velocityLimit[plain.nv - hand.model.nv + hand.v_indices]
    if origin := _ORIGINS.get(hand.spec.speeds or ""):
        what += f"; these speeds are {origin}"
    elif times[worst] > _PLACEHOLDER and np.ptp(given[~hand.moves_wrist]) == 0.0:
        what += "; all joints have the same speed: a placeholder?"
    yield advice(key, what, _true_speeds(hand))


def _fast_joints(hand: Hand) -> Iterator[HandFinding]:
    """Find joints whose speed hardly any motor reaches: a limit that never holds."""
    if hand.spec.speeds in ("maker", "given", "estimated"):
        return
    speeds = hand.velocity_limits
    most = np.where(
        are_prismatic(hand), FASTEST_SPEEDS["prismatic"], FASTEST_SPEEDS["revolute"]
    )
    count = (speeds > most).sum()
    if not count:
        return
    worst = np.argmax(speeds / most)
    joints = "joint has a speed" if count == 1 else "joints have speeds"
    what = (
        f"{count} {joints} of up to {speeds[worst]:,.5g} per second, which hardly any motor "
        "reaches: a placeholder? The robot then falls behind its commands"
    )
    yield advice(f"limits.{hand.joint_names[worst]}", what, _true_speeds(hand))


def _unsure_speeds(hand: Hand) -> Iterator[HandFinding]:
    """Say what it costs that speeds are assumed or estimated."""
    assumed = hand.spec.assumed_speeds
    if not assumed and hand.spec.speeds != "estimated":
        return
    joints = [*map(hand.joint_names.index, assumed or hand.spec.joints)]
    speeds = hand.velocity_limits[joints]
    low, high = f"{speeds.min():.3g}", f"{speeds.max():.3g}"
    span = low if low == high else f"{low} to {high}"
    times = _fist_times(hand)
    worst = joints[np.argmax(times[joints])]
    count = f"{len(joints)} joint" + "s" * (len(joints) > 1)
    cost = (
        f"a fist takes {times[worst]:.2g} s or more; a faster robot is held back, and a slower "
        "one falls behind its commands"
        if assumed
        else "they fit a simulation with these actuators; motors may be slower"
    )
    origin = _ORIGINS[hand.spec.speeds or ""]
    what = f"the speeds of {count} are {origin}, {span} per second: {cost}"
    yield advice(f"limits.{hand.joint_names[worst]}", what, _true_speeds(hand))


def _fist_times(hand: Hand) -> Array:
    """Return the time of each joint of the fingers for its part of a fist [s], shape (n,)."""
    travel = np.abs(hand.limits - hand.zero).max(axis=0)
    times = np.minimum(travel, _FIST_ANGLE) / hand.velocity_limits
    times[hand.moves_wrist] = 0.0
    return times


def _true_speeds(hand: Hand) -> str:
    """Return what to change where speeds are not the robot's."""
    change = "give the maker's speeds in `limits`, or one by `hands init --speed`"
    if maker := maker_speed(hand.spec):
        change += ": {:g} by {}".format(*maker)
    return change


def _check_followers(hand: Hand) -> Found:
    followers = hand.all_joint_roles.count("follower")
    if not followers:
        return
    plain = pin.buildModelFromXML(hand.urdf_text)
    # It lacks the coordinates of a floating wrist, which come first.
    at = hand.q_indices + plain.nq - hand.model.nq
    lower, upper = plain.lowerPositionLimit[at], plain.upperPositionLimit[at]
    low, high = hand.limits
    narrowed = np.maximum(low - lower, upper - high) > 0.005 * (upper - lower)
    for i in np.flatnonzero(narrowed):
        ends = f"[{lower[i]:.3g}, {upper[i]:.3g}] to [{low[i]:.3g}, {high[i]:.3g}]"
        yield fine(f"limits.{hand.joint_names[i]}", f"its followers narrow {ends}")
    within = "" if hand.notes else ", within their own limits"
    yield fine("mimic", f"{followers} joints follow others{within}")


def check_held(hand: Hand) -> Iterator[HandFinding]:
    """Find locked joints that an MJCF file couples to others, and say why they are held.

    A file that contradicts itself is wrong. Of others only those matter that move a reference
    point: no line describes most bars of a linkage.
    """
    robot = parse_urdf(read_urdf(hand.spec))
    parents = {child: parent for _, parent, child in edges(robot)}
    ways = (carriers(parents, point.link) for point in hand.spec.points)
    links = {link for way in ways for link in way}
    moves_point = {
        joint.get("name") for joint, _, child in edges(robot) if child in links
    }
    locked = hand.spec.locked
    for joint, reason in held_joints(robot).items():
        if joint not in locked:
            continue
        what = reason.held_at(locked[joint])
        if reason.kind == "limits":
            yield warning(f"locked.{joint}", what, reason.next_step)
        elif joint in moves_point:
            yield advice(f"locked.{joint}", what, reason.next_step)


def _check_points(hand: Hand) -> Found:
    """Check partners, places and weights of the reference points."""
    points = hand.points(hand.rest)
    names = {point.name for point in load_hand("human").spec.points}
    partners = partner_names(hand, names)
    for i, point in enumerate(hand.reference_points):
        where = f"points.{point.name}"
        if partners[i] not in names:
            what = f"the human hand has no point {partners[i]!r}"
            yield advice(where, what, "name a partner")
        for j in np.flatnonzero(lengths(points[:i] - points[i]) < 1e-3):
            what = f"lies on {hand.reference_points[j].name}"
            yield warning(where, what, "one of them will do")
    ratio = hand.point_weights.max() / hand.point_weights.min()
    if ratio > 100.0:
        what = f"weights are {ratio:.0f}-fold apart"
        yield advice("points.weight", what, "stay within 100")
    if len(points) < 3:
        what = f"{len(points)} points leave some of the hand's motion open"
        yield advice("sets", what, "add points of the same links")


def check_places(hand: Hand) -> Iterator[HandFinding]:
    """Find reference points far outside the shape of their body."""
    try:
        robot = Robot(urdf_path(hand.spec), hand.urdf_text, root=hand.spec.wrist.link)
    except HandError:
        return
    for point in hand.reference_points:
        if point.link not in robot.frames:
            continue
        body, place = place_of(robot, point)
        if not len(cloud := robot.surface(body)):
            continue
        distance = lengths(place - place.clip(*box_of(cloud)))
        if distance > _OFF_THE_LINK:
            what = f"lies {1e3 * distance:.0f} mm outside the shape of {point.link}"
            change = "check its xyz, in metres in that link's frame"
            yield warning(f"points.{point.name}", what, change)


def _check_tips(hand: Hand) -> Found:
    """Find fingertips outside the shapes of their links, where a shape may be misplaced."""
    try:
        shapes = read_collision_shapes(hand).geometryObjects
    except HandError:
        return
    for finger, chain in find_fingers(hand).items():
        joint, tip = chain.tip
        there = coal.Sphere(1e-6), pin.SE3(np.eye(3), tip)
        gaps = [
            distance(shape.geometry, shape.placement, *there)[0]
            for shape in shapes
            if shape.parentJoint == joint
        ]
        if (
            chain.joints
            and _OFF_THE_TIP < (gap := min(gaps, default=0.0)) < _OFF_THE_LINK
        ):
            what = f"the fingertip is {1e3 * gap:.0f} mm outside the shapes of its link"
            change = "is one of them in a wrong place? `shapes` moves it"
            yield warning(f"points.{finger}", what, change)


def check_shapes(hand: Hand) -> Iterator[HandFinding]:
    """Find links with malformed collision shapes, or such that end elsewhere than visual ones."""
    used = {
        shape.name.rpartition("_")[0]
        for shape in read_collision_shapes(hand).geometryObjects
    }
    robot = Robot(urdf_path(hand.spec), hand.urdf_text, root=hand.spec.wrist.link)
    for link, element in robot.elements.items():
        if element.findall("collision") and link not in used:
            what = f"a collision shape of {link} is malformed: none of them is used"
            yield warning("urdf", what, "correct it, or leave it out")
        elif all(
            clouds := [robot.clouds(link, kind) for kind in ("visual", "collision")]
        ):
            seen, other = (box_of(np.concatenate(cloud)) for cloud in clouds)
            off = np.abs(seen - other).max()
            if off > max(_OFF_THE_LINK, lengths(np.ptp(seen, axis=0)) / 2.0):
                what = f"collision and visual shapes of {link} end {1e3 * off:.0f} mm apart"
                yield warning("urdf", what, "correct the scale or place of one of them")


def _check_meshes(hand: Hand) -> Found:
    """Find meshes of which other shapes of a link, cylinders or balls take the place."""
    robot = parse_urdf(hand.urdf_text)
    for tag, is_gone, use in (
        ("collision", is_lost, "self-collision and pinches"),
        ("visual", is_missing, "pictures"),
    ):
        meshes = {
            mesh.get("filename", ""): mesh for mesh in robot.iterfind(f".//{tag}//mesh")
        }
        lost = [Path(file) for file, mesh in meshes.items() if is_gone(mesh)]
        if lost:
            shown = first_of([file.name for file in lost], MOST_NAMES)
            what = (
                f"{len(lost)} of {len(meshes)} {tag} meshes are missing, unreadable, flat or of "
                f"no link's size: {shown}; {use} have simple shapes in their place"
            )
            change = f"put them where the URDF looks for them: {lost[0].parent}"
            yield warning("urdf", what, change)


def _check_wrist(hand: Hand) -> Found:
    """Find actuated wrist joints that the description leaves out."""
    spec = hand.spec
    if hand.moves_wrist.any() or spec.root is None or urdf_path(spec).suffix != ".urdf":
        return
    joints, base = left_out_wrist(Robot(urdf_path(spec)), spec.root)
    if joints:
        what = f"wrist joints are left out: {joints}"
        yield advice("root", what, f"keep them with `hands init --base {base}`")


def _check_order(hand: Hand) -> Found:
    """Compare the row of the knuckles with the side: thumb and index are at the radial edge."""
    chains = find_fingers(hand)
    row = [chains[finger].knuckle for finger in FINGERS if finger in chains]
    places = PalmKinematics(hand).points(hand.zero, row)
    is_back = np.diff(places[:, 0]) * (-1.0 if hand.side == "right" else 1.0) > NARROW
    if len(is_back) and is_back.all():
        what = (
            f"the {hand.side} hand's fingers run from little to index, "
            "seen from the thumb's side"
        )
        yield warning("side", what, "change side, or the sign of palm.dorsal")
    elif is_back.any():
        what = "the fingers are not in the order of their knuckles"
        yield warning("points", what, "rename them")


def _compare_detection(hand: Hand) -> Found:
    """Compare the description with a detection from the URDF."""
    try:
        found = detect(urdf_path(hand.spec), hand.urdf_text, root=hand.spec.wrist.link)
    except HandError as error:
        yield advice("palm", f"not compared with the URDF: {error.problem}")
        return
    clues = {clue.what: clue for clue in found.clues}
    yield from _compare_axes(hand, found.spec, clues)
    side = found.spec.side
    if side == hand.side and clues["fingers"].confidence > _SURE:
        yield from _compare_fingers(hand, found.chains)
    elif side != hand.side and clues["side"].confidence > _SURE:
        yield warning("side", f"{clues['side'].how}: a {side} hand", f"side: {side}")


def _compare_axes(hand: Hand, found: HandSpec, clues: dict[str, Clue]) -> Found:
    """Find axes of the palm that point elsewhere than the detected ones."""
    links = [hand.spec.palm.link, found.palm.link]
    own, theirs = hand.link_poses(links, hand.rest)[:, :3, :3]
    for name in ("distal", "dorsal"):
        clue = clues[name]
        # The detected direction in the frame of the described palm link.
        other = own.T @ theirs @ getattr(found.palm, name)
        angle = angle_between(getattr(hand.spec.palm, name), other)
        if clue.confidence > _WORTH and angle > _ANGLES[clue.certainty]:
            what = f"is {angle:.0f} degrees from the detected one: {clue.how}"
            change = f"try [{', '.join(f'{value:.3f}' for value in other)}]"
            yield warning(f"palm.{name}", what, change)


def _compare_fingers(hand: Hand, chains: dict[str, Names]) -> Found:
    """Find points that name another finger than the one whose joints move them."""
    # A joint of several fingers is the first one's.
    pairs = reversed(chains.items())
    owners = {joint: finger for finger, joints in pairs for joint in joints}
    for point in hand.reference_points:
        owner = owners.get(hand.model.names[hand.frames[point.link].parentJoint])
        if owner and point.finger not in (None, owner):
            what = f"is on the finger at the position of the {owner}, but names {point.finger}"
            change = f"finger: {owner}, with a matching name and partner"
            yield warning(f"points.{point.name}", what, change)


def _check_collisions(hand: Hand) -> Found:
    if collision := hand.spec.collision:
        try:
            named_pairs(hand, collision.pairs)
        except HandError as error:
            yield warning(error.key or "collision", error.problem, "correct the pair")
    pairs = colliding_links(hand, hand.rest)
    yield _overlap(pairs, "open the hand or spread its fingers more")


def _overlap(pairs: list[Links], change: str) -> HandFinding:
    if pairs:
        shown = first_of([*map(" and ".join, pairs)], MOST_NAMES)
        return warning("rest", f"at rest {shown} overlap", change)
    return fine("rest", "no links overlap at rest, except neighbours at a joint")


_CHECKS = (
    _list_joints,
    _check_limits,
    check_speeds,
    _check_followers,
    check_held,
    _check_points,
    check_places,
    _check_tips,
    check_shapes,
    _check_meshes,
    _check_wrist,
    _check_order,
    check_fist,
    check_pinches,
    _compare_detection,
    _check_collisions,
    check_reach,
    check_size,
    check_arm,
)
_MOTIONS = (
    check_contacts,
    check_fist_time,
    check_following,
    check_motion,
    check_directions,
)
