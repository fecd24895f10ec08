"""The option `alignment` of methods; `handmap_core.mapping.alignment` has what it means."""

from collections.abc import Callable
from typing import ClassVar

import numpy as np

from handmap_core.errors import InvalidOptionsError
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


class AlignedOptions(MethodOptions, frozen=True, kw_only=True):
    """Base of methods whose robot moves as the human does in the world.

    Attributes:
        alignment: Rotation from the human's world axes to the robot's. world: they agree (the
            paper). y-up: the tracker's +y is up and its -z is forward, as of headsets; the robot's
            are +z and +x. palm: lay the human's palm axes at the reference onto the robot's. Or a
            rotation matrix.
    """

    bound_type: ClassVar[Callable[..., BoundMethod]]
    """What the method is for two hands, made of it, the human and the robot."""
    alignment: Alignment = "world"

    def bind(self, human: Hand, robot: Hand) -> BoundMethod:
        """Check the method against two hands, and measure them; see `Method.bind`."""
        return self.bound_type(self, human, robot)

    def check(self) -> None:
        """Reject a matrix that is no rotation; see `Options.check`."""
        if isinstance(self.alignment, str):
            return
        rotation = np.array(self.alignment)
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6:
            raise InvalidOptionsError(
                option="alignment",
                expected=f"{', '.join(ROTATIONS)}, palm or a rotation of shape (3, 3)",
                value=self.alignment,
            )
        if np.linalg.det(rotation) < 0.0:
            raise InvalidOptionsError(
                "the matrix mirrors",
                option="alignment",
                value=self.alignment,
                advice="map a left hand with the URDF of a left hand",
            )


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
