"""From the URDF in the file to the URDF of a hand's model: `compose_urdf`.

All changes are made to the text, so that every reader of `Hand.urdf_text` (Pinocchio, MuJoCo, a
picture) sees the same robot.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import NamedTuple

from handmap_qp.errors import HandError
from handmap_qp.hands.spec import HandSpec, LimitSpec, MimicSpec
from handmap_qp.hands.urdf.arm import mount_on_arm, remove_tools
from handmap_qp.hands.urdf.check import check_limits, check_tree
from handmap_qp.hands.urdf.elements import parse_urdf
from handmap_qp.hands.urdf.joints import (
    complete_followers,
    fix_free_joints,
    lock_joints,
    set_limits,
    set_mimic_rules,
)
from handmap_qp.hands.urdf.mirror import mirrored_urdf
from handmap_qp.hands.urdf.tree import cut_subtree


class ComposedUrdf(NamedTuple):
    """The URDF of a hand's model.

    Attributes:
        text: The URDF.
        locked: Position of every joint that was made a fixed one [rad or m]: those that the spec
            locks, and the joints that mimic them.
    """

    text: str
    locked: dict[str, float]


def compose_urdf(spec: HandSpec, text: str, arm_text: str | None = None) -> ComposedUrdf:
    """Compose the URDF that a hand's model is built from.

    The steps: keep only the part from `root` outwards; write `mimic`, `locked` and `limits` into
    it; mount it on the arm; mirror all of it.

    Args:
        spec: The hand.
        text: Its URDF as in the file (or scaled).
        arm_text: The URDF of its arm; needed where the spec has one.

    Returns:
        The URDF and the locked joints.

    Raises:
        HandError: If the URDF is not a tree, the spec names links or joints that do not exist, a
            joint is left without limits, or arm and hand have joints of the same name.
    """
    try:
        robot = parse_urdf(text)
        check_tree(robot)
        locked = prepare_urdf(robot, spec.root, spec.mimic, spec.locked, spec.limits)
        if spec.arm is not None and arm_text is not None:
            arm = parse_urdf(arm_text)
            check_tree(arm)
            remove_tools(arm, spec.arm)
            arm_locked = prepare_urdf(arm, spec.arm.root, {}, spec.arm.locked, spec.arm.limits)
            locked = {**arm_locked, **locked}
            robot = mount_on_arm(arm, robot, spec.arm)
        check_limits(robot)
        text = ET.tostring(robot, encoding="unicode")
        return ComposedUrdf(mirrored_urdf(text) if spec.mirror else text, locked)
    except HandError as error:
        raise spec.located(error) from error


def prepare_urdf(
    robot: ET.Element,
    root: str | None,
    mimic: Mapping[str, MimicSpec | None],
    locked: Mapping[str, float],
    limits: Mapping[str, LimitSpec],
) -> dict[str, float]:
    """Cut one URDF and edit its joints.

    Args:
        robot: The `<robot>` element, changed in place.
        root: Link from which outwards it is kept; all of it if None.
        mimic: Mimic rules by follower, as of `HandSpec`.
        locked: Positions of joints to lock [rad or m].
        limits: Limits by joint name.

    Returns:
        Positions of all joints that were locked [rad or m].

    Raises:
        HandError: If a link or joint does not exist.
    """
    if root is not None:
        cut_subtree(robot, root)
    set_mimic_rules(robot, mimic)
    positions = lock_joints(robot, locked)
    fix_free_joints(robot)
    set_limits(robot, limits)
    complete_followers(robot)
    return positions
