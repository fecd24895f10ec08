"""The ridge that keeps T bounded for nearly flat points, its prior, and rejected inputs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from strategies import (
    affine_motions,
    coplanar_point_sets,
    generators,
    near_coplanar_point_sets,
    noise_like,
    point_sets,
    poses,
    rotations,
    weights_for,
)

from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.reference.estimation import estimate_motion
from handmap_qp.se3 import transform_points

ridges = st.floats(min_value=1e-6, max_value=1e3)
FINGERTIPS = (
    np.array([[-62, 8, -21], [-22, 52, -8], [4, 58, -3], [27, 50, -5], [50, 30, -12]])
    / 1e3
)


def centred(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return points - weights @ points / weights.sum()


def kabsch_of_scipy(
    before: np.ndarray, after: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    return Rotation.align_vectors(
        centred(after, weights), centred(before, weights), weights=weights
    )[0].as_matrix()


def solve_augmented(
    before: np.ndarray,
    after: np.ndarray,
    weights: np.ndarray,
    ridge: float,
    prior: np.ndarray,
) -> np.ndarray:
    """A by one least-squares problem.

    A row for each point, and three rows that ask for the prior.
    """
    roots = np.sqrt(weights / weights.sum())[:, None]
    x, y = roots * centred(before, weights), roots * centred(after, weights)
    pull = np.sqrt(ridge * np.sum(x * x) / 3.0)
    return np.linalg.lstsq(
        np.vstack([x, pull * np.eye(3)]), np.vstack([y, pull * prior.T]), rcond=None
    )[0].T


def cost(
    A: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    weights: np.ndarray,
    ridge: float,
    prior: np.ndarray,
) -> float:
    shares = weights / weights.sum()
    x, y = centred(before, weights), centred(after, weights)
    fit = shares @ np.sum((y - x @ A.T) ** 2, axis=1)
    return float(
        fit + ridge * (shares @ np.sum(x * x, axis=1)) / 3.0 * np.sum((A - prior) ** 2)
    )


def noisy_pair(
    data: st.DataObject, points: st.SearchStrategy[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    before = data.draw(points)
    after = transform_points(
        data.draw(affine_motions(largest=1.5)), before
    ) + data.draw(noise_like(before, 1e-3))
    return before, after, data.draw(weights_for(before))


# --- the ridge solution


@given(st.data(), ridges, rotations)
def test_with_a_prior_the_motion_solves_the_augmented_least_squares(
    data: st.DataObject, ridge: float, prior: np.ndarray
) -> None:
    before, after, weights = noisy_pair(data, point_sets() | coplanar_point_sets)
    estimate = estimate_motion(before, after, weights=weights, ridge=ridge, prior=prior)
    expected = solve_augmented(before, after, weights, ridge, prior)
    # The coordinates lie 200 times their spread from the origin at worst, and a ridge of 1e-6 adds
    # a condition of 1e3.
    np.testing.assert_allclose(estimate.motion[:3, :3], expected, rtol=0.0, atol=1e-9)


@given(st.data(), ridges)
def test_without_a_prior_the_best_rotation_takes_its_place(
    data: st.DataObject, ridge: float
) -> None:
    before, after, weights = noisy_pair(data, point_sets())
    prior = kabsch_of_scipy(before, after, weights)
    expected = solve_augmented(before, after, weights, ridge, prior)
    estimate = estimate_motion(before, after, weights=weights, ridge=ridge)
    np.testing.assert_allclose(estimate.motion[:3, :3], expected, rtol=0.0, atol=1e-9)


@given(st.data(), ridges, rotations, generators)
def test_no_other_linear_map_costs_less(
    data: st.DataObject, ridge: float, prior: np.ndarray, generator: np.random.Generator
) -> None:
    before, after, weights = noisy_pair(data, point_sets() | near_coplanar_point_sets)
    A = estimate_motion(
        before, after, weights=weights, ridge=ridge, prior=prior
    ).motion[:3, :3]
    least = cost(A, before, after, weights, ridge, prior)
    for size in (1e-4, 1e-2, 1.0):
        other = A + size * generator.normal(size=(3, 3))
        assert cost(other, before, after, weights, ridge, prior) >= least * (
            1.0 - 1e-12
        )


@given(st.data(), rotations)
def test_an_endless_ridge_gives_the_prior(
    data: st.DataObject, prior: np.ndarray
) -> None:
    before, after, weights = noisy_pair(data, point_sets())
    estimate = estimate_motion(before, after, weights=weights, ridge=1e14, prior=prior)
    np.testing.assert_allclose(estimate.motion[:3, :3], prior, rtol=0.0, atol=1e-12)
    # The translation is still that of the centroids.
    centroid = weights @ before / weights.sum()
    image = transform_points(estimate.motion, centroid[None])[0]
    np.testing.assert_allclose(
        image, weights @ after / weights.sum(), rtol=0.0, atol=1e-13
    )


@given(st.data())
def test_a_vanishing_ridge_gives_eq_6(data: st.DataObject) -> None:
    before, after, weights = noisy_pair(data, point_sets())
    almost = estimate_motion(before, after, weights=weights, ridge=1e-15).motion
    np.testing.assert_allclose(
        almost,
        estimate_motion(before, after, weights=weights).motion,
        rtol=0.0,
        atol=1e-9,
    )


@given(
    coplanar_point_sets,
    rotations,
    st.sampled_from([5e-324, 1e-200, 1e-20, 1e-16, 1e-9]),
    st.data(),
)
def test_across_a_plane_the_motion_is_the_prior_however_small_the_ridge(
    points: np.ndarray, prior: np.ndarray, ridge: float, data: st.DataObject
) -> None:
    after = points + data.draw(noise_like(points, 1e-3))
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    A = estimate_motion(points, after, ridge=ridge, prior=prior).motion[:3, :3]
    np.testing.assert_allclose(A @ normal, prior @ normal, rtol=0.0, atol=1e-9)


@given(point_sets() | near_coplanar_point_sets | coplanar_point_sets, poses, ridges)
def test_a_rigid_motion_is_recovered_at_any_ridge(
    points: np.ndarray, pose: np.ndarray, ridge: float
) -> None:
    estimate = estimate_motion(points, transform_points(pose, points), ridge=ridge)
    # Coordinates of up to 6 m carry roundings of 1e-15, and a ridge amplifies them as it does any
    # noise (see the bound below).
    spread = np.linalg.norm(points - points.mean(axis=0))
    np.testing.assert_allclose(
        estimate.motion,
        pose,
        rtol=0.0,
        atol=1e-13 / spread + 1e-14 / (np.sqrt(ridge) * spread),
    )


def test_three_points_off_a_line_are_enough_with_a_ridge() -> None:
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    estimate = estimate_motion(FINGERTIPS[:3], FINGERTIPS[:3] @ turn.T, ridge=0.1)
    np.testing.assert_allclose(estimate.motion[:3, :3], turn, rtol=0.0, atol=1e-14)


# --- the reason for the ridge: five fingertips are nearly coplanar


def stretches(motion: np.ndarray) -> np.ndarray:
    return np.linalg.svd(motion[:3, :3], compute_uv=False)


@given(near_coplanar_point_sets, poses, st.data())
def test_with_a_ridge_noise_stretches_no_more_than_its_share_of_the_spread(
    points: np.ndarray, pose: np.ndarray, data: st.DataObject
) -> None:
    # y = R x + e gives A = R + e^T X (X^T X + c I)^-1 with c = ridge |X|^2 / 3 and R as prior, and
    # no singular value of X (X^T X + c I)^-1 exceeds 1 / (2 sqrt(c)), however flat X is.
    ridge = 0.1
    centred_points = points - points.mean(axis=0)
    noise = data.draw(
        noise_like(points, 0.02 * np.linalg.norm(centred_points) / np.sqrt(len(points)))
    )
    estimate = estimate_motion(
        points, transform_points(pose, points) + noise, ridge=ridge, prior=pose[:3, :3]
    )
    bound = np.linalg.norm(noise) / (
        2.0 * np.sqrt(ridge / 3.0) * np.linalg.norm(centred_points)
    )
    assert np.abs(stretches(estimate.motion) - 1.0).max() <= bound + 1e-9


def flat_fingertips() -> np.ndarray:
    """Return fingertips flattened to a smallest singular value of 1.4 mm, as measured on hands."""
    left, values, right = np.linalg.svd(
        FINGERTIPS - FINGERTIPS.mean(axis=0), full_matrices=False
    )
    return (left * (values[0], values[1], 1.4e-3)) @ right


def noise_across() -> np.ndarray:
    """Return noise of 1 mm (root mean square) across the plane, against the points' depth."""
    left, _, right = np.linalg.svd(flat_fingertips(), full_matrices=False)
    return -1e-3 * np.sqrt(5.0) * np.outer(left[:, 2], right[2])


