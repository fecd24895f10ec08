"""Poses and affine motions as 4x4 matrices: the conventions of the whole project.

- Units are SI and radians, frames right-handed. Points are rows: `(n, 3)` [m].
- A *pose* `pose_ab` (4, 4) is a rigid change of coordinates: it takes coordinates in `b` to
  coordinates in `a`, and its columns are the axes and the origin of `b` seen from `a`. Inner
  letters meet: `pose_ac = pose_ab @ pose_bc`.
- A *motion* (4, 4) is the paper's active transformation T (eq. 1): it moves points inside one
  frame, and may deform them.
- Quaternions appear only where something enters or leaves, and then their order is in the name:
  `quat_wxyz` or `quat_xyzw`.
"""

from __future__ import annotations

import math
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from handmap_qp.errors import InvalidInputError

QuatOrder = Literal["wxyz", "xyzw"]

# A rotation that came through float32 is orthogonal to about 1e-6; anything past 1e-3 is not meant
# to be a rotation.
_ROTATION_TOLERANCE = 1e-3
_ROTATION_EXACT = 1e-12

FARTHEST = 1e9
"""Coordinates beyond this are refused [m].

No hand is there, and squares and differences of larger ones lose what matters.
"""

_IDENTITY = np.eye(4)


@runtime_checkable
class HasHomogeneous(Protocol):
    """What `pinocchio.SE3` offers: the pose as a matrix."""

    @property
    def homogeneous(self) -> np.ndarray:
        """The pose, shape (4, 4)."""
        ...


PoseLike = npt.ArrayLike | HasHomogeneous


