"""Views of Pinocchio's placements as arrays, which follow every new placement without a copy."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidInputError


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

    def __reduce__(self) -> NoReturn:
        """Reject copies: they would not follow the placements."""
        raise InvalidInputError("views of Pinocchio's memory cannot be copied or pickled")

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
    count = len(placements) - first
    if count <= 0:
        return PlacementViews(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 12)))
    # A vector's elements are evenly spaced: the first two and the last one tell the layout.
    ends = [placements[i] for i in (first, min(first + 1, first + count - 1), first + count - 1)]
    start, second, last = (_address(pose.translation) for pose in ends)
    stride = second - start
    if last - start != (count - 1) * stride:
        raise RuntimeError("Pinocchio's placements are not evenly spaced in memory")
    if any(_address(pose.translation) - _address(pose.rotation) != 72 for pose in ends):
        raise RuntimeError("Pinocchio's rotations do not lie before their translations")
    if any(pose.rotation.strides != (8, 24) for pose in ends):
        raise RuntimeError("Pinocchio's rotations are not kept by columns")
    block: Any = (ctypes.c_double * (stride // 8 * (count - 1) + 12)).from_address(start - 72)
    # The memory lives as long as the views.
    block.owner = ends[0]
    rotations = np.ndarray((count, 3, 3), float, block, 0, (stride, 8, 24))
    translations = np.ndarray((count, 3), float, block, 72, (stride, 8))
    columns = np.ndarray((count, 12), float, block, 0, (stride, 8))
    for view in (rotations, translations, columns):
        view.setflags(write=False)
    return PlacementViews(rotations, translations, columns)


def _address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def moved_by(model: pin.Model, joints: Sequence[int]) -> np.ndarray:
    """Return 1 for every velocity coordinate that moves a joint's frame.

    Args:
        model: The model.
        joints: Indices of k joints.

    Returns:
        Shape (k, model.nv).
    """
    moved = np.zeros((model.njoints, model.nv))
    columns = zip(model.parents.tolist(), model.idx_vs.tolist(), model.nvs.tolist(), strict=True)
    for joint, (parent, start, count) in enumerate(columns):
        if joint > 0:
            # Parents come before their children.
            moved[joint] = moved[parent]
            moved[joint, start : start + count] = 1.0
    return moved[np.asarray(joints, dtype=int)]
