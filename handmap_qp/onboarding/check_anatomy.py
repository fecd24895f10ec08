"""Checks of palm axes, side and fingers: against names, gestures, and a detection."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError
from handmap_qp.hands.fingers import THUMB, Finger, PalmKinematics, find_fingers, zero_posture
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.urdf.files import urdf_path
from handmap_qp.onboarding.anatomy import FINGERS
from handmap_qp.onboarding.detect import Detection, detect_text
from handmap_qp.onboarding.finger_names import named_fingers, named_side
from handmap_qp.onboarding.gestures import fingertip_pads, make_fist, measure_pinches
from handmap_qp.onboarding.report import Report

# Least confidence of the detection for a warning, and the angle with and without certainty [deg].
_SURE = 0.65
_CERTAIN_ANGLE, _LIKELY_ANGLE = 20.0, 40.0
# Largest angles of the axis of flexion and of the straight fingers to the palm's axes [deg].
_ACROSS, _DISTAL = 25.0, 35.0
# A thumb whose pad stays farther than this from every other opposes none of them [m].
_OPPOSING = 0.015
# Knuckles closer than this may be in any order [m].
_NARROW = 0.004


def check_anatomy(report: Report, hand: Hand) -> None:
    """Compare palm axes, side and fingers with names, a fist, pinches and a detection."""
    chains = find_fingers(hand)
    _check_names(report, hand, chains)
    _check_order(report, hand, chains)
    _check_fist(report, hand)
    _check_opposition(report, hand)
    _compare_detection(report, hand)


def _check_names(report: Report, hand: Hand, chains: dict[str, Finger]) -> None:
    """Compare the fingers and the side with the names of links and joints."""
    model, names = hand.model, []
    for finger, chain in chains.items():
        links = [point.link for point in hand.spec.points if point.finger == finger]
        names.append([*(model.names[j] for j in chain.joints), *links])
    for (finger, _), label in zip(chains.items(), named_fingers(names), strict=True):
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


def _check_order(report: Report, hand: Hand, chains: dict[str, Finger]) -> None:
    """Compare the row of the knuckles with the side: thumb and index are at the radial edge."""
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
        angle = float(
            np.degrees(
                np.arccos(np.clip(np.array(getattr(hand.spec.palm, name)) @ other, -1.0, 1.0))
            )
        )
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
        frame = hand.model.getFrameId(point.link, pin.FrameType.BODY)
        joint = hand.model.frames[frame].parentJoint
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
