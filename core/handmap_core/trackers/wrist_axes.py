"""Axes of wrists and palms. The compiled core compares them (`handmap/wrist_axes.hpp`)."""

import numpy as np

from handmap_core.core import core
from handmap_core.se3 import Array

CONVENTIONS: Array = core.WRIST_CONVENTIONS
"""The wrist's axes that known trackers have (`axes_convention`), ours first, shape (6, 3, 3)."""


def axes_convention(distal: Array, dorsal: Array) -> Array:
    """Return a wrist's axes in the frame of our wrist: +y distal, +z dorsal.

    Args:
        distal: The direction of the fingers in the wrist's own axes, shape (3,).
        dorsal: The direction out of the back of the hand in them, shape (3,).

    Returns:
        Rotation from the wrist's axes to ours, shape (3, 3).
    """
    return np.stack([np.cross(distal, dorsal), distal, dorsal])


def palm_axes(landmarks: Array, sign: float) -> Array:
    """Return the palm's rotations: +y to the middle knuckle, 8 to 11 degrees from ours, +z dorsal.

    Args:
        landmarks: Some samples, shape (T, 21, 3).
        sign: 1 for a right hand, -1 for a left one.

    Returns:
        Rotations, shape (T, 3, 3).
    """
    return core.palm_axes(landmarks, sign)
