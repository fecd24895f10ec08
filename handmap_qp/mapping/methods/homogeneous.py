"""The paper's method: T of the human's points, split, and imposed on the robot's (eqs. 2-7).

`handmap_core.mapping.homogeneous` has the options, and prepares the formulas for a reference; the
compiled core computes them (`handmap/targets.hpp`). Here the method is bound to two hands whose
points name partners, and has its presets.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from handmap_core.mapping import homogeneous
from handmap_qp.hands import Hand
from handmap_qp.ik import IkOptions
from handmap_qp.mapping import FOLLOWING, AlignedOptions, Preset, require_partners

if TYPE_CHECKING:
    from handmap_qp.hands import ShapePairs


class BoundHomogeneous(homogeneous.BoundHomogeneous[Hand]):
    """The method for two hands; see `BoundMethod`."""

    contacts: ShapePairs | None = None

    def __init__(self, options: Homogeneous, human: Hand, robot: Hand) -> None:
        super().__init__(options, human, robot)
        if options.residual_gain > 0.0:
            self.partners = require_partners(
                human,
                robot,
                option="residual_gain",
                value=options.residual_gain,
                advice=", or give residual_gain=0",
            )


class Homogeneous(homogeneous.HomogeneousOptions, AlignedOptions, frozen=True):
    """The paper's mapping, and the choices that it leaves open: how T is estimated, split, imposed.

    The defaults are the paper's, but for `ridge`: 0 is its least squares.
    """

    bound_type = BoundHomogeneous


MappingOptions = Homogeneous
"""The same by the name of its options."""
TELEMANIPULATION = Homogeneous(
    rigid_from="wrist", pivot="palm", residual_gain=1.0, deformation_gain=0.5
)
"""Choices for a tracked wrist and a robot whose points name partners: the wrist goes where the
human's does, and fingers follow fingers."""

PRESETS = {
    "paper": Preset(
        Homogeneous(),
        IkOptions(),
        "eqs. (5)-(8) as published: rigid part and deformation from the points alone",
        "gestures; closing the fingers turns the robot's wrist, by 24 deg for a half-closed hand",
        rank=1,
    ),
    "object": Preset(
        Homogeneous(rigid_from="wrist", pivot="palm", reference="rest"),
        FOLLOWING,
        "in-hand motion: the palm follows the wrist, and T deforms the fingers' grasp; no partners",
        "gestures: T cannot tell a pointing finger from a fist",
        rank=1,
        suits=lambda _, robot: robot.has_moving_wrist,
    ),
    "fixed_wrist": Preset(
        Homogeneous(
            rigid_from="none", pivot="palm", reference="rest", alignment="palm"
        ),
        IkOptions(),
        "in-hand motion on a hand whose wrist cannot move: all of T deforms the fingers' grasp",
        "gestures; the motion of the human's own wrist goes to the fingers as well",
        rank=1,
        suits=lambda *_: True,
    ),
}
