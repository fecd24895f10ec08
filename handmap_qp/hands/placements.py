"""Views of Pinocchio's placements as arrays, which follow every new placement without a copy."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pinocchio as pin


class PlacementViews(NamedTuple):
    """Placements of joints, frames or shapes that share Pinocchio's memory.

    Attributes:
        rotations: Shape (n, 3, 3).
        translations: Shape (n, 3) [m].
    """

    rotations: np.ndarray
    translations: np.ndarray


def placement_views(placements: Sequence[pin.SE3], first: int = 0) -> PlacementViews:
    """View consecutive placements of a Pinocchio vector as two arrays.

    An SE3 is twelve doubles in one block: its rotation by columns, then its translation. That is
    checked here rather than trusted.

    Args:
        placements: `data.oMi`, `data.oMf` or `geometry_data.oMg`; must outlive the views.
        first: Index of the first placement.

    Returns:
        Read-only views of the placements from `first` on.
    """
    poses = [placements[i] for i in range(first, len(placements))]
    if not poses:
        return PlacementViews(np.zeros((0, 3, 3)), np.zeros((0, 3)))
    starts = [_address(pose.translation) for pose in poses]
    stride = starts[1] - starts[0] if len(starts) > 1 else 0
    if any(after - before != stride for before, after in pairwise(starts)):
        raise RuntimeError("Pinocchio's placements are not evenly spaced in memory")
    if any(_address(pose.translation) - _address(pose.rotation) != 72 for pose in poses):
        raise RuntimeError("Pinocchio's rotations do not lie before their translations")
    rotation, translation = poses[0].rotation, poses[0].translation
    rotations = np.lib.stride_tricks.as_strided(
        rotation, (len(poses), 3, 3), (stride, *rotation.strides), writeable=False
    )
    translations = np.lib.stride_tricks.as_strided(
        translation, (len(poses), 3), (stride, 8), writeable=False
    )
    return PlacementViews(rotations, translations)


def _address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def moved_by(model: pin.Model, joint: int) -> np.ndarray:
    """Return 1 for every velocity coordinate that moves a joint's frame, shape (model.nv,)."""
    moved = np.zeros(model.nv)
    for ancestor in model.supports[joint]:
        start = model.joints[ancestor].idx_v
        moved[start : start + model.joints[ancestor].nv] = ancestor > 0
    return moved
