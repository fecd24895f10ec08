"""Check a `hand.yaml`: `check_hand` reports findings and advice.

The checks compare names, close fingers and pinch, look for files, map a motion, and compare the
description with a detection.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError, HandmapError
from handmap_qp.hands.fingers import (
    THUMB,
    PalmKinematics,
    find_fingers,
    partner_names,
    place_of,
    zero_posture,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.shape_pairs import named_pairs
from handmap_qp.hands.sources import read_urdf, urdf_path
from handmap_qp.hands.urdf import MOVABLE, edges, origin_of, parse_urdf, urdf_with_mesh_paths
from handmap_qp.onboarding.anatomy import FINGERS, angle_between
from handmap_qp.onboarding.detect import Detection, detect_text
from handmap_qp.onboarding.finger_names import named_fingers, named_side
from handmap_qp.onboarding.gestures import fingertip_pads, make_fist, measure_pinches
from handmap_qp.onboarding.measure import (
    FingerReach,
    colliding_links,
    measure_arm,
    measure_reach,
    measure_size,
    try_motion,
)
from handmap_qp.onboarding.report import LEVELS, Report
from handmap_qp.onboarding.robot import Robot
from handmap_qp.se3 import transform_points

# A person makes a fist in this time [s], and flexes each joint by up to this angle [rad].
_FIST_TIME, _FIST_ANGLE = 0.5, 1.5
# A larger range is in degrees or millimetres [rad or m].
_LARGEST_TURN, _LARGEST_SLIDE = 2.0 * np.pi + 0.01, 2.0
# Allowed distance of a reference point from its link's shape, for example a sensor's frame [m].
_OFF_THE_LINK = 0.02
# Names in one finding.
_MOST_NAMES = 3
# A joint this near to the hand's first link is one of its wrist [m].
_WRIST_REACH = 0.25
# Least confidence of the detection for a warning, and the angle with and without certainty [deg].
_SURE = 0.65
_CERTAIN_ANGLE, _LIKELY_ANGLE = 20.0, 40.0
# Largest angles of the axis of flexion and of the straight fingers to the palm's axes [deg].
_ACROSS, _DISTAL = 25.0, 35.0
# A thumb whose pad stays farther than this from every other opposes none of them [m].
_OPPOSING = 0.015
# Knuckles closer than this may be in any order [m].
_NARROW = 0.004
# A point this far from its target is out of reach [m].
_OUT_OF_REACH = 0.02
# A person's hand moves this far to all sides in front of the body [m].
_ARM_MOTION = 0.25
# An arm follows if it reaches that far in this share of the directions.
_MOST_DIRECTIONS = 0.8


def check_hand(hand: str | Path, *, has_motion: bool = True) -> Report:
    """Check a description.

    Args:
        hand: Path of a `hand.yaml` or name of a hand.
        has_motion: Whether to map a standard motion to it.

    Returns:
        All findings; the only one is an error if the hand cannot be built.
    """
    with warnings.catch_warnings():
        # Warnings of the loader are among `hand.notes`, which become findings.
        warnings.simplefilter("ignore")
        return _check(hand, has_motion)


def _check(hand: str | Path, has_motion: bool) -> Report:
    report = Report(str(hand))
    try:
        report.hand = built = load_hand(hand)
    except HandError as error:
        report.add("error", error.key or "hand", str(error))
        return report
    report.name = built.name
    for where, check in _CHECKS[: None if has_motion else -1]:
        try:
            check(report, built)
        except HandmapError as error:
            report.add("advice", where, f"not checked: {error}")
    if not any(finding.level in ("error", "warning") for finding in report.findings):
        report.add(
            "fine", "", "no contradiction between description, names, limits, shapes and gestures"
        )
    report.findings.sort(key=lambda finding: LEVELS.index(finding.level))
    return report


def _check_joints(report: Report, hand: Hand) -> None:
    """Check limits, rest angles, speeds and followers."""
    for note in hand.notes:
        report.add(
            "warning",
            "mimic",
            note,
            "correct the URDF, or give the rule in `mimic` or the limits in `limits`",
        )
    width = hand.upper_limits - hand.lower_limits
    for i, joint in enumerate(hand.joint_names):
        edge = min(hand.rest[i] - hand.lower_limits[i], hand.upper_limits[i] - hand.rest[i])
        if edge < 0.01 * width[i]:
            report.add(
                "advice",
                f"rest.{joint}",
                "rests at its limit, so it can move in one direction only",
                "move it inwards",
            )
        if width[i] < 0.002:
            report.add(
                "warning",
                "limits",
                f"{joint} has a range of {width[i]:.2g}",
                "give its true limits, or lock it",
            )
        if hand.velocity_limits[i] > 60.0 or hand.velocity_limits[i] < 0.02:
            speed = hand.velocity_limits[i]
            report.add(
                "advice",
                f"limits.{joint}",
                f"a speed of {speed:.3g} per second is unusual",
                "check its unit",
            )


def _check_ranges(report: Report, hand: Hand) -> None:
    """Find ranges in degrees or millimetres; joints of an arm may turn twice."""
    width, carriers = hand.upper_limits - hand.lower_limits, _carriers(hand)
    joints = [hand.model.getJointId(joint) for joint in hand.joint_names]
    turns, _ = PalmKinematics(hand).axes(hand.rest, joints)
    for slides, largest, unit in (
        (False, _LARGEST_TURN, "degrees"),
        (True, _LARGEST_SLIDE, "millimetres"),
    ):
        wide = [
            i
            for i, joint in enumerate(joints)
            if width[i] > largest and turns[i].any() != slides and joint not in carriers
        ]
        if wide:
            count = f"{len(wide)} joints have ranges" if len(wide) > 1 else "it has a range"
            report.add(
                "warning",
                f"limits.{hand.joint_names[wide[0]]}",
                f"{count} of up to {width[wide].max():.3g}: in {unit}?",
                "give limits in rad and m",
            )


def _carriers(hand: Hand) -> set[int]:
    """Return the joints of the model that move the wrist."""
    return set(hand.model.supports[hand.model.frames[hand.wrist_frame_id].parentJoint])


def _check_speeds(report: Report, hand: Hand) -> None:
    """Find joints of the fingers that are too slow for a fist in half a second."""
    stretched = zero_posture(hand)
    travel = np.maximum(hand.upper_limits - stretched, stretched - hand.lower_limits)
    needed = np.minimum(travel, _FIST_ANGLE) / _FIST_TIME
    carriers = _carriers(hand)
    slow = [
        i
        for i, joint in enumerate(hand.joint_names)
        if hand.velocity_limits[i] < needed[i] and hand.model.getJointId(joint) not in carriers
    ]
    if slow:
        worst = min(slow, key=lambda i: hand.velocity_limits[i] / needed[i])
        speed, count = hand.velocity_limits[worst], len(slow)
        time = _FIST_TIME * needed[worst] / speed
        report.add(
            "advice",
            f"limits.{hand.joint_names[worst]}",
            f"{count} {'joints are' if count > 1 else 'joint is'} too slow for a fist in half a "
            f"second; at {speed:.3g} per second this one needs {time:.2g} s",
            "give the true speeds in `limits`, or move more slowly than people do",
        )


def _check_followers(report: Report, hand: Hand) -> None:
    followers = hand.all_joint_roles.count("follower")
    if not followers:
        return
    plain = pin.buildModelFromXML(hand.urdf_text)
    for i, joint in enumerate(hand.joint_names):
        at = plain.joints[plain.getJointId(joint)].idx_q
        lower, upper = plain.lowerPositionLimit[at], plain.upperPositionLimit[at]
        narrowing = max(hand.lower_limits[i] - lower, upper - hand.upper_limits[i])
        if narrowing > 0.005 * (upper - lower):
            now = f"[{hand.lower_limits[i]:.3g}, {hand.upper_limits[i]:.3g}]"
            report.add(
                "fine",
                f"limits.{joint}",
                f"its followers narrow [{lower:.3g}, {upper:.3g}] to {now}",
            )
    report.add(
        "fine",
        "mimic",
        f"{followers} joints follow others" + ("" if hand.notes else ", within their own limits"),
    )


def _check_points(report: Report, hand: Hand) -> None:
    """Check partners, places and weights of the reference points."""
    points, names = hand.points(hand.rest), {point.name for point in load_hand("human").spec.points}
    partners = partner_names(hand, names)
    for i, point in enumerate(hand.reference_points):
        if (wanted := partners[i]) not in names:
            report.add(
                "advice",
                f"points.{point.name}",
                f"the human hand has no point {wanted!r}",
                "name a partner",
            )
        for j in range(i):
            if np.linalg.norm(points[i] - points[j]) < 1e-3:
                other = hand.reference_points[j].name
                report.add(
                    "warning", f"points.{point.name}", f"lies on {other}", "one of them will do"
                )
    weights = hand.point_weights
    if weights.max() > 100.0 * weights.min():
        report.add(
            "advice",
            "points.weight",
            f"weights are {weights.max() / weights.min():.0f}-fold apart",
            "stay within 100",
        )
    if len(points) < 3:
        report.add(
            "advice",
            "sets",
            f"{len(points)} points leave some of the hand's motion open",
            "add points of the same links",
        )


def _check_places(report: Report, hand: Hand) -> None:
    """Find reference points far outside the shape of their body."""
    try:
        robot = Robot(hand.urdf_text, urdf_path(hand.spec), root=hand.spec.wrist.link)
    except HandError:
        return
    for point in hand.reference_points:
        if point.link not in robot.links:
            continue
        body = robot.body(point.link)
        cloud = robot.body_surface(body)
        if len(cloud):
            place = transform_points(robot.pose_in(point.link, body), np.array(point.xyz))
            outside = np.maximum(
                np.maximum(cloud.min(axis=0) - place, place - cloud.max(axis=0)), 0.0
            )
            if (distance := float(np.linalg.norm(outside))) > _OFF_THE_LINK:
                what = f"lies {1e3 * distance:.0f} mm outside the shape of {point.link}"
                report.add(
                    "warning",
                    f"points.{point.name}",
                    what,
                    "check its xyz, in metres in that link's frame",
                )


def _check_meshes(report: Report, hand: Hand) -> None:
    robot = parse_urdf(urdf_with_mesh_paths(hand.spec, hand.urdf_text))
    for tag, use in (("collision", "self-collision and pinches"), ("visual", "pictures")):
        names = [
            mesh.get("filename", "") for shape in robot.iter(tag) for mesh in shape.iter("mesh")
        ]
        missing = [name for name in dict.fromkeys(names) if not Path(name).is_file()]
        if missing:
            shown = ", ".join(Path(name).name for name in missing[:_MOST_NAMES])
            more = ", ..." if len(missing) > _MOST_NAMES else ""
            report.add(
                "warning",
                "urdf",
                f"{len(missing)} of {len(set(names))} {tag} meshes are missing: {shown}{more}; "
                f"{use} do without them",
                f"put them where the URDF looks for them: {Path(missing[0]).parent}",
            )


def _check_wrist(report: Report, hand: Hand) -> None:
    spec = hand.spec
    if (
        spec.root is None
        or spec.arm is not None
        or (hand.has_moving_wrist and not hand.is_floating)
    ):
        return
    if urdf_path(spec).suffix != ".urdf":
        return
    robot = parse_urdf(read_urdf(spec))
    above = {child: (joint, parent) for joint, parent, child in edges(robot)}
    link, distance, left_out, base = spec.root, 0.0, [], ""
    while link in above:
        joint, parent = above[link]
        # The link turns about its own origin: count the way from there to the hand.
        if distance > _WRIST_REACH:
            break
        if joint.get("type") in MOVABLE:
            left_out.append(joint.get("name", ""))
            base = parent
        distance += float(np.linalg.norm(origin_of(joint)[:3, 3]))
        link = parent
    if left_out:
        report.add(
            "advice",
            "root",
            f"wrist joints are left out: {', '.join(reversed(left_out))}",
            f"keep them with `hands init --base {base}`",
        )


def _check_names(report: Report, hand: Hand) -> None:
    """Compare the fingers and the side with the names of links and joints."""
    model, names, chains = hand.model, [], find_fingers(hand)
    for finger, chain in chains.items():
        links = [point.link for point in hand.spec.points if point.finger == finger]
        names.append([*(model.names[j] for j in chain.joints), *links])
    for finger, label in zip(chains, named_fingers(names), strict=True):
        if label is not None and label != finger:
            report.add(
                "warning",
                f"points.{finger}_tip",
                f"its links and joints are named {label}, but its finger is {finger}",
                f"finger: {label}, with a matching name and partner",
            )
    side = named_side([hand.spec.palm.link, *(name for group in names for name in group)])
    if side is not None and side != hand.side and not hand.spec.mirror:
        report.add("warning", "side", f"links and joints are named {side}", f"side: {side}")


def _check_order(report: Report, hand: Hand) -> None:
    """Compare the row of the knuckles with the side: thumb and index are at the radial edge."""
    chains = find_fingers(hand)
    row = [chains[finger].knuckle for finger in FINGERS if finger in chains]
    places = PalmKinematics(hand).points(zero_posture(hand), row).reshape(-1, 3)
    steps = np.diff(places[:, 0]) * (-1.0 if hand.side == "right" else 1.0)
    if len(steps) and (steps > _NARROW).all():
        report.add(
            "warning",
            "side",
            f"the {hand.side} hand's fingers run from little to index, seen from the thumb's side",
            "change side, or the sign of palm.dorsal",
        )
    elif len(steps) and (steps > _NARROW).any():
        report.add(
            "warning", "points", "the fingers are not in the order of their knuckles", "rename them"
        )


def _check_fist(report: Report, hand: Hand) -> None:
    """Close the fingers: their tips must go to the palm, about an axis across it."""
    fist = make_fist(hand)
    if fist is None:
        return
    if fist.across_deg > 180.0 - _ACROSS:
        report.add(
            "warning",
            "palm.dorsal",
            "a fist brings the fingertips to the back of the hand",
            "turn dorsal over, or change side",
        )
    elif fist.across_deg > _ACROSS:
        report.add(
            "warning",
            "palm.dorsal",
            f"the fingers close about an axis {fist.across_deg:.0f} degrees off the palm's x axis",
            "correct distal and dorsal",
        )
    elif fist.distal_deg > _DISTAL:
        report.add(
            "warning",
            "palm.distal",
            f"the straight fingers point {fist.distal_deg:.0f} degrees off it",
            "correct distal",
        )
    else:
        report.add(
            "fine",
            "palm",
            f"{len(fist.fingers)} fingers close to the palm, {fist.across_deg:.0f} degrees off its "
            "x axis",
        )


def _check_opposition(report: Report, hand: Hand) -> None:
    """Find which fingers the thumb can touch."""
    report.pads = fingertip_pads(hand, find_fingers(hand))
    report.pinches = measure_pinches(hand)
    if not report.pinches:
        if THUMB not in find_fingers(hand):
            report.add("advice", "points", "no point is on a thumb: pinches are not mapped")
        return
    touched = [pinch.finger for pinch in report.pinches if pinch.touches]
    if touched:
        report.add("fine", "points", f"the thumb can touch {', '.join(touched)}")
        return
    nearest = min(report.pinches, key=lambda pinch: pinch.gap)
    level: Literal["warning", "advice"] = "warning" if nearest.gap > _OPPOSING else "advice"
    report.add(
        level,
        "points",
        f"the thumb touches no finger; nearest is the {nearest.finger}, "
        f"{1e3 * nearest.gap:.0f} mm away",
        "check the thumb, the tips, and the limits",
    )


def _compare_detection(report: Report, hand: Hand) -> None:
    """Compare the description with a detection from the URDF."""
    try:
        found = detect_text(hand.urdf_text, urdf_path(hand.spec), root=hand.spec.wrist.link)
    except HandError as error:
        report.add("advice", "palm", f"not compared with the URDF: {error.problem}")
        return
    clues = {clue.what: clue for clue in found.clues}
    own, theirs = hand.link_poses([hand.spec.palm.link, found.spec.palm.link], hand.rest)[:, :3, :3]
    for name in ("distal", "dorsal"):
        # The detected direction in the frame of the described palm link.
        other = own.T @ theirs @ np.array(getattr(found.spec.palm, name))
        angle = angle_between(np.array(getattr(hand.spec.palm, name)), other)
        is_certain = clues[name].certainty == "certain"
        allowed = _CERTAIN_ANGLE if is_certain else _LIKELY_ANGLE
        if angle > allowed and clues[name].confidence > _SURE:
            better = ", ".join(f"{value:.3f}" for value in other)
            what = f"is {angle:.0f} degrees from the detected one: {clues[name].how}"
            report.add("warning", f"palm.{name}", what, f"try [{better}]")
    if found.spec.side != hand.side and clues["side"].confidence > _SURE:
        report.add(
            "warning",
            "side",
            f"{clues['side'].how}: a {found.spec.side} hand",
            f"side: {found.spec.side}",
        )
    if clues["fingers"].confidence > _SURE and found.spec.side == hand.side:
        _compare_fingers(report, hand, found)


def _compare_fingers(report: Report, hand: Hand, found: Detection) -> None:
    """Compare the finger named by each point with the chain that moves it."""
    for point in hand.reference_points:
        mover = hand.model.names[place_of(hand, point)[0]]
        owner = next((finger for finger, chain in found.chains.items() if mover in chain), None)
        if owner is not None and point.finger is not None and owner != point.finger:
            what = f"is on the finger at the position of the {owner}, but names {point.finger}"
            report.add(
                "warning",
                f"points.{point.name}",
                what,
                f"finger: {owner}, with a matching name and partner",
            )


def _check_reach(report: Report, hand: Hand) -> None:
    report.reach = _best_of_each_finger(measure_reach(hand))
    for row in report.reach:
        if row.directions == 0:
            report.add(
                "warning",
                "points",
                f"no joint moves {row.point}",
                "put it on a link that moves, or leave it out",
            )


def _best_of_each_finger(rows: tuple[FingerReach, ...]) -> tuple[FingerReach, ...]:
    """Return the point of each finger with the largest span."""
    best: dict[str, FingerReach] = {}
    for row in rows:
        if row.finger not in best or row.span > best[row.finger].span:
            best[row.finger] = row
    return tuple(best.values())


def _check_collisions(report: Report, hand: Hand) -> None:
    if hand.spec.collision is not None:
        try:
            named_pairs(hand)
        except HandError as error:
            report.add("warning", error.key or "collision", error.problem, "correct the pair")
    pairs = colliding_links(hand, hand.rest)
    if pairs:
        shown = ", ".join(f"{one} and {other}" for one, other in pairs[:4]) + (
            ", ..." if len(pairs) > 4 else ""
        )
        report.add(
            "warning",
            "rest",
            f"at rest {shown} overlap",
            "open the hand or spread its fingers more",
        )
    else:
        report.add("fine", "rest", "no links overlap at rest, except neighbours at a joint")


def _check_size(report: Report, hand: Hand) -> None:
    tips = hand.with_points("fingertips") if "fingertips" in hand.spec.sets else hand
    report.size = size = measure_size(tips)
    if not 0.3 < size.ratio < 4.0:
        what = f"palm to fingertip is {size.length:.3g} m, {size.ratio:.2g} of a human hand"
        report.add(
            "warning", "palm.xyz", what, "check the URDF's unit (metres) and the palm's origin"
        )


def _check_arm(report: Report, hand: Hand) -> None:
    """Compare the reach of an arm with that of a person's hand in front of the body."""
    reach = measure_arm(hand)
    if reach is None:
        return
    far = int((reach >= _ARM_MOTION).sum())
    what = (
        f"the arm moves the wrist by {1e3 * _ARM_MOTION:.0f} mm in {far} of {len(reach)} "
        f"directions from rest, and by {1e3 * np.median(reach):.0f} mm in half of them"
    )
    scale = float(np.floor(20.0 * min(1.0, np.quantile(reach, 0.2) / _ARM_MOTION)) / 20.0)
    if far < _MOST_DIRECTIONS * len(reach):
        advice = "rest in the middle of the arm's range"
        if scale >= 0.05:
            what += f"; a scale of {scale:.2g} fits"
            advice += f", or map with --scale {scale:.2g}"
        report.add("advice", "rest", what, advice)
    else:
        report.add("fine", "rest", what)


def _check_motion(report: Report, hand: Hand) -> None:
    report.motion = try_motion(hand)
    for part in report.motion:
        if part.error > _OUT_OF_REACH:
            stops = f", {', '.join(part.limited[:3])} at a position limit" if part.limited else ""
            what = (
                f"{part.name}: {part.worst_point} stays {1e3 * part.error:.0f} mm "
                f"from its target{stops}"
            )
            report.add("advice", "reach", what)


_CHECKS = (
    *(("joints", check) for check in (_check_joints, _check_ranges, _check_speeds)),
    ("joints", _check_followers),
    ("points", _check_points),
    ("points", _check_places),
    ("meshes", _check_meshes),
    ("root", _check_wrist),
    *(("palm", check) for check in (_check_names, _check_order, _check_fist, _check_opposition)),
    ("palm", _compare_detection),
    ("rest", _check_collisions),
    ("reach", _check_reach),
    ("size", _check_size),
    ("arm", _check_arm),
    ("motion", _check_motion),
)
