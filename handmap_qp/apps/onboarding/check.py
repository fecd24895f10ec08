"""Check a `hand.yaml`: `check_hand` reports findings and advice, and tables of what was measured.

The checks close a fist and pinch, compare the description with a detection, look for files, and map
a motion. Each yields its findings, and may yield tables.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import msgspec
import numpy as np
import pinocchio as pin

from handmap_qp.apps.onboarding.anatomy import FINGERS, Clue, angle_between
from handmap_qp.apps.onboarding.collision_pairs import colliding_links, joined_notes
from handmap_qp.apps.onboarding.detect import detect_text, left_out_wrist
from handmap_qp.apps.onboarding.measure import (
    fingertip_pads,
    make_fist,
    measure_arm,
    measure_directions,
    measure_pinches,
    measure_reach,
    measure_size,
    tour_gestures,
    try_motion,
)
from handmap_qp.apps.onboarding.robot import Robot
from handmap_qp.apps.tables import rows_of
from handmap_qp.errors import HandError, HandmapError
from handmap_qp.hands.collision_shapes import parse_with_meshes
from handmap_qp.hands.fingers import (
    PalmKinematics,
    carrier_of,
    find_fingers,
    partner_names,
    place_of,
    zero_posture,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import THUMB
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.robot import Robot as WholeRobot
from handmap_qp.hands.shape_pairs import all_pairs, named_pairs
from handmap_qp.hands.sources import read_urdf, urdf_path
from handmap_qp.hands.spec import HandSpec
from handmap_qp.se3 import lengths
from handmap_qp.trackers.formats.base import first_of

# A person makes a fist in this time [s], and flexes each joint by up to this angle [rad].
_FIST_TIME = 0.5
_FIST_ANGLE = 1.5
# A larger range is in degrees or millimetres [rad or m].
_LARGEST_TURN = 2.0 * np.pi + 0.01
_LARGEST_SLIDE = 2.0
# Allowed distance of a reference point from its link's shape, for example a sensor's frame [m].
_OFF_THE_LINK = 0.02
# Names in one finding.
_MOST_NAMES = 3
# Least confidence of the detection for a finding: of fingers and side, and of a direction, whose
# largest angle depends on its certainty [deg].
_SURE = 0.65
_WORTH = 0.45
_ANGLES = {"certain": 20.0, "likely": 40.0, "a guess: check it": 60.0}
# Largest angles of the axis of flexion and of the straight fingers to the palm's axes [deg].
_ACROSS = 25.0
_DISTAL = 35.0
# Knuckles closer than this may be in any order [m].
_NARROW = 0.004
# A thumb whose pad stays farther than this from every other opposes none of them [mm].
_OPPOSING = 15.0
# A joint moves if its range is more than this [rad or m].
_MOVES = 0.2
# A point this far from its target is out of reach [mm].
_OUT_OF_REACH = 20.0
# A person's hand moves this far to all sides in front of the body [m].
_ARM_MOTION = 0.25
# A direction of the hand that an arm misses by more is worth saying [deg].
_ASTRAY = 30.0
# So is a shorter way for one of 50 mm [mm].
_SHORT = 25.0
# An arm follows if it reaches that far in this share of the directions.
_MOST_DIRECTIONS = 0.8

Level = Literal["error", "warning", "advice", "fine"]
LEVELS = get_args(Level)
"""All levels, the worst first."""
Rows = list[dict[str, Any]]
"""Rows of a table: values by column."""
Tables = dict[str, Rows]
"""Rows by the title of their table."""


class Finding(NamedTuple):
    """One finding about a description.

    Attributes:
        level: `error`: cannot be used; `warning`: probably wrong; `advice`: could be better;
            `fine`: no problem.
        where: Key of the `hand.yaml`.
        what: What was found.
        change: What to change; empty if nothing.
    """

    level: Level
    where: str
    what: str
    change: str = ""


Findings = Iterator[Finding]
Measures = Iterator[Finding | tuple[str, list[Any]]]
"""Findings, and tables: a title and rows, which are structs or plain."""
warning, advice, fine = (partial(Finding, level) for level in LEVELS[1:])


@dataclass(eq=False)
class Report:
    """All findings about a hand.

    Attributes:
        name: Name of the hand.
        hand: The hand; None if it cannot be built.
        findings: All findings, the worst first.
        measured: Tables of what was measured.
    """

    name: str
    hand: Hand | None = None
    findings: list[Finding] = field(default_factory=list)
    measured: Tables = field(default_factory=dict)

    def raise_if_unusable(self) -> None:
        """Raise the first error, if there is one.

        Raises:
            HandError: With the finding.
        """
        for level, where, what, change in self.findings:
            if level == "error":
                raise HandError(f"{what}; {change}" if change else what, key=where)

    def tables(self) -> Tables:
        """Return everything as tables to print: rows by title."""
        return {f"{self.name}: findings": self._rows(""), **self.measured}

    def document(self, picture: Path | None) -> dict[str, Any]:
        """Return everything as values for JSON."""
        shown = None if picture is None else str(picture)
        rows = self._rows("level")
        return {"name": self.name, **self.measured, "findings": rows, "picture": shown}

    def _rows(self, level: str) -> Rows:
        """Return a row per finding; `level` heads its first column."""
        return [
            {level: at, "key": where, "found": what, "change": change}
            for at, where, what, change in self.findings
        ]


def check_hand(hand: str | Path, *, has_motion: bool = True) -> Report:
    """Check a description.

    Args:
        hand: Path of a `hand.yaml` or name of a hand.
        has_motion: Whether to map a standard motion to it, and an arm's six directions.

    Returns:
        All findings; the only one is an error if the hand cannot be built.
    """
    report = Report(str(hand))
    with warnings.catch_warnings():
        # Warnings of the loader are among `hand.notes`, which become findings.
        warnings.simplefilter("ignore")
        try:
            report.hand = built = load_hand(hand)
        except HandError as error:
            report.findings.append(Finding("error", error.key or "hand", str(error)))
            return report
        report.name = built.name
        report.measured["Joints"] = _joint_rows(built)
        for check in _CHECKS[: None if has_motion else -2]:
            try:
                for found in check(built):
                    if isinstance(found, Finding):
                        report.findings.append(found)
                    else:
                        title, rows = found
                        if rows:
                            report.measured[title] = msgspec.to_builtins(rows)
            except HandmapError as error:
                where = getattr(error, "key", None) or "hand"
                report.findings.append(advice(where, f"not checked: {error}"))
    if "warning" not in {finding.level for finding in report.findings}:
        what = (
            "no contradiction between description, names, limits, shapes and gestures"
        )
        report.findings.append(fine("", what))
    report.findings.sort(key=lambda finding: LEVELS.index(finding.level))
    return report


def check_robot(robot: WholeRobot, *, has_motion: bool = True) -> Report:
    """Check the descriptions of a robot's hands, and what overlaps at rest.

    Args:
        robot: The robot.
        has_motion: Whether to map a standard motion to each hand.

    Returns:
        All findings of its hands and of itself.
    """
    report = Report(robot.name, measured={"Hands": palm_rows(robot)})
    for side, hand in robot.hands.items():
        found = check_hand(str(hand.spec.file), has_motion=has_motion).findings
        report.findings += [one._replace(where=f"{side}: {one.where}") for one in found]
    hands = [*robot.hands.values()]
    whole = hands[0]
    wrists = [carrier_of(whole, hand.spec.wrist.link) for hand in hands]
    # Links of one hand are among its own findings.
    pairs = colliding_links(whole, whole.rest, wrists)
    change = "move the arms apart, and away from the body"
    report.findings.append(_overlap(pairs, change))
    report.findings.sort(key=lambda finding: LEVELS.index(finding.level))
    return report


def palm_rows(robot: WholeRobot) -> Rows:
    """Return a row for each hand: its palm at rest in the robot's base, and its wrist's reach."""
    rows = []
    for side, hand in robot.hands.items():
        pose = hand.frame_pose("palm", hand.rest)
        reach = measure_arm(hand)
        rows.append(
            {
                "side": side,
                "palm": hand.spec.palm.link,
                "at, m": _joined(pose[:3, 3], 3),
                "fingers point": _joined(pose[:3, 1], 2),
                "reach, m": 0.0 if reach is None else float(np.median(reach)),
            }
        )
    return rows


def _joined(values: np.ndarray, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)


def _joint_rows(hand: Hand) -> Rows:
    """Return a row per joint of the URDF: role, limits of active joints, rest angle."""
    ends = zip(hand.lower_limits, hand.upper_limits, strict=True)
    # Followers, which come last, have no limits of their own.
    return rows_of(
        {
            "joint": hand.all_joint_names,
            "role": hand.all_joint_roles,
            "limits": [f"[{lower:.3g}, {upper:.3g}]" for lower, upper in ends],
            "speed": [f"{speed:.3g}" for speed in hand.velocity_limits],
            "rest": hand.all_joints(hand.rest).tolist(),
        }
    )


def _check_joints(hand: Hand) -> Findings:
    """Check limits, rest angles, speeds and followers."""
    change = "correct the URDF, or give the rule in `mimic` or the limits in `limits`"
    yield from (warning("mimic", note, change) for note in hand.notes)
    columns = (hand.rest, hand.lower_limits, hand.upper_limits, hand.velocity_limits)
    for joint, rest, lower, upper, speed in zip(
        hand.joint_names, *columns, strict=True
    ):
        width = upper - lower
        if min(rest - lower, upper - rest) < 0.01 * width:
            what = "rests at its limit, so it can move in one direction only"
            yield advice(f"rest.{joint}", what, "move it inwards")
        if width < 0.002:
            what = f"{joint} has a range of {width:.2g}"
            yield warning("limits", what, "give its true limits, or lock it")
        if not 0.02 <= speed <= 60.0:
            what = f"a speed of {speed:.3g} per second is unusual"
            yield advice(f"limits.{joint}", what, "check its unit")


def _check_ranges(hand: Hand) -> Findings:
    """Find ranges in degrees or millimetres; joints of an arm may turn twice."""
    width = np.where(hand.moves_wrist, 0.0, hand.upper_limits - hand.lower_limits)
    joints = [hand.model.getJointId(joint) for joint in hand.joint_names]
    turns = PalmKinematics(hand).axes(hand.rest, joints)[0].any(axis=1)
    for kind, largest, unit in (
        (turns, _LARGEST_TURN, "degrees"),
        (~turns, _LARGEST_SLIDE, "millimetres"),
    ):
        wide = np.flatnonzero((width > largest) & kind)
        if len(wide):
            have = (
                f"{len(wide)} joints have ranges" if len(wide) > 1 else "it has a range"
            )
            what = f"{have} of up to {width[wide].max():.3g}: in {unit}?"
            where = f"limits.{hand.joint_names[wide[0]]}"
            yield warning(where, what, "give limits in rad and m")


def _check_speeds(hand: Hand) -> Findings:
    """Find joints of the fingers that are too slow for a fist in half a second."""
    stretched = zero_posture(hand)
    travel = np.maximum(hand.upper_limits - stretched, stretched - hand.lower_limits)
    times = np.minimum(travel, _FIST_ANGLE) / hand.velocity_limits
    times[hand.moves_wrist] = 0.0
    worst = np.argmax(times)
    if count := (times > _FIST_TIME).sum():
        what = (
            f"{count} {'joints are' if count > 1 else 'joint is'} too slow for a fist in half a "
            f"second; at {hand.velocity_limits[worst]:.3g} per second this one needs "
            f"{times[worst]:.2g} s"
        )
        change = "give the true speeds in `limits`, or move more slowly than people do"
        yield advice(f"limits.{hand.joint_names[worst]}", what, change)


def _check_followers(hand: Hand) -> Findings:
    followers = hand.all_joint_roles.count("follower")
    if not followers:
        return
    plain = pin.buildModelFromXML(hand.urdf_text)
    at = [plain.idx_qs[plain.getJointId(joint)] for joint in hand.joint_names]
    limits = (plain.lowerPositionLimit[at], plain.upperPositionLimit[at])
    own = (hand.lower_limits, hand.upper_limits)
    for joint, lower, upper, low, high in zip(
        hand.joint_names, *limits, *own, strict=True
    ):
        if max(low - lower, upper - high) > 0.005 * (upper - lower):
            what = f"its followers narrow [{lower:.3g}, {upper:.3g}] to [{low:.3g}, {high:.3g}]"
            yield fine(f"limits.{joint}", what)
    within = "" if hand.notes else ", within their own limits"
    yield fine("mimic", f"{followers} joints follow others{within}")


def _check_points(hand: Hand) -> Findings:
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


def _check_places(hand: Hand) -> Findings:
    """Find reference points far outside the shape of their body."""
    try:
        robot = Robot(hand.urdf_text, urdf_path(hand.spec), root=hand.spec.wrist.link)
    except HandError:
        return
    for point in hand.reference_points:
        if point.link not in robot.frames:
            continue
        body, place = robot.place_of(point.link, np.array(point.xyz))
        if not len(cloud := robot.surface(body)):
            continue
        distance = lengths(place - place.clip(cloud.min(axis=0), cloud.max(axis=0)))
        if distance > _OFF_THE_LINK:
            what = f"lies {1e3 * distance:.0f} mm outside the shape of {point.link}"
            change = "check its xyz, in metres in that link's frame"
            yield warning(f"points.{point.name}", what, change)


def _check_meshes(hand: Hand) -> Findings:
    robot = parse_with_meshes(hand)
    for tag, use in (
        ("collision", "self-collision and pinches"),
        ("visual", "pictures"),
    ):
        meshes = (mesh for shape in robot.iter(tag) for mesh in shape.iter("mesh"))
        files = {Path(mesh.get("filename", "")): None for mesh in meshes}
        if missing := [file for file in files if not file.is_file()]:
            shown = first_of([file.name for file in missing], _MOST_NAMES)
            what = f"{len(missing)} of {len(files)} {tag} meshes are missing: {shown}; "
            change = f"put them where the URDF looks for them: {missing[0].parent}"
            yield warning("urdf", f"{what}{use} do without them", change)


def _check_wrist(hand: Hand) -> Findings:
    """Find actuated wrist joints that the description leaves out."""
    spec = hand.spec
    is_on_arm = hand.has_moving_wrist and not hand.is_floating
    if spec.root is None or is_on_arm or urdf_path(spec).suffix != ".urdf":
        return
    joints, base = left_out_wrist(Robot(read_urdf(spec), urdf_path(spec)), spec.root)
    if joints:
        what = f"wrist joints are left out: {joints}"
        yield advice("root", what, f"keep them with `hands init --base {base}`")


def _check_order(hand: Hand) -> Findings:
    """Compare the row of the knuckles with the side: thumb and index are at the radial edge."""
    chains = find_fingers(hand)
    row = [chains[finger].knuckle for finger in FINGERS if finger in chains]
    places = PalmKinematics(hand).points(zero_posture(hand), row).reshape(-1, 3)
    is_back = np.diff(places[:, 0]) * (-1.0 if hand.side == "right" else 1.0) > _NARROW
    if len(is_back) and is_back.all():
        what = (
            f"the {hand.side} hand's fingers run from little to index, "
            "seen from the thumb's side"
        )
        yield warning("side", what, "change side, or the sign of palm.dorsal")
    elif is_back.any():
        what = "the fingers are not in the order of their knuckles"
        yield warning("points", what, "rename them")


def _check_fist(hand: Hand) -> Findings:
    """Close the fingers: their tips must go to the palm, about an axis across it."""
    if (fist := make_fist(hand)) is None:
        return
    across = f"{fist.across_deg:.0f} degrees off"
    if fist.across_deg > 180.0 - _ACROSS:
        what = "a fist brings the fingertips to the back of the hand"
        yield warning("palm.dorsal", what, "turn dorsal over, or change side")
    elif fist.across_deg > _ACROSS:
        what = f"the fingers close about an axis {across} the palm's x axis"
        yield warning("palm.dorsal", what, "correct distal and dorsal")
    elif fist.distal_deg > _DISTAL:
        what = f"the straight fingers point {fist.distal_deg:.0f} degrees off it"
        yield warning("palm.distal", what, "correct distal")
    else:
        what = f"{len(fist.fingers)} fingers close to the palm, {across} its x axis"
        yield fine("palm", what)


def _check_opposition(hand: Hand) -> Measures:
    """Find which fingers the thumb can touch."""
    fingers = find_fingers(hand)
    pads = [
        {
            "finger": finger,
            "on the link of": hand.model.names[pad.joint],
            "centre, mm": _joined(1e3 * pad.offset, 1),
            "radius, mm": round(1e3 * pad.radius, 1),
        }
        for finger, pad in fingertip_pads(hand, fingers).items()
    ]
    yield "Pads", pads
    pinches = measure_pinches(hand)
    yield "Pinches", pinches
    touched = [pinch.finger for pinch in pinches if pinch.touch == "yes"]
    if THUMB not in fingers:
        yield advice("points", "no point is on a thumb: pinches are not mapped")
    elif touched:
        yield fine("points", f"the thumb can touch {', '.join(touched)}")
    elif pinches:
        near = min(pinches, key=lambda pinch: pinch.gap)
        what = f"the thumb touches no finger; nearest is the {near.finger}, {near.gap:.0f} mm away"
        finding = warning if near.gap > _OPPOSING else advice
        yield finding("points", what, "check the thumb, the tips, and the limits")


def _compare_detection(hand: Hand) -> Findings:
    """Compare the description with a detection from the URDF."""
    try:
        found = detect_text(
            hand.urdf_text, urdf_path(hand.spec), root=hand.spec.wrist.link
        )
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


def _compare_axes(
    hand: Hand,
    found: HandSpec,
    clues: dict[str, Clue],
) -> Findings:
    """Find axes of the palm that point elsewhere than the detected ones."""
    links = [hand.spec.palm.link, found.palm.link]
    own, theirs = hand.link_poses(links, hand.rest)[:, :3, :3]
    for name in ("distal", "dorsal"):
        clue = clues[name]
        # The detected direction in the frame of the described palm link.
        other = own.T @ theirs @ np.array(getattr(found.palm, name))
        angle = angle_between(np.array(getattr(hand.spec.palm, name)), other)
        if clue.confidence > _WORTH and angle > _ANGLES[clue.certainty]:
            what = f"is {angle:.0f} degrees from the detected one: {clue.how}"
            better = ", ".join(f"{value:.3f}" for value in other)
            yield warning(f"palm.{name}", what, f"try [{better}]")


def _compare_fingers(hand: Hand, chains: dict[str, tuple[str, ...]]) -> Findings:
    """Find points that name another finger than the one whose joints move them."""
    # A joint of several fingers is the first one's.
    pairs = reversed(chains.items())
    owners = {joint: finger for finger, joints in pairs for joint in joints}
    for point in hand.reference_points:
        owner = owners.get(hand.model.names[place_of(hand, point)[0]])
        if owner is not None and point.finger not in (None, owner):
            what = f"is on the finger at the position of the {owner}, but names {point.finger}"
            change = f"finger: {owner}, with a matching name and partner"
            yield warning(f"points.{point.name}", what, change)


def _check_reach(hand: Hand) -> Measures:
    """Find fingers whose point no joint moves."""
    rows = measure_reach(hand)
    yield "Fingers", rows
    for row in rows:
        if row.moves_in.startswith("0"):
            change = "put it on a link that moves, or leave it out"
            yield warning("points", f"no joint moves {row.point}", change)


def _check_collisions(hand: Hand) -> Findings:
    if hand.spec.collision is not None:
        try:
            named_pairs(hand, hand.spec.collision.pairs)
        except HandError as error:
            yield warning(error.key or "collision", error.problem, "correct the pair")
    pairs = colliding_links(hand, hand.rest)
    yield _overlap(pairs, "open the hand or spread its fingers more")


def _overlap(pairs: list[tuple[str, str]], change: str) -> Finding:
    if pairs:
        shown = first_of([*map(" and ".join, pairs)], _MOST_NAMES)
        return warning("rest", f"at rest {shown} overlap", change)
    return fine("rest", "no links overlap at rest, except neighbours at a joint")


def _check_size(hand: Hand) -> Measures:
    tips = hand.with_points("fingertips") if "fingertips" in hand.spec.sets else hand
    size = measure_size(tips)
    ratio = f"{size.ratio:.2f}"
    rows = {
        "length, palm to fingertip": f"{1e3 * size.length:.0f} mm, {ratio} of a human hand",
        "RMS distance of fingertips from their mean": f"{1e3 * size.cloud:.0f} mm; "
        f"a person's: {1e3 * size.human_cloud:.0f} mm",
        "suggested scale": "1 (translations as the human's), or "
        f"{ratio} (in proportion to the hand)",
    }
    yield "Size", [{"what": what, "value": value} for what, value in rows.items()]
    if not 0.3 < size.ratio < 4.0:
        what = f"palm to fingertip is {size.length:.3g} m, {size.ratio:.2g} of a human hand"
        change = "check the URDF's unit (metres) and the palm's origin"
        yield warning("palm.xyz", what, change)


def _check_arm(hand: Hand) -> Findings:
    """Compare the reach of an arm with that of a person's hand in front of the body."""
    if (reach := measure_arm(hand)) is None:
        return
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


