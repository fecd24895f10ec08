"""The virtual ellipsoid: the smallest one, motions that it can express, and its ridge."""

from __future__ import annotations

import numpy as np
import pytest
from virtual_object_cases import HUMAN, rotation_of, sphere_matrix

from handmap_qp import HandMapper, InvalidOptionsError, VirtualEllipsoid, load_hand
from handmap_qp.mapping.methods.virtual_object import (
    VirtualSphere,
    enclosing_ellipsoid,
)


@pytest.mark.parametrize("count", [4, 5, 9, 30])
def test_the_ellipsoid_encloses_all_points_and_none_is_smaller(count: int) -> None:
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3)) * [0.05, 0.02, 0.01]
    centre, axes, semi_axes = enclosing_ellipsoid(points)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0.0
    assert (np.diff(semi_axes) <= 0.0).all()
    distances = np.linalg.norm((points - centre) @ axes / semi_axes, axis=1)
    np.testing.assert_allclose(distances.max(), 1.0, atol=1e-6)
    # Every small change that still encloses the points has a larger volume.
    volume = semi_axes.prod()
    for _ in range(300):
        shape = axes * semi_axes @ (np.eye(3) + 0.03 * rng.normal(size=(3, 3)))
        other = centre + 0.03 * semi_axes[0] * rng.normal(size=3)
        reach = np.linalg.norm(np.linalg.solve(shape, (points - other).T), axis=0).max()
        assert abs(np.linalg.det(shape)) * reach**3 > volume * (1.0 - 1e-6)


def test_points_in_a_plane_or_on_a_line_have_an_ellipse_or_a_segment() -> None:
    triangle = np.array([[1.0, 0.0, 2.0], [-0.5, 0.8, 2.0], [-0.5, -0.8, 2.0]])
    centre, axes, semi_axes = enclosing_ellipsoid(triangle)
    np.testing.assert_allclose(centre, [0.0, 0.0, 2.0], atol=1e-9)
    # Steiner's circumscribed ellipse: semi-axes of an affine image of the equilateral triangle.
    np.testing.assert_allclose(
        semi_axes, [1.0, 0.8 / np.sin(np.pi / 3), 0.0], atol=1e-7
    )
    np.testing.assert_allclose(np.abs(axes[:, 2]), [0.0, 0.0, 1.0], atol=1e-9)
    centre, _, semi_axes = enclosing_ellipsoid(
        np.array([[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]])
    )
    np.testing.assert_allclose(centre, [0.0, 0.1, 0.0], atol=1e-9)
    np.testing.assert_allclose(semi_axes, [0.1, 0.0, 0.0], atol=1e-9)
    assert enclosing_ellipsoid(np.zeros((3, 3)))[2].max() == 0.0


def test_a_motion_along_the_axes_is_recovered_exactly_without_a_ridge() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(6, 3)) * [0.05, 0.03, 0.02]
    ellipsoid = VirtualEllipsoid(ridge=0.0).enclose(points)
    turn, ratios, shift = (
        rotation_of(0.4, -0.7, 0.2),
        np.array([0.6, 1.2, 0.9]),
        rng.normal(size=3),
    )
    linear = turn @ ellipsoid.axes @ np.diag(ratios) @ ellipsoid.axes.T
    after = (points - ellipsoid.centre) @ linear.T + ellipsoid.centre + shift
    motion = ellipsoid.motion_to(after)
    np.testing.assert_allclose(motion.ratios, ratios, atol=1e-7)
    np.testing.assert_allclose(motion.linear, linear, atol=1e-7)
    np.testing.assert_allclose(motion.shift, shift, atol=1e-8)


def test_a_similarity_is_recovered_with_any_ridge() -> None:
    points = HUMAN.points(HUMAN.rest)
    turn, shift = rotation_of(-0.3, 0.1, 0.5), np.array([0.01, 0.02, -0.03])
    for ridge in (0.0, 0.1, 10.0):
        ellipsoid = VirtualEllipsoid(ridge=ridge).enclose(points)
        after = 0.7 * (points - ellipsoid.centre) @ turn.T + ellipsoid.centre + shift
        motion = ellipsoid.motion_to(after)
        np.testing.assert_allclose(motion.linear, 0.7 * turn, atol=1e-6)
        np.testing.assert_allclose(motion.shift, shift, atol=1e-8)


def test_a_large_ridge_makes_a_sphere_of_it_and_none_fits_best() -> None:
    before = HUMAN.points(HUMAN.rest)
    after = HUMAN.points(0.5 * (HUMAN.rest + HUMAN.upper_limits))
    sphere = VirtualSphere().enclose(before).motion_to(after)
    np.testing.assert_allclose(
        VirtualEllipsoid(ridge=1e9).enclose(before).motion_to(after).linear,
        sphere.linear,
        atol=1e-6,
    )
    misfits = []
    for ridge in (0.0, 0.1, 1e9):
        linear = VirtualEllipsoid(ridge=ridge).enclose(before).motion_to(after).linear
        moved = (before - before.mean(axis=0)) @ linear.T
        misfits.append(np.linalg.norm(moved - (after - after.mean(axis=0))))
    assert misfits[0] < misfits[1] < misfits[2]


def test_small_displacements_move_it_as_its_matrix_says() -> None:
    # Nine columns: those of the sphere, with one for growth along each axis.
    rng = np.random.default_rng(2)
    points = rng.normal(size=(7, 3)) * [0.05, 0.03, 0.02]
    ellipsoid = VirtualEllipsoid(ridge=0.0).enclose(points)
    offsets = points - ellipsoid.centre
    along = [np.outer(offsets @ axis, axis).ravel() for axis in ellipsoid.axes.T]
    sphere = sphere_matrix(points, ellipsoid.centre)
    np.testing.assert_allclose(np.sum(along, axis=0), sphere[:, 6], atol=1e-15)
    inverse = np.linalg.pinv(np.column_stack([sphere[:, :6], *along]))
    way, tiny = rng.normal(size=points.shape), 1e-5
    ahead, behind = (
        ellipsoid.motion_to(points + sign * tiny * way) for sign in (1, -1)
    )
    rates = inverse @ way.ravel()
    np.testing.assert_allclose(
        (ahead.ratios - behind.ratios) / (2 * tiny), rates[6:], rtol=1e-3
    )
    np.testing.assert_allclose(
        (ahead.shift - behind.shift) / (2 * tiny), rates[:3], atol=1e-3
    )


def test_a_flat_robot_follows_too() -> None:
    mapper = HandMapper(HUMAN, load_hand("three_finger"), VirtualEllipsoid())
    step = mapper.map_step(HUMAN.rest, np.eye(4))
    for q in np.linspace(HUMAN.rest, HUMAN.upper_limits, 5):
        step = mapper.map_step(q, np.eye(4))
        assert np.isfinite(step.targets).all()
        assert (step.diagnostics["ratios"] >= 0.0).all()
    assert step.diagnostics["ratios"].max() < 1.0


@pytest.mark.parametrize("ridge", [-0.1, np.inf, np.nan, "0"])
def test_a_ridge_without_a_meaning_is_rejected_by_name(ridge: float) -> None:
    with pytest.raises(InvalidOptionsError) as raised:
        VirtualEllipsoid(ridge=ridge)
    assert raised.value.option == "ridge"
