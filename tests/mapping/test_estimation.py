"""The motion from point pairs (eqs. 5-6).

Exact recovery, change of world frame, and residuals.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import (
    affine_motions,
    collinear_point_sets,
    coplanar_point_sets,
    motion_of,
    near_coplanar_point_sets,
    noise_like,
    point_sets,
    poses,
    rotations,
    weights_for,
)

from handmap_qp.errors import DegeneratePointsError
from handmap_qp.mapping import MotionEstimate, MotionEstimator
from handmap_qp.reference import estimate, estimate_motion
from handmap_qp.se3 import nearest_rotation, transform_points

ridges = st.sampled_from([0.0, 1e-6, 0.1, 1.0, 1e3])


def system_of_eq_6(points: np.ndarray) -> np.ndarray:
    """M, shape (3 n, 12), as printed in the paper."""
    return np.vstack([np.kron(np.eye(3), np.append(point, 1.0)) for point in points])


def solve_eq_6(
    before: np.ndarray, after: np.ndarray, weights: np.ndarray | None = None
) -> np.ndarray:
    """T by least squares on `M t = p`, each point's three rows scaled by the root of its weight."""
    rows = np.repeat(np.ones(len(before)) if weights is None else np.sqrt(weights), 3)
    t = np.linalg.lstsq(
        system_of_eq_6(before) * rows[:, None], after.ravel() * rows, rcond=None
    )[0]
    return np.vstack([t.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])


def assert_same_motion(
    actual: np.ndarray,
    expected: np.ndarray,
    points: np.ndarray,
    relative: float = 1e-13,
) -> None:
    """Compare linear parts, relative to the conditioning of the points, and the points' images.

    The images stand for `b`: points a centimetre apart and two metres from the origin lose a factor
    of 200 there, whatever the method.
    """
    largest, _, smallest = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    images = transform_points(expected, points)
    reach = np.abs(points).max() + np.abs(images).max()
    np.testing.assert_allclose(
        actual[:3, :3], expected[:3, :3], rtol=0.0, atol=relative * reach / smallest
    )
    np.testing.assert_allclose(
        transform_points(actual, points),
        images,
        rtol=0.0,
        atol=relative * reach * largest / smallest,
    )


# --- eq. (6)


@given(point_sets(), affine_motions(mirrored=None))
def test_an_affine_motion_is_recovered_exactly_from_points_off_a_plane(
    points: np.ndarray, motion: np.ndarray
) -> None:
    estimate = estimate_motion(points, transform_points(motion, points))
    assert_same_motion(estimate.motion, motion, points)
    np.testing.assert_allclose(estimate.residual_norms, 0.0, rtol=0.0, atol=1e-13)


@given(near_coplanar_point_sets, affine_motions())
def test_accuracy_falls_only_linearly_with_the_flatness_of_the_points(
    points: np.ndarray, motion: np.ndarray
) -> None:
    # Down to a millionth of the spread: through the normal matrix the error would grow with its
    # square, to 1e-4 here.
    assert_same_motion(
        estimate_motion(points, transform_points(motion, points)).motion, motion, points
    )


@given(point_sets(), affine_motions(), st.data())
def test_weights_do_not_change_an_exact_fit(
    points: np.ndarray, motion: np.ndarray, data: st.DataObject
) -> None:
    weights = data.draw(weights_for(points))
    assert_same_motion(
        estimate_motion(
            points, transform_points(motion, points), weights=weights
        ).motion,
        motion,
        points,
    )


@given(point_sets(), affine_motions(), st.data())
def test_noisy_points_give_the_least_squares_solution_of_eq_6(
    points: np.ndarray, motion: np.ndarray, data: st.DataObject
) -> None:
    after = transform_points(motion, points) + data.draw(noise_like(points, 0.01))
    # lstsq takes the points uncentred, with a condition number up to 1e4 larger, which sets the
    # tolerance.
    assert_same_motion(
        estimate_motion(points, after).motion,
        solve_eq_6(points, after),
        points,
        relative=1e-12,
    )


