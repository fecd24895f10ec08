"""Split a motion into rigid part and deformation, or into primitives (eqs. 2-3, Sec. II).

`T = T_def T_rb`: the left polar decomposition `A = U R` gives the rotation and the stretch, which
act about the pivot. `T_rb` carries the pivot to its image under T, and `T_def` keeps it there.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.errors import InvalidInputError, expect
from handmap_core.mapping.estimation import about
from handmap_core.se3 import (
    Array,
    affine,
    as_floats,
    mirror_sign,
    quat_wxyz_from_rotation,
)


class Decomposition(NamedTuple):
    """The parts of a motion: `deformation @ rigid == motion`.

    Attributes:
        rigid: T_rb, shape (4, 4).
        deformation: T_def, shape (4, 4).
        rotation: R in SO(3), the rotation of T_rb, shape (3, 3).
        stretch: U, symmetric, the linear part of T_def, shape (3, 3).
        stretches: Eigenvalues of U, largest first in magnitude, shape (3,). The last is negative
            where the motion mirrors.
    """

    rigid: Array
    deformation: Array
    rotation: Array
    stretch: Array
    stretches: Array


class PolarFactors(NamedTuple):
    """Left polar decomposition `A = U R` with the eigenvectors of U.

    Attributes:
        rotation: R in SO(3), shape (..., 3, 3).
        axes: Eigenvectors of U as columns, shape (..., 3, 3).
        stretches: Eigenvalues of U, shape (..., 3).
    """

    rotation: Array
    axes: Array
    stretches: Array

    def stretch(self, stretches: Array) -> Array:
        """Return the symmetric factor U with such eigenvalues, shape (..., 3, 3)."""
        return (self.axes * stretches[..., None, :]) @ self.axes.mT


def polar(linear: Array) -> PolarFactors:
    """Left polar decomposition by SVD (eq. 3), always with a proper rotation.

    Where `A` mirrors, the eigenvalue of U of smallest magnitude takes the sign, so that `U R = A`
    still holds. Where the two smallest are equal there, either may take it, and R is not unique.

    Args:
        linear: A, shape (..., 3, 3).

    Returns:
        Rotation, axes and stretches.
    """
    axes, stretches, right = np.linalg.svd(linear)
    sign = mirror_sign(axes @ right)[..., None]
    right[..., 2, :] *= sign
    stretches[..., 2:] *= sign
    return PolarFactors(axes @ right, axes, stretches)


def decompose(
    motion: ArrayLike, *, pivot: ArrayLike = (0.0, 0.0, 0.0)
) -> Decomposition:
    """Split a motion into `T_def T_rb` (eqs. 2-3).

    Args:
        motion: T, shape (4, 4).
        pivot: The point about which rotation and deformation act [m], shape (3,). The origin is the
            paper's literal reading.

    Returns:
        The parts; `deformation @ rigid == motion` up to rounding.

    Raises:
        InvalidInputError: If `motion` is not an affine 4x4 matrix or `pivot` not a point.
    """
    matrix = _check_motion(motion)
    point = as_floats(pivot, "pivot", shape=(3,), is_finite=True)
    factors = polar(matrix[:3, :3])
    stretch = factors.stretch(factors.stretches)
    image = matrix[:3, :3] @ point + matrix[:3, 3]
    return Decomposition(
        rigid=about(factors.rotation, point, image),
        deformation=about(stretch, image, image),
        rotation=factors.rotation,
        stretch=stretch,
        stretches=factors.stretches,
    )


class Primitives(NamedTuple):
    """A motion as a product of primitive transformations (Sec. II of the paper).

    `translation_motion @ rotation_motion @ shear_motion @ axis_scale_motion @
    isotropic_scale_motion == motion`.

    Attributes:
        translation: [m], shape (3,).
        quat_wxyz: Unit quaternion of the rotation, scalar first, shape (4,).
        isotropic_scale: Scale common to all axes: the cube root of the volume ratio, negative where
            the motion mirrors.
        axis_scales: What remains along x, y and z; their product is 1, shape (3,).
        shear: xy, xz and yz entries of the unit upper-triangular shear matrix, shape (3,).
        translation_motion: The translation as a 4x4.
        rotation_motion: The rotation as a 4x4.
        isotropic_scale_motion: The isotropic scale as a 4x4.
        axis_scale_motion: The axis scales as a 4x4.
        shear_motion: The shear as a 4x4.
    """

    translation: Array
    quat_wxyz: Array
    isotropic_scale: float
    axis_scales: Array
    shear: Array
    translation_motion: Array
    rotation_motion: Array
    isotropic_scale_motion: Array
    axis_scale_motion: Array
    shear_motion: Array


def primitives(motion: ArrayLike) -> Primitives:
    """Factor a motion into translation, rotation, shear, axis scales and isotropic scale.

    The linear part is factored as rotation times upper-triangular matrix (QR); the diagonal of the
    latter gives the scales and the rest the shear. This rotation is not the polar one of
    `decompose` unless there is no shear.

    Args:
        motion: T, shape (4, 4), with an invertible linear part.

    Returns:
        Each primitive as numbers and as a 4x4 whose product is the motion.

    Raises:
        InvalidInputError: If the matrix is not an affine motion, or its linear part is singular.
    """
    matrix = _check_motion(motion)
    rotation, upper = np.linalg.qr(matrix[:3, :3])
    scales = np.diagonal(upper).copy()
    if not np.abs(scales).min() > 1e-12 * np.abs(scales).max():
        raise InvalidInputError(
            f"its linear part is singular (scales {scales.tolist()}), no primitives exist",
            argument="motion",
            value=motion,
        )
    # QR leaves the signs open: take the rotation proper and, where the motion mirrors, give all
    # three scales the sign.
    signs = np.sign(scales) * np.linalg.slogdet(matrix[:3, :3]).sign
    rotation *= signs
    upper *= signs[:, None]
    scales *= signs
    isotropic = float(np.cbrt(np.prod(scales)))
    shear_matrix = upper / scales
    return Primitives(
        translation=matrix[:3, 3].copy(),
        quat_wxyz=quat_wxyz_from_rotation(rotation),
        isotropic_scale=isotropic,
        axis_scales=scales / isotropic,
        shear=shear_matrix[[0, 0, 1], [1, 2, 2]],
        translation_motion=affine(np.eye(3), matrix[:3, 3]),
        rotation_motion=affine(rotation),
        isotropic_scale_motion=affine(isotropic * np.eye(3)),
        axis_scale_motion=affine(np.diag(scales / isotropic)),
        shear_motion=affine(shear_matrix),
    )


def _check_motion(motion: ArrayLike) -> Array:
    matrix = as_floats(motion, "motion", shape=(4, 4), is_finite=True)
    is_affine = np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() <= 1e-12
    expect(
        is_affine, "motion", "a last row of 0, 0, 0, 1 (no perspective)", value=motion
    )
    return matrix
