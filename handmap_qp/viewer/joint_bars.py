"""A robot's joints as bars between their limits, finger by finger: `joint_bars`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from itertools import takewhile

import numpy as np
import pinocchio as pin

from handmap_qp.hands.hand import Hand
from handmap_qp.viewer.markup import FIRST, ORANGE, RED, SECOND, legend
from handmap_qp.viewer.sample import ViewSample

# Characters; longer joint names are shortened in the middle.
_LONGEST_NAME = 19


def joint_bars(robot: Hand, sample: ViewSample, other: ViewSample | None = None) -> str:
    """Draw every joint as a bar from its lower to its upper position limit, finger by finger.

    The bar is red at a position limit, and orange where the speed limit held the joint.

    Args:
        robot: The robot hand.
        sample: Its posture.
        other: The posture that it is compared with, as a narrow bar below.

    Returns:
        The HTML.
    """
    ranges = robot.upper_limits - robot.lower_limits

    def shares(q: np.ndarray) -> np.ndarray:
        return np.clip((q - robot.lower_limits) / ranges, 0.0, 1.0)

    is_limited = np.zeros(len(ranges), dtype=bool)
    if sample.is_limited is not None:
        is_limited = sample.is_limited
    columns = zip(
        robot.joint_names,
        short_names(robot.joint_names),
        sample.robot_q,
        shares(sample.robot_q),
        shares(robot.rest),
        np.full(len(ranges), np.nan) if other is None else shares(other.robot_q),
        np.where(robot.at_position_limit(sample.robot_q), RED, np.where(is_limited, ORANGE, FIRST)),
        strict=True,
    )
    bars = [_joint_bar(*column) for column in columns]
    groups = "".join(
        f'<div style="color:#666;margin-top:2px">{escape(finger)}</div>'
        f"{''.join(bars[i] for i in joints)}"
        for finger, joints in joints_by_finger(robot).items()
    )
    entries = (("position limit", RED), ("speed limit", ORANGE))
    return (
        '<div style="font-size:11px;line-height:14px;padding:4px 14px">'
        '<div style="font-weight:600">joints between their limits</div>'
        f"{groups}</div>{legend(entries)}"
    )


def joints_by_finger(robot: Hand) -> dict[str, list[int]]:
    """Return the joints that move one finger alone, by its name, and all others as `palm`.

    Args:
        robot: The robot hand.

    Returns:
        Indices into `Hand.joint_names`; every joint once.
    """
    model = robot.model
    carried = [
        (
            point.finger,
            set(
                model.supports[
                    model.frames[model.getFrameId(point.link, pin.FrameType.BODY)].parentJoint
                ]
            ),
        )
        for point in robot.spec.points
        if point.finger is not None
    ]
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(robot.joint_names):
        joint = model.getJointId(name)
        fingers = {finger for finger, joints in carried if joint in joints}
        groups.setdefault(fingers.pop() if len(fingers) == 1 else "palm", []).append(i)
    return groups


def _joint_bar(
    name: str, short: str, q: float, share: float, rest: float, other: float, colour: str
) -> str:
    """Return one joint's row: name, bar with a mark at the rest angle, and angle, as HTML."""
    bar = f"height:7px;border-radius:4px;background:{colour}"
    second = ""
    if not np.isnan(other):
        second = (
            f'<span style="position:absolute;left:0;top:5px;width:{100 * other:.1f}%;height:3px;'
            f'background:{SECOND}"></span>'
        )
    return (
        '<div style="display:flex;align-items:center;height:14px">'
        f'<span title="{escape(name)}" style="width:112px;overflow:hidden;white-space:nowrap">'
        f"{escape(short)}</span>"
        '<span style="flex:1;position:relative;height:7px;background:#e4e6ea;border-radius:4px">'
        f'<span style="position:absolute;left:0;width:{100 * share:.1f}%;{bar}"></span>{second}'
        f'<span style="position:absolute;left:{100 * rest:.1f}%;top:-2px;width:1px;height:11px;'
        'background:#333"></span></span>'
        f'<span style="width:40px;text-align:right;color:{colour}">{np.degrees(q):.0f}°</span>'
        "</div>"
    )


def short_names(names: Sequence[str]) -> list[str]:
    """Shorten joint names to the panel's width.

    If any name is too long, remove the prefix that all share, then the middle of those still too
    long: names differ at their ends.
    """
    if max(map(len, names)) <= _LONGEST_NAME:
        return list(names)
    # Cut the shared prefix only after a separator.
    alike = takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    shared = (
        re.split(r"[^_./]*$", "".join(letters[0] for letters in alike))[0] if len(names) > 1 else ""
    )
    rest = [name.removeprefix(shared) for name in names]
    head, tail = _LONGEST_NAME // 2 - 3, _LONGEST_NAME // 2 + 3
    return [
        name if len(name) <= _LONGEST_NAME else f"{name[:head]}…{name[-tail:]}" for name in rest
    ]