@given(point_sets(), affine_motions(), st.data())
def test_weighted_points_give_the_row_weighted_solution_of_eq_6(
    points: np.ndarray, motion: np.ndarray, data: st.DataObject
) -> None:
    after = transform_points(motion, points) + data.draw(noise_like(points, 0.01))
    weights = data.draw(weights_for(points))
    expected = solve_eq_6(points, after, weights)
    assert_same_motion(
        estimate_motion(points, after, weights=weights).motion,
        expected,
        points,
        relative=1e-11,
    )


def test_hand_sized_points_at_the_origin_agree_with_eq_6_to_1e_10() -> None:
    generator = np.random.default_rng(2014)
    for count in range(4, 24):
        before = 0.05 * generator.normal(size=(count, 3))
        after = (
            before @ generator.normal(size=(3, 3))
            + 0.01 * generator.normal(size=(count, 3))
            + generator.normal(size=3)
        )
        weights = generator.uniform(0.1, 1.0, size=count)
        np.testing.assert_allclose(
            estimate_motion(before, after).motion, solve_eq_6(before, after), atol=1e-10
        )
        weighted = estimate_motion(before, after, weights=weights)
        np.testing.assert_allclose(
            weighted.motion, solve_eq_6(before, after, weights), atol=1e-10
        )


@given(point_sets(least=5), st.data())
def test_a_point_of_weight_zero_is_as_good_as_absent(
    points: np.ndarray, data: st.DataObject
) -> None:
    after = points + data.draw(noise_like(points, 0.01))
    ridge = data.draw(st.sampled_from([0.1, 1.0]))
    weights = np.append(np.ones(len(points) - 1), 0.0)
    with_it = estimate_motion(points, after, weights=weights, ridge=ridge)
    without_it = estimate_motion(points[:-1], after[:-1], ridge=ridge)
    assert_same_motion(with_it.motion, without_it.motion, points)
    np.testing.assert_allclose(
        with_it.residual_norms[:-1], without_it.residual_norms, rtol=0.0, atol=1e-13
    )


@given(point_sets(), st.data(), st.sampled_from([1e-300, 1e-3, 1e3, 1e308 / 10.0]))
def test_only_the_ratios_of_weights_matter(
    points: np.ndarray, data: st.DataObject, factor: float
) -> None:
    after = points + data.draw(noise_like(points, 0.01))
    weights = data.draw(weights_for(points))
    scaled = estimate_motion(points, after, weights=factor * weights, ridge=0.1)
    assert_same_motion(
        scaled.motion,
        estimate_motion(points, after, weights=weights, ridge=0.1).motion,
        points,
    )


# --- T in another world frame


def noisy_pair(data: st.DataObject) -> tuple[np.ndarray, np.ndarray]:
    before = data.draw(point_sets())
    return before, transform_points(data.draw(affine_motions()), before) + data.draw(
        noise_like(before, 0.005)
    )


@given(st.data(), poses, st.sampled_from([0.0, 0.1]))
def test_in_another_world_frame_the_motion_is_conjugated(
    data: st.DataObject, world: np.ndarray, ridge: float
) -> None:
    before, after = noisy_pair(data)
    plain = estimate_motion(before, after, ridge=ridge)
    moved_before = transform_points(world, before)
    moved = estimate_motion(moved_before, transform_points(world, after), ridge=ridge)
    assert_same_motion(
        moved.motion, world @ plain.motion @ np.linalg.inv(world), moved_before
    )
    np.testing.assert_allclose(
        moved.residual_norms, plain.residual_norms, rtol=0.0, atol=1e-12
    )


@given(st.data(), poses, st.sampled_from([0.0, 0.1]))
def test_a_rigid_motion_after_the_sample_multiplies_from_the_left(
    data: st.DataObject, pose: np.ndarray, ridge: float
) -> None:
    before, after = noisy_pair(data)
    later = estimate_motion(before, transform_points(pose, after), ridge=ridge)
    assert_same_motion(
        later.motion, pose @ estimate_motion(before, after, ridge=ridge).motion, before
    )


@given(st.data(), st.sampled_from([0.0, 0.1]), st.sampled_from([1e-3, 39.37, 1e3]))
def test_other_units_scale_the_translation_and_nothing_else(
    data: st.DataObject, ridge: float, unit: float
) -> None:
    before, after = noisy_pair(data)
    plain = estimate_motion(before, after, ridge=ridge)
    scaled = estimate_motion(unit * before, unit * after, ridge=ridge)
    assert_same_motion(
        motion_of(scaled.motion[:3, :3], scaled.motion[:3, 3] / unit),
        plain.motion,
        before,
    )
    np.testing.assert_allclose(
        scaled.residual_norms, unit * plain.residual_norms, rtol=0.0, atol=1e-12 * unit
    )


