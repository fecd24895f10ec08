"""Directions of a palm: parts of vectors, angles between them, and the nearest axis of a link."""

from collections.abc import Sequence

import numpy as np

from handmap_core.se3 import Array, lengths, unit

# Largest angles at which a direction counts as the palm link's axis: alone, and if the knuckles lie
# in that direction from the link's origin [deg].
_SNAP = 5.0
_SNAP_WITH_PALM = 16.0
# Largest angle of the axis of flexion to another of these axes for the latter [deg].
_SNAP_AXIS = 8.0
# A tip whose motion has a smaller part across the fingers does not tell which way they close.
_ACROSS = 0.2
UNKNOWN = np.zeros(3)
"""A direction that is not known."""


def beside(vector: Array, direction: Array) -> Array:
    """Return the part of a vector at right angles to a unit vector."""
    return vector - (vector @ direction) * direction


def across_ways(ways: Array, lines: Array, alike: Sequence[int] | Array) -> Array:
    """Return the motions of fingertips across the middle of fingers that lean apart.

    The tips of fingers that lean far apart move ahead as they close, which is not the way in which
    they meet.

    Args:
        ways: Unit direction of each tip's motion, shape (F, 3).
        lines: Unit direction of each finger, shape (F, 3).
        alike: Indices of the fingers on one side of the middle; all others are on the other side.

    Returns:
        Unit vectors at right angles to the middle, shape (F, 3); zero of a tip that moves along it.
    """
    one = lines[alike].sum(axis=0)
    other = lines.sum(axis=0) - one
    middle = unit(unit(one) + unit(other))
    across = ways - np.outer(ways @ middle, middle)
    return np.where(lengths(across)[:, None] > _ACROSS, unit(across), 0.0)


def widest(points: Array) -> Array:
    """Return the direction in which points extend most, a unit vector, shape (3,)."""
    return np.linalg.svd(points - points.mean(axis=0))[2][0]


def angle_between(one: Array, other: Array) -> float:
    """Return the angle between two vectors [deg]; 90 if one is zero."""
    return float(np.degrees(np.arccos(np.clip(unit(one) @ unit(other), -1.0, 1.0))))


def nearest_axis(direction: Array) -> tuple[int, Array]:
    """Return the index of the link's axis nearest to a vector, and that axis, signed, (3,)."""
    nearest = int(np.abs(direction).argmax())
    return nearest, np.sign(direction[nearest]) * np.eye(3)[nearest]


def snapped(
    direction: Array, knuckles: Array = UNKNOWN, axis: Array = UNKNOWN
) -> Array:
    """Return the link's axis next to a unit vector, or else the vector.

    Fingers that cannot stretch fully are farther off it: it is then taken if the axis of flexion is
    another of the link's axes, and the knuckles lie in its direction from the link's origin.
    """
    nearest, ahead = nearest_axis(direction)
    angle = angle_between(direction, ahead)
    lateral = np.delete(np.abs(axis), nearest).max()
    is_lateral = lateral > np.cos(np.radians(_SNAP_AXIS))
    is_ahead = angle_between(beside(knuckles, axis), ahead) < angle
    limit = _SNAP_WITH_PALM if is_lateral and is_ahead else _SNAP
    return ahead if angle < limit else direction


def shown(direction: Array) -> str:
    """Return a unit vector in words: an axis such as `+x`, or its coordinates."""
    nearest = np.abs(direction).argmax()
    if abs(direction[nearest]) > 0.9999:
        return f"{'+' if direction[nearest] > 0 else '-'}{'xyz'[nearest]}"
    return f"[{', '.join(f'{value:.3f}' for value in direction)}]"
