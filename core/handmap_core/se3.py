"""Poses, rotations and affine motions as matrices: the conventions of the whole project.

- Units are SI and radians, frames right-handed. Points are rows: `(n, 3)` [m].
- A *pose* `pose_ab` (4, 4) is a rigid change of coordinates: it takes coordinates in `b` to
  coordinates in `a`, and its columns are the axes and the origin of `b` seen from `a`. Inner
  letters meet: `pose_ac = pose_ab @ pose_bc`.
- A *motion* (4, 4) is the paper's active transformation T (eq. 1): it moves points inside one
  frame, and may deform them.
- Quaternions appear only where something enters or leaves, and then their order is in the name:
  `quat_wxyz` or `quat_xyzw`. Roll, pitch and yaw are those of URDF.

Arrays may have leading axes, written `...`: one of time for a recording, none for a sample.
`as_floats`, `as_points`, `check_pose` and the functions of quaternions check what enters the
package; the others expect arrays of finite numbers that fit together.
"""

import math
import numbers
from typing import Any, Literal, Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from handmap_core.errors import InvalidInputError, describe_value, expect

Array = np.ndarray
"""An array of floats, where nothing else is said."""
Arrays = dict[str, Array]
"""Arrays by name."""
QuatOrder = Literal["wxyz", "xyzw"]


@runtime_checkable
class RigidTransform(Protocol):
    """A pose of another library that has its matrix, such as `pinocchio.SE3`."""

    @property
    def homogeneous(self) -> Array:
        """The pose, shape (4, 4)."""
        ...


PoseLike = ArrayLike | RigidTransform

# A rotation that came through float32 is orthogonal to about 1e-6; beyond 1e-3 a matrix is not
# meant as a rotation.
_ROTATION_TOLERANCE = 1e-3
_ROTATION_EXACT = 1e-12

FARTHEST = 1e9
"""Coordinates beyond this are rejected [m].

No hand is there, and squares and differences of larger ones lose the digits that matter.
"""


class ArrayStruct(msgspec.Struct, frozen=True, eq=False):
    """Base of results that hold arrays: each is equal to itself only, and has a hash."""


def frozen(array: Array) -> Array:
    """Write-protect an array in place and return it."""
    array.setflags(write=False)
    return array


def affine(linear: Array, translation: ArrayLike = 0.0) -> Array:
    """Compose the motion `x -> linear @ x + translation` (eq. 1).

    Args:
        linear: Linear part, shape (..., 3, 3).
        translation: Translation [m], shape (..., 3); none if omitted.

    Returns:
        Motion, shape (..., 4, 4); a new array.
    """
    motion = np.zeros((*linear.shape[:-2], 4, 4))
    motion[..., :3, :3] = linear
    motion[..., :3, 3] = translation
    motion[..., 3, 3] = 1.0
    return motion


def transform_points(motion: Array, points: Array) -> Array:
    """Apply a pose or a motion (..., 4, 4) to points [m], shape (..., n, 3) or (3,)."""
    origin = motion[..., :3, 3] if points.ndim == 1 else motion[..., None, :3, 3]
    return points @ motion[..., :3, :3].swapaxes(-1, -2) + origin


def cross_matrices(vectors: Array) -> Array:
    """Return the matrices S(v) with `S(v) @ w == v x w`, shape (..., 3, 3).

    Their product takes a fraction of the time of `np.cross`.
    """
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    matrices = np.zeros((*vectors.shape, 3))
    matrices[..., 0, 1] = -z
    matrices[..., 0, 2] = y
    matrices[..., 1, 0] = z
    matrices[..., 1, 2] = -x
    matrices[..., 2, 0] = -y
    matrices[..., 2, 1] = x
    return matrices


def cross(first: Array, second: Array) -> Array:
    """Return the cross products of vectors, shape (..., 3).

    The result is that of `np.cross`, which spends 80 calls of Python on axes and shapes.

    Args:
        first: Shape (..., 3).
        second: Shape (..., 3).
    """
    ahead, behind = [1, 2, 0], [2, 0, 1]
    return (
        first[..., ahead] * second[..., behind]
        - first[..., behind] * second[..., ahead]
    )


def lengths(vectors: Array) -> Array:
    """Return the Euclidean length of each vector, shape (...), of shape (..., 3)."""
    return np.linalg.norm(vectors, axis=-1)


