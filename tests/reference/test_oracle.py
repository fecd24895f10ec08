"""The published method judges the compiled core: targets and commands, on 30 samples a hand.

Targets are those of numpy, kinematics are Pinocchio's, mink poses the QP and quadprog solves it. Of
the core this way has the gate alone: the bounds of each command, and the rows that keep links apart
(`tests/ik/test_collision.py` compares those with coal).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from marks import crossed

from handmap_core.ik.motion import Motion
from handmap_qp import (
    TELEMANIPULATION,
    HandMapper,
    Homogeneous,
    IkOptions,
    PublishedMethod,
    Teleoperation,
    hand_names,
    load_hand,
)
from handmap_qp.errors import (
    InvalidOptionsError,
    MissingExtraError,
    MissingPackageError,
)
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.presets import get_preset
from handmap_qp.trackers.formats import read_recording

# Every sample starts from one state, so few have all there is: an open hand, a fist and a pinch.
SAMPLES = 30
PRESETS = "paper", "object", "teleoperation"
# With one like the person's, whose joints have other shares of damping.
HANDS = [*(name for name in hand_names() if not name.startswith("human")), "human"]
# Several times the usual period, so that samples reach limits of speed as well as their targets.
DT = 0.05

# Choices that the presets leave at their defaults.
CHOICES = [
    TELEMANIPULATION,
    Homogeneous(stretch_min=0.95, stretch_max=1.05, deformation_gain=0.5),
    Homogeneous(rigid_from="none", reference="rest", pivot="palm", alignment="palm"),
    Homogeneous(ridge=0.0, reference="previous", pivot="world", scale=0.7),
    Teleoperation(picking=0.5, scale=0.8, residual_gain=0.5, alignment="palm"),
    Teleoperation(),
]

human_of = lru_cache(maxsize=2)(load_hand)


def mappers(name: str, preset: str, solver: str) -> tuple[HandMapper, HandMapper]:
    """Return a mapper by the core, and one by the published method."""
    try:
        robot = load_hand(name)
    except (MissingExtraError, MissingPackageError) as error:
        pytest.skip(str(error))
    side = "human_left" if robot.side == "left" else "human"
    human = human_of(side, points="landmarks")
    chosen = get_preset(preset)
    assert isinstance(chosen.method, Homogeneous | Teleoperation)
    published = PublishedMethod(chosen.method)
    weights = chosen.ik.replaced(formulation="mink", solver=solver)
    try:
        return (
            HandMapper(human, robot, chosen.method, ik=chosen.ik),
            HandMapper(human, robot, published, ik=weights),
        )
    except InvalidOptionsError as error:
        pytest.skip(str(error))


@pytest.mark.slow
# `tests/ik/test_compiled.py` has the other robots in the suite, by a path like this one. Human
# hands, whose joints have shares of the damping, are met here alone.
@pytest.mark.parametrize(("name", "preset"), crossed(HANDS, PRESETS, every=6, start=3))
def test_the_core_moves_a_hand_as_the_published_method_does(
    name: str, preset: str
) -> None:
    by_core, published = mappers(name, preset, "quadprog")
    recording = read_recording("demo", by_core.robot.side)
    landmarks = recording.landmarks[recording.valid]
    chosen = np.linspace(0, len(landmarks) - 1, SAMPLES).astype(int)
    for sample in landmarks[chosen]:
        step = by_core.map_landmarks(sample, dt=DT)
        expected = published.map_landmarks(sample, dt=DT)
        assert step.status == expected.status
        np.testing.assert_allclose(step.targets, expected.targets, atol=1e-6)
        np.testing.assert_allclose(step.wrist_target, expected.wrist_target, atol=1e-9)
        assert step.diagnostics.keys() == expected.diagnostics.keys()
        for key, value in expected.diagnostics.items():
            np.testing.assert_allclose(step.diagnostics[key], value, atol=1e-9)
        np.testing.assert_allclose(step.command.q, expected.command.q, atol=1e-6)
        np.testing.assert_allclose(
            step.command.wrist, expected.command.wrist, atol=1e-6
        )
        # Every sample starts from one state. A motion that is set ends a detour, so set both.
        by_core.motion = published.motion = Motion(*published.motion)


@pytest.mark.parametrize("name", ["allegro_right", "human"])
@pytest.mark.parametrize("method", CHOICES)
def test_targets_are_those_of_the_core_whatever_is_chosen(
    method: Homogeneous | Teleoperation, name: str
) -> None:
    human, robot = human_of("human", points="landmarks"), load_hand(name)
    # With these weights, targets do not go with the wrist that the robot reaches.
    by_core = HandMapper(human, robot, method, ik=IkOptions())
    published = HandMapper(human, robot, PublishedMethod(method), ik=IkOptions())
    for sample in read_recording("demo", "right").landmarks[:180:9]:
        step, expected = (each.map_landmarks(sample) for each in (by_core, published))
        np.testing.assert_allclose(step.targets, expected.targets, atol=1e-10)
        np.testing.assert_allclose(step.wrist_target, expected.wrist_target, atol=1e-10)
        assert step.is_clamped == expected.is_clamped
        for key, value in expected.diagnostics.items():
            np.testing.assert_allclose(step.diagnostics[key], value, atol=1e-10)


@pytest.mark.parametrize("solver", ["osqp", "proxqp"])
@pytest.mark.parametrize("preset", PRESETS)
def test_other_solvers_move_a_hand_alike(preset: str, solver: str) -> None:
    by_core, published = mappers("g1_left", preset, solver)
    recording = read_recording("demo", "left")
    landmarks = recording.landmarks[recording.valid]
    failed = 0
    for sample in landmarks[:: len(landmarks) // SAMPLES]:
        step = by_core.map_landmarks(sample, dt=DT)
        found = published.map_landmarks(sample, dt=DT)
        if found.status == "failed":
            failed += 1
        else:
            np.testing.assert_allclose(step.command.q, found.command.q, atol=1e-5)
        by_core.motion = published.motion = by_core.motion
    # ProxQP takes a few problems for infeasible.
    assert failed <= (0 if solver == "osqp" else 1)


@pytest.mark.parametrize("name", ["allegro_right", "ur5_allegro", "robotiq_2f85"])
def test_the_box_of_the_qp_is_that_of_its_formula(name: str) -> None:
    hand = load_hand(name)
    ik = PointIk(hand, IkOptions())
    rng = np.random.default_rng(0)
    joints = hand.joint_columns
    for _ in range(100):
        # Some joints begin outside their limits, from where they come back.
        q = rng.uniform(hand.lower_limits - 0.1, hand.upper_limits + 0.1)
        ik.place(hand.configuration_vector(q))
        lower, upper = ik.gate.bounds(DT)
        reach = DT * hand.velocity_limits
        np.testing.assert_allclose(
            lower[joints], np.clip(hand.lower_limits - q, -reach, reach), atol=1e-12
        )
        np.testing.assert_allclose(
            upper[joints], np.clip(hand.upper_limits - q, -reach, reach), atol=1e-12
        )


def test_only_a_method_of_t_is_published() -> None:
    method = PublishedMethod(get_preset("fingertip-vectors").method)  # ty: ignore[invalid-argument-type]
    with pytest.raises(InvalidOptionsError, match="method"):
        HandMapper(human_of("human"), load_hand("allegro_right"), method)
