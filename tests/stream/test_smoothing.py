"""The one-euro filter on samples: signals that it keeps and removes, and time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from mapping_cases import little_pose, near_rest

from handmap_qp import (
    Follower,
    HandMapper,
    InvalidInputError,
    InvalidOptionsError,
    Smoothing,
    load_hand,
)
from handmap_qp.mapping.method import HumanPose
from handmap_qp.se3 import affine, transform_points
from handmap_qp.stream.smoothing import smooth_sample

HUMAN = load_hand("human")
THREE = load_hand("three_finger")
OPTIONS = Smoothing()


def run(
    samples: list[HumanPose], times: np.ndarray, options: Smoothing = OPTIONS
) -> list[HumanPose]:
    state, smooth = None, []
    for sample, dt in zip(
        samples, np.diff(times, prepend=times[0] - 0.01), strict=True
    ):
        result, state = smooth_sample(options, state, sample, float(dt))
        smooth.append(result)
    return smooth


def wrist_of(sample: HumanPose) -> np.ndarray:
    """Return the wrist pose of a sample that has one, shape (4, 4)."""
    assert sample.wrist is not None
    return sample.wrist


def line(times: np.ndarray, speed: float) -> list[HumanPose]:
    return [HumanPose(np.array([[speed * t, 0.0, 0.0]]), None) for t in times]


def test_a_constant_sample_passes_unchanged() -> None:
    rng = np.random.default_rng(0)
    sample = HumanPose(rng.normal(size=(5, 3)), little_pose(rng))
    for result in run([sample] * 10, 0.01 * np.arange(10)):
        np.testing.assert_allclose(result.points, sample.points, atol=1e-12)
        np.testing.assert_allclose(wrist_of(result), wrist_of(sample), atol=1e-12)


def test_noise_at_rest_is_taken_away() -> None:
    rng, times = np.random.default_rng(1), 0.011 * np.arange(600)
    noise = rng.normal(scale=1e-4, size=(600, 1, 3))
    smooth = run([HumanPose(points, None) for points in noise], times)
    assert np.std([s.points for s in smooth[100:]]) < 0.45 * np.std(noise)


def test_a_quick_hand_lags_less_than_a_slow_one() -> None:
    times = 0.01 * np.arange(300)
    lags = []
    for speed in (0.01, 0.1, 1.0):
        end = run(line(times, speed), times)[-1].points[0, 0]
        lags.append(times[-1] - end / speed)
    assert lags[0] > lags[1] > lags[2]
    assert lags[2] < 0.006


def test_a_turning_wrist_lags_like_a_point_on_a_lever_of_10_cm() -> None:
    times, speed = 0.01 * np.arange(400), 2.0
    none = np.zeros((1, 3))
    turning = [
        affine(pin.exp3(np.array([0.0, 0.0, speed * t])), np.zeros(3)) for t in times
    ]
    moving = [affine(np.eye(3), np.array([0.1 * speed * t, 0.0, 0.0])) for t in times]
    turned, moved = (
        wrist_of(run([HumanPose(none, pose) for pose in poses], times)[-1])
        for poses in (turning, moving)
    )
    angle = pin.log3(turned[:3, :3].T @ turning[-1][:3, :3])[2]
    distance = moving[-1][0, 3] - moved[0, 3]
    assert angle / speed == pytest.approx(distance / (0.1 * speed), rel=1e-6)
    assert distance > 1e-4


def test_jitter_in_time_changes_little() -> None:
    rng = np.random.default_rng(2)
    even = 0.01 * np.arange(300)
    jittery = np.sort(even + rng.uniform(-0.004, 0.004, size=300))
    motion = lambda t: 0.05 * np.sin(6.0 * t)  # noqa: E731
    error = []
    for times in (even, jittery):
        samples = [HumanPose(np.array([[motion(t), 0.0, 0.0]]), None) for t in times]
        smooth = np.array([s.points[0, 0] for s in run(samples, times)])
        error.append(np.abs(smooth - motion(times))[50:].max())
    assert error[1] < 1.3 * error[0]


def test_two_half_steps_come_near_to_one() -> None:
    options = Smoothing(min_cutoff=2.0, speed_gain=0.0)
    step = [HumanPose(np.zeros((1, 3)), None)] + [
        HumanPose(np.ones((1, 3)), None)
    ] * 200
    coarse = run(step[:101], np.r_[0.0, 0.01 + 0.01 * np.arange(100)], options)[50]
    fine = run(step, np.r_[0.0, 0.005 + 0.005 * np.arange(200)], options)[100]
    np.testing.assert_allclose(coarse.points, fine.points, atol=0.01)


def test_moving_the_world_moves_the_smooth_hand_with_it() -> None:
    rng, times = np.random.default_rng(3), 0.01 * np.arange(20)
    moved = affine(pin.exp3(np.array([0.3, 1.0, -0.4])), np.array([0.5, 0.1, -2.0]))
    here = [
        HumanPose(rng.normal(scale=0.05, size=(6, 3)), little_pose(rng)) for _ in times
    ]
    there = [
        HumanPose(transform_points(moved, s.points), moved @ wrist_of(s)) for s in here
    ]
    for one, other in zip(run(here, times), run(there, times), strict=True):
        np.testing.assert_allclose(
            other.points, transform_points(moved, one.points), atol=1e-9
        )
        np.testing.assert_allclose(wrist_of(other), moved @ wrist_of(one), atol=1e-9)
        rotation = wrist_of(one)[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


def test_a_rigid_motion_of_the_hand_leaves_its_shape() -> None:
    times = 0.01 * np.arange(50)
    shape = np.random.default_rng(4).normal(scale=0.05, size=(6, 3))
    poses = [
        affine(pin.exp3(np.array([0.0, 0.0, t])), np.array([t, 0.0, 0.0]))
        for t in times
    ]
    smooth = run([HumanPose(transform_points(p, shape), p) for p in poses], times)
    for sample in smooth:
        wrist = wrist_of(sample)
        back = (sample.points - wrist[:3, 3]) @ wrist[:3, :3]
        np.testing.assert_allclose(back, shape, atol=1e-12)


def test_a_gap_in_time_or_in_the_wrist_starts_again() -> None:
    far = HumanPose(np.ones((1, 3)), None)
    _, state = smooth_sample(OPTIONS, None, HumanPose(np.zeros((1, 3)), None), 0.01)
    result, _ = smooth_sample(OPTIONS, state, far, 1.0)
    np.testing.assert_array_equal(result.points, far.points)
    result, _ = smooth_sample(
        OPTIONS, state, HumanPose(np.ones((1, 3)), np.eye(4)), 0.01
    )
    np.testing.assert_array_equal(result.points, far.points)


def test_a_follower_smooths_and_a_failed_step_leaves_the_filter_as_it_was() -> None:
    rng = np.random.default_rng(5)
    samples = [(near_rest(rng, 0.3, HUMAN), little_pose(rng, 0.02)) for _ in range(12)]
    plain, smooth, disturbed = (
        Follower(HandMapper(HUMAN, THREE, "object"), smoothing=s)
        for s in (None, OPTIONS, OPTIONS)
    )
    rough_targets, smooth_targets = [], []
    for q, wrist in samples:
        pose, dt = HumanPose(HUMAN.points(q, wrist), wrist), 1.0 / 60.0
        with pytest.raises(InvalidInputError):
            disturbed.map(pose, -1.0)
        with pytest.raises(InvalidInputError):
            disturbed.map(HumanPose(pose.points, None), dt)
        expected = smooth.map(pose, dt)
        np.testing.assert_array_equal(disturbed.map(pose, dt).targets, expected.targets)
        smooth_targets.append(expected.targets)
        rough_targets.append(plain.map(pose, dt).targets)
    rough, calm = (
        np.abs(np.diff(t, axis=0)).mean() for t in (rough_targets, smooth_targets)
    )
    assert calm < 0.9 * rough


def test_a_new_reference_is_the_hand_as_it_is() -> None:
    rng = np.random.default_rng(6)
    follower = Follower(HandMapper(HUMAN, THREE, "object"), smoothing=OPTIONS)
    for k in range(8):
        wrist = little_pose(rng, 0.02)
        pose = HumanPose(HUMAN.points(near_rest(rng, 0.3, HUMAN), wrist), wrist)
        if k == 5:
            follower.mapper.clutch()
        seen = follower.map(pose, 1.0 / 60.0).human_points
        is_smoothed = bool(np.abs(seen - pose.points).max() > 1e-6)
        assert is_smoothed == (k not in (0, 5))


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"min_cutoff": 0.0}, "min_cutoff"),
        ({"speed_gain": -1.0}, "speed_gain"),
        ({"speed_cutoff": np.inf}, "speed_cutoff"),
        ({"min_cutoff": "x"}, "min_cutoff"),
    ],
    ids=str,
)
def test_filters_without_a_meaning_are_rejected_by_name(
    options: dict[str, Any], name: str
) -> None:
    with pytest.raises(InvalidOptionsError) as raised:
        Smoothing(**options)
    assert raised.value.option == name
