"""Where the targets of both hands go: palms turn to the person's, and near ones keep their offset.

The compiled core has the formulas (`handmap/two_palms.hpp`). Its `RobotMapper` moves the targets of
hands that it maps; these functions move those of all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from msgspec import structs

from handmap_core.core import core
from handmap_core.hands import Hand
from handmap_core.ik import AttachedPoints, PointOffset
from handmap_core.se3 import Array, transform_points
from .hand_request import AnyRequest
from .palm import PalmMap
from .targets import Targets

NEAR = 0.4
"""Distance of the person's palms at which the robot's begin to go by it [m]."""
TOGETHER = 0.2
"""Distance at which they wholly do [m]."""
TOGETHER_SHARE = 5.0
"""Weight of their offset over the weight of a wrist's position."""


class LedPalm(NamedTuple):
    """A palm that a method leads.

    Attributes:
        map: The map that leads it.
        core: The palm as the core has it, with the person's.
    """

    map: PalmMap
    core: core.LedPalm


class AimedHand(NamedTuple):
    """Where one hand of a robot goes, seen from the robot's base.

    Attributes:
        targets: Its targets.
        palm: Its palm; None where the hand stays, or the method moves no palm.
    """

    targets: Targets
    palm: LedPalm | None = None


def aimed(request: AnyRequest, world: Array, share: float) -> AimedHand:
    """Return where a hand goes, with a palm that is turning to the person's.

    Args:
        request: What the hand asks.
        world: The world of its reference, seen from the robot's base, shape (4, 4). A hand that
            stays goes with the base.
        share: Share of the turn, from 0 to 1.
    """
    target_map = request.map
    if target_map is None:
        return AimedHand(request.targets)
    targets = with_moved_targets(world, request.targets)
    if not isinstance(target_map, PalmMap):
        return AimedHand(targets)
    person = world @ target_map.person_at(request.pose)
    palm = LedPalm(target_map, core.LedPalm(target_map.core_palm, person))
    return AimedHand(
        with_moved_targets(palm.core.turn(targets.wrist, share), targets), palm
    )


def brought_together(
    hands: Sequence[AimedHand], robot: Hand, weight: float
) -> tuple[Sequence[AimedHand], tuple[PointOffset, ...]]:
    """Return both hands with near palms seen from each other as the person's.

    Args:
        hands: Where the hands go.
        robot: The robot.
        weight: Weight of a wrist's position.

    Returns:
        The hands, and a term of the QP's cost for palms that cannot come there. Palms that are not
        near are as they were, without a term.
    """
    palms = [hand.palm for hand in hands if hand.palm]
    if len(palms) < 2:
        return hands, ()
    first, other = palms
    wrist, other_wrist = (hand.targets.wrist for hand in hands)
    meeting = first.core.meeting(wrist, other.core, other_wrist, NEAR, TOGETHER)
    if meeting is None:
        return hands, ()
    *motions, aim, share = meeting
    moved = []
    places = []
    for hand, palm, motion, part in zip(
        hands, palms, motions, robot.hands, strict=True
    ):
        moved.append(AimedHand(with_moved_targets(motion, hand.targets), palm))
        frame = part.palm_frame
        placement = frame.placement.homogeneous
        anchor = transform_points(placement, palm.map.robot_anchor)
        places.append((frame.parentJoint, anchor))
    points = AttachedPoints(robot, places)
    return moved, (PointOffset(points, aim, TOGETHER_SHARE * share * weight),)


def with_moved_targets(motion: Array, targets: Targets) -> Targets:
    """Return the targets of a hand after a motion, shape (4, 4)."""
    points = transform_points(motion, targets.points)
    return structs.replace(targets, points=points, wrist=motion @ targets.wrist)
