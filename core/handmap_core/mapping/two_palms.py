"""Where the targets of both hands go: palms turn to the person's, and near ones keep their offset.

The `RobotMapper` of the compiled core has the same for hands that it maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from msgspec import structs

from handmap_core.core import core
from handmap_core.hands import Hand
from handmap_core.ik import AttachedPoints, PointOffset
from handmap_core.se3 import (
    Array,
    affine,
    inverse_pose,
    lengths,
    smoothstep,
    transform_points,
)
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
        person: The person's palm in the robot's world, shape (4, 4).
    """

    map: PalmMap
    person: Array


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
    targets = moved_by(world, request.targets)
    if not isinstance(target_map, PalmMap):
        return AimedHand(targets)
    palm = LedPalm(target_map, world @ target_map.person_at(request.pose))
    return AimedHand(turned(targets, palm, share), palm)


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
    apart = (other.person - first.person)[:3, 3]
    gap = lengths(apart) / (1.0 + first.map.further)
    share = float(smoothstep((NEAR - gap) / (NEAR - TOGETHER)))
    is_aligned = np.array_equal(first.map.alignment, other.map.alignment)
    if share == 0.0 or not is_aligned:
        return hands, ()
    ends, places = [], []
    for hand, palm, part in zip(hands, palms, robot.hands, strict=True):
        anchor = palm.map.robot_anchor
        ends.append(transform_points(hand.targets.wrist @ part.wrist_to_palm, anchor))
        frame = part.palm_frame
        placement = frame.placement.homogeneous
        places.append((frame.parentJoint, transform_points(placement, anchor)))
    offset = ends[1] - ends[0]
    aim = offset + share * (apart - offset)
    shifts = [sign * (aim - offset) for sign in (-0.5, 0.5)]
    moved = [
        AimedHand(turned(hand.targets, palm, share, shift), palm)
        for hand, palm, shift in zip(hands, palms, shifts, strict=True)
    ]
    points = AttachedPoints(robot, places)
    return moved, (PointOffset(points, aim, TOGETHER_SHARE * share * weight),)


def turned(
    targets: Targets, palm: LedPalm, share: float, shift: Array | float = 0.0
) -> Targets:
    """Return targets whose palm has turned about its anchor to the person's axes, and shifted.

    Args:
        targets: The targets.
        palm: Their palm.
        share: Share of the turn, from 0 to 1.
        shift: The shift [m], shape (3,).
    """
    here = targets.wrist @ inverse_pose(palm.map.robot_palm_to_wrist)
    centre = transform_points(here, palm.map.robot_anchor)
    whole = palm.person[:3, :3] @ here[:3, :3].T
    turn = core.exp3(share * core.log3(whole))
    return moved_by(affine(turn, centre - turn @ centre + shift), targets)


def moved_by(motion: Array, targets: Targets) -> Targets:
    """Return the targets of a hand after a motion, shape (4, 4)."""
    points = transform_points(motion, targets.points)
    return structs.replace(targets, points=points, wrist=motion @ targets.wrist)
