"""Presets: a mapping method and QP weights that go together, by name."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.hand_pair import KNUCKLES, MIDDLES, TIPS
from handmap_qp.mapping.method import Method
from handmap_qp.mapping.methods.homogeneous import Homogeneous
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.mapping.options import MappingOptions

PresetName = Literal["teleoperation", "object", "paper"]


class Preset(NamedTuple):
    """A method and QP weights that go together.

    Attributes:
        method: How a sample becomes targets.
        ik: Weights and settings of the QP.
        purpose: What it is for.
        weakness: Where it loses.
    """

    method: Method
    ik: IkOptions
    purpose: str
    weakness: str


PRESETS: dict[str, Preset] = {
    "teleoperation": Preset(
        Teleoperation(),
        IkOptions(
            wrist_position_weight=10.0,
            wrist_orientation_weight=10.0,
            rest_weight=0.05,
        ),
        "gestures and pinches of a tracked hand: each robot finger does what the human's does",
        "needs a tracked palm, and fingers with names; a grasped object's motion is not imposed",
    ),
    "object": Preset(
        Homogeneous(MappingOptions(rigid_from="wrist", pivot="palm")),
        IkOptions(wrist_position_weight=10.0, wrist_orientation_weight=10.0),
        "in-hand motion: the palm follows the wrist, and T deforms the fingers' grasp; no partners",
        "gestures: T cannot tell a pointing finger from a fist",
    ),
    "paper": Preset(
        Homogeneous(),
        IkOptions(),
        "eqs. (5)-(8) as published: rigid part and deformation from the points alone",
        "gestures; closing the fingers turns the robot's wrist, by 24 deg for a half-closed hand",
    ),
}
"""All presets, by name."""


def get_preset(name: str) -> Preset:
    """Return a preset.

    Raises:
        InvalidOptionsError: If there is no such preset.
    """
    if name not in PRESETS:
        raise InvalidOptionsError(
            option="preset", expected=f"one of {', '.join(get_args(PresetName))}", value=name
        )
    return PRESETS[name]


def default_preset(human: Hand, robot: Hand) -> PresetName:
    """Choose the preset for two hands: teleoperation where fingers correspond, else object.

    Args:
        human: The hand that leads.
        robot: The hand that follows.
    """
    given = {point.name for point in human.reference_points}
    fingers = {point.finger for point in robot.spec.points} & set(FINGERS)
    needed = {table[finger] for finger in fingers for table in (TIPS, MIDDLES, KNUCKLES)}
    if fingers and needed <= given:
        return "teleoperation"
    return "object" if robot.has_moving_wrist else "paper"
