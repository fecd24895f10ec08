"""Fingertip vectors from the knuckles; those from the palm are in test_methods.py."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mapping_cases import little_pose, near_rest

from handmap_qp import FingertipVectors, HandMapper, InvalidOptionsError, load_hand
from handmap_qp.hands.fingers import find_fingers
from handmap_qp.hands.spec import PointSpec
from handmap_qp.mapping.methods.fingertip_vectors import BoundFingertipVectors
from handmap_qp.se3 import inverse_pose, transform_points

HUMAN = load_hand("human")
ALLEGRO = load_hand("allegro_right")
KNUCKLE = FingertipVectors(origin="knuckle")


def targets_in_palm(step: Any, robot: Any) -> np.ndarray:
    return transform_points(
        inverse_pose(step.wrist_target @ robot.wrist_to_palm), step.targets
    )


def straight() -> np.ndarray:
    flexes = np.array(["flexion" in name for name in HUMAN.joint_names])
    return np.where(flexes, 0.0, HUMAN.rest)


@pytest.mark.parametrize(("scale", "tolerance"), [(1.0, 1e-12), (None, 2e-4)])
def test_a_hand_onto_itself_keeps_its_own_points(
    scale: float | None, tolerance: float
) -> None:
    rng = np.random.default_rng(1)
    mapper = HandMapper(HUMAN, HUMAN, FingertipVectors(scale=scale, origin="knuckle"))
    for _ in range(5):
        step = mapper.map_step(near_rest(rng, 0.5, HUMAN), little_pose(rng))
        np.testing.assert_allclose(step.targets, step.human_points, atol=tolerance)


def test_a_straight_finger_is_straight_on_the_robot() -> None:
    # From the palm, one scale for the whole hand asks for tips beyond or within the reach.
    chains = find_fingers(ALLEGRO)
    reaches = [chains[str(point.finger)].reach for point in ALLEGRO.reference_points]
    knuckles = BoundFingertipVectors(KNUCKLE, HUMAN, ALLEGRO).robot_origins
    shares = {}
    for method in (KNUCKLE, FingertipVectors()):
        step = HandMapper(HUMAN, ALLEGRO, method).map_step(straight(), np.eye(4))
        lengths = np.linalg.norm(targets_in_palm(step, ALLEGRO) - knuckles, axis=1)
        shares[method.origin] = (lengths / reaches)[1:]
    np.testing.assert_allclose(shares["knuckle"], 1.0, atol=1e-6)
    assert np.abs(shares["palm"] - 1.0).max() > 0.05


def test_an_arm_does_not_count_to_the_size_of_its_hand() -> None:
    alone, on_arm = (
        BoundFingertipVectors(FingertipVectors(), HUMAN, load_hand(name))
        for name in ("allegro_right", "ur5_allegro")
    )
    np.testing.assert_allclose(on_arm.scales, alone.scales, rtol=1e-9)


def test_vectors_begin_at_the_measured_knuckles() -> None:
    mapper = HandMapper(HUMAN, ALLEGRO, KNUCKLE)
    points = HUMAN.points(HUMAN.rest)
    before = mapper.map_points(points, np.eye(4))
    names = [point.name for point in HUMAN.reference_points]
    moved = points.copy()
    moved[[names.index("index_mcp"), names.index("index_tip")]] += [0.0, 0.01, 0.0]
    after = mapper.map_points(moved, np.eye(4))
    np.testing.assert_allclose(after.targets, before.targets, atol=1e-12)
    moved[names.index("index_tip")] += [0.0, 0.0, -0.01]
    bent = mapper.map_points(moved, np.eye(4)).targets - before.targets
    scale = before.diagnostics["scales"][1]
    np.testing.assert_allclose(
        np.linalg.norm(bent, axis=1), [0.0, 0.01 * scale, 0.0, 0.0], atol=1e-9
    )


def test_joints_are_independent_of_the_hands_place_in_the_world() -> None:
    rng = np.random.default_rng(4)
    here, there = (HandMapper(HUMAN, ALLEGRO, KNUCKLE) for _ in range(2))
    moved = little_pose(rng, 2.0)
    for _ in range(3):
        q = near_rest(rng, 0.5, HUMAN)
        expected, found = here.map_step(q, np.eye(4)), there.map_step(q, moved)
        np.testing.assert_allclose(found.command.q, expected.command.q, atol=1e-6)


def test_knuckle_vectors_name_their_missing_requirement() -> None:
    with pytest.raises(InvalidOptionsError) as unknown:
        FingertipVectors(origin="wrist")  # ty: ignore[invalid-argument-type]
    assert unknown.value.option == "origin"
    with pytest.raises(InvalidOptionsError, match="index_mcp") as missing:
        HandMapper(HUMAN.with_points("fingertips"), ALLEGRO, KNUCKLE)
    assert missing.value.option == "human_points"
    with pytest.raises(InvalidOptionsError) as text:
        FingertipVectors(scale="1")  # ty: ignore[invalid-argument-type]
    assert text.value.option == "scale"


def test_points_of_the_palm_have_no_vector_from_a_knuckle() -> None:
    centre = PointSpec("centre", "palm_link", (0.0, 0.0, -0.03), partner="middle_tip")
    robot = ALLEGRO.with_points((*ALLEGRO.reference_points, centre))
    mapper = HandMapper(HUMAN, robot, KNUCKLE)
    steps = [mapper.map_step(q, np.eye(4)) for q in (HUMAN.rest, straight())]
    first, last = (targets_in_palm(step, mapper.robot) for step in steps)
    np.testing.assert_allclose(first[-1], last[-1], rtol=0.0, atol=1e-12)
    assert np.abs(first[:-1] - last[:-1]).max() > 0.01
