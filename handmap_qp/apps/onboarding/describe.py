"""Lists and descriptions of hands and robots in plain values: `hands list`, `robots show`, ..."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from handmap_qp.apps.tables import rows_of
from handmap_qp.hands import (
    BASE,
    LONGEST_STOP,
    Hand,
    HandSpec,
    Values,
    hand_files,
    load_hand,
    load_robot,
    parse_urdf,
    read_hand_spec,
    read_hands,
    read_robot_spec,
    robot_files,
    urdf_path,
    why_missing,
)
from .findings import Rows
from .measure import palm_rows

# Links that stand on the base of a composed robot.
_BASES = f"joint/parent[@link='{BASE}']/../child"


def list_hands() -> Rows:
    """List all hands that have a name, and what installs them; those of others come last."""
    return [
        {
            "name": spec.name,
            "side": spec.side,
            "joints": len(spec.joints),
            "wrist": spec.wrist.mount,
            "point sets": ", ".join(spec.sets),
            "available": _available(spec),
        }
        for spec in map(read_hand_spec, hand_files().values())
    ]


def list_robots() -> Rows:
    """List the robots of the package with their hands, and what installs a missing one."""
    rows = []
    for name, file in robot_files().items():
        hands = read_hands(read_robot_spec(file)).values()
        names = ", ".join(hand.name for hand in hands)
        rows.append({"name": name, "hands": names, "available": _available(*hands)})
    return rows


def _available(*hands: HandSpec) -> str:
    """Return whether hands are installed, or what installs the first that is missing."""
    missing = [*filter(None, map(why_missing, hands))]
    return f"no: {missing[0]}" if missing else "yes"


def describe_hand(given: str | Path) -> Values:
    """Describe one hand in plain values for JSON: frames, joints with limits, reference points.

    Args and errors are those of `load_hand`.
    """
    found = load_hand(given)
    return {
        "name": found.name,
        "side": found.side,
        "urdf": str(urdf_path(found.spec)),
        "wrist": f"{found.mount}, link {found.spec.wrist.link}",
        "palm": f"link {found.spec.palm.link}",
        "stops within": f"{LONGEST_STOP:g} s",
        "speeds from": found.spec.speeds or "not said",
        "joints": _joint_rows(found),
        "points": [
            {
                "point": point.name,
                "link": point.link,
                "finger": point.finger or "",
                "weight": point.weight,
                "in use": "yes" if point in found.reference_points else "",
            }
            for point in found.spec.points
        ],
    }


def describe_robot(given: str | Path) -> Values:
    """Describe a robot in plain values for JSON: its hands, and its joints by part.

    Args and errors are those of `load_robot`.
    """
    found = load_robot(given)
    first = found.hands[0]
    bases = parse_urdf(first.urdf_text).iterfind(_BASES)
    return {
        "name": found.name,
        "base": ", ".join(child.get("link", "") for child in bases),
        "hands": palm_rows(found),
        "joints": _joint_rows(first, part=_parts(found)),
    }


def _parts(robot: Hand) -> list[str]:
    """Return what each joint is part of: `left arm`, `left hand`, ..., or `shared` by both."""
    hands = robot.hands
    arms = np.array([hand.moves_wrist for hand in hands])
    parts = np.full(arms.shape[1], "other", dtype=object)
    for hand, arm, own in zip(hands, arms, robot.finger_joints, strict=True):
        parts[own] = f"{hand.side} hand"
        parts[arm] = f"{hand.side} arm"
    parts[arms.sum(axis=0) > 1] = "shared"
    return parts.tolist()


def _joint_rows(hand: Hand, **extra_columns: Sequence[str]) -> Rows:
    """Return a row for each joint with its limits, and further columns."""
    columns = {
        "joint": hand.joint_names,
        **extra_columns,
        "lower rad": hand.lower_limits,
        "upper rad": hand.upper_limits,
        "speed rad/s": hand.velocity_limits,
        "stop": hand.stop_distances,
        "rest rad": hand.rest,
    }
    return rows_of(columns)
