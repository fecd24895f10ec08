"""Presets: a mapping method and QP weights that go together, by name."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.hand_pair import KNUCKLES, MIDDLES, TIPS
from handmap_qp.mapping.method import Method
from handmap_qp.mapping.methods.homogeneous import Homogeneous
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.mapping.options import Alignment, MappingOptions, Rotation

PresetName = Literal["teleoperation", "object", "paper", "fixed_wrist"]
MethodOptions = MappingOptions | Teleoperation
"""The options of a preset's method."""
_IK_NAMES = frozenset(item.name for item in fields(IkOptions))


class Preset(NamedTuple):
    """A method and QP weights that go together.

    Attributes:
        method: Mapping method.
        ik: Weights and settings of the QP.
        purpose: Intended use, in words.
        weakness: Known weaknesses, in words.
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
        Homogeneous(MappingOptions(rigid_from="wrist", pivot="palm", reference="rest")),
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
    "fixed_wrist": Preset(
        Homogeneous(
            MappingOptions(rigid_from="none", pivot="palm", reference="rest", alignment="palm")
        ),
        IkOptions(),
        "in-hand motion on a hand whose wrist cannot move: all of T deforms the fingers' grasp",
        "gestures; the motion of the human's own wrist goes to the fingers as well",
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
    """Choose the preset for two hands.

    It is teleoperation where fingers correspond, else object, or fixed_wrist if the robot's wrist
    cannot move.

    Args:
        human: The hand that leads.
        robot: The hand that follows.
    """
    given = {point.name for point in human.reference_points}
    fingers = set(FINGERS) & {point.finger for point in robot.spec.points}
    needed = {table[finger] for finger in fingers for table in (TIPS, MIDDLES, KNUCKLES)}
    if fingers and needed <= given:
        return "teleoperation"
    return "object" if robot.has_moving_wrist else "fixed_wrist"


def possible_presets(human: Hand, robot: Hand) -> tuple[PresetName, ...]:
    """Return the presets that two hands can be mapped with.

    Args:
        human: The hand that leads.
        robot: The hand that follows.
    """
    first = default_preset(human, robot)
    following: tuple[PresetName, ...] = ("teleoperation",) if first == "teleoperation" else ()
    moving: tuple[PresetName, ...] = ("object", "paper")
    return (*following, *(moving if robot.has_moving_wrist else ()), "fixed_wrist")


class Choice(NamedTuple):
    """A preset with the options that were chosen for it.

    Attributes:
        preset: Name of the preset.
        options: Options of its method.
        ik: Weights and settings of the QP.
    """

    preset: PresetName
    options: MethodOptions
    ik: IkOptions

    @property
    def method(self) -> Method:
        """The method with these options."""
        options = self.options
        return Homogeneous(options) if isinstance(options, MappingOptions) else options

    @property
    def is_teleoperation(self) -> bool:
        """True if the options are those of `Teleoperation`."""
        return isinstance(self.options, Teleoperation)

    @property
    def alignment(self) -> Alignment | Rotation:
        """Rotation from the human's world axes to the robot's, as of `MappingOptions`."""
        return self.options.alignment if isinstance(self.options, MappingOptions) else "world"

    def check_has(self, names: Iterable[str]) -> None:
        """Reject options that the preset does not have.

        Raises:
            InvalidOptionsError: With the first one by name.
        """
        known = {item.name for item in fields(self.options)}
        if unknown := sorted(set(names) - known):
            raise InvalidOptionsError(
                option=unknown[0],
                problem=f"the preset {self.preset} has no such option",
                advice="choose another preset, or leave it out",
            )

    def with_changes(self, changes: dict[str, Any]) -> Choice:
        """Return a copy with other values for some options.

        Args:
            changes: Values by the names of options of the method and of the QP. If `preset` is
                among them, options that are not named are those of that preset.

        Raises:
            InvalidOptionsError: If there is no such preset or option, or options contradict each
                other.
        """
        rest = dict(changes)
        start = preset_choice(rest.pop("preset")) if "preset" in rest else self
        ik = {name: rest.pop(name) for name in _IK_NAMES & rest.keys()}
        start.check_has(rest)
        return start._replace(options=replace(start.options, **rest), ik=replace(start.ik, **ik))

    def changes_to(self, other: Choice) -> dict[str, Any]:
        """Return the changes that turn this choice into another one."""
        start, changes = self, {}
        if self.preset != other.preset:
            start, changes = preset_choice(other.preset), {"preset": other.preset}
        for ours, theirs in ((start.options, other.options), (start.ik, other.ik)):
            for item in fields(theirs):
                # array_equal, because an alignment may be a matrix.
                if not np.array_equal(getattr(ours, item.name), getattr(theirs, item.name)):
                    changes[item.name] = getattr(theirs, item.name)
        return changes


def preset_choice(name: str, contact_gap: float | None = None) -> Choice:
    """Return a preset with its own options.

    Args:
        name: Name of the preset.
        contact_gap: The measured contact gap [m]; the preset's if omitted.

    Raises:
        InvalidOptionsError: If there is no such preset.
    """
    method, ik = get_preset(name)[:2]
    options: MethodOptions
    if isinstance(method, Homogeneous):
        options = method.options
    elif isinstance(method, Teleoperation):
        options = method if contact_gap is None else replace(method, contact_gap=contact_gap)
    else:
        raise InvalidOptionsError(option="preset", problem=f"{name} has no options")
    return Choice(next(known for known in get_args(PresetName) if known == name), options, ik)