def affine(linear: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """The motion `x -> linear @ x + translation` as a 4x4 matrix (eq. 1).

    Args:
        linear: Linear part, shape (3, 3).
        translation: Translation [m], shape (3,).

    Returns:
        Motion, shape (4, 4).
    """
    motion = _IDENTITY.copy()
    motion[:3, :3] = linear
    motion[:3, 3] = translation
    return motion


def transform_points(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a pose or a motion to points.

    Args:
        motion: Pose or affine motion, shape (4, 4).
        points: Points [m], shape (n, 3).

    Returns:
        The moved points [m], shape (n, 3).
    """
    return points @ motion[:3, :3].T + motion[:3, 3]


def inverse_pose(pose: np.ndarray) -> np.ndarray:
    """Invert a pose.

    Args:
        pose: `pose_ab`, shape (4, 4).

    Returns:
        `pose_ba`, shape (4, 4).
    """
    rotation_ba = pose[:3, :3].T
    return affine(rotation_ba, -rotation_ba @ pose[:3, 3])


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The proper rotation nearest to a matrix in the Frobenius norm.

    Args:
        matrix: Any matrix, shape (3, 3).

    Returns:
        Rotation in SO(3), shape (3, 3).
    """
    left, _, right = np.linalg.svd(matrix)
    if np.linalg.det(left @ right) < 0.0:
        left[:, 2] *= -1.0
    return left @ right


def rotation_from_quat_wxyz(quat_wxyz: npt.ArrayLike) -> np.ndarray:
    """Rotation matrix of a quaternion, which is normalised first.

    Args:
        quat_wxyz: Quaternion with its scalar first, shape (4,).

    Returns:
        Rotation, shape (3, 3).

    Raises:
        InvalidInputError: If it is not four finite numbers that can be normalised.
    """
    quat = as_floats(quat_wxyz, "quaternion")
    norm = math.hypot(*quat) if quat.shape == (4,) else math.nan
    if not (math.isfinite(norm) and norm > 1e-6):
        raise InvalidInputError(
            f"quaternion: expected 4 finite numbers, not all zero; got {quat_wxyz}", value=quat_wxyz
        )
    w, x, y, z = quat / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_wxyz_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion of a rotation, scalar first and not negative.

    The eigenvector of Bar-Itzhack's matrix is used: it has no singular case.

    Args:
        rotation: Rotation, shape (3, 3).

    Returns:
        Quaternion wxyz, shape (4,).
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.asarray(rotation, dtype=float)
    symmetric = np.array(
        [
            [xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, yy - xx - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, zz - xx - yy],
        ]
    )
    quat = np.linalg.eigh(symmetric)[1][:, 3]
    return -quat if quat[0] < 0.0 else quat


def pose_from_xyz_quat(values: npt.ArrayLike, order: QuatOrder) -> np.ndarray:
    """Pose of seven numbers: position, then a quaternion in the order that the caller names.

    Args:
        values: x, y, z [m] and four quaternion components, shape (7,).
        order: `"wxyz"` or `"xyzw"`.

    Returns:
        Pose, shape (4, 4).

    Raises:
        InvalidInputError: If the numbers are no pose, or the order is unknown.
    """
    array = as_floats(values, "pose")
    if array.shape != (7,) or not np.isfinite(array).all():
        raise InvalidInputError(
            f"pose: expected 7 finite numbers (x, y, z, quaternion), got {values}", value=values
        )
    if order not in ("wxyz", "xyzw"):
        raise InvalidInputError(
            f"quaternion order: expected 'wxyz' or 'xyzw', got {order!r}", value=order
        )
    quat = array[3:] if order == "wxyz" else array[[6, 3, 4, 5]]
    return affine(rotation_from_quat_wxyz(quat), array[:3])


def check_pose(
    value: PoseLike, name: str = "pose", quat_order: QuatOrder | None = None
) -> np.ndarray:
    """Take a pose in any of the accepted forms and return it as a checked 4x4 matrix.

    A rotation that is off by rounding (float32 trackers, chained products) is replaced by the
    nearest one.

    Args:
        value: A (4, 4) matrix, a `pinocchio.SE3`, or 7 numbers x, y, z, quaternion.
        name: What to call it in an error.
        quat_order: The order of the quaternion in the 7-number form, which is refused without it.

    Returns:
        Pose, shape (4, 4); a new array unless `value` was an exact float pose already.

    Raises:
        InvalidInputError: On a wrong shape, non-finite numbers, or a rotation that is none.
    """
    if isinstance(value, np.ndarray) and value.dtype == np.float64:
        pose = value
    else:
        pose = as_floats(value.homogeneous if isinstance(value, HasHomogeneous) else value, name)
    if pose.shape == (7,):
        if quat_order is None:
            raise InvalidInputError(
                f"{name}: 7 numbers need a named quaternion order: give quat_order='wxyz' or 'xyzw'"
            )
        try:
            return pose_from_xyz_quat(pose, quat_order)
        except InvalidInputError as error:
            raise InvalidInputError(f"{name}: {error}", value=error.value) from error
    if pose.shape != (4, 4):
        raise InvalidInputError(
            f"{name}: expected shape (4, 4), a pinocchio.SE3 or 7 numbers, got shape {pose.shape}"
        )
    # Nine scalar products in plain floats are quicker than numpy's calls on so small an array.
    (a, b, c, x), (d, e, f, y), (g, h, i, z), bottom = pose.tolist()
    defect = max(
        abs(a * a + d * d + g * g - 1.0),
        abs(b * b + e * e + h * h - 1.0),
        abs(c * c + f * f + i * i - 1.0),
        abs(a * b + d * e + g * h),
        abs(a * c + d * f + g * i),
        abs(b * c + e * f + h * i),
    )
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    # Written so that a NaN, which compares false with everything, is refused too.
    if (
        bottom != [0.0, 0.0, 0.0, 1.0]
        or not max(abs(x), abs(y), abs(z)) + 0.0 * (x + y + z) <= FARTHEST
    ):
        raise InvalidInputError(
            f"{name}: expected finite coordinates within {FARTHEST:g} m and a last row of 0, 0, 0, 1, got {pose.tolist()}"
        )
    # Written so that a NaN, which compares false with everything, is refused too.
    if not (defect <= _ROTATION_TOLERANCE and determinant > 0.0):
        raise InvalidInputError(
            f"{name}: its 3x3 part is no rotation (orthogonality off by {defect:.3g}, determinant {determinant:.3g})"
        )
    if defect > _ROTATION_EXACT:
        pose = affine(nearest_rotation(pose[:3, :3]), pose[:3, 3])
    return pose


def as_floats(value: Any, name: str) -> np.ndarray:
    """Take real numbers in whatever form as an array.

    Texts and complex numbers, which numpy would convert, are refused.

    Args:
        value: Number, nested sequence or array.
        name: What to call it in an error.

    Returns:
        Array of floats; `value` itself if it is one already.

    Raises:
        InvalidInputError: If these are no real numbers, or a ragged sequence of them.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biufO":
            raise TypeError(f"{array.dtype} is no real number")
        return array.astype(float, copy=False)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(
            f"{name}: expected numbers, got {type(value).__name__} {value!r:.60}"
        ) from error
