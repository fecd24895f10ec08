"""Check that a `hand.yaml` agrees with its URDF: `check_hand` reports findings and advice."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError, HandmapError
from handmap_qp.hands.fingers import partner_names
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.urdf.files import urdf_path
from handmap_qp.onboarding.detect import Detection, detect_text
from handmap_qp.onboarding.measure import (
    FingerReach,
    MotionPart,
    Size,
    colliding_links,
    measure_reach,
    measure_size,
    try_motion,
)
from handmap_qp.onboarding.robot import Robot
from handmap_qp.transform import transform_points

Level = Literal["error", "warning", "advice", "fine"]

# Least confidence of the detection for a warning.
_SURE = 0.65
# A point this far from its target is out of reach [m].
_OUT_OF_REACH = 0.02
# A person makes a fist in this time [s], and flexes each joint by up to this angle [rad].
_FIST_TIME, _FIST_ANGLE = 0.5, 1.5
# Allowed distance of a reference point from its link's shape, for example a sensor's frame [m].
_OFF_THE_LINK = 0.02


@dataclass(frozen=True, slots=True)
class Finding:
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


@dataclass(eq=False)
class Report:
    """All findings about a hand.

    Attributes:
        name: Name of the hand.
        hand: The hand; None if it cannot be built.
        findings: All findings.
        reach: How each finger's farthest-reaching point moves.
        size: Size of the hand; None if not measured.
        motion: How it follows a standard motion; empty if not tried.
    """

    name: str
    hand: Hand | None = None
    findings: list[Finding] = field(default_factory=list)
    reach: tuple[FingerReach, ...] = ()
    size: Size | None = None
    motion: tuple[MotionPart, ...] = ()

    def add(self, level: Level, where: str, what: str, change: str = "") -> None:
        """Add a finding."""
        self.findings.append(Finding(level, where, what, change))

    def raise_if_unusable(self) -> None:
        """Raise the first error, if there is one.

        Raises:
            HandError: With the finding.
        """
        for finding in self.findings:
            if finding.level == "error":
                raise HandError(
                    f"{finding.what}; {finding.change}" if finding.change else finding.what,
                    key=finding.where,
                )

    def tables(self) -> dict[str, list[dict[str, Any]]]:
        """Return everything as tables to print: rows by title."""
        size = self.size
        findings = [
            {"": f.level, "key": f.where, "found": f.what, "change": f.change}
            for f in self.findings
        ]
        tables: dict[str, list[dict[str, Any]]] = {f"{self.name}: findings": findings}
        if self.hand is not None:
            tables["Joints"] = _joint_rows(self.hand)
        tables["Fingers"] = [
            {
                "point": row.point,
                "span mm": 1e3 * row.span,
                "moves in": f"{row.directions} of 3 directions",
                "slowest direction, mm per rad or m": 1e3 * row.slowest,
                "manipulability": f"{row.manipulability:.2e}",
            }
            for row in self.reach
        ]
        if size is not None:
            rows = {
                "length, palm to fingertip": f"{1e3 * size.length:.0f} mm, "
                f"{size.ratio:.2f} of a human hand",
                "RMS distance of fingertips from their mean": f"{1e3 * size.cloud:.0f} mm; "
                f"a person's: {1e3 * size.human_cloud:.0f} mm",
                "suggested scale": "1 (translations as the human's), or "
                f"{size.ratio:.2f} (in proportion to the hand)",
            }
            tables["Size"] = [{"what": what, "value": value} for what, value in rows.items()]
        tables["A standard motion"] = [
            {
                "posture": row.name,
                "worst point": row.worst_point,
                "error mm": 1e3 * row.error,
                "joints at a position limit": ", ".join(row.limited),
            }
            for row in self.motion
        ]
        return {title: rows for title, rows in tables.items() if rows}

    def document(self, picture: Path | None) -> dict[str, Any]:
        """Return everything as values for JSON."""
        tables = self.tables()
        tables["findings"] = [
            {"level": f.level, "key": f.where, "found": f.what, "change": f.change}
            for f in self.findings
        ]
        tables.pop(f"{self.name}: findings")
        return {"name": self.name, **tables, "picture": None if picture is None else str(picture)}


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
    _check_joints(report, built)
    _check_points(report, built)
    _check_anatomy(report, built)
    _check_collisions(report, built)
    report.reach = _best_of_each_finger(measure_reach(built))
    for row in report.reach:
        if row.directions == 0:
            report.add(
                "warning",
                "points",
                f"no joint moves {row.point}",
                "put it on a link that moves, or leave it out",
            )
    tips = built.with_points("fingertips") if "fingertips" in built.spec.sets else built
    report.size = measure_size(tips)
    _check_size(report, report.size)
    if has_motion:
        _check_motion(report, built)
    if not any(finding.level in ("error", "warning") for finding in report.findings):
        report.add("fine", "", "description and URDF agree")
    report.findings.sort(
        key=lambda finding: ("error", "warning", "advice", "fine").index(finding.level)
    )
    return report


def _best_of_each_finger(rows: tuple[FingerReach, ...]) -> tuple[FingerReach, ...]:
    """Return the point of each finger with the largest span."""
    best: dict[str, FingerReach] = {}
    for row in rows:
        if row.finger not in best or row.span > best[row.finger].span:
            best[row.finger] = row
    return tuple(best.values())


def _joint_rows(hand: Hand) -> list[dict[str, Any]]:
    """Return a row per joint of the URDF: role, limits of active joints, rest angle."""
    rest = hand.all_joints(hand.rest)
    rows = []
    for i, (joint, role) in enumerate(zip(hand.all_joint_names, hand.all_joint_roles, strict=True)):
        is_set = i < len(hand.joint_names)
        limits = f"[{hand.lower_limits[i]:.3g}, {hand.upper_limits[i]:.3g}]" if is_set else ""
        speed = f"{hand.velocity_limits[i]:.3g}" if is_set else ""
        rows.append(
            {"joint": joint, "role": role, "limits": limits, "speed": speed, "rest": float(rest[i])}
        )
    return rows


def _check_joints(report: Report, hand: Hand) -> None:
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
    _check_speeds(report, hand)
    _check_followers(report, hand)


def _check_speeds(report: Report, hand: Hand) -> None:
    """Find joints of the fingers that are too slow for a fist in half a second."""
    wrist = hand.model.frames[hand.wrist_frame_id].parentJoint
    stretched = np.clip(0.0, hand.lower_limits, hand.upper_limits)
    travel = np.maximum(hand.upper_limits - stretched, stretched - hand.lower_limits)
    needed = np.minimum(travel, _FIST_ANGLE) / _FIST_TIME
    carriers = set(hand.model.supports[wrist])
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
    _check_places(report, hand)
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


def _check_anatomy(report: Report, hand: Hand) -> None:
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
        angle = float(
            np.degrees(
                np.arccos(np.clip(np.array(getattr(hand.spec.palm, name)) @ other, -1.0, 1.0))
            )
        )
        if angle > 40.0 and clues[name].confidence > _SURE:
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
        _check_fingers(report, hand, found)


def _check_fingers(report: Report, hand: Hand, found: Detection) -> None:
    """Compare the finger named by each point with the chain that moves it."""
    for point in hand.reference_points:
        joint = hand.model.frames[hand.model.getFrameId(point.link)].parentJoint
        mover = hand.model.names[joint]
        owner = next((finger for finger, chain in found.chains.items() if mover in chain), None)
        if owner is not None and point.finger is not None and owner != point.finger:
            what = f"is on the finger at the position of the {owner}, but names {point.finger}"
            report.add(
                "warning",
                f"points.{point.name}",
                what,
                f"finger: {owner}, with a matching name and partner",
            )


def _check_collisions(report: Report, hand: Hand) -> None:
    try:
        pairs = colliding_links(hand, hand.rest)
    except HandmapError as error:
        report.add("advice", "urdf", f"self-collisions were not checked: {error}")
        return
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


def _check_size(report: Report, size: Size) -> None:
    if not 0.3 < size.ratio < 4.0:
        what = f"palm to fingertip is {size.length:.3g} m, {size.ratio:.2g} of a human hand"
        report.add(
            "warning", "palm.xyz", what, "check the URDF's unit (metres) and the palm's origin"
        )


def _check_motion(report: Report, hand: Hand) -> None:
    try:
        report.motion = try_motion(hand)
    except HandmapError as error:
        report.add("advice", "", f"the standard motion was not tried: {error}")
        return
    for part in report.motion:
        if part.error > _OUT_OF_REACH:
            stops = f", {', '.join(part.limited[:3])} at a position limit" if part.limited else ""
            what = (
                f"{part.name}: {part.worst_point} stays {1e3 * part.error:.0f} mm "
                f"from its target{stops}"
            )
            report.add("advice", "reach", what)
