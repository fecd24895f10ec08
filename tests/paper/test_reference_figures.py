"""Eqs. (5) to (8) against numbers of the paper's toolbox (`data/eq5_8.json`, in millimetres)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from strategies import motion_of

from handmap_qp.errors import DegeneratePointsError
from handmap_qp.reference.decomposition import decompose
from handmap_qp.reference.estimation import estimate_motion
from handmap_qp.se3 import transform_points

FULL_RANK = ("big_syn1_arc_rot30", "exact_affine", "four_points_syn1_full")
PROPER_SPLITS = [(case, "raw") for case in FULL_RANK[:2]] + [
    ("three_points_syn1", v) for v in ("raw", "inc", "cinc")
]
SPLITS = ("origin_b", "centroid_h", "centroid_r", "Uinv_b")
MIRRORED = "four_points_syn1_full"


@pytest.fixture(scope="module")
def figures(load_data: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    return load_data("eq5_8")


def motion_from(rows: list[list[float]]) -> np.ndarray:
    return np.vstack([rows, [0.0, 0.0, 0.0, 1.0]])


def assert_close(actual: np.ndarray, expected: Any, relative: float = 1e-8) -> None:
    """Assert equality relative to the largest entry, as single entries may be rounding errors."""
    np.testing.assert_allclose(
        actual, expected, rtol=0.0, atol=relative * np.abs(expected).max()
    )


def system_of_eq_6(points: np.ndarray) -> np.ndarray:
    """M, shape (3 n, 12), as printed in the paper."""
    return np.vstack([np.kron(np.eye(3), np.append(point, 1.0)) for point in points])


def pivot_of(
    split: str, T: np.ndarray, human_points: np.ndarray, robot_points: np.ndarray
) -> np.ndarray:
    """Return the pivot that corresponds to the toolbox's placement of T_rb and T_def."""
    if split == "origin_b":
        return np.zeros(3)
    if split == "Uinv_b":
        # T_def without translation keeps the origin, the image of the pivot: T(pivot) = 0.
        return -np.linalg.solve(T[:3, :3], T[:3, 3])
    return (human_points if split == "centroid_h" else robot_points).mean(axis=0)


def test_the_data_say_where_they_come_from(figures: dict[str, Any]) -> None:
    assert "SynGrasp 2.2" in figures["source"]
    assert figures["units"] == "mm and rad"
    assert {
        name for name, case in figures["cases"].items() if case["rank_M"] == 12
    } == set(FULL_RANK)


@pytest.mark.parametrize("variant", ["raw", "inc", "cinc"])
@pytest.mark.parametrize("name", FULL_RANK)
def test_estimate_equals_the_toolbox_motion_where_it_is_unique(
    figures: dict[str, Any], name: str, variant: str
) -> None:
    case = figures["cases"][name]
    estimate = estimate_motion(case["p"], case["f"])
    assert_close(estimate.motion, motion_from(case["variants"][variant]["T"]))


def test_three_points_do_not_determine_the_motion(figures: dict[str, Any]) -> None:
    case = figures["cases"]["three_points_syn1"]
    with pytest.raises(DegeneratePointsError) as caught:
        estimate_motion(case["p"], case["f"])
    assert caught.value.singular_values[2] < 1e-12 * caught.value.singular_values[0]


@pytest.mark.parametrize("variant", ["raw", "inc", "cinc"])
def test_minimum_norm_solutions_of_eq_6_are_the_toolbox_ones_for_three_points(
    figures: dict[str, Any], variant: str
) -> None:
    # They depend on the coordinates (`raw`) or on the choice of the undetermined part. So such
    # points are rejected.
    case = figures["cases"]["three_points_syn1"]
    before, after = np.array(case["p"]), np.array(case["f"])
    centre = before.mean(axis=0) if variant == "cinc" else np.zeros(3)
    base = np.zeros(12) if variant == "raw" else np.eye(4)[:3].ravel()
    M = system_of_eq_6(before - centre)
    assert np.linalg.matrix_rank(M) == case["rank_M"]
    t = base + np.linalg.pinv(M, rcond=1e-12) @ ((after - centre).ravel() - M @ base)
    shift = motion_of(np.eye(3), centre)
    assert_close(
        shift @ motion_from(t.reshape(3, 4).tolist()) @ np.linalg.inv(shift),
        motion_from(case["variants"][variant]["T"]),
    )


