"""Pinocchio's placements as arrays, and which coordinates move them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin


class Placements:
    """Placements of a Pinocchio vector, read as arrays.

    Args:
        poses: `data.oMi`, `data.oMf` or `geometry_data.oMg`, which every placing overwrites.
        first: Index of the first placement.
    """

    def __init__(self, poses: Sequence[pin.SE3], first: int = 0) -> None:
        self._poses = [poses[i] for i in range(first, len(poses))]
        # Pinocchio's arrays follow every placing, so they are fetched once.
        self._rotations = [pose.rotation for pose in self._poses]
        self._translations = [pose.translation for pose in self._poses]

    @property
    def translations(self) -> np.ndarray:
        """Origins of the placements [m], shape (n, 3); a new array."""
        return np.array(self._translations).reshape(-1, 3)

    def points(self, offsets: np.ndarray, indices: Sequence[int] | None = None) -> np.ndarray:
        """Return points that are fixed to placements, in the world.

        Args:
            offsets: Points in the frames of the placements [m], shape (k, 3).
            indices: Placement of each point; one point on every placement if omitted.

        Returns:
            Points [m], shape (k, 3).
        """
        chosen = range(len(self._poses)) if indices is None else indices
        rotations = np.array([self._rotations[i] for i in chosen]).reshape(-1, 3, 3)
        origins = np.array([self._translations[i] for i in chosen]).reshape(-1, 3)
        return np.matmul(rotations, offsets[:, :, None])[:, :, 0] + origins


def moved_by(model: pin.Model, joints: Sequence[int]) -> np.ndarray:
    """Return 1 for every velocity coordinate that moves a joint's frame.

    Args:
        model: The model.
        joints: Indices of k joints.

    Returns:
        Shape (k, model.nv).
    """
    moved = np.zeros((model.njoints, model.nv))
    for joint in range(1, model.njoints):
        # Parents come before their children.
        moved[joint] = moved[model.parents[joint]]
        moved[joint, model.idx_vs[joint] : model.idx_vs[joint] + model.nvs[joint]] = 1.0
    return moved[np.asarray(joints, dtype=int)]