@given(st.data())
def test_the_order_of_the_points_does_not_matter(data: st.DataObject) -> None:
    before, after = noisy_pair(data)
    order = data.draw(st.permutations(range(len(before))))
    shuffled = estimate_motion(before[order], after[order], ridge=0.1)
    assert_same_motion(
        shuffled.motion, estimate_motion(before, after, ridge=0.1).motion, before
    )


# --- results beside T


@given(st.data(), ridges)
def test_residuals_are_the_distances_to_where_the_motion_takes_the_points(
    data: st.DataObject, ridge: float
) -> None:
    before, after = noisy_pair(data)
    estimate = estimate_motion(before, after, ridge=ridge)
    misfit = after - transform_points(estimate.motion, before)
    np.testing.assert_allclose(estimate.residual_vectors, misfit, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(
        estimate.residual_norms, np.linalg.norm(misfit, axis=1), rtol=0.0, atol=1e-13
    )


@given(st.sampled_from([1e-3, 0.1, 1.0, 30.0]), rotations, st.floats(0.01, 10.0))
def test_a_ridge_weighs_the_prior_against_points_that_spread_alike(
    ridge: float, prior: np.ndarray, size: float
) -> None:
    # A regular octahedron: the misfit of A is s^2 |A - B|^2, the ridge's ridge s^2 |A - R0|^2.
    before = size * np.vstack([np.eye(3), -np.eye(3)])
    linear = np.array([[1.2, 0.3, 0.0], [-0.1, 0.7, 0.2], [0.4, 0.0, 1.5]])
    found = estimate_motion(before, before @ linear.T, ridge=ridge, prior=prior)
    wanted = (linear + ridge * prior) / (1.0 + ridge)
    np.testing.assert_allclose(found.linear, wanted, rtol=0.0, atol=1e-12)


@given(st.data(), ridges)
def test_the_weighted_misfit_has_no_mean(data: st.DataObject, ridge: float) -> None:
    before, after = noisy_pair(data)
    weights = data.draw(weights_for(before))
    estimate = estimate_motion(before, after, weights=weights, ridge=ridge)
    np.testing.assert_allclose(
        weights @ estimate.residual_vectors, 0.0, rtol=0.0, atol=1e-12
    )


@given(point_sets())
def test_singular_values_are_those_of_the_centred_points(points: np.ndarray) -> None:
    expected = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    np.testing.assert_allclose(
        estimate_motion(points, points).singular_values, expected, rtol=0.0, atol=1e-14
    )


@given(point_sets(), st.data())
def test_weighted_singular_values_are_those_of_weighted_points_about_their_centroid(
    points: np.ndarray, data: st.DataObject
) -> None:
    shares = data.draw(weights_for(points))
    shares = shares / shares.sum()
    scaled = (points - shares @ points) * np.sqrt(len(points) * shares)[:, None]
    expected = np.linalg.svd(scaled, compute_uv=False)
    actual = estimate_motion(points, points, weights=shares).singular_values
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-14)


# --- points that do not determine T


@given(coplanar_point_sets)
def test_without_a_ridge_points_in_a_plane_are_refused_with_their_singular_values(
    points: np.ndarray,
) -> None:
    with pytest.raises(DegeneratePointsError, match="off a plane") as caught:
        estimate_motion(points, points)
    expected = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    np.testing.assert_allclose(
        caught.value.singular_values, expected, rtol=0.0, atol=1e-14
    )
    assert f"{1e3 * expected[0]:.3g}" in str(caught.value)


@given(collinear_point_sets, st.sampled_from([1e-6, 0.1, 1e3]))
def test_points_on_a_line_are_refused_without_a_prior(
    points: np.ndarray, ridge: float
) -> None:
    with pytest.raises(DegeneratePointsError, match="on a line") as caught:
        estimate_motion(points, points, ridge=ridge)
    assert caught.value.singular_values.shape == (3,)