@pytest.mark.parametrize(("name", "variant"), PROPER_SPLITS)
def test_polar_factors_are_the_toolbox_ones(
    figures: dict[str, Any], name: str, variant: str
) -> None:
    expected = figures["cases"][name]["variants"][variant]
    parts = decompose(motion_from(expected["T"]))
    assert_close(parts.stretch, expected["U"])
    assert_close(parts.rotation, expected["R"])


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize(("name", "variant"), PROPER_SPLITS)
def test_rigid_part_and_deformation_are_the_toolbox_ones(
    figures: dict[str, Any], name: str, variant: str, split: str
) -> None:
    case = figures["cases"][name]
    expected = case["variants"][variant]
    T = motion_from(expected["T"])
    pivot = pivot_of(split, T, np.array(case["p"]), np.array(figures["robot_points"]))
    parts = decompose(T, pivot=pivot)
    assert_close(parts.rigid, motion_from(expected["splits"][split]["T_rb"]))
    assert_close(parts.deformation, motion_from(expected["splits"][split]["T_def"]))


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize(("name", "variant"), PROPER_SPLITS)
def test_robot_targets_and_joint_steps_are_the_toolbox_ones(
    figures: dict[str, Any], name: str, variant: str, split: str
) -> None:
    case = figures["cases"][name]
    expected = case["variants"][variant]
    robot_points, J = np.array(figures["robot_points"]), np.array(figures["robot_J"])
    T = motion_from(expected["T"])
    parts = decompose(T, pivot=pivot_of(split, T, np.array(case["p"]), robot_points))
    rigid_targets = transform_points(parts.rigid, robot_points)
    targets = transform_points(parts.deformation, rigid_targets)  # eq. (7)
    dq = np.linalg.pinv(J) @ (targets - rigid_targets).ravel()  # eq. (8) with xi = 0
    assert_close(rigid_targets, expected["splits"][split]["p_rb"])
    assert_close(targets, expected["p_f"])
    # The tolerance on differences follows from the rounding of the targets.
    lengths = np.abs(targets).max()
    np.testing.assert_allclose(
        targets - rigid_targets,
        expected["splits"][split]["dp"],
        rtol=0.0,
        atol=1e-11 * lengths,
    )
    np.testing.assert_allclose(
        dq, expected["splits"][split]["dq"], rtol=1e-8, atol=1e-12 * lengths
    )


@pytest.mark.parametrize("case", ["exact_affine", "big_syn1_arc_rot30"])
def test_from_points_to_joint_steps_in_one_go(
    figures: dict[str, Any], case: str
) -> None:
    points, robot_points = (
        np.array(figures["cases"][case]["p"]),
        np.array(figures["robot_points"]),
    )
    motion = estimate_motion(points, figures["cases"][case]["f"]).motion
    parts = decompose(motion, pivot=points.mean(axis=0))
    dp = transform_points(motion, robot_points) - transform_points(
        parts.rigid, robot_points
    )
    dq = np.linalg.pinv(np.array(figures["robot_J"])) @ dp.ravel()
    assert_close(
        dq, figures["cases"][case]["variants"]["raw"]["splits"]["centroid_h"]["dq"]
    )


def test_a_mirrored_motion_keeps_a_rotation_where_the_toolbox_has_a_reflection(
    figures: dict[str, Any],
) -> None:
    # Four points with a fully closed synergy: det A = -6.3. Ours differs by the mirror along the
    # weakest axis of stretch.
    expected = figures["cases"][MIRRORED]["variants"]["raw"]
    U, R = np.array(expected["U"]), np.array(expected["R"])
    assert np.linalg.det(R) == pytest.approx(-1.0)
    weakest = np.linalg.eigh(U)[1][:, 0]
    mirror = np.eye(3) - 2.0 * np.outer(weakest, weakest)
    parts = decompose(motion_from(expected["T"]))
    assert_close(parts.rotation, mirror @ R)
    assert_close(parts.stretch, U @ mirror)
    assert np.linalg.det(parts.rotation) == pytest.approx(1.0)


def test_a_mirrored_motion_leads_to_the_same_targets_all_the_same(
    figures: dict[str, Any],
) -> None:
    expected = figures["cases"][MIRRORED]["variants"]["raw"]
    for split in SPLITS:
        T = motion_from(expected["T"])
        robot_points = np.array(figures["robot_points"])
        pivot = pivot_of(
            split, T, np.array(figures["cases"][MIRRORED]["p"]), robot_points
        )
        parts = decompose(T, pivot=pivot)
        assert_close(
            transform_points(parts.deformation @ parts.rigid, robot_points),
            expected["p_f"],
        )
