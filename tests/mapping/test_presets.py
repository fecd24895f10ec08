"""Presets with options, and T of a step of any of them."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from marks import rotated

from handmap_core.ik.tasks import AttachedPoints
from handmap_qp import HandMapper, InvalidOptionsError, load_hand
from handmap_qp.hands.library import HUMAN_HANDS, hand_names
from handmap_qp.mapping.hand_pair import hand_pair
from handmap_qp.mapping.methods.fingertip_vectors import FingertipVectors
from handmap_qp.mapping.presets import PRESETS, possible_presets, preset_choice
from handmap_qp.se3 import affine, rotation_from_quat_wxyz, transform_points

HUMAN = load_hand("human")
WRIST = affine(
    rotation_from_quat_wxyz((0.6, 0.0, 0.8, 0.0)), np.array([0.1, 1.0, -0.3])
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", rotated(sorted(set(hand_names()) - set(HUMAN_HANDS)), 3)
)
def test_possible_presets_are_those_that_the_mapper_accepts(name: str) -> None:
    robot = load_hand(name)
    robots = [robot, load_hand(name, mount="fixed")] if robot.is_floating else [robot]
    for each in robots:
        accepted = []
        for preset in PRESETS:
            try:
                HandMapper(HUMAN, each, preset)
            except InvalidOptionsError:
                continue
            accepted.append(preset)
        assert list(possible_presets(HUMAN, each)) == accepted


def test_a_choice_takes_options_of_its_preset_only() -> None:
    person = load_hand("human").with_contact_gap(0.017)
    fingers = preset_choice("teleoperation", person)
    assert fingers.method.values["contact_gap"] == 0.017
    changed = fingers.with_changes({"pinch_weight": 2.0, "damping": 0.3})
    assert changed.preset == "teleoperation"
    assert changed.method == fingers.with_changes({"pinch_weight": 2.0}).method
    assert (changed.ik.damping, changed.ik.rest_weight) == (0.3, fingers.ik.rest_weight)
    for choice, name in (
        (fingers, "rigid_from"),
        (preset_choice("paper"), "pinch_weight"),
    ):
        with pytest.raises(InvalidOptionsError, match="has no such option") as raised:
            choice.with_changes({name: 1.0})
        assert raised.value.option == name
    with pytest.raises(InvalidOptionsError) as raised:
        fingers.with_changes({"preset": "claw"})
    assert raised.value.option == "preset"


@pytest.mark.parametrize("first", PRESETS)
@pytest.mark.parametrize("second", PRESETS)
def test_changes_lead_from_one_choice_to_another(first: str, second: str) -> None:
    start = preset_choice(first).with_changes({"damping": 0.4})
    end = preset_choice(second).with_changes({"rest_weight": 0.9})
    for choice in (start, end):
        if "scale" in choice.method.values:
            assert choice.with_changes({"scale": 0.5}).changes_to(choice).keys() == {
                "scale"
            }
    changes = start.changes_to(end)
    assert start.with_changes(changes) == end
    assert ("preset" in changes) == (first != second)
    assert end.changes_to(end) == {}


WITH_T = ("teleoperation", "object", "paper", "fixed_wrist")


@pytest.mark.parametrize("preset", WITH_T)
def test_stages_of_t_compose_and_carry_the_points(preset: str) -> None:
    human, robot = load_hand("human"), load_hand("allegro_right")
    mapper = HandMapper(human, robot, preset)
    mapper.map_step(human.rest, np.eye(4))
    step = mapper.map_step(np.minimum(human.rest + 0.3, human.upper_limits), WRIST)
    np.testing.assert_allclose(
        step.motion_deformation @ step.motion_rigid, step.motion, atol=1e-9
    )
    rotation = step.motion_rigid[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    used = step.human_points
    if preset == "teleoperation":
        # T starts from the resting human at the palm of the reference, here the model's own.
        pair = hand_pair(human, robot)
        palm = human.wrist_to_palm
        before = transform_points(palm, pair.human_rest[pair.shape_points])
        used = step.human_points[pair.shape_points]
        np.testing.assert_allclose(rotation, WRIST[:3, :3], atol=1e-12)
    else:
        before = human.points(human.rest, np.eye(4))
    misses = np.linalg.norm(transform_points(step.motion, before) - used, axis=1)
    np.testing.assert_allclose(misses, step.residual_norms, atol=1e-9)


def test_a_method_without_t_has_no_stages() -> None:
    human, robot = load_hand("human"), load_hand("allegro_right")
    step = HandMapper(human, robot, FingertipVectors()).map_step(human.rest, WRIST)
    assert set(step.diagnostics) == {"vectors", "scales"}
    with pytest.raises(InvalidOptionsError, match="have no motion: there are vectors"):
        _ = step.motion
    np.testing.assert_array_equal(step.human_wrist, WRIST)


def test_pairs_with_one_robot_share_its_contacts() -> None:
    robot = load_hand("allegro_right")
    pairs = [hand_pair(load_hand("human"), robot) for _ in range(2)]
    assert pairs[0] is not pairs[1]
    assert pairs[0].measured is pairs[1].measured


@pytest.mark.slow
def test_pairs_are_found_again_while_they_are_used_and_then_forgotten() -> None:
    robot, person = load_hand("three_finger"), load_hand("human")
    others = []
    for i in range(17):
        other = load_hand("human", hand_length=0.17 + 0.002 * i)
        others.append(weakref.ref(hand_pair(other, robot)))
        assert hand_pair(person, robot) is hand_pair(person, robot)
    del other
    gc.collect()
    assert others[0]() is None


def test_a_robot_far_from_its_matched_posture_has_the_extension_of_that_posture() -> (
    None
):
    pair = hand_pair(load_hand("human"), load_hand("allegro_right"))
    assert pair.robot_distances.shape == (len(pair.fingers),)
    names = [point.name for point in pair.robot.reference_points]
    tips = [names.index(f"{finger}_tip") for finger in pair.fingers]
    points = pair.robot.points(pair.matched)[tips]
    knuckles = AttachedPoints(
        pair.robot, [pair.chains[f].knuckle for f in pair.fingers]
    )
    placed = pair.robot.configuration()
    placed.place(pair.robot.configuration_vector(pair.matched))
    distances = np.linalg.norm(points - knuckles.positions(placed), axis=1)
    np.testing.assert_allclose(pair.robot_distances, distances, atol=1e-12)
