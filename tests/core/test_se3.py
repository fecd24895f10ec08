"""Poses, points and quaternions, and the inputs that `check_pose` accepts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from strategies import (
    affine_motions,
    generators,
    linear_maps,
    point_sets,
    poses,
    rotations,
    translations,
    unit_quats,
)

from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.se3 import (
    QuatOrder,
    affine,
    as_floats,
    check_pose,
    cross_matrices,
    inverse_pose,
    nearest_rotation,
    pose_from_xyz_quat,
    quat_wxyz_from_rotation,
    rigid_fit,
    rotation_from_quat_wxyz,
    rotation_from_rpy,
    rpy_from_rotation,
    transform_points,
)

ORDERS: tuple[QuatOrder, ...] = ("wxyz", "xyzw")
NOT_FINITE = (np.nan, np.inf, -np.inf)


# --- points and motions


@given(arrays(float, (4, 3), elements=st.floats(-10.0, 10.0)))
def test_cross_matrices_give_the_cross_product(vectors: np.ndarray) -> None:
    a, b = vectors.reshape(2, 2, 3)
    products = (cross_matrices(a) @ b[..., None])[..., 0]
    np.testing.assert_allclose(products, np.cross(a, b), atol=1e-12)


@given(linear_maps(), translations)
def test_affine_is_linear_part_and_translation_over_a_last_row_of_0_0_0_1(
    linear: np.ndarray, translation: np.ndarray
) -> None:
    motion = affine(linear, translation)
    np.testing.assert_array_equal(motion[:3, :3], linear)
    np.testing.assert_array_equal(motion[:3, 3], translation)
    np.testing.assert_array_equal(motion[3], [0.0, 0.0, 0.0, 1.0])


def test_affine_matrices_do_not_share_memory() -> None:
    first = affine(np.eye(3), np.zeros(3))
    first[:] = np.nan
    np.testing.assert_array_equal(affine(np.eye(3), np.zeros(3)), np.eye(4))


@given(affine_motions(mirrored=None), point_sets())
def test_points_are_moved_as_homogeneous_vectors(
    motion: np.ndarray, points: np.ndarray
) -> None:
    homogeneous = np.column_stack([points, np.ones(len(points))])
    np.testing.assert_allclose(
        transform_points(motion, points),
        (homogeneous @ motion.T)[:, :3],
        rtol=0.0,
        atol=1e-13,
    )


@given(affine_motions(), affine_motions(), point_sets())
def test_moving_twice_is_moving_by_the_product(
    first: np.ndarray, second: np.ndarray, points: np.ndarray
) -> None:
    one_by_one = transform_points(second, transform_points(first, points))
    # Two maps that stretch threefold and translate give coordinates of up to 60 m.
    np.testing.assert_allclose(
        transform_points(second @ first, points), one_by_one, rtol=0.0, atol=1e-12
    )


@given(poses)
def test_a_pose_times_its_inverse_is_the_identity(pose: np.ndarray) -> None:
    np.testing.assert_allclose(
        pose @ inverse_pose(pose), np.eye(4), rtol=0.0, atol=1e-14
    )
    np.testing.assert_allclose(
        inverse_pose(pose) @ pose, np.eye(4), rtol=0.0, atol=1e-14
    )


@given(poses, point_sets())
def test_an_inverse_pose_takes_points_back(
    pose: np.ndarray, points: np.ndarray
) -> None:
    np.testing.assert_allclose(
        transform_points(inverse_pose(pose), transform_points(pose, points)),
        points,
        atol=1e-13,
    )


# --- nearest rotation


@given(generators)
def test_the_nearest_rotation_is_a_proper_rotation_for_any_matrix(
    generator: np.random.Generator,
) -> None:
    rotation = nearest_rotation(generator.normal(size=(3, 3)))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0.0, atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-13)


@given(rotations)
def test_a_rotation_is_its_own_nearest_rotation(rotation: np.ndarray) -> None:
    np.testing.assert_allclose(
        nearest_rotation(rotation), rotation, rtol=0.0, atol=1e-14
    )


@given(linear_maps(mirrored=None), rotations)
def test_no_other_rotation_is_nearer_than_the_nearest(
    matrix: np.ndarray, other: np.ndarray
) -> None:
    nearest = nearest_rotation(matrix)
    assert np.linalg.norm(matrix - nearest) <= np.linalg.norm(matrix - other) + 1e-14
    tilted = (
        nearest
        @ Rotation.from_rotvec(
            1e-3 * Rotation.from_matrix(other).as_rotvec()
        ).as_matrix()
    )
    assert np.linalg.norm(matrix - nearest) <= np.linalg.norm(matrix - tilted) + 1e-14


@given(linear_maps(), rotations)
def test_the_nearest_rotation_turns_with_its_matrix(
    matrix: np.ndarray, turn: np.ndarray
) -> None:
    np.testing.assert_allclose(
        nearest_rotation(turn @ matrix),
        turn @ nearest_rotation(matrix),
        rtol=0.0,
        atol=1e-13,
    )


def test_the_nearest_rotation_to_a_reflection_is_proper() -> None:
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(
        1.0
    )


# --- rigid fits


@given(point_sets(least=3), poses)
def test_a_rigid_fit_of_moved_points_is_the_motion(
    points: np.ndarray, pose: np.ndarray
) -> None:
    fitted = rigid_fit(points, transform_points(pose, points))
    # Points may be a millimetre wide in one direction, metres away from the origin.
    np.testing.assert_allclose(fitted, pose, atol=1e-8)


@given(generators)
def test_arrays_with_leading_axes_give_the_result_of_each(
    generator: np.random.Generator,
) -> None:
    """Every function that promises leading axes keeps them."""
    matrices, vectors = (
        generator.normal(size=(2, 3, 3, 3)),
        generator.normal(size=(2, 3, 3)),
    )
    points, quats = (
        generator.normal(size=(2, 3, 4, 3)),
        generator.normal(size=(2, 3, 4)),
    )
    turned = nearest_rotation(matrices)
    placed, onto = affine(turned, vectors), generator.normal(size=(4, 3))
    sevens = np.concatenate([vectors, quats], axis=-1)
    for i in np.ndindex(2, 3):
        pairs = (
            (turned[i], nearest_rotation(matrices[i])),
            (placed[i], affine(turned[i], vectors[i])),
            (inverse_pose(placed)[i], inverse_pose(placed[i])),
            (
                transform_points(placed, points)[i],
                transform_points(placed[i], points[i]),
            ),
            (rigid_fit(points, onto)[i], rigid_fit(points[i], onto)),
            (rigid_fit(onto, points)[i], rigid_fit(onto, points[i])),
            (rotation_from_quat_wxyz(quats)[i], rotation_from_quat_wxyz(quats[i])),
            (
                pose_from_xyz_quat(sevens, "xyzw")[i],
                pose_from_xyz_quat(sevens[i], "xyzw"),
            ),
        )
        for found, expected in pairs:
            np.testing.assert_allclose(found, expected, atol=1e-12)


@given(generators, st.integers(3, 8))
def test_a_rigid_fit_is_that_of_scipy(
    generator: np.random.Generator, count: int
) -> None:
    points, onto = generator.normal(size=(2, count, 3))
    centre, centre_onto = points.mean(axis=0), onto.mean(axis=0)
    turn = Rotation.align_vectors(onto - centre_onto, points - centre)[0].as_matrix()
    fitted = rigid_fit(points, onto)
    np.testing.assert_allclose(fitted[:3, :3], turn, atol=1e-10)
    np.testing.assert_allclose(fitted[:3, 3], centre_onto - turn @ centre, atol=1e-10)


@given(point_sets())
def test_a_rigid_fit_of_mirrored_points_is_proper(points: np.ndarray) -> None:
    fitted = rigid_fit(points, points * (1.0, 1.0, -1.0))
    assert np.linalg.det(fitted[:3, :3]) == pytest.approx(1.0)


# --- roll, pitch and yaw


@given(st.tuples(*[st.floats(-4.0, 4.0)] * 3))
def test_roll_pitch_and_yaw_are_those_of_scipy(rpy: tuple[float, float, float]) -> None:
    expected = Rotation.from_euler("xyz", rpy).as_matrix()
    np.testing.assert_allclose(rotation_from_rpy(rpy), expected, rtol=0.0, atol=1e-14)


@given(rotations)
def test_rotation_to_roll_pitch_yaw_and_back_is_the_rotation(
    rotation: np.ndarray,
) -> None:
    np.testing.assert_allclose(
        rotation_from_rpy(rpy_from_rotation(rotation)), rotation, rtol=0.0, atol=1e-12
    )


@given(
    st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.sampled_from([np.pi / 2, -np.pi / 2])
)
def test_a_pitch_of_a_right_angle_is_recovered(
    roll: float, yaw: float, pitch: float
) -> None:
    rotation = rotation_from_rpy([roll, pitch, yaw])
    found = rpy_from_rotation(rotation)
    np.testing.assert_allclose(rotation_from_rpy(found), rotation, rtol=0.0, atol=1e-12)


# --- quaternions


@given(unit_quats)
def test_quaternions_rotate_as_those_of_scipy(quat_xyzw: np.ndarray) -> None:
    expected = Rotation.from_quat(quat_xyzw).as_matrix()
    np.testing.assert_allclose(
        rotation_from_quat_wxyz(np.roll(quat_xyzw, 1)), expected, rtol=0.0, atol=1e-14
    )


@given(unit_quats)
def test_quaternion_to_rotation_and_back_gives_the_one_of_its_two_signs_with_positive_scalar(
    quat: np.ndarray,
) -> None:
    back = quat_wxyz_from_rotation(rotation_from_quat_wxyz(quat))
    assert back[0] >= 0.0
    np.testing.assert_allclose(back * np.sign(back @ quat), quat, rtol=0.0, atol=1e-14)


@given(rotations)
def test_rotation_to_quaternion_and_back_is_the_rotation(rotation: np.ndarray) -> None:
    np.testing.assert_allclose(
        rotation_from_quat_wxyz(quat_wxyz_from_rotation(rotation)),
        rotation,
        rtol=0.0,
        atol=1e-14,
    )


@pytest.mark.parametrize(
    "axis", np.vstack([np.eye(3), [[1.0, 1.0, 0.0]], [[1.0, -2.0, 3.0]]])
)
def test_half_turns_have_no_singular_case(axis: np.ndarray) -> None:
    axis = axis / np.linalg.norm(axis)
    quat = quat_wxyz_from_rotation(2.0 * np.outer(axis, axis) - np.eye(3))
    assert quat[0] == pytest.approx(0.0, abs=1e-15)
    assert abs(quat[1:] @ axis) == pytest.approx(1.0, abs=1e-15)


@given(unit_quats, st.floats(min_value=1e-3, max_value=1e300))
def test_quaternions_are_normalised_first(quat: np.ndarray, length: float) -> None:
    np.testing.assert_allclose(
        rotation_from_quat_wxyz(length * quat),
        rotation_from_quat_wxyz(quat),
        rtol=0.0,
        atol=1e-14,
    )


@pytest.mark.parametrize(
    "quat",
    [
        np.zeros(4),
        [1, 0, 0],
        [np.nan, 0, 0, 1],
        [0, np.inf, 0, 1],
        "wxyz",
        ["1", "0", "0", "0"],
        None,
    ],
)
def test_an_invalid_quaternion_is_rejected(quat: Any) -> None:
    with pytest.raises(InvalidInputError, match="quat_wxyz: expected"):
        rotation_from_quat_wxyz(quat)


# --- poses of seven numbers


@given(poses)
def test_seven_numbers_give_the_pose_back_in_both_orders(pose: np.ndarray) -> None:
    quat_wxyz = quat_wxyz_from_rotation(pose[:3, :3])
    for order, quat in zip(ORDERS, (quat_wxyz, np.roll(quat_wxyz, -1)), strict=True):
        values = [*pose[:3, 3], *quat]
        np.testing.assert_allclose(
            pose_from_xyz_quat(values, order), pose, rtol=0.0, atol=1e-14
        )
        np.testing.assert_allclose(
            check_pose(values, quat_order=order), pose, rtol=0.0, atol=1e-14
        )


def test_xyzw_is_the_order_of_pinocchio() -> None:
    placement = pinocchio.SE3.Random()
    np.testing.assert_allclose(
        pose_from_xyz_quat(pinocchio.SE3ToXYZQUAT(placement), "xyzw"),
        placement.homogeneous,
        rtol=0.0,
        atol=1e-14,
    )


@pytest.mark.parametrize(
    "values",
    [np.zeros(6), np.zeros(8), np.zeros((1, 7)), np.zeros(7), ["a"] * 7, None, 7.0],
)
@pytest.mark.parametrize("order", ORDERS)
def test_an_invalid_pose_of_seven_numbers_is_rejected(
    values: Any, order: QuatOrder
) -> None:
    with pytest.raises(InvalidInputError):
        pose_from_xyz_quat(values, order)


@given(st.integers(0, 6), st.sampled_from(NOT_FINITE), st.sampled_from(ORDERS))
def test_seven_numbers_must_be_finite(index: int, bad: float, order: QuatOrder) -> None:
    values = np.array([0.1, 0.2, 0.3, 0.5, 0.5, 0.5, 0.5])
    values[index] = bad
    with pytest.raises(InvalidInputError, match="finite"):
        pose_from_xyz_quat(values, order)


@pytest.mark.parametrize("order", ["wzyx", "WXYZ", "", 3])
def test_an_unknown_quaternion_order_is_rejected(order: Any) -> None:
    with pytest.raises(InvalidInputError, match="order: expected 'wxyz' or 'xyzw'"):
        pose_from_xyz_quat([0, 0, 0, 1, 0, 0, 0], order)


def test_seven_numbers_without_a_named_order_are_rejected() -> None:
    with pytest.raises(
        InvalidInputError, match=r"wrist: expected .* 7 numbers need quat_order"
    ):
        check_pose([0, 0, 0, 1, 0, 0, 0], "wrist")


# --- check_pose


@given(poses)
def test_an_exact_pose_passes_unchanged(pose: np.ndarray) -> None:
    np.testing.assert_allclose(check_pose(pose), pose, rtol=0.0, atol=1e-14)


@given(poses)
def test_the_other_forms_of_a_pose_are_taken_too(pose: np.ndarray) -> None:
    forms = (
        pose.tolist(),
        tuple(map(tuple, pose)),
        pinocchio.SE3(pose),
        np.asfortranarray(pose),
    )
    for form in forms:
        np.testing.assert_allclose(check_pose(form), pose, rtol=0.0, atol=1e-14)


def test_a_pose_of_another_library_is_checked_too() -> None:
    class Scaled:
        """Has a matrix as poses of libraries have, but is none."""

        homogeneous = np.diag([2.0, 2.0, 2.0, 1.0])

    with pytest.raises(InvalidInputError, match="a rotation as its 3x3 part"):
        check_pose(Scaled())
    for wrong in (None, object(), "pose"):
        with pytest.raises(InvalidInputError, match=r"^pose: expected "):
            check_pose(wrong)  # ty: ignore[invalid-argument-type]


def test_a_pose_of_integers_becomes_one_of_floats() -> None:
    pose = check_pose([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    assert pose.dtype == np.float64


@given(poses, generators, st.floats(min_value=1e-9, max_value=1e-6))
def test_a_rotation_off_by_rounding_is_made_exact(
    pose: np.ndarray, generator: np.random.Generator, size: float
) -> None:
    noisy = pose.copy()
    noisy[:3, :3] += size * generator.uniform(-1.0, 1.0, size=(3, 3))
    given_values = noisy.copy()
    checked = check_pose(noisy)
    np.testing.assert_allclose(
        checked[:3, :3] @ checked[:3, :3].T, np.eye(3), rtol=0.0, atol=1e-14
    )
    np.testing.assert_allclose(checked, pose, rtol=0.0, atol=4.0 * size)
    np.testing.assert_array_equal(noisy, given_values)


@given(poses)
def test_a_float32_pose_is_made_exact(pose: np.ndarray) -> None:
    checked = check_pose(pose.astype(np.float32))
    np.testing.assert_allclose(
        checked[:3, :3] @ checked[:3, :3].T, np.eye(3), rtol=0.0, atol=1e-14
    )


@given(poses, st.integers(0, 3), st.integers(0, 3), st.sampled_from(NOT_FINITE))
def test_a_pose_must_be_finite_in_every_entry(
    pose: np.ndarray, row: int, column: int, bad: float
) -> None:
    pose = pose.copy()
    pose[row, column] = bad
    with pytest.raises(InvalidInputError, match="wrist: "):
        check_pose(pose, "wrist")


def test_infinities_of_both_signs_do_not_cancel() -> None:
    pose = np.eye(4)
    pose[:3, 3] = np.inf, -np.inf, 0.0
    with pytest.raises(InvalidInputError, match="finite"):
        check_pose(pose)


@given(poses, st.integers(0, 3), st.floats(min_value=1e-6, max_value=1e6))
def test_the_last_row_must_be_0_0_0_1(
    pose: np.ndarray, column: int, change: float
) -> None:
    pose = pose.copy()
    pose[3, column] += change
    with pytest.raises(InvalidInputError, match="last row"):
        check_pose(pose)


@given(poses, st.integers(0, 2))
def test_a_mirrored_pose_is_rejected(pose: np.ndarray, column: int) -> None:
    pose = pose.copy()
    pose[:3, column] *= -1.0
    with pytest.raises(InvalidInputError, match="expected a rotation"):
        check_pose(pose)


SHEARS = [
    np.eye(3) + 0.01 * np.eye(3)[[i]].T @ np.eye(3)[[j]]
    for i in range(3)
    for j in range(3)
    if i != j
]
SCALES = [
    np.diag([0.99, 1.0, 1.0]),
    np.diag([1.0, 1.01, 1.0]),
    np.diag([1.0, 1.0, 0.9]),
    np.zeros((3, 3)),
    np.ones((3, 3)),
]


@pytest.mark.parametrize("linear", SHEARS + SCALES)
def test_a_matrix_that_scales_or_shears_is_rejected_as_pose(linear: np.ndarray) -> None:
    with pytest.raises(InvalidInputError, match="expected a rotation"):
        check_pose(affine(linear, np.zeros(3)))


@pytest.mark.parametrize(
    "value",
    [
        np.eye(3),
        np.eye(4)[:3],
        np.eye(4)[None],
        np.eye(5),
        np.zeros(16),
        np.zeros(6),
        np.zeros((7, 1)),
        [],
        1.0,
        None,
    ],
)
def test_a_pose_of_wrong_shape_is_rejected(value: Any) -> None:
    with pytest.raises(InvalidInputError, match=r"wrist: expected"):
        check_pose(value, "wrist", "wxyz")


@pytest.mark.parametrize(
    "value",
    [
        "pose",
        "1",
        [["1", "0"], ["0", "1"]],
        {"xyz": 0},
        [[1, 2], [3]],
        object(),
        1j * np.eye(4),
        np.array(["x"] * 7),
    ],
)
def test_a_pose_of_anything_but_numbers_is_rejected(value: Any) -> None:
    with pytest.raises(InvalidInputError, match="wrist: expected numbers"):
        check_pose(value, "wrist", "wxyz")


@pytest.mark.parametrize("bad", [[0, 0, 0, 0, 0, 0, 0], [0, 0, np.nan, 1, 0, 0, 0]])
def test_errors_name_the_pose_at_fault(bad: list[float]) -> None:
    with pytest.raises(HandmapError, match="wrist at sample 7: "):
        check_pose(bad, "wrist at sample 7", "wxyz")


def test_floats_are_passed_on_without_a_copy() -> None:
    values = np.array([1.0, 2.0])
    assert as_floats(values, "values") is values


@pytest.mark.parametrize("axis", range(3))
def test_poses_beyond_the_farthest_coordinate_are_rejected(axis: int) -> None:
    pose = np.eye(4)
    for sign in (1.0, -1.0):
        pose[axis, 3] = sign * 0.99e9
        np.testing.assert_array_equal(check_pose(pose), pose)
        pose[axis, 3] = sign * 1.01e9
        with pytest.raises(InvalidInputError, match="within 1e"):
            check_pose(pose)


# --- invalid inputs of every function

BAD: tuple[Any, ...] = (
    "x",
    None,
    ["1", "2", "3"],
    [[1.0], [1.0, 2.0]],
    1j * np.eye(3),
    np.full((3, 3), np.nan),
    np.full((3, 3), np.inf),
    np.zeros((2, 2)),
    np.zeros((3, 3, 3)),
    np.full((3, 3), None),
    np.full((3, 3), "1", dtype=object),
    5,
    {},
)
CHECKED: dict[str, tuple[Callable[[Any], Any], str]] = {
    "rotation_from_quat_wxyz": (rotation_from_quat_wxyz, "quat_wxyz"),
    "quat_wxyz_from_rotation": (quat_wxyz_from_rotation, "rotation"),
    "pose_from_xyz_quat": (lambda bad: pose_from_xyz_quat(bad, "wxyz"), "values"),
    "check_pose": (check_pose, "pose"),
    "as_floats": (lambda bad: as_floats(bad, "q", shape=(3,), is_finite=True), "q"),
}


@pytest.mark.parametrize("name", CHECKED)
def test_invalid_arguments_are_named(name: str) -> None:
    call, argument = CHECKED[name]
    for bad in BAD:
        with pytest.raises(InvalidInputError) as caught:
            call(bad)
        assert caught.value.argument.startswith(argument), bad
        assert "\n" not in str(caught.value)


def test_as_floats_names_the_entry_at_fault() -> None:
    with pytest.raises(
        InvalidInputError, match=r"q: expected finite numbers, got nan at \[1, 0\]"
    ):
        as_floats([[0.0, 1.0], [np.nan, np.inf]], "q", is_finite=True)
    with pytest.raises(
        InvalidInputError, match=r"of shape \(n, 3\), got shape \(2, 2\)"
    ):
        as_floats(np.eye(2), "points", shape=("n", 3))
    with pytest.raises(InvalidInputError, match="dt: expected a number, got shape"):
        as_floats([0.1], "dt", shape=())
