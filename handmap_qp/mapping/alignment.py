"""Alignment: how the human's world axes and the robot's correspond."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.mapping.method import MethodOptions
from handmap_qp.options import number, text
from handmap_qp.se3 import FARTHEST, affine, frozen

Coordinate = Annotated[float, number("Finite.", -FARTHEST, FARTHEST)]
Row = tuple[Coordinate, Coordinate, Coordinate]
Alignment = Literal["world", "palm", "y-up"] | tuple[Row, Row, Row]
"""Rotation from the human's world axes to the robot's."""

_ROTATIONS = {
    "world": frozen(np.eye(3)),
    # A tracker's right, up and back (+x, +y, +z) are a robot's -y, +z and -x (REP 103).
    "y-up": frozen(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])),
}


class AlignedOptions(MethodOptions, frozen=True, kw_only=True):
    """Base of methods whose robot moves as the human does in the world."""

    alignment: Annotated[
        Alignment,
        text(
            "Rotation from the human's world axes to the robot's. world: they agree (the paper). "
            "y-up: the tracker's +y is up and its -z is forward, as of headsets; the robot's are "
            "+z and +x. palm: lay the human's palm axes at the reference onto the robot's. Or a "
            "rotation matrix."
        ),
    ] = "world"

    def check(self) -> None:
        """Reject a matrix that is no rotation; see `Options.check`."""
        if isinstance(self.alignment, str):
            return
        rotation = np.array(self.alignment)
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6:
            raise InvalidOptionsError(
                option="alignment",
                expected=f"{', '.join(_ROTATIONS)}, palm or a rotation of shape (3, 3)",
                value=self.alignment,
            )
        if np.linalg.det(rotation) < 0.0:
            raise InvalidOptionsError(
                option="alignment",
                problem="the matrix mirrors",
                value=self.alignment,
                advice="map a left hand with the URDF of a left hand",
            )


def rotation_of(
    alignment: Alignment,
    human_palm: np.ndarray | None = None,
    robot_palm: np.ndarray | None = None,
) -> np.ndarray:
    """Return the rotation from the human's world to the robot's, shape (3, 3).

    Args:
        alignment: The option.
        human_palm: The human's palm at the reference, shape (4, 4); without it, `palm` is `world`.
        robot_palm: The robot's, likewise.
    """
    if alignment == "palm" and human_palm is not None and robot_palm is not None:
        return robot_palm[:3, :3] @ human_palm[:3, :3].T
    if isinstance(alignment, str):
        return _ROTATIONS.get(alignment, _ROTATIONS["world"])
    return np.array(alignment)


def in_robot_world(alignment: Alignment, palm: np.ndarray | None) -> np.ndarray:
    """Return where a human's palm is in the robot's world, (4, 4).

    It is the origin where nothing else is known: with `palm`, and without a palm.
    """
    if alignment == "palm" or palm is None:
        return np.eye(4)
    return affine(rotation_of(alignment), np.zeros(3)) @ palm
