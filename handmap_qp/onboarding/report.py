"""What `handmap hands check` found: findings with advice, and tables of what was measured."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from handmap_qp.errors import HandError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.pads import Pad
from handmap_qp.onboarding.gestures import Pinch
from handmap_qp.onboarding.measure import FingerReach, MotionPart, Size

Level = Literal["error", "warning", "advice", "fine"]
LEVELS = get_args(Level)
"""All levels, the worst first."""


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
        pinches: How near the thumb comes to each finger.
        pads: Ball under the surface of each fingertip, for pinches.
    """

    name: str
    hand: Hand | None = None
    findings: list[Finding] = field(default_factory=list)
    reach: tuple[FingerReach, ...] = ()
    size: Size | None = None
    motion: tuple[MotionPart, ...] = ()
    pinches: tuple[Pinch, ...] = ()
    pads: dict[str, Pad] = field(default_factory=dict)

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
        tables["Pads"] = [
            {
                "finger": finger,
                "on the link of": "" if self.hand is None else self.hand.model.names[pad.joint],
                "centre, mm": " ".join(f"{1e3 * value:.1f}" for value in pad.offset),
                "radius, mm": round(1e3 * pad.radius, 1),
            }
            for finger, pad in self.pads.items()
        ]
        tables["Pinches"] = [
            {
                "thumb and": pinch.finger,
                "nearest, mm between pads": max(0.0, round(1e3 * pinch.gap, 1)),
                "touch": "yes" if pinch.touches else "no",
            }
            for pinch in self.pinches
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