def box_of(points: Array) -> Array:
    """Return the lowest and the highest corner of the box around points (n, d), shape (2, d)."""
    return np.array([points.min(axis=0), points.max(axis=0)])


def unit(vectors: Array) -> Array:
    """Return vectors of length 1 along others of shape (..., 3); those below 1 nm go to zero."""
    return vectors / np.maximum(lengths(vectors)[..., None], 1e-9)


def inverse_pose(pose: Array) -> Array:
    """Return `pose_ba` of `pose_ab`, shape (..., 4, 4)."""
    rotation = pose[..., :3, :3].swapaxes(-1, -2)
    return affine(rotation, -(rotation @ pose[..., :3, 3:])[..., 0])


def nearest_rotation(matrix: Array) -> Array:
    """Return the proper rotation nearest to a matrix in the Frobenius norm, shape (..., 3, 3).

    Of the covariance `sum_k w_k y_k x_k^T` of centred points, it is the rotation that best carries
    the points x to y (Kabsch, Acta Cryst. A32, 1976).
    """
    left, _, right = np.linalg.svd(matrix)
    left[..., 2] *= mirror_sign(left @ right)[..., None]
    return left @ right


def mirror_sign(orthogonal: Array) -> Array:
    """Return -1 for orthogonal matrices (..., 3, 3) that mirror, 1 for rotations, shape (...)."""
    return np.sign(np.linalg.det(orthogonal))


def rigid_fit(points: Array, onto: Array, weights: Array | None = None) -> Array:
    """Fit the pose that best lays points onto others, in the least-squares sense.

    Args:
        points: Points [m], shape (..., n, 3). Where they lie on a line, the turn about it is
            arbitrary.
        onto: Where each of them should come to lie [m], shape (..., n, 3).
        weights: Weight of each point's squared distance, >= 0, shape (n,); equal if omitted.

    Returns:
        Pose that takes `points` to `onto`, shape (..., 4, 4).
    """
    if weights is None:
        weights = np.ones(points.shape[-2])
    shares = (weights / weights.sum())[:, None]
    centre = (shares * points).sum(axis=-2, keepdims=True)
    centre_onto = (shares * onto).sum(axis=-2, keepdims=True)
    covariance = (shares * (onto - centre_onto)).swapaxes(-1, -2) @ (points - centre)
    rotation = nearest_rotation(covariance)
    shift = centre_onto - centre @ rotation.swapaxes(-1, -2)
    return affine(rotation, shift[..., 0, :])


def rotation_from_rpy(rpy: ArrayLike) -> Array:
    """Compose a rotation (3, 3) from roll, pitch and yaw [rad]: `Rz(yaw) Ry(pitch) Rx(roll)`."""
    angles = np.asarray(rpy, dtype=float)
    (cos_x, cos_y, cos_z), (sin_x, sin_y, sin_z) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [
                cos_z * cos_y,
                cos_z * sin_y * sin_x - sin_z * cos_x,
                cos_z * sin_y * cos_x + sin_z * sin_x,
            ],
            [
                sin_z * cos_y,
                sin_z * sin_y * sin_x + cos_z * cos_x,
                sin_z * sin_y * cos_x - cos_z * sin_x,
            ],
            [-sin_y, cos_y * sin_x, cos_y * cos_x],
        ]
    )


def rpy_from_rotation(rotation: Array) -> Array:
    """Find roll, pitch and yaw of a rotation (3, 3), as in a URDF [rad], pitch within +-pi / 2.

    Where the pitch is a right angle, only yaw minus roll (or their sum) is determined, and both are
    some that fit. Pinocchio's `matrixToRpy` loses digits near there.
    """
    roll = math.atan2(*rotation[2, 1:])
    # Of the rotation that is left without the roll, so that an uncertain roll does no harm.
    left = rotation @ rotation_from_rpy((-roll, 0.0, 0.0))
    yaw = math.atan2(-left[0, 1], left[1, 1])
    return np.array([roll, math.atan2(-left[2, 0], left[2, 2]), yaw])