def test_without_a_ridge_a_millimetre_of_noise_turns_fingertips_inside_out() -> None:
    A = estimate_motion(flat_fingertips(), flat_fingertips() + noise_across()).motion[
        :3, :3
    ]
    assert np.linalg.det(A) < -0.5


def test_without_a_ridge_a_millimetre_of_noise_in_the_plane_shears_fingertips() -> None:
    left, _, right = np.linalg.svd(flat_fingertips(), full_matrices=False)
    along = 5e-3 * np.outer(left[:, 2], right[0])
    assert (
        stretches(estimate_motion(flat_fingertips(), flat_fingertips() + along).motion)[
            0
        ]
        > 3.0
    )


def test_with_a_ridge_the_same_noise_leaves_the_fingertips_as_they_are() -> None:
    estimate = estimate_motion(
        flat_fingertips(), flat_fingertips() + noise_across(), ridge=0.1
    )
    assert np.linalg.det(estimate.motion[:3, :3]) > 0.0
    assert 0.9 < stretches(estimate.motion)[2] <= stretches(estimate.motion)[0] < 1.1


# --- invalid inputs

NOT_POINTS: list[Any] = [
    np.zeros((5, 2)),
    np.zeros(3),
    np.zeros((0, 3)),
    np.zeros((5, 3, 1)),
    0.0,
    [],
    None,
]
NOT_POINTS += [
    "points",
    [["0", "1", "2"]] * 5,
    [[1, 2, 3], [4, 5]],
    {"thumb": [0, 0, 0]},
    1j * FINGERTIPS,
]
NOT_WEIGHTS: list[Any] = [
    np.ones(4),
    np.ones(6),
    np.ones((5, 1)),
    1.0,
    np.zeros(5),
    -np.ones(5),
    [1, 1, 1, 1, -1e-9],
]
NOT_WEIGHTS += [[1, 1, 1, 1, np.nan], [1, 1, 1, 1, np.inf], "12345", ["1"] * 5, {}]
NOT_ROTATIONS: list[Any] = [
    np.eye(4),
    np.eye(2),
    np.eye(3)[None],
    [1, 0, 0, 0],
    np.zeros((3, 3)),
    1.1 * np.eye(3),
]
NOT_ROTATIONS += [
    np.eye(3) + 0.01 * np.eye(3, k=1),
    np.nan * np.eye(3),
    np.full((3, 3), np.inf),
    "prior",
    [["1"] * 3] * 3,
]


