"""The option `alignment` of methods; `handmap_core.mapping.alignment` has what it means."""

from collections.abc import Callable
from typing import ClassVar

from handmap_core.mapping import alignment
from handmap_core.mapping.alignment import ROTATIONS as ROTATIONS
from handmap_core.mapping.alignment import Alignment as Alignment
from handmap_core.mapping.alignment import Row as Row
from handmap_core.mapping.alignment import (
    alignment_from_gestures as alignment_from_gestures,
)
from handmap_core.mapping.alignment import rotation_of as rotation_of
from handmap_core.mapping.alignment import rotation_onto as rotation_onto
from handmap_qp.hands import Hand, Values
from .method import BoundMethod, MethodOptions


class AlignedOptions(
    alignment.AlignedOptions, MethodOptions, frozen=True, kw_only=True
):
    """Base of methods whose robot moves as the human does in the world."""

    bound_type: ClassVar[Callable[..., BoundMethod]]
    """What the method is for two hands, made of it, the human and the robot."""

    def bind(self, human: Hand, robot: Hand) -> BoundMethod:
        """Check the method against two hands, and measure them; see `Method.bind`."""
        return self.bound_type(self, human, robot)


def find_alignment(method: MethodOptions, robot: Hand, upright: str) -> Values:
    """Return the change of options that lays a tracker's up and forward onto an arm's.

    Args:
        method: The options of a preset before the user's own choice, which counts more.
        robot: The robot hand.
        upright: As of `rotation_onto`.

    Returns:
        The option `alignment`; none where there is no such rotation or the method aligns otherwise.
    """
    rotation = rotation_onto(robot, upright)
    if rotation is None or method.values.get("alignment") != "world":
        return {}
    known = (name for name, turn in ROTATIONS.items() if (turn == rotation).all())
    return {"alignment": next(known, rotation.tolist())}