def rotation_from_quat_wxyz(quat_wxyz: ArrayLike, name: str = "quat_wxyz") -> Array:
    """Compose rotations from quaternions, which are normalised first.

    Args:
        quat_wxyz: Quaternions with their scalar first, shape (..., 4).
        name: What to call them in an error.

    Returns:
        Rotations, shape (..., 3, 3).

    Raises:
        InvalidInputError: If one is not four finite numbers that can be normalised, with its index.
    """
    quats = as_floats(quat_wxyz, name)
    expected = "quaternions of 4 finite numbers, not all zero"
    expect(quats.shape[-1:] == (4,), name, expected, got=f"shape {quats.shape}")
    # Divided first, so that squares of large numbers do not overflow.
    largest = np.abs(quats).max(axis=-1, keepdims=True)
    is_turn = (largest > 1e-6) & (largest < np.inf)
    if not is_turn.all():
        row = np.argmin(is_turn)
        got = f"{quats.reshape(-1, 4)[row].tolist()} in row {row}"
        raise InvalidInputError(argument=name, expected=expected, value=quats, got=got)
    quats = quats / largest
    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
    # With the matrix [v] of the cross product: 1 + 2 w [v] + 2 [v]^2.
    cross = np.cross(np.eye(3), quats[..., None, 1:])
    return np.eye(3) + 2.0 * (quats[..., :1, None] * cross + cross @ cross)


def quat_wxyz_from_rotation(rotation: ArrayLike) -> Array:
    """Find the unit quaternion of a rotation (3, 3), scalar first and not negative, shape (4,).

    Raises:
        InvalidInputError: On a wrong shape, or numbers that are not finite.
    """
    # Not above: where the core cannot be loaded, all else here works.
    from handmap_core.core import core

    matrix = as_floats(rotation, "rotation", shape=(3, 3), is_finite=True)
    quat = np.roll(core.quat_xyzw(matrix), 1)
    return math.copysign(1.0, quat[0]) * quat


def pose_from_xyz_quat(
    values: ArrayLike, order: QuatOrder, name: str = "values"
) -> Array:
    """Compose poses from seven numbers each: position, then a quaternion in the order named.

    Args:
        values: x, y, z [m] and four quaternion components, shape (..., 7).
        order: `"wxyz"` or `"xyzw"`.
        name: What to call the numbers in an error.

    Returns:
        Poses, shape (..., 4, 4).

    Raises:
        InvalidInputError: If the numbers are not a pose, or the order is unknown.
    """
    seven = as_floats(values, name)
    is_seven = seven.shape[-1:] == (7,) and np.isfinite(seven).all()
    expect(is_seven, name, "7 finite numbers (x, y, z, quaternion)", value=values)
    expect(order in ("wxyz", "xyzw"), "order", "'wxyz' or 'xyzw'", value=order)
    quats = seven[..., 3:] if order == "wxyz" else seven[..., [6, 3, 4, 5]]
    return affine(rotation_from_quat_wxyz(quats, name), seven[..., :3])


def check_pose(
    value: PoseLike | None, name: str = "pose", quat_order: QuatOrder | None = None
) -> Array:
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
    # Whether an array has the attribute takes longer to find out than that it is an array.
    is_transform = not isinstance(value, np.ndarray) and isinstance(
        value, RigidTransform
    )
    pose = as_floats(value.homogeneous if is_transform else value, name)
    if pose.shape == (7,) and quat_order is not None:
        return pose_from_xyz_quat(pose, quat_order, name)
    advice = "7 numbers need quat_order='wxyz' or 'xyzw'" if pose.shape == (7,) else ""
    expect(
        pose.shape == (4, 4),
        name,
        "shape (4, 4), a pinocchio.SE3 or 7 numbers",
        value=value,
        got=f"shape {pose.shape}",
        advice=advice,
    )
    is_pose, is_placed, defect, volume = _measure(pose)
    if is_pose:
        if defect <= _ROTATION_EXACT:
            return pose
        return affine(nearest_rotation(pose[:3, :3]), pose[:3, 3])
    expected = f"finite coordinates within {FARTHEST:g} m and a last row of 0, 0, 0, 1"
    got = str(pose.tolist())
    if is_placed:
        expected = "a rotation as its 3x3 part"
        got = f"a matrix off a rotation by {defect:.3g}, with determinant {volume:.3g}"
    raise InvalidInputError(argument=name, expected=expected, value=value, got=got)


