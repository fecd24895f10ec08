"""Options that change during a motion: `HandMapper.configure`."""

from typing import Any

import numpy as np
import pytest

from handmap_qp import (
    HandMapper,
    IkOptions,
    InvalidOptionsError,
    MappingOptions,
    load_hand,
)
from handmap_qp.se3 import affine

HUMAN = load_hand("human")
ALLEGRO = load_hand("allegro_right")
CHANGES = [
    {"ridge": 0.5},
    {"scale": 1.5},
    {"deformation_gain": 0.5},
    {"residual_gain": 1.0},
    {"stretch_min": 0.9, "stretch_max": 1.1},
    {"rigid_from": "wrist"},
    {"pivot": "palm"},
    {"alignment": "palm"},
    {"rigid_from": "wrist", "pivot": "palm", "residual_gain": 1.0},
]


def sample(phase: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a human posture and wrist pose of one motion."""
    q = HUMAN.rest + 0.3 * np.sin(phase + np.arange(20.0)) * np.minimum(
        HUMAN.upper_limits - HUMAN.rest, HUMAN.rest - HUMAN.lower_limits
    )
    turn = np.array(
        [
            [np.cos(phase), -np.sin(phase), 0.0],
            [np.sin(phase), np.cos(phase), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    return q, affine(turn, np.array([0.1 * phase, 0.0, 0.3]))


@pytest.mark.parametrize("change", CHANGES, ids=str)
def test_the_motion_goes_on_counting_from_the_same_reference(
    change: dict[str, Any],
) -> None:
    changed, other = (
        HandMapper(HUMAN, ALLEGRO, "paper"),
        HandMapper(HUMAN, ALLEGRO, **change),
    )
    # Both start with the robot away from rest, and with different wrist poses.
    start = ALLEGRO.rest + 0.2 * (ALLEGRO.upper_limits - ALLEGRO.rest)
    for mapper in (changed, other):
        mapper.reset(*sample(0.0), robot_q=start, robot_wrist=sample(2.0)[1])
    changed.map_step(*sample(0.1))
    changed.configure(MappingOptions(**change))
    after, expected = changed.map_step(*sample(0.3)), other.map_step(*sample(0.3))
    np.testing.assert_allclose(after.targets, expected.targets, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(
        after.motion_rigid, expected.motion_rigid, rtol=0.0, atol=1e-14
    )


@pytest.mark.parametrize(
    "ik", [IkOptions(), IkOptions(max_acceleration=30.0)], ids=["plain", "acceleration"]
)
@pytest.mark.parametrize("reference", ["first", "previous"])
def test_configuring_the_present_options_changes_nothing(
    ik: IkOptions, reference: Any
) -> None:
    touched, untouched = (
        HandMapper(HUMAN, ALLEGRO, ik=ik, reference=reference) for _ in range(2)
    )
    for i in range(12):
        touched.configure(touched.method, ik=touched.ik)
        if i == 6:
            touched.release()
            untouched.release()
        after, expected = (
            mapper.map_step(*sample(0.05 * i)) for mapper in (touched, untouched)
        )
        np.testing.assert_allclose(
            after.command.q, expected.command.q, rtol=0.0, atol=1e-12
        )
        assert after.status == expected.status


def test_weights_of_the_qp_count_from_the_next_sample() -> None:
    mapper = HandMapper(HUMAN, ALLEGRO, "paper")
    mapper.map_step(*sample(0.0))
    before = mapper.map_step(*sample(0.2)).command.q
    mapper.configure(ik=IkOptions(rest_weight=100.0, has_velocity_limits=False))
    assert mapper.ik.rest_weight == 100.0
    after = mapper.map_step(*sample(0.2)).command.q
    assert (
        np.abs(after - ALLEGRO.rest).max() < 0.01 * np.abs(before - ALLEGRO.rest).max()
    )


def test_a_reference_without_wrist_is_given_up_where_the_wrist_is_needed() -> None:
    mapper, points = HandMapper(HUMAN, ALLEGRO, "paper"), HUMAN.points(*sample(0.1))
    mapper.reset(robot_wrist=np.eye(4))
    mapper.map_points(points)
    mapper.configure(MappingOptions(ridge=0.3))
    moved = points + np.array([0.05, 0.0, 0.0])
    np.testing.assert_allclose(
        mapper.map_points(moved).motion[:3, 3], (0.05, 0.0, 0.0), atol=1e-12
    )
    mapper.configure(MappingOptions(rigid_from="wrist"))
    # The wrist's displacement counts from this sample, which is the reference now.
    np.testing.assert_allclose(
        mapper.map_points(moved, sample(0.4)[1]).motion, np.eye(4), atol=1e-12
    )


def test_a_rejected_configuration_changes_nothing() -> None:
    fixed = MappingOptions(rigid_from="none")
    mapper = HandMapper(HUMAN, load_hand("three_finger", mount="fixed"), fixed)
    before = mapper.map_step(*sample(0.0))
    for wrong in (
        MappingOptions(rigid_from="points"),
        MappingOptions(rigid_from="wrist"),
    ):
        with pytest.raises(InvalidOptionsError, match="moves the wrist"):
            mapper.configure(wrong, ik=IkOptions(damping=5.0))
    assert (mapper.method, mapper.ik) == (fixed, IkOptions())
    np.testing.assert_array_equal(mapper.map_step(*sample(0.0)).targets, before.targets)


def test_velocity_outlives_a_change_of_method_and_a_lowered_limit() -> None:
    # Forgotten, it would let a robot that moves stop or turn within one sample.
    high, low, dt = 20.0, 0.5, 1.0 / 60.0
    changes: tuple[dict[str, Any], ...] = (
        {"method": "object", "ik": IkOptions(max_acceleration=high)},
        {"method": MappingOptions(scale=1.1)},
        {"ik": IkOptions(max_acceleration=low)},
    )
    for change in changes:
        mapper = HandMapper(
            HUMAN, ALLEGRO, "paper", ik=IkOptions(max_acceleration=high)
        )
        mapper.map_step(*sample(0.0), dt=dt)
        q, velocity, fastest = mapper.motion.q[ALLEGRO.q_indices], None, 0.0
        for k in range(80):
            if k == 12:
                mapper.configure(**change)
            command = mapper.map_step(*sample(1.5 if k < 40 else 0.0), dt=dt).command
            last, velocity, q = velocity, (command.q - q) / dt, command.q
            fastest = max(fastest, np.abs(velocity).max())
            if last is not None:
                assert np.abs(velocity - last).max() <= high * dt * (1.0 + 1e-9), k
            assert (q >= ALLEGRO.lower_limits).all()
            assert (q <= ALLEGRO.upper_limits).all()
        assert fastest > 1.0


def test_a_released_robot_brakes_within_its_limit_and_sets_out_from_rest() -> None:
    most, dt = 20.0, 1.0 / 60.0
    mapper = HandMapper(HUMAN, ALLEGRO, "paper", ik=IkOptions(max_acceleration=most))
    mapper.map_step(*sample(0.0), dt=dt)
    q, last, moved = mapper.motion.q[ALLEGRO.q_indices], np.zeros(16), []
    for k in range(80):
        if k == 12:
            mapper.release()
        if k == 50:
            mapper.clutch()
        step = mapper.map_step(*sample(0.1 * k), dt=dt)
        assert (step.status == "released") == (12 <= k < 50)
        velocity, q = (step.command.q - q) / dt, step.command.q
        assert np.abs(velocity - last).max() <= most * dt * (1.0 + 1e-9), k
        last = velocity
        moved.append(np.abs(velocity).max())
    assert moved[11] > 1.0
    assert 0.0 < moved[12] < moved[11]
    assert moved[49] == 0.0
