"""Poses, rotations and affine motions as matrices: the conventions of the whole project.

- Units are SI and radians, frames right-handed. Points are rows: `(n, 3)` [m].
- A *pose* `pose_ab` (4, 4) is a rigid change of coordinates: it takes coordinates in `b` to
  coordinates in `a`, and its columns are the axes and the origin of `b` seen from `a`. Inner
  letters meet: `pose_ac = pose_ab @ pose_bc`.
- A *motion* (4, 4) is the paper's active transformation T (eq. 1): it moves points inside one
  frame, and may deform them.
- Quaternions appear only where something enters or leaves, and then their order is in the name:
  `quat_wxyz` or `quat_xyzw`. Roll, pitch and yaw are those of URDF.

`as_floats` and `check_pose` check what enters the package; the other functions expect arrays of
finite numbers and check shapes only, or nothing where they say so.
"""

from __future__ import annotations

import math
import numbers
import threading
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
from eigenpy import DecompositionOptions
from eigenpy import NoPrecondJacobiSVD as SquareSvd

from handmap_qp.errors import InvalidInputError, describe_value

QuatOrder = Literal["wxyz", "xyzw"]

# A rotation that came through float32 is orthogonal to about 1e-6; beyond 1e-3 a matrix is not
# meant as a rotation.
_ROTATION_TOLERANCE = 1e-3
_ROTATION_EXACT = 1e-12

FARTHEST = 1e9
"""Coordinates beyond this are rejected [m].

No hand is there, and squares and differences of larger ones lose the digits that matter.
"""

_IDENTITY = np.eye(4)
_ONES = np.ones(3)

_FULL = int(DecompositionOptions.ComputeFullU) | int(DecompositionOptions.ComputeFullV)

# What numpy and Eigen raise on arrays of another shape or type.
_ARRAY_ERRORS = (TypeError, ValueError, IndexError, AttributeError)


class _Workspace(threading.local):
    """Eigen's memory for the decomposition of a 3x3 matrix, one for each thread."""

    def __init__(self) -> None:
        self.svd = SquareSvd(np.eye(3), _FULL)


_WORKSPACE = _Workspace()


@runtime_checkable
class HasHomogeneous(Protocol):
    """What `pinocchio.SE3` offers: the pose as a matrix."""

    @property
    def homogeneous(self) -> np.ndarray:
        """The pose, shape (4, 4)."""
        ...


PoseLike = npt.ArrayLike | HasHomogeneous


def frozen(array: np.ndarray) -> np.ndarray:
    """Write-protect an array in place and return it."""
    array.setflags(write=False)
    return array