def check_poses(values: Any, name: str, is_used: Array) -> Array:
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
    is_pose, *_ = _measure(poses)
    wrong = np.flatnonzero(is_used & ~is_pose)
    if len(wrong):
        got = f"another matrix in sample {wrong[0]}"
        raise InvalidInputError(argument=name, expected="poses", value=poses, got=got)
    return poses


def _measure(poses: Array) -> tuple[Array, ...]:
    """Return whether matrices are poses, whether but for rotation, its defect and determinant."""
    # `<= FARTHEST` is also false for NaN.
    is_placed = (np.abs(poses[..., :3, :]) <= FARTHEST).all(axis=(-2, -1))
    is_placed &= (poses[..., 3, :] == (0.0, 0.0, 0.0, 1.0)).all(axis=-1)
    turns = np.where(is_placed[..., None, None], poses[..., :3, :3], 0.0)
    products = turns.swapaxes(-1, -2) @ turns
    defects = np.abs(products - np.eye(3)).max(axis=(-2, -1))
    volumes = np.linalg.det(turns)
    is_pose = is_placed & (defects <= _ROTATION_TOLERANCE) & (volumes > 0.0)
    return is_pose, is_placed, defects, volumes


def is_real(value: Any) -> bool:
    """Return whether a value is one finite real number; False for texts, arrays and None."""
    return (
        isinstance(value, int | float | np.integer | np.floating)
        and abs(value) < math.inf
    )


def as_floats(
    value: Any,
    name: str,
    *,
    shape: tuple[int | str, ...] | None = None,
    is_finite: bool = False,
) -> Array:
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
    array = _as_array(value)
    got = ""
    if array is None:
        got = f"{type(value).__name__} {describe_value(value)}"
    elif shape is not None and not _has_shape(array, shape):
        got = f"shape {array.shape}"
    elif is_finite and not np.isfinite(array).all():
        place = np.argwhere(~np.isfinite(array))[0].tolist()
        got = f"{array[*place]}" + (f" at {place}" if place else "")
    else:
        return array
    noun = "finite number" if is_finite else "number"
    # Letters stand for sizes that are free.
    sized = f"{noun}s of shape {shape}".replace("'", "")
    expected = {None: f"{noun}s", (): f"a {noun}"}.get(shape, sized)
    raise InvalidInputError(argument=name, expected=expected, value=value, got=got)


def as_points(value: Any, name: str, count: int | str = "n") -> Array:
    """Take points as an array of floats, where a hand may be.

    Args:
        value: Points [m], shape (n, 3).
        name: What to call them in an error.
        count: Their number, n, if it is known.

    Returns:
        The array; `value` itself if it is one already.

    Raises:
        InvalidInputError: If these are other numbers, none, not finite or beyond `FARTHEST`.
    """
    points = as_floats(value, name, shape=(count, 3))
    # NaN is not near either.
    if not (len(points) and np.abs(points).max() <= FARTHEST):
        expected = f"finite coordinates within {FARTHEST:g} m, of one point or more"
        raise InvalidInputError(argument=name, expected=expected, value=points.tolist())
    return points


def _as_array(value: Any) -> Array | None:
    """Return real numbers as an array of floats; None if they are something else."""
    try:
        array = np.asarray(value)
        # An array of objects may hold fractions or long integers.
        is_real = array.dtype.kind in "biuf" or (
            array.dtype.kind == "O"
            and all(isinstance(x, numbers.Real) for x in array.flat)
        )
        return array.astype(float, copy=False) if is_real else None
    except (TypeError, ValueError, OverflowError, RecursionError):
        return None


def _has_shape(array: Array, shape: tuple[int | str, ...]) -> bool:
    # Most shapes have no letter.
    return array.shape == shape or (
        array.ndim == len(shape)
        and all(
            isinstance(wanted, str) or size == wanted
            for size, wanted in zip(array.shape, shape, strict=True)
        )
    )


def smoothstep(x: ArrayLike) -> Array:
    """Go smoothly from 0 at 0 to 1 at 1, element by element."""
    # Not above: where the core cannot be loaded, all else here works.
    from handmap_core.core import core

    x = np.asarray(x, dtype=float)
    return core.smoothstep(x).reshape(x.shape)[()]
