"""Arguments that several commands share.

A field added to `MappingArguments` becomes an option of every command that maps.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass
from typing import Annotated, Any

import tyro

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.options import MappingOptions

HandName = Annotated[str, tyro.conf.arg(metavar="HAND")]
"""Name of a hand of the package, or path of a hand.yaml."""
PointSet = Annotated[
    str | None, tyro.conf.arg(metavar="SET", help_behavior_hint="(default: the hand's own)")
]
"""Name of a set of reference points."""


@dataclass(frozen=True)
class MappingArguments:
    """What a command needs to know to map a human hand to a robot hand.

    Attributes:
        human_points: Set of reference points on the human hand; `handmap hands human` lists them.
        robot_points: Set of reference points on the robot hand; `handmap hands HAND` lists them.
        mapping: How the human's motion becomes the robot's.
        ik: Weights and settings of the QP, per 10 mm, per 0.1 rad of the wrist, per rad of a joint.
    """

    human_points: PointSet = None
    robot_points: PointSet = None
    mapping: Annotated[MappingOptions, tyro.conf.arg(name="")] = field(
        default_factory=MappingOptions
    )
    ik: Annotated[IkOptions, tyro.conf.arg(name="ik")] = field(default_factory=IkOptions)

    def load_robot(self, name: str) -> Hand:
        """Load a robot hand with the chosen reference points.

        Raises:
            HandError: If there is no such hand or set.
        """
        return load_hand(name, points=self.robot_points)

    def changed(self) -> list[str]:
        """Return the options that differ from their defaults, as `--ridge` or `--ik.damping`."""
        return _changed(self, MappingArguments(), "--")


def _changed(given: Any, default: Any, prefix: str) -> list[str]:
    names = []
    for item in fields(given):
        value, usual = getattr(given, item.name), getattr(default, item.name)
        if value == usual:
            continue
        if is_dataclass(value):
            names += _changed(value, usual, f"{prefix}ik." if item.name == "ik" else prefix)
        else:
            names.append(prefix + item.name.replace("_", "-"))
    return names
