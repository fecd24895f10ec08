"""Check a `hand.yaml`: `check_hand` reports findings and advice.

The checks are independent of how `detect` reasons: they compare names, make a fist and pinches,
look for files, and map a motion.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from handmap_qp.errors import HandError, HandmapError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.shape_pairs import named_pairs
from handmap_qp.onboarding.check_anatomy import check_anatomy
from handmap_qp.onboarding.check_files import check_files
from handmap_qp.onboarding.check_joints import check_joints
from handmap_qp.onboarding.check_points import check_points
from handmap_qp.onboarding.measure import (
    FingerReach,
    colliding_links,
    measure_arm,
    measure_reach,
    measure_size,
    try_motion,
)
from handmap_qp.onboarding.report import Report

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
    checks: list[tuple[str, Callable[[Report, Hand], None]]] = [
        ("joints", check_joints),
        ("points", check_points),
        ("meshes", check_files),
        ("palm", check_anatomy),
        ("rest", _check_collisions),
        ("reach", _check_reach),
        ("size", _check_size),
        ("arm", _check_arm),
    ]
    if has_motion:
        checks.append(("motion", _check_motion))
    for where, check in checks:
        try:
            check(report, built)
        except HandmapError as error:
            report.add("advice", where, f"not checked: {error}")
    if not any(finding.level in ("error", "warning") for finding in report.findings):
        report.add(
            "fine", "", "no contradiction between description, names, limits, shapes and gestures"
        )
    report.findings.sort(
        key=lambda finding: ("error", "warning", "advice", "fine").index(finding.level)
    )
    return report


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
