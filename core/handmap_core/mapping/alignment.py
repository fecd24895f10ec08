"""Alignment: how the human's world axes and the robot's correspond."""

from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.errors import InvalidOptionsError, expect
from handmap_core.hands import Hand
from handmap_core.human import upright_axes
from handmap_core.options import Options, number
from handmap_core.se3 import (
    FARTHEST,
    Array,
    as_floats,
    frozen,
    lengths,
    nearest_rotation,
    unit,
)

Coordinate = Annotated[float, number(-FARTHEST, FARTHEST)]
Row = tuple[Coordinate, Coordinate, Coordinate]
Alignment = Literal["world", "palm", "y-up"] | tuple[Row, Row, Row]
"""Rotation from the human's world axes to the robot's."""

_MIRRORED = "reach to your left; if you did, negate an axis (`mirror` of a layout)"
# A reach is at least so long [m], and within 20 degrees of its axis; two reaches that are at 60
# degrees are each 15 off.
_SHORTEST_REACH = 0.05
_LEAST_COSINE = 0.94
ROTATIONS = {
    "world": frozen(np.eye(3)),
    # A robot's x is forward and its z is up (REP 103).
    "y-up": frozen(upright_axes("+y up, -z forward")),
}
"""Rotations that have a name."""


class AlignedOptions(Options, frozen=True, kw_only=True):
    """Base of the options of methods whose robot moves as the human does in the world.

    Attributes:
        alignment: Rotation from the human's world axes to the robot's. world: they agree (the
            paper). y-up: the tracker's +y is up and its -z is forward, as of headsets; the robot's
            are +z and +x. palm: lay the human's palm axes at the reference onto the robot's. Or a
            rotation matrix.
    """

    alignment: Alignment = "world"

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


def rotation_onto(robot: Hand, upright: str) -> Array | None:
    """Return the rotation that takes a tracker's up and forward to those of a hand on an arm.

    Args:
        robot: The robot hand.
        upright: The axes of the tracker's world; empty where they are not known.

    Returns:
        The rotation, shape (3, 3); None where the axes are not known or the hand is on no arm.
    """
    if upright and robot.has_moving_wrist and not robot.is_floating:
        return upright_axes(robot.upright).T @ upright_axes(upright)
    return None


def alignment_from_gestures(reaches: ArrayLike) -> Array:
    """Return the rotation to a robot's x, y and z (REP 103) that fits three reaches best, (3, 3).

    Args:
        reaches: How far the palm moved forward, to the person's left, and up, each in the tracker's
            world [m], shape (3, 3).

    Raises:
        InvalidInputError: If a reach is shorter than 5 cm, or they are farther than 20 degrees from
            the axes of any right-handed world.
    """
    ways = as_floats(reaches, "reaches", shape=(3, 3), is_finite=True)
    size = lengths(ways)
    rotation = nearest_rotation(unit(ways))
    cosines = (unit(ways) * rotation).sum(axis=1)
    expect(
        size.min() >= _SHORTEST_REACH and cosines.min() >= _LEAST_COSINE,
        "reaches",
        "5 cm or more, within 20 degrees of the axes of a right-handed world",
        got=f"{size.round(3)} m, cosines to these axes {cosines.round(2)}",
        advice=_MIRRORED if np.linalg.det(ways) < 0.0 else "",
    )
    return rotation


def rotation_of(
    alignment: Alignment,
    human_palm: Array | None = None,
    robot_palm: Array | None = None,
) -> Array:
    """Return the rotation from the human's world to the robot's, shape (3, 3).

    Args:
        alignment: The option.
        human_palm: The human's palm at the reference, shape (4, 4); without it, `palm` is `world`.
        robot_palm: The robot's, likewise.
    """
    if alignment == "palm" and human_palm is not None and robot_palm is not None:
        return robot_palm[:3, :3] @ human_palm[:3, :3].T
    if isinstance(alignment, str):
        return ROTATIONS.get(alignment, ROTATIONS["world"])
    return np.array(alignment)
