"""Views of Pinocchio's placements as arrays, which follow every new placement without a copy."""

from __future__ import annotations

import ctypes
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
        columns: Both side by side, as Pinocchio keeps them: the three columns of the rotation, then
            the translation, shape (n, 12).
    """

    rotations: np.ndarray
    translations: np.ndarray
    columns: np.ndarray

    def points(self, offsets: np.ndarray, indices: np.ndarray | None = None) -> np.ndarray:
        """Return points that are fixed to placements, in the world.

        Args:
            offsets: Points in the frames of the placements, made by `homogeneous` (k, 1, 4).
            indices: Placement of each point, shape (k,); one point on every placement if omitted.

        Returns:
            Points [m], shape (k, 3).
        """
        columns = self.columns if indices is None else self.columns.take(indices, 0)
        return np.matmul(offsets, columns.reshape(-1, 4, 3))[:, 0]


def homogeneous(points: np.ndarray) -> np.ndarray:
    """Append a 1 to every point for `PlacementViews.points`: from (k, 3) to (k, 1, 4)."""
    return np.hstack([points, np.ones((len(points), 1))])[:, None]


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
        return PlacementViews(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 12)))
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
    # The rotation's memory is shorter than the block that begins with it.
    first_block = np.ctypeslib.as_array((ctypes.c_double * 12).from_address(starts[0] - 72))
    columns = np.lib.stride_tricks.as_strided(
        first_block, (len(poses), 12), (stride, 8), writeable=False
    )
    return PlacementViews(rotations, translations, columns)


def _address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def moved_by(model: pin.Model, joint: int) -> np.ndarray:
    """Return 1 for every velocity coordinate that moves a joint's frame, shape (model.nv,)."""
    moved = np.zeros(model.nv)
    for ancestor in model.supports[joint]:
        start = model.joints[ancestor].idx_v
        moved[start : start + model.joints[ancestor].nv] = ancestor > 0
    return moved
