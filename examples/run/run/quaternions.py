"""What `wrist_axes` takes of scipy, for rotations of shape (n, 3, 3); see `taken.py`."""

from __future__ import annotations

import numpy as np

from handmap_qp.ik.core import core
from handmap_qp.se3 import Array, rotation_from_quat_wxyz


class Rotation:
    """Rotations, made of matrices or of quaternions x, y, z, w."""

    def __init__(self, matrices: Array) -> None:
        self._matrices = matrices

    @classmethod
    def from_matrix(cls, matrices: Array) -> Rotation:
        return cls(matrices)

    @classmethod
    def from_quat(cls, quat_xyzw: Array) -> Rotation:
        return cls(rotation_from_quat_wxyz(np.roll(quat_xyzw, 1, axis=-1)))

    def as_matrix(self) -> Array:
        return self._matrices

    def as_quat(self) -> Array:
        return np.array([core.quat_xyzw(matrix) for matrix in self._matrices])