@given(collinear_point_sets, rotations)
def test_points_on_a_line_are_enough_with_a_prior(
    points: np.ndarray, prior: np.ndarray
) -> None:
    estimate = estimate_motion(points, points @ prior.T, ridge=0.1, prior=prior)
    np.testing.assert_allclose(estimate.motion[:3, :3], prior, rtol=0.0, atol=1e-11)


@given(collinear_point_sets, rotations)
def test_a_prior_alone_does_not_replace_a_ridge(
    points: np.ndarray, prior: np.ndarray
) -> None:
    with pytest.raises(DegeneratePointsError):
        estimate_motion(points, points, prior=prior)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_fewer_than_four_points_are_refused_without_a_ridge(count: int) -> None:
    points = 0.05 * np.random.default_rng(3).normal(size=(count, 3))
    with pytest.raises(DegeneratePointsError) as caught:
        estimate_motion(points, points)
    assert caught.value.singular_values[2] < 1e-15


@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 40])
@pytest.mark.parametrize("place", [0.0, 0.1, 3.7])
def test_points_that_coincide_leave_the_prior_as_it_is(
    count: int, place: float
) -> None:
    # The rounding error of their centroid must not count as a spread.
    generator = np.random.default_rng(count)
    prior = nearest_rotation(generator.normal(size=(3, 3)))
    points = np.full((count, 3), place)
    estimate = estimate_motion(
        points,
        points + 0.03 * generator.normal(size=(count, 3)),
        ridge=0.1,
        prior=prior,
    )
    np.testing.assert_allclose(estimate.motion[:3, :3], prior, rtol=0.0, atol=1e-14)
    for options in ({"ridge": 0.0}, {"ridge": 0.1}):
        with pytest.raises(DegeneratePointsError):
            estimate_motion(points, points, **options)


# --- one estimator for many samples


@given(point_sets(), ridges, st.data())
def test_a_reused_estimator_equals_estimate_motion(
    points: np.ndarray, ridge: float, data: st.DataObject
) -> None:
    weights = data.draw(weights_for(points))
    estimator = MotionEstimator(points, weights=weights, ridge=ridge)
    for _ in range(4):
        after = transform_points(data.draw(affine_motions()), points) + data.draw(
            noise_like(points, 0.01)
        )
        prior = data.draw(st.none() | rotations)
        reused = estimate(estimator, after, prior)
        fresh = estimate_motion(
            points, after, weights=weights, ridge=ridge, prior=prior
        )
        np.testing.assert_array_equal(reused.motion, fresh.motion)
        np.testing.assert_array_equal(reused.residual_norms, fresh.residual_norms)


@given(point_sets(), ridges, rotations, st.data())
def test_inputs_are_never_modified(
    points: np.ndarray, ridge: float, prior: np.ndarray, data: st.DataObject
) -> None:
    inputs = [
        points,
        points + data.draw(noise_like(points, 0.01)),
        data.draw(weights_for(points)),
        prior,
    ]
    copies = [array.copy() for array in inputs]
    before, after, weights, prior = inputs
    estimate_motion(before, after, weights=weights, ridge=ridge, prior=prior)
    estimate_motion(before, after, weights=weights, ridge=ridge)
    for array, copy in zip(inputs, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_an_estimator_keeps_nothing_of_the_callers_arrays() -> None:
    points = 0.05 * np.random.default_rng(4).normal(size=(6, 3))
    weights = np.ones(6)
    after = points + 0.01
    estimator = MotionEstimator(points, weights=weights, ridge=0.1)
    expected = estimate(estimator, after).motion
    points[:], weights[:] = np.nan, np.nan
    np.testing.assert_array_equal(estimate(estimator, after).motion, expected)


def test_results_share_no_memory() -> None:
    points = 0.05 * np.random.default_rng(5).normal(size=(6, 3))
    estimator = MotionEstimator(points)
    first = estimate(estimator, points)
    first.motion[:], first.residual_norms[:], first.residual_vectors[:] = (
        np.nan,
        np.nan,
        np.nan,
    )
    second: MotionEstimate = estimate(estimator, points)
    np.testing.assert_allclose(second.motion, np.eye(4), rtol=0.0, atol=1e-13)
    with pytest.raises(ValueError, match="read-only"):
        first.singular_values[:] = 0.0
