"""Alignment: how the human's world axes and the robot's correspond."""

from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.errors import expect
from handmap_core.hands import Hand
from handmap_core.human import upright_axes
from handmap_core.options import number
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
