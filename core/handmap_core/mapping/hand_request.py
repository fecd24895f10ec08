"""What one hand of a person asks of a robot, for one command."""

from __future__ import annotations

import copyreg
from typing import Any

from handmap_core.core import core
from handmap_core.se3 import Array, ArrayStruct
from .targets import AnyPose, TargetMap, Targets


class HandRequest(ArrayStruct, frozen=True):
    """What one hand of a person asks of a robot. The core has the same as its `HandRequest`.

    Attributes:
        pose: The person's hand.
        targets: Of the robot's hand, as the method has them.
        rest: Joint positions that the QP's rest term pulls to [rad or m], shape (n,).
        dt: Time since the last sample of this hand, which its filters and turns count in [s]. The
            robot's limits do not: see `When`.
        speed: Share of the speed limits at which the robot may move.
        map: What made the targets; None for a hand that stays where it is.
    """

    pose: AnyPose
    targets: Targets
    rest: Array
    dt: float
    speed: float = 1.0
    map: TargetMap | None = None


AnyRequest = HandRequest | core.HandRequest
"""A request, of Python or of the core: both have the same attributes."""


def _reduced_request(request: core.HandRequest) -> tuple[Any, ...]:
    """Make a copy of a request of the core one of Python, by copy or pickle."""
    pose, targets, rest = request.pose, request.targets, request.rest
    fields = pose, targets, rest, request.dt, request.speed, request.map
    return HandRequest, fields


copyreg.pickle(core.HandRequest, _reduced_request)
