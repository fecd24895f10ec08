"""The smoothing: signals that it keeps, noise that it removes, time, and the core's."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from mapping_cases import little_pose, near_rest
from oracles.alpha_beta import ReferenceSmoother

from handmap_core.stream.smoothing import Smoother
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

HUMAN = load_hand("human")
THREE = load_hand("three_finger")
OPTIONS = Smoothing()


def run(
    samples: list[HumanPose],
    times: np.ndarray,
    options: Smoothing | None = OPTIONS,
    kind: type[Smoother | ReferenceSmoother] = Smoother,
) -> list[HumanPose]:
    smoother = kind(options)
    steps = np.diff(times, prepend=times[0] - 0.01)
    return [
        smoother.smooth(sample, float(dt))
        for sample, dt in zip(samples, steps, strict=True)
    ]


def wrist_of(sample: HumanPose) -> np.ndarray:
    """Return the wrist pose of a sample that has one, shape (4, 4)."""
    assert sample.wrist is not None
    return sample.wrist


def moving(
    times: np.ndarray, speed: float, noise: float = 0.0, count: int = 12
) -> list[HumanPose]:
    """Return points that oscillate over 10 cm at a largest speed, with white noise [m]."""
    random = np.random.default_rng(1)
    place = 0.05 * np.sin(speed / 0.05 * times)
    points = np.zeros((len(times), count, 3))
    points[:, :, 0] = place[:, None]
    points += random.normal(scale=noise, size=points.shape)
    return [HumanPose(each, None) for each in points]


def test_a_constant_sample_passes_unchanged() -> None:
    rng = np.random.default_rng(0)
    sample = HumanPose(rng.normal(size=(5, 3)), little_pose(rng))
    for result in run([sample] * 10, 0.01 * np.arange(10)):
        np.testing.assert_allclose(result.points, sample.points, atol=1e-12)
        np.testing.assert_allclose(wrist_of(result), wrist_of(sample), atol=1e-12)


@pytest.mark.parametrize("rate", [30.0, 60.0, 90.0, 200.0])
def test_a_clean_stream_passes_almost_unchanged(rate: float) -> None:
    times = np.arange(0.0, 3.0, 1.0 / rate)
    samples = moving(times, 0.5, noise=2e-5)
    lag = []
    for sample, result in zip(samples, run(samples, times), strict=True):
        lag.append(np.abs(result.points - sample.points).max())
    assert max(lag[5:]) < 1e-3
    assert np.mean(lag) < 2e-4


@pytest.mark.parametrize("noise", [1e-3, 2e-3, 5e-3])
@pytest.mark.parametrize("rate", [57.0, 90.0])
def test_noise_at_rest_is_taken_away(noise: float, rate: float) -> None:
    times = np.arange(600) / rate
    rough = moving(times, 1e-9, noise)
    smooth = np.array([result.points for result in run(rough, times)])[100:]
    given = np.array([sample.points for sample in rough])[100:]
    assert smooth.std() < 0.6 * noise
    jerks = [np.diff(points, 3, axis=0).std() for points in (smooth, given)]
    assert jerks[0] < 0.1 * jerks[1]


@pytest.mark.parametrize("noise", [2e-3, 5e-3])
def test_noise_of_a_moving_hand_costs_no_accuracy(noise: float) -> None:
    times = np.arange(900) / 90.0
    truth = np.array([sample.points for sample in moving(times, 0.4)])
    rough = moving(times, 0.4, noise)
    smooth = np.array([result.points for result in run(rough, times)])
    given = np.array([sample.points for sample in rough])
    error, former = (
        np.linalg.norm(points - truth, axis=2)[90:] for points in (smooth, given)
    )
    assert np.percentile(error, 95) < 1.1 * np.percentile(former, 95)


def test_a_measured_point_is_never_far_from_the_first_filter() -> None:
    """A sudden motion is followed at once, up to some times the noise."""
    times = np.arange(200) / 90.0
    rough = moving(times, 1e-9, 2e-3)
    for sample in rough[150:]:
        sample.points[:, 0] += 0.1
    smooth = run(rough, times)
    late = [abs(result.points[:, 0].mean() - 0.1) for result in smooth[150:]]
    assert late[12] < 0.015


def test_a_sample_that_repeats_is_one_sample() -> None:
    """A tracker at 30 Hz that is polled at 90 Hz is smoothed as it is at 30 Hz."""
    times = np.arange(90) / 30.0
    samples = moving(times, 0.4, 1e-3)
    once = run(samples, times)
    smoother = Smoother(OPTIONS)
    for k, sample in enumerate(samples):
        for i in range(3):
            dt = 0.01 if k + i == 0 else 1.0 / 90.0
            result = smoother.smooth(sample, dt)
        if k > 1:
            np.testing.assert_allclose(result.points, once[k].points, atol=1e-9)


def test_time_without_a_sample_counts() -> None:
    times = np.arange(60) / 60.0
    samples = moving(times, 0.4, 1e-3)
    kept = np.arange(60) % 5 != 3
    some = run([s for s, k in zip(samples, kept, strict=True) if k], times[kept])
    smoother = Smoother(OPTIONS)
    found = []
    for i, (sample, is_seen) in enumerate(zip(samples, kept, strict=True)):
        dt = 1.0 / 60.0 if i else 0.01
        if is_seen:
            found.append(smoother.smooth(sample, dt))
        else:
            smoother.wait(dt)
    for one, other in zip(some, found, strict=True):
        np.testing.assert_allclose(one.points, other.points, atol=1e-9)


def test_jitter_in_time_changes_little() -> None:
    rng = np.random.default_rng(2)
    even = 0.01 * np.arange(300)
    jittery = np.sort(even + rng.uniform(-0.004, 0.004, size=300))
    error = []
    for times in (even, jittery):
        smooth = run(moving(times, 0.3, 1e-3), times)
        truth = moving(times, 0.3)
        error.append(
            np.mean(
                [
                    np.abs(one.points - other.points)[:, 0].mean()
                    for one, other in zip(smooth[50:], truth[50:], strict=True)
                ]
            )
        )
    assert error[1] < 1.3 * error[0]


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
    for later, dt in ((far, 1.0), (HumanPose(far.points, np.eye(4)), 0.01)):
        smoother = Smoother(OPTIONS)
        smoother.smooth(HumanPose(np.zeros((1, 3)), None), 0.01)
        result = smoother.smooth(later, dt)
        np.testing.assert_allclose(result.points, far.points, atol=1e-12)


@pytest.mark.parametrize("has_wrist", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_the_core_smooths_as_the_reference_does(seed: int, has_wrist: bool) -> None:
    rng = np.random.default_rng(seed)
    fast, slow = Smoother(OPTIONS), ReferenceSmoother(OPTIONS)
    points, wrist = rng.normal(scale=0.05, size=(7, 3)), np.eye(4)
    for _ in range(400):
        event = rng.random()
        if event > 0.05:
            points = points + 10.0 ** rng.uniform(-6, -1) * rng.normal(size=(7, 3))
            wrist = wrist @ affine(pin.exp3(0.1 * rng.normal(size=3)), np.full(3, 1e-3))
        if event > 0.99:
            points, wrist = (
                1e6 * points,
                affine(wrist[:3, :3], 1e6 * rng.normal(size=3)),
            )
        pose = HumanPose(points, wrist if has_wrist else None)
        dt = float(rng.choice([1e-6, 0.011, 0.016, 0.03, 0.6]))
        for each in (fast, slow):
            if 0.1 < event < 0.12:
                each.restart()
            if 0.15 < event < 0.2:
                each.wait(dt)
        one, other = fast.smooth(pose, dt), slow.smooth(pose, dt)
        if 0.2 < event < 0.22:
            fast.forget()
            slow.forget()
        size = max(1.0, np.abs(points).max())
        np.testing.assert_allclose(one.points / size, other.points / size, atol=1e-9)
        if has_wrist:
            np.testing.assert_allclose(
                wrist_of(one)[:3, :3], wrist_of(other)[:3, :3], atol=1e-9
            )
        if event > 0.99:
            points = 1e-6 * points


@pytest.mark.parametrize(
    "way", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))]
)
def test_a_copy_goes_on_with_what_was_seen(way: Callable[[Any], Any]) -> None:
    times = np.arange(60) / 60.0
    smoother = Smoother(OPTIONS)
    for i, sample in enumerate(moving(times, 0.4, 1e-3)):
        copied = way(smoother)
        one, other = (each.smooth(sample, 1.0 / 60.0) for each in (smoother, copied))
        np.testing.assert_array_equal(one.points, other.points, str(i))


def test_a_follower_smooths_and_a_failed_step_leaves_the_filter_as_it_was() -> None:
    rng = np.random.default_rng(5)
    samples = [(near_rest(rng, 0.03, HUMAN), little_pose(rng, 2e-3)) for _ in range(30)]
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
        # The noise is known from the third sample on.
        assert is_smoothed == (k not in (0, 1, 5))


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"acceleration": 0.0}, "acceleration"),
        ({"speed_gain": -1.0}, "speed_gain"),
        ({"speed_gain": np.inf}, "speed_gain"),
        ({"acceleration": "x"}, "acceleration"),
    ],
    ids=str,
)
def test_filters_without_a_meaning_are_rejected_by_name(
    options: dict[str, Any], name: str
) -> None:
    with pytest.raises(InvalidOptionsError) as raised:
        Smoothing(**options)
    assert raised.value.option == name
