"""Rigid part and deformation of a motion (eqs. 2-3), and its primitives (Sec. II)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from strategies import (
    affine_motions,
    linear_maps,
    motion_of,
    poses,
    rotations,
    translations,
)

from handmap_qp.errors import InvalidInputError
from handmap_qp.reference.decomposition import decompose, polar, primitives
from handmap_qp.se3 import rotation_from_quat_wxyz, transform_points

any_motions = affine_motions(mirrored=None)
scales = st.floats(min_value=0.2, max_value=5.0)


def assert_rotation(matrix: np.ndarray) -> None:
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), rtol=0.0, atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1.0, abs=1e-13)


# --- eqs. (2)-(3)


@given(any_motions, translations)
def test_deformation_times_rigid_part_is_the_motion(
    motion: np.ndarray, pivot: np.ndarray
) -> None:
    parts = decompose(motion, pivot=pivot)
    # Relative to the translation of T_def, which a pivot metres away from the origin makes large.
    np.testing.assert_allclose(
        parts.deformation @ parts.rigid,
        motion,
        rtol=0.0,
        atol=1e-13 * np.abs(parts.deformation).max(),
    )


@given(any_motions)
def test_the_rigid_part_is_a_proper_rotation_even_where_the_motion_mirrors(
    motion: np.ndarray,
) -> None:
    parts = decompose(motion)
    assert_rotation(parts.rotation)
    np.testing.assert_array_equal(parts.rigid[:3, :3], parts.rotation)
    np.testing.assert_array_equal(parts.rigid[3], [0.0, 0.0, 0.0, 1.0])


@given(any_motions)
def test_the_stretch_is_symmetric_with_the_stretches_as_eigenvalues(
    motion: np.ndarray,
) -> None:
    parts = decompose(motion)
    np.testing.assert_allclose(parts.stretch, parts.stretch.T, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(
        np.sort(parts.stretches),
        np.linalg.eigvalsh(parts.stretch),
        rtol=0.0,
        atol=1e-13,
    )
    np.testing.assert_array_equal(parts.deformation[:3, :3], parts.stretch)


@given(any_motions)
def test_stretches_come_largest_first_and_only_the_last_may_be_negative(
    motion: np.ndarray,
) -> None:
    stretches = decompose(motion).stretches
    assert (np.diff(np.abs(stretches)) <= 0.0).all()
    assert (stretches[:2] > 0.0).all()
    assert np.sign(stretches[2]) == np.sign(np.linalg.det(motion[:3, :3]))


@given(linear_maps())
def test_polar_factors_are_those_of_scipy(linear: np.ndarray) -> None:
    rotation, stretch = scipy.linalg.polar(linear, side="left")
    factors = polar(linear)
    np.testing.assert_allclose(factors.rotation, rotation, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(
        factors.stretch(factors.stretches), stretch, rtol=0.0, atol=1e-13
    )


@given(linear_maps())
def test_left_and_right_polar_decomposition_share_the_rotation(
    linear: np.ndarray,
) -> None:
    rotation, right_stretch = scipy.linalg.polar(linear, side="right")
    factors = polar(linear)
    np.testing.assert_allclose(factors.rotation, rotation, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(
        factors.rotation @ right_stretch,
        factors.stretch(factors.stretches) @ factors.rotation,
        rtol=0.0,
        atol=1e-13,
    )


@given(linear_maps(mirrored=None))
def test_other_stretches_act_along_the_same_axes(linear: np.ndarray) -> None:
    factors = polar(linear)
    squared = factors.stretch(factors.stretches**2)
    np.testing.assert_allclose(
        squared,
        factors.stretch(factors.stretches) @ factors.stretch(factors.stretches),
        rtol=0.0,
        atol=1e-13,
    )


@given(rotations, rotations, linear_maps())
def test_the_rotation_follows_turns_of_either_world(
    before: np.ndarray, after: np.ndarray, linear: np.ndarray
) -> None:
    turned, plain = polar(after @ linear @ before), polar(linear)
    np.testing.assert_allclose(
        turned.rotation, after @ plain.rotation @ before, rtol=0.0, atol=1e-13
    )
    np.testing.assert_allclose(
        turned.stretch(turned.stretches),
        after @ plain.stretch(plain.stretches) @ after.T,
        rtol=0.0,
        atol=1e-13,
    )


@pytest.mark.parametrize(
    "linear",
    [np.zeros((3, 3)), np.diag([1.0, 0.0, 0.0]), np.diag([2.0, 1.0, 0.0]), -np.eye(3)],
)
def test_singular_and_fully_mirrored_motions_still_have_a_rotation(
    linear: np.ndarray,
) -> None:
    factors = polar(linear)
    assert_rotation(factors.rotation)
    np.testing.assert_allclose(
        factors.stretch(factors.stretches) @ factors.rotation,
        linear,
        rtol=0.0,
        atol=1e-15,
    )


# --- the pivot


@given(poses, translations)
def test_a_rigid_motion_has_no_deformation_about_any_pivot(
    pose: np.ndarray, pivot: np.ndarray
) -> None:
    parts = decompose(pose, pivot=pivot)
    np.testing.assert_allclose(parts.deformation, np.eye(4), rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(parts.rigid, pose, rtol=0.0, atol=1e-13)


@given(any_motions, translations)
def test_the_rigid_part_carries_the_pivot_to_its_image_and_the_deformation_leaves_it(
    motion: np.ndarray, pivot: np.ndarray
) -> None:
    parts = decompose(motion, pivot=pivot)
    image = transform_points(motion, pivot[None])
    np.testing.assert_allclose(
        transform_points(parts.rigid, pivot[None]), image, rtol=0.0, atol=1e-13
    )
    np.testing.assert_allclose(
        transform_points(parts.deformation, image), image, rtol=0.0, atol=1e-12
    )


@given(any_motions)
def test_about_the_world_origin_the_rigid_translation_is_b(motion: np.ndarray) -> None:
    parts = decompose(motion)
    np.testing.assert_array_equal(parts.rigid[:3, 3], motion[:3, 3])
    np.testing.assert_array_equal(
        parts.rigid, decompose(motion, pivot=np.zeros(3)).rigid
    )


@given(any_motions, translations)
def test_the_pivot_does_not_change_rotation_or_stretch(
    motion: np.ndarray, pivot: np.ndarray
) -> None:
    np.testing.assert_array_equal(
        decompose(motion, pivot=pivot).rotation, decompose(motion).rotation
    )
    np.testing.assert_array_equal(
        decompose(motion, pivot=pivot).stretch, decompose(motion).stretch
    )


@given(affine_motions(), translations, poses)
def test_parts_do_not_depend_on_where_the_world_lies(
    motion: np.ndarray, pivot: np.ndarray, world: np.ndarray
) -> None:
    inverse = np.linalg.inv(world)
    moved = decompose(
        world @ motion @ inverse, pivot=transform_points(world, pivot[None])[0]
    )
    parts = decompose(motion, pivot=pivot)
    np.testing.assert_allclose(
        moved.rigid, world @ parts.rigid @ inverse, rtol=0.0, atol=1e-12
    )
    np.testing.assert_allclose(
        moved.deformation, world @ parts.deformation @ inverse, rtol=0.0, atol=1e-11
    )


@given(any_motions, translations)
def test_decomposing_does_not_touch_its_input(
    motion: np.ndarray, pivot: np.ndarray
) -> None:
    given_motion, given_pivot = motion.copy(), pivot.copy()
    decompose(motion, pivot=pivot)
    primitives(motion)
    np.testing.assert_array_equal(motion, given_motion)
    np.testing.assert_array_equal(pivot, given_pivot)


# --- primitives


@given(any_motions)
def test_the_product_of_the_primitives_is_the_motion(motion: np.ndarray) -> None:
    parts = primitives(motion)
    product = (
        parts.translation_motion
        @ parts.rotation_motion
        @ parts.shear_motion
        @ parts.axis_scale_motion
        @ parts.isotropic_scale_motion
    )
    np.testing.assert_allclose(product, motion, rtol=0.0, atol=1e-13)


@given(any_motions)
def test_the_numbers_of_the_primitives_are_those_in_their_matrices(
    motion: np.ndarray,
) -> None:
    parts = primitives(motion)
    xy, xz, yz = parts.shear
    shear = np.array([[1.0, xy, xz], [0.0, 1.0, yz], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(
        parts.translation_motion, motion_of(np.eye(3), parts.translation)
    )
    np.testing.assert_allclose(
        parts.rotation_motion[:3, :3],
        rotation_from_quat_wxyz(parts.quat_wxyz),
        rtol=0.0,
        atol=1e-13,
    )
    np.testing.assert_array_equal(
        parts.isotropic_scale_motion,
        motion_of(parts.isotropic_scale * np.eye(3), np.zeros(3)),
    )
    np.testing.assert_array_equal(
        parts.axis_scale_motion, motion_of(np.diag(parts.axis_scales), np.zeros(3))
    )
    np.testing.assert_allclose(
        parts.shear_motion, motion_of(shear, np.zeros(3)), rtol=0.0, atol=1e-14
    )


@given(any_motions)
def test_primitives_keep_volume_and_handedness_in_the_isotropic_scale(
    motion: np.ndarray,
) -> None:
    parts = primitives(motion)
    assert parts.isotropic_scale**3 == pytest.approx(
        np.linalg.det(motion[:3, :3]), rel=1e-12
    )
    assert np.prod(parts.axis_scales) == pytest.approx(1.0, rel=1e-13)
    assert (parts.axis_scales > 0.0).all()
    assert_rotation(parts.rotation_motion[:3, :3])


@given(rotations, translations, scales, scales, translations)
def test_primitives_that_made_a_motion_are_recovered(
    rotation: np.ndarray,
    translation: np.ndarray,
    isotropic: float,
    ratio: float,
    shear: np.ndarray,
) -> None:
    axis_scales = np.array([ratio, 1.0, 1.0 / ratio])
    sheared = np.eye(3)
    sheared[[0, 0, 1], [1, 2, 2]] = shear
    parts = primitives(
        motion_of(rotation @ sheared @ np.diag(axis_scales) * isotropic, translation)
    )
    np.testing.assert_array_equal(parts.translation, translation)
    np.testing.assert_allclose(
        parts.rotation_motion[:3, :3], rotation, rtol=0.0, atol=1e-12
    )
    assert parts.isotropic_scale == pytest.approx(isotropic, rel=1e-13)
    np.testing.assert_allclose(parts.axis_scales, axis_scales, rtol=1e-13)
    # A column is up to 125 times as long as the next: the rounding of the larger shows in the shear
    # of the smaller.
    np.testing.assert_allclose(parts.shear, shear, rtol=0.0, atol=1e-12)


@given(translations)
def test_a_translation_is_nothing_but_a_translation(translation: np.ndarray) -> None:
    parts = primitives(motion_of(np.eye(3), translation))
    np.testing.assert_array_equal(parts.translation_motion[:3, 3], translation)
    for other in (
        parts.rotation_motion,
        parts.isotropic_scale_motion,
        parts.axis_scale_motion,
        parts.shear_motion,
    ):
        np.testing.assert_array_equal(other, np.eye(4))


@given(rotations)
def test_a_rotation_is_nothing_but_a_rotation(rotation: np.ndarray) -> None:
    parts = primitives(motion_of(rotation, np.zeros(3)))
    np.testing.assert_allclose(
        parts.rotation_motion[:3, :3], rotation, rtol=0.0, atol=1e-14
    )
    for other in (
        parts.translation_motion,
        parts.isotropic_scale_motion,
        parts.axis_scale_motion,
        parts.shear_motion,
    ):
        np.testing.assert_allclose(other, np.eye(4), rtol=0.0, atol=1e-14)


@given(rotations)
def test_without_shear_the_rotation_is_the_polar_one(rotation: np.ndarray) -> None:
    motion = motion_of(1.7 * rotation, np.zeros(3))
    np.testing.assert_allclose(
        primitives(motion).rotation_motion[:3, :3],
        decompose(motion).rotation,
        rtol=0.0,
        atol=1e-14,
    )


def test_a_mirrored_motion_has_a_negative_isotropic_scale() -> None:
    parts = primitives(np.diag([2.0, 3.0, -4.0, 1.0]))
    assert parts.isotropic_scale == pytest.approx(-np.cbrt(24.0))


@pytest.mark.parametrize(
    "linear",
    [
        np.zeros((3, 3)),
        np.diag([1.0, 1.0, 0.0]),
        np.ones((3, 3)),
        np.diag([1.0, 1e-14, 1.0]),
    ],
)
def test_a_singular_motion_has_no_primitives(linear: np.ndarray) -> None:
    with pytest.raises(InvalidInputError, match="singular"):
        primitives(motion_of(linear, np.zeros(3)))


# --- invalid inputs


@pytest.mark.parametrize("function", [decompose, primitives])
@pytest.mark.parametrize(
    "motion",
    [
        np.eye(3),
        np.eye(4)[:3],
        np.zeros(16),
        "motion",
        [["1"] * 4] * 4,
        None,
        [[1, 2], [3]],
        {},
    ],
)
def test_an_invalid_motion_is_rejected(function: Any, motion: Any) -> None:
    with pytest.raises(InvalidInputError, match="motion: expected"):
        function(motion)


@given(
    any_motions,
    st.integers(0, 3),
    st.integers(0, 3),
    st.sampled_from([np.nan, np.inf, -np.inf]),
)
def test_a_motion_must_be_finite_in_every_entry(
    motion: np.ndarray, row: int, column: int, bad: float
) -> None:
    motion = motion.copy()
    motion[row, column] = bad
    for function in (decompose, primitives):
        with pytest.raises(InvalidInputError, match="finite"):
            function(motion)


@given(any_motions, st.integers(0, 3), st.floats(min_value=1e-9, max_value=10.0))
def test_a_perspective_is_refused(
    motion: np.ndarray, column: int, change: float
) -> None:
    motion = motion.copy()
    motion[3, column] += change
    with pytest.raises(InvalidInputError, match="last row"):
        decompose(motion)


@pytest.mark.parametrize(
    "pivot",
    [
        np.zeros(2),
        np.zeros((1, 3)),
        [0, 0, np.nan],
        [np.inf, 0, 0],
        "xyz",
        ["0", "0", "0"],
        None,
        0.0,
    ],
)
def test_an_invalid_pivot_is_rejected(pivot: Any) -> None:
    with pytest.raises(InvalidInputError, match="pivot: expected"):
        decompose(np.eye(4), pivot=pivot)
