"""A hand's fingers about its thumb: what its directions, side and names are found from."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array
from .flexion import HandFlexion


class Layout(NamedTuple):
    """The fingers of a hand, one of which may be the thumb.

    Attributes:
        flexion: How all fingers flex, in the order of the file.
        labels: The anatomical name in the names of each finger.
        thumb: Index of the thumb; None of a hand with one finger.
        others: Indices of all fingers but the thumb.
        axis: Unit axis of flexion that these have in common, zero if there is none, shape (3,).
        surface: Points of the palm's surface in its link's frame, if any [m], shape (k, 3).
    """

    flexion: HandFlexion
    labels: Sequence[str | None]
    thumb: int | None
    others: list[int]
    axis: Array
    surface: Array


def lay_out(
    flexion: HandFlexion,
    labels: Sequence[str | None],
    thumb: int | None,
    surface: Array,
) -> Layout:
    """Return the fingers about a thumb.

    Args:
        flexion: How all fingers flex.
        labels: The anatomical name in the names of each finger.
        thumb: Index of the thumb, if there are several fingers.
        surface: Points of the palm's surface in its link's frame [m], shape (k, 3).
    """
    others = [i for i in range(len(labels)) if i != thumb]
    axes = flexion.axes[others]
    values, vectors = np.linalg.eigh(axes.T @ axes)
    # Jaws and hands with fingers all around have no common axis of flexion.
    has_axis = values[-1] > 0.8 * values.sum()
    axis = has_axis * vectors[:, -1]
    return Layout(flexion, labels, thumb, others, axis, surface)
