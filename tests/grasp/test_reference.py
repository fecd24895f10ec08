"""The paper's two grasps against the published numbers."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from grasp_measures import grasp_quality
from section_four.cube import REFERENCE_HANDS, reference_grasp
from section_four.statics import grasp_matrix

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.sources import urdf_directory


@pytest.mark.parametrize(("hand", "count"), [("human", 7), ("three_finger", 3)])
def test_reference_contacts_are_where_they_were_published(
    hand: str, count: int
) -> None:
    reference = reference_grasp(hand)
    assert reference.published_points.shape == (count, 3)
    np.testing.assert_allclose(
        reference.grasp.points, reference.published_points, atol=1e-9
    )
    np.testing.assert_array_equal(
        reference.grasp.hand.points(reference.grasp.q, reference.grasp.wrist_pose),
        reference.grasp.points,
    )


@pytest.mark.parametrize("hand", REFERENCE_HANDS)
def test_reference_contacts_lie_on_the_cube_grown_as_the_planner_grew_it(
    hand: str,
) -> None:
    grasp = reference_grasp(hand).grasp
    local = (grasp.points - grasp.centre) @ grasp.object_pose[:3, :3]
    # The cube is 1.5 mm larger per side. The planner's points are midpoints of the bone's segment
    # inside the cube, so they are up to 3 mm deeper.
    assert (np.abs(local).max(axis=1) <= 0.0265 + 1e-9).all()
    assert (np.abs(local).max(axis=1) >= 0.0235).all()


@pytest.mark.parametrize("hand", REFERENCE_HANDS)
def test_reference_joints_are_inside_their_limits(hand: str) -> None:
    grasp = reference_grasp(hand).grasp
    assert (grasp.hand.lower_limits <= grasp.q).all()
    assert (grasp.q <= grasp.hand.upper_limits).all()


def test_both_hands_hold_the_same_cube() -> None:
    human, robot = (reference_grasp(hand).grasp for hand in REFERENCE_HANDS)
    np.testing.assert_array_equal(human.object_pose, robot.object_pose)
    assert human.shape == robot.shape


def test_reference_normals_point_into_the_cube() -> None:
    for grasp in (reference_grasp(hand).grasp for hand in REFERENCE_HANDS):
        local = grasp.normals @ grasp.object_pose[:3, :3]
        # Normals of the cube's faces.
        np.testing.assert_allclose(
            np.sort(np.abs(local), axis=1),
            np.tile([0.0, 0.0, 1.0], (len(local), 1)),
            atol=1e-12,
        )
        assert (
            np.einsum("cj,cj->c", grasp.normals, grasp.centre - grasp.points) > 0.0
        ).all()


def test_published_robot_angles_miss_our_hand_by_the_planners_shift() -> None:
    reference = reference_grasp("three_finger")
    published = dataclasses.replace(reference.grasp, q=reference.published_q)
    misses = np.linalg.norm(published.points - reference.published_points, axis=1)
    np.testing.assert_allclose(misses, 0.05 / 3.0, atol=1e-12)


def test_the_best_palm_for_the_published_robot_angles_is_hardly_better() -> None:
    figures = json.loads(
        (urdf_directory() / "three_finger" / "grasp_cube50.json").read_text(
            encoding="utf-8"
        )
    )["published"]
    reference = reference_grasp("three_finger")
    published = dataclasses.replace(
        reference.grasp,
        q=reference.published_q,
        wrist_pose=np.array(figures["best_wrist_pose"]),
    )
    points, goals = published.points, reference.published_points
    rms = np.sqrt(np.square(points - goals).sum(axis=1).mean())
    assert rms == pytest.approx(figures["best_rms"], abs=1e-9)
    assert rms == pytest.approx(0.016375, abs=1e-6)
    # Kabsch: no rigid motion of the points brings them nearer.
    offsets, wanted = points - points.mean(axis=0), goals - goals.mean(axis=0)
    U, _, Vt = np.linalg.svd(wanted.T @ offsets)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    assert np.sqrt(
        np.square(offsets @ R.T - wanted).sum(axis=1).mean()
    ) == pytest.approx(rms, abs=1e-9)


def test_other_hands_have_no_reference_grasp() -> None:
    with pytest.raises(InvalidInputError, match="human, three_finger"):
        reference_grasp("allegro_right")


@pytest.mark.parametrize("measure", ["gii", "msvg", "mev", "dtsc", "uot"])
def test_quality_of_the_human_reference_is_the_published_one(measure: str) -> None:
    reference = reference_grasp("human")
    expected = reference.published_quality[measure]
    assert grasp_quality(reference.grasp, measure, length=1e-3) == pytest.approx(
        expected, rel=1e-10
    )


def test_quality_of_the_robot_reference_is_the_published_one_with_the_shifted_fingers() -> (
    None
):
    reference = reference_grasp("three_finger")
    expected = reference.published_quality
    # Shifting a finger as a whole changes its contacts, but not its Jacobian.
    G = grasp_matrix(
        1e3 * (reference.published_points - reference.grasp.centre), np.zeros(3)
    )
    J = 1e3 * dataclasses.replace(reference.grasp, q=reference.published_q).jacobian
    of_G, of_H = (
        np.linalg.svd(G, compute_uv=False),
        np.linalg.svd(np.linalg.pinv(G.T) @ J, compute_uv=False),
    )
    found = {
        "gii": of_G[5] / of_G[0],
        "msvg": of_G[5],
        "mev": of_H.prod(),
        "dtsc": of_H[5],
        "uot": of_H[0] / of_H[5],
    }
    assert found == pytest.approx(expected, rel=1e-9)