@pytest.mark.parametrize("points", NOT_POINTS)
def test_an_invalid_array_of_points_is_rejected(points: Any) -> None:
    with pytest.raises(InvalidInputError, match="points_before: expected"):
        estimate_motion(points, FINGERTIPS)
    with pytest.raises(InvalidInputError, match="points_after: expected"):
        estimate_motion(FINGERTIPS, points)


@given(st.integers(0, 4), st.integers(0, 2), st.sampled_from([np.nan, np.inf, -np.inf]))
def test_points_must_be_finite(row: int, column: int, bad: float) -> None:
    points = FINGERTIPS.copy()
    points[row, column] = bad
    with pytest.raises(InvalidInputError, match="points_before: expected finite"):
        estimate_motion(points, FINGERTIPS)
    with pytest.raises(InvalidInputError, match="points_after: expected finite"):
        estimate_motion(FINGERTIPS, points)


@pytest.mark.parametrize("count", [1, 4, 6])
def test_points_before_and_after_must_be_as_many(count: int) -> None:
    with pytest.raises(
        InvalidInputError,
        match=f"points_after: expected 5 points as in points_before, got {count}",
    ):
        estimate_motion(FINGERTIPS, np.zeros((count, 3)))


@pytest.mark.parametrize("weights", NOT_WEIGHTS)
def test_invalid_weights_are_rejected(weights: Any) -> None:
    with pytest.raises(InvalidInputError, match="weights: expected"):
        estimate_motion(FINGERTIPS, FINGERTIPS, weights=weights)


@pytest.mark.parametrize(
    "ridge", [-1e-12, -1.0, np.nan, np.inf, -np.inf, "0.1", None, [0.1, 0.2], 1j]
)
def test_a_ridge_that_is_none_is_refused(ridge: Any) -> None:
    with pytest.raises(InvalidInputError, match="ridge: expected"):
        estimate_motion(FINGERTIPS, FINGERTIPS, ridge=ridge)


@pytest.mark.parametrize("prior", NOT_ROTATIONS)
def test_a_prior_other_than_a_rotation_is_rejected(prior: Any) -> None:
    with pytest.raises(InvalidInputError, match="prior: expected"):
        estimate_motion(FINGERTIPS, FINGERTIPS, ridge=0.1, prior=prior)


@given(rotations, st.integers(0, 2))
def test_a_mirrored_prior_is_refused(rotation: np.ndarray, column: int) -> None:
    mirrored = rotation.copy()
    mirrored[:, column] *= -1.0
    with pytest.raises(InvalidInputError, match="prior: expected a rotation"):
        estimate_motion(FINGERTIPS, FINGERTIPS, ridge=0.1, prior=mirrored)


def test_errors_are_both_ours_and_plain_value_errors() -> None:
    with pytest.raises(HandmapError) as caught:
        estimate_motion(FINGERTIPS, FINGERTIPS, ridge=-1.0)
    assert isinstance(caught.value, ValueError)