def affine(linear: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Compose the motion `x -> linear @ x + translation` (eq. 1).

    Args:
        linear: Linear part, shape (3, 3).
        translation: Translation [m], shape (3,).

    Returns:
        Motion, shape (4, 4); a new array.

    Raises:
        InvalidInputError: If an argument does not fit into its place.
    """
    motion = _IDENTITY.copy()
    try:
        motion[:3, :3] = linear
        motion[:3, 3] = translation
    except _ARRAY_ERRORS as error:
        raise _mismatch("linear and translation", "shapes (3, 3) and (3,)") from error
    return motion


def affines(linear: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """Compose many motions as `affine`; not checked.

    Args:
        linear: Linear parts, shape (T, 3, 3).
        translations: Translations [m], shape (T, 3).

    Returns:
        Motions, shape (T, 4, 4).
    """
    motions = np.tile(_IDENTITY, (len(linear), 1, 1))
    motions[:, :3, :3], motions[:, :3, 3] = linear, translations
    return motions


def transform_points(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a pose or a motion to points.

    Args:
        motion: Pose or affine motion, shape (4, 4).
        points: Points [m], shape (n, 3).

    Returns:
        The moved points [m], shape (n, 3); a new array.

    Raises:
        InvalidInputError: If motion and points do not fit together.
    """
    try:
        return points @ motion[:3, :3].T + motion[:3, 3]
    except _ARRAY_ERRORS as error:
        raise _mismatch("motion and points", "shapes (4, 4) and (n, 3)") from error


def moved_rows(rows: np.ndarray, linear: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Apply an affine motion to points with a 1 behind each; not checked, for every sample.

    One product takes two thirds of the time of `points @ linear.T + translation`.

    Args:
        rows: Points [m] and a 1 each, shape (n, 4).
        linear: Linear part, shape (3, 3).
        translation: Translation [m], shape (3,).

    Returns:
        The moved points [m], shape (n, 3); a new array.
    """
    columns = np.empty((4, 3))
    columns[:3] = linear.T
    columns[3] = translation
    return rows.dot(columns)


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Return the Euclidean length of each row, shape (n,), of vectors of shape (n, 3).

    In half the time of `numpy.linalg.norm`; not checked, for use sample by sample.
    """
    return np.sqrt(np.square(vectors).dot(_ONES))


def inverse_pose(pose: np.ndarray) -> np.ndarray:
    """Invert a pose.

    Args:
        pose: `pose_ab`, shape (4, 4).

    Returns:
        `pose_ba`, shape (4, 4); a new array.

    Raises:
        InvalidInputError: On a wrong shape.
    """
    try:
        rotation_ba = pose[:3, :3].T
        return affine(rotation_ba, -rotation_ba @ pose[:3, 3])
    except _ARRAY_ERRORS as error:
        raise _mismatch("pose", "shape (4, 4)") from error


def svd3(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decompose a 3x3 matrix into singular values and vectors; not checked, for every sample.

    Args:
        matrix: Shape (3, 3), finite.

    Returns:
        Left singular vectors as columns, shape (3, 3); singular values, largest first, shape (3,);
        right singular vectors as rows, shape (3, 3).
    """
    # Eigen's takes a quarter of the time of numpy's on so small a matrix.
    found = _WORKSPACE.svd
    found.compute(matrix)
    return found.matrixU(), found.singularValues(), found.matrixV().T


def determinant(matrix: np.ndarray) -> float:
    """Compute the determinant of a 3x3 matrix in plain floats, which is quicker than numpy's.

    Args:
        matrix: Shape (3, 3).

    Raises:
        InvalidInputError: On a wrong shape.
    """
    try:
        (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
        return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    except _ARRAY_ERRORS as error:
        raise _mismatch("matrix", "numbers of shape (3, 3)") from error


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the proper rotation nearest to a matrix in the Frobenius norm.

    Args:
        matrix: Any matrix, shape (3, 3).

    Returns:
        Rotation in SO(3), shape (3, 3).

    Raises:
        InvalidInputError: On a wrong shape, or numbers that are not finite.
    """
    return kabsch_rotation(as_floats(matrix, "matrix", shape=(3, 3), is_finite=True))


def kabsch_rotation(covariance: np.ndarray) -> np.ndarray:
    """Return the rotation that best carries points x to y; not checked, for every sample.

    It is the proper rotation nearest to their covariance (Kabsch, Acta Cryst. A32, 1976).

    Args:
        covariance: `sum_k w_k y_k x_k^T` of centred points, shape (3, 3), finite.

    Returns:
        Rotation in SO(3), shape (3, 3).
    """
    found = _WORKSPACE.svd
    found.compute(covariance)
    left, right = found.matrixU(), found.matrixV().T
    rotation = left.dot(right)
    if determinant(rotation) < 0.0:
        left[:, 2] *= -1.0
        rotation = left.dot(right)
    return rotation


def nearest_rotations(matrices: np.ndarray) -> np.ndarray:
    """Return the proper rotation nearest to each of many matrices; not checked.

    Args:
        matrices: Shape (T, 3, 3), finite.

    Returns:
        Rotations as of `nearest_rotation`, shape (T, 3, 3).
    """
    left, _, right = np.linalg.svd(matrices)
    left[np.linalg.det(left @ right) < 0.0, :, 2] *= -1.0
    return left @ right


def rigid_fit(
    points: npt.ArrayLike, onto: npt.ArrayLike, weights: npt.ArrayLike | None = None
) -> np.ndarray:
    """Fit the pose that best lays points onto others, in the weighted least-squares sense.

    Args:
        points: Points [m], shape (n, 3). Where they lie on a line, the turn about it is arbitrary.
        onto: Where each of them should come to lie [m], shape (n, 3).
        weights: Weight of each pair, not negative, shape (n,); equal if omitted.

    Returns:
        Pose that takes `points` to `onto`, shape (4, 4).

    Raises:
        InvalidInputError: On wrong shapes, numbers that are not finite, no points, or weights that
            are negative or all zero.
    """
    before = as_floats(points, "points", shape=("n", 3), is_finite=True)
    after = as_floats(onto, "onto", shape=(len(before), 3), is_finite=True)
    if len(before) == 0:
        raise InvalidInputError(argument="points", expected="at least one point", got="none")
    share = np.full(len(before), 1.0 / len(before))
    if weights is not None:
        share = as_floats(weights, "weights", shape=(len(before),), is_finite=True)
        if not (share.min() >= 0.0 and share.max() > 0.0):
            expected = "numbers >= 0, not all of them zero"
            raise InvalidInputError(argument="weights", expected=expected, value=weights)
        share = share / share.max()
        share = share / share.sum()
    centre, centre_onto = share @ before, share @ after
    rotation = nearest_rotation(((after - centre_onto).T * share) @ (before - centre))
    return affine(rotation, centre_onto - rotation @ centre)


def rigid_fits(points: np.ndarray, onto: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the rotation and translation that best lay each of many sets of points onto another one.

    As `rigid_fit` of each, in one decomposition of all; not checked.

    Args:
        points: Sets of points [m], shape (T, n, 3), finite.
        onto: Where the points of every set should come to lie [m], shape (n, 3).

    Returns:
        Rotations, shape (T, 3, 3), and translations [m], shape (T, 3).
    """
    centres, centre_onto = points.mean(axis=1), onto.mean(axis=0)
    covariances = (onto - centre_onto).T @ (points - centres[:, None])
    rotations = nearest_rotations(covariances)
    return rotations, centre_onto - (rotations @ centres[:, :, None])[:, :, 0]


def rotation_from_rpy(rpy: npt.ArrayLike) -> np.ndarray:
    """Compose a rotation from roll, pitch and yaw as in a URDF: `Rz(yaw) Ry(pitch) Rx(roll)`.

    Args:
        rpy: Roll, pitch and yaw [rad], shape (3,).

    Returns:
        Rotation, shape (3, 3).

    Raises:
        InvalidInputError: If they are not three finite numbers.
    """
    angles = as_floats(rpy, "rpy", shape=(3,), is_finite=True)
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_rotation(rotation: npt.ArrayLike) -> np.ndarray:
    """Find roll, pitch and yaw of a rotation, as in a URDF.

    Where the pitch is a right angle, only yaw minus roll (or their sum) is determined; yaw is then
    zero.

    Args:
        rotation: Rotation, shape (3, 3).

    Returns:
        Roll, pitch and yaw [rad], pitch within +-pi / 2, shape (3,).

    Raises:
        InvalidInputError: On a wrong shape, or numbers that are not finite.
    """
    (xx, _, _), (yx, yy, yz), (zx, zy, zz) = as_floats(
        rotation, "rotation", shape=(3, 3), is_finite=True
    )
    flat = math.hypot(xx, yx)
    pitch = math.atan2(-zx, flat)
    if flat < 1e-9:
        return np.array([math.atan2(-yz, yy), pitch, 0.0])
    return np.array([math.atan2(zy, zz), pitch, math.atan2(yx, xx)])


def rotation_from_quat_wxyz(quat_wxyz: npt.ArrayLike) -> np.ndarray:
    """Compose a rotation from a quaternion, which is normalised first.

    Args:
        quat_wxyz: Quaternion with its scalar first, shape (4,).

    Returns:
        Rotation, shape (3, 3).

    Raises:
        InvalidInputError: If it is not four finite numbers that can be normalised.
    """
    return _rotation_of(as_floats(quat_wxyz, "quat_wxyz"), "quat_wxyz")


def quat_wxyz_from_rotation(rotation: npt.ArrayLike) -> np.ndarray:
    """Find the unit quaternion of a rotation, scalar first and not negative.

    It is the eigenvector of Bar-Itzhack's matrix (J. Guidance 23, 2000), which has no singular
    case.

    Args:
        rotation: Rotation, shape (3, 3).

    Returns:
        Quaternion wxyz, shape (4,).

    Raises:
        InvalidInputError: On a wrong shape, or numbers that are not finite.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = as_floats(
        rotation, "rotation", shape=(3, 3), is_finite=True
    )
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
    """Compose a pose from seven numbers: position, then a quaternion in the order named.

    Args:
        values: x, y, z [m] and four quaternion components, shape (7,).
        order: `"wxyz"` or `"xyzw"`.

    Returns:
        Pose, shape (4, 4).

    Raises:
        InvalidInputError: If the numbers are not a pose, or the order is unknown.
    """
    return _pose_of_seven(as_floats(values, "values"), order, "values")


def poses_from_quats(positions: np.ndarray, quats_wxyz: np.ndarray, name: str) -> np.ndarray:
    """Compose poses over time from positions and quaternions.

    Args:
        positions: Positions [m], shape (T, 3).
        quats_wxyz: Quaternions of any length but zero, in the order w, x, y, z, shape (T, 4).
        name: What to call them in an error.

    Returns:
        Poses, shape (T, 4, 4).

    Raises:
        InvalidInputError: If a quaternion is zero or not finite, with its index.
    """
    norms = np.sqrt(np.square(quats_wxyz).sum(axis=1))
    is_turn = np.isfinite(norms) & (norms > 1e-6)
    if not is_turn.all():
        got = f"{quats_wxyz[~is_turn][0].tolist()} in row {int(np.argmin(is_turn))}"
        expected = "quaternions of 4 finite numbers, not all zero"
        raise InvalidInputError(argument=name, expected=expected, value=quats_wxyz, got=got)
    w, x, y, z = (quats_wxyz / norms[:, None]).T
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    poses[:, :3, :3] = np.array(rows).transpose(2, 0, 1)
    return poses


def check_pose(
    value: PoseLike, name: str = "pose", quat_order: QuatOrder | None = None
) -> np.ndarray:
    """Take a pose in any of the accepted forms and return it as a checked 4x4 matrix.

    A rotation that is off by rounding (float32 trackers, chained products) is replaced by the
    nearest one.

    Args:
        value: A (4, 4) matrix, a `pinocchio.SE3`, or 7 numbers x, y, z, quaternion.
        name: What to call it in an error.
        quat_order: The order of the quaternion in the 7-number form, which is rejected without it.

    Returns:
        Pose, shape (4, 4); a new array unless `value` was an exact float pose already.

    Raises:
        InvalidInputError: On a wrong shape, numbers that are not finite, coordinates beyond
            `FARTHEST`, or a 3x3 part that is not a rotation.
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        pose = value
    else:
        pose = as_floats(value.homogeneous if isinstance(value, HasHomogeneous) else value, name)
    if pose.shape == (7,) and quat_order is not None:
        return _pose_of_seven(pose, quat_order, name)
    if pose.shape != (4, 4):
        has_order = pose.shape != (7,)
        advice = "" if has_order else "7 numbers need quat_order='wxyz' or 'xyzw'"
        expected, got = "shape (4, 4), a pinocchio.SE3 or 7 numbers", f"shape {pose.shape}"
        raise InvalidInputError(
            argument=name, expected=expected, value=value, got=got, advice=advice
        )
    # Plain floats are quicker than numpy's calls on so small an array. Two orthogonal unit columns
    # and their cross product are a proper rotation. `max` may pass over NaN; zero times the sum
    # makes the result NaN where any number is NaN or infinite.
    (a, b, c, x), (d, e, f, y), (g, h, i, z), bottom = pose.tolist()
    defect = max(
        abs(a * a + d * d + g * g - 1.0),
        abs(b * b + e * e + h * h - 1.0),
        abs(a * b + d * e + g * h),
        abs(d * h - e * g - c),
        abs(b * g - a * h - f),
        abs(a * e - b * d - i),
    ) + 0.0 * (a + b + c + d + e + f + g + h + i)
    # `not ... <= FARTHEST` also rejects NaN.
    reach = max(abs(x), abs(y), abs(z)) + 0.0 * (x + y + z)
    if bottom != [0.0, 0.0, 0.0, 1.0] or not reach <= FARTHEST:
        expected = f"finite coordinates within {FARTHEST:g} m and a last row of 0, 0, 0, 1"
        raise InvalidInputError(
            argument=name, expected=expected, value=value, got=str(pose.tolist())
        )
    # `not ... <= tolerance` also rejects NaN.
    if not defect <= _ROTATION_TOLERANCE:
        turn = determinant(pose[:3, :3])
        got = f"a matrix off a rotation by {defect:.3g}, with determinant {turn:.3g}"
        raise InvalidInputError(
            argument=name, expected="a rotation as its 3x3 part", value=value, got=got
        )
    if defect > _ROTATION_EXACT:
        pose = affine(nearest_rotation(pose[:3, :3]), pose[:3, 3])
    return pose


def check_poses(values: Any, name: str, is_used: np.ndarray) -> np.ndarray:
    """Take poses over time as they are; those that are used must be poses.

    Args:
        values: Poses, shape (T, 4, 4).
        name: What to call them in an error.
        is_used: Which of them are looked at, shape (T,).

    Returns:
        The poses as floats, unchanged.

    Raises:
        InvalidInputError: If a pose that is used is not one, with its index.
    """
    poses = as_floats(values, name, shape=(len(is_used), 4, 4))
    turns, shifts = poses[:, :3, :3], poses[:, :3, 3]
    with np.errstate(invalid="ignore", over="ignore"):
        defect = np.abs(turns.transpose(0, 2, 1) @ turns - np.eye(3)).max(axis=(1, 2))
        # `not ... <=` also rejects NaN.
        is_pose = (defect <= _ROTATION_TOLERANCE) & (np.abs(shifts).max(axis=1) <= FARTHEST)
        is_pose &= (poses[:, 3] == (0.0, 0.0, 0.0, 1.0)).all(axis=1)
        is_pose &= np.linalg.det(np.where(is_pose[:, None, None], turns, 0.0)) > 0.0
    if (is_used & ~is_pose).any():
        sample = int(np.flatnonzero(is_used & ~is_pose)[0])
        got = f"another matrix in sample {sample}"
        raise InvalidInputError(argument=name, expected="poses", value=poses, got=got)
    return poses


def as_floats(
    value: Any,
    name: str,
    *,
    shape: tuple[int | str, ...] | None = None,
    is_finite: bool = False,
) -> np.ndarray:
    """Take real numbers in whatever form as an array of floats.

    Texts, None and complex numbers, which numpy would convert, are rejected.

    Args:
        value: Number, nested sequence or array.
        name: What to call it in an error.
        shape: Shape that it must have; a text such as `"n"` stands for any size.
        is_finite: Whether to reject NaN and infinity.

    Returns:
        Array of floats; `value` itself if it is one already.

    Raises:
        InvalidInputError: If these are not real numbers, a ragged sequence of them, of another
            shape, or not finite where they must be.
    """
    if type(value) is np.ndarray and value.dtype == np.float64 and shape is None and not is_finite:
        return value
    expected = _numbers_text(shape, "finite " if is_finite else "")
    try:
        array = np.asarray(value)
        if not (array.dtype.kind in "biuf" or _holds_numbers(array)):
            raise InvalidInputError(
                argument=name,
                expected=expected,
                value=value,
                got=f"{type(value).__name__} {describe_value(value)}",
            )
        array = array.astype(float, copy=False)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        if isinstance(error, InvalidInputError):
            raise
        raise InvalidInputError(argument=name, expected=expected, value=value) from error
    if shape is not None and not _has_shape(array, shape):
        got = f"shape {array.shape}"
        raise InvalidInputError(argument=name, expected=expected, value=value, got=got)
    if is_finite and not np.isfinite(array).all():
        place = tuple(map(int, np.argwhere(~np.isfinite(array))[0]))
        got = f"{array[place]}" + (f" at {list(place)}" if place else "")
        raise InvalidInputError(argument=name, expected=expected, value=value, got=got)
    return array


def _holds_numbers(array: np.ndarray) -> bool:
    """Whether an array of objects holds real numbers only, such as fractions or long integers."""
    return array.dtype.kind == "O" and all(isinstance(item, numbers.Real) for item in array.flat)


def _has_shape(array: np.ndarray, shape: tuple[int | str, ...]) -> bool:
    return array.ndim == len(shape) and all(
        isinstance(wanted, str) or size == wanted
        for size, wanted in zip(array.shape, shape, strict=True)
    )


def _numbers_text(shape: tuple[int | str, ...] | None, finite: str) -> str:
    """Say which numbers are expected, with letters for sizes that are free."""
    if shape is None:
        return f"{finite}numbers"
    if shape == ():
        return f"a {finite}number"
    sizes = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
    return f"{finite}numbers of shape ({sizes})"


def _mismatch(argument: str, expected: str) -> InvalidInputError:
    return InvalidInputError(argument=argument, expected=expected, got="something else")


def _rotation_of(quat_wxyz: np.ndarray, name: str) -> np.ndarray:
    """Normalise a quaternion and compose its rotation, shape (3, 3)."""
    norm = math.hypot(*quat_wxyz) if quat_wxyz.shape == (4,) else math.nan
    if not (math.isfinite(norm) and norm > 1e-6):
        expected = "a quaternion of 4 finite numbers, not all zero"
        raise InvalidInputError(argument=name, expected=expected, value=quat_wxyz)
    w, x, y, z = quat_wxyz / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _pose_of_seven(values: np.ndarray, order: QuatOrder, name: str) -> np.ndarray:
    """Compose a pose from position and quaternion, with errors that name the argument."""
    if values.shape != (7,) or not np.isfinite(values).all():
        expected = "7 finite numbers (x, y, z, quaternion)"
        raise InvalidInputError(argument=name, expected=expected, value=values.tolist())
    if order not in ("wxyz", "xyzw"):
        raise InvalidInputError(argument="order", expected="'wxyz' or 'xyzw'", value=order)
    quat = values[3:] if order == "wxyz" else values[[6, 3, 4, 5]]
    return affine(_rotation_of(quat, name), values[:3])
