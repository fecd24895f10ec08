"""Checks of a description's joints: limits, speeds, followers."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from handmap_qp.hands.hand import Hand
from handmap_qp.onboarding.report import Report

# A person makes a fist in this time [s], and flexes each joint by up to this angle [rad].
_FIST_TIME, _FIST_ANGLE = 0.5, 1.5
# A larger range is in degrees or millimetres [rad or m].
_LARGEST_TURN, _LARGEST_SLIDE = 2.0 * np.pi + 0.01, 2.0


def check_joints(report: Report, hand: Hand) -> None:
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
    _check_ranges(report, hand)
    _check_speeds(report, hand)
    _check_followers(report, hand)


def _check_ranges(report: Report, hand: Hand) -> None:
    """Find ranges in degrees or millimetres; joints of an arm may turn twice."""
    width, carriers = hand.upper_limits - hand.lower_limits, _carriers(hand)
    for slides, largest, unit in (
        (False, _LARGEST_TURN, "degrees"),
        (True, _LARGEST_SLIDE, "millimetres"),
    ):
        wide = [
            i
            for i, joint in enumerate(hand.joint_names)
            if width[i] > largest
            and _slides(hand, joint) == slides
            and hand.model.getJointId(joint) not in carriers
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


def _slides(hand: Hand, joint: str) -> bool:
    return (
        hand.model.joints[hand.model.getJointId(joint)]
        .shortname()
        .startswith(("JointModelP", "JointModelPrismatic"))
    )


def _check_speeds(report: Report, hand: Hand) -> None:
    """Find joints of the fingers that are too slow for a fist in half a second."""
    stretched = np.clip(0.0, hand.lower_limits, hand.upper_limits)
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