def _check_contacts(hand: Hand) -> Measures:
    """Find joints that links lock by lying on each other."""
    for note in joined_notes(all_pairs(hand, find_fingers(hand))):
        yield fine("collision", note)
    rows = tour_gestures(hand)
    yield "A tour of gestures", rows
    for row in rows:
        free = row.without_contacts
        if free > _MOVES and row.with_contacts < 0.5 * free:
            what = (
                f"contacts narrow the range of {row.joint} in a tour of gestures from "
                f"{free:.2g} to {row.with_contacts:.2g}: {row.held_by or 'some links'} meet"
            )
            yield warning("urdf", what, "correct the collision shapes of these links")


def _check_motion(hand: Hand) -> Measures:
    motion = try_motion(hand)
    yield "A standard motion", motion
    for part in motion:
        if part.error_mm > _OUT_OF_REACH:
            far = f"{part.worst_point} stays {part.error_mm:.0f} mm from its target"
            if stops := part.joints_at_a_position_limit:
                far += (
                    f", {first_of(stops.split(', '), _MOST_NAMES)} at a position limit"
                )
            yield advice("reach", f"{part.posture}: {far}")
    directions = measure_directions(hand)
    yield "Directions", directions
    for row in directions:
        far = lengths(np.array(row["robot moved, mm"]))
        if row["degrees off"] > _ASTRAY or far < _SHORT:
            way = f"{row['direction']}, {row['degrees off']:.0f} degrees off"
            yield advice(
                "reach", f"{way} and {far:.0f} of 50 mm: the arm cannot go there"
            )


_CHECKS = (
    _check_joints,
    _check_ranges,
    _check_speeds,
    _check_followers,
    _check_points,
    _check_places,
    _check_meshes,
    _check_wrist,
    _check_order,
    _check_fist,
    _check_opposition,
    _compare_detection,
    _check_collisions,
    _check_reach,
    _check_size,
    _check_arm,
    _check_contacts,
    _check_motion,
)
