"""Smoothing with look-ahead: less lag, filled gaps, hands that keep their size, all limits."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from handmap_qp import Recording, load_hand
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.offline.look_ahead import (
    look_ahead,
    smooth_poses,
    whittaker,
)
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.offline.trajectory import map_hands, rms_derivative
from handmap_qp.se3 import rotation_from_rpy
from handmap_qp.stream.measurement import measure_person


def turning_hand(count: int = 120, rate: float = 60.0) -> Recording:
    """A hand in its rest posture that turns by 3 rad and moves, without noise."""
    human = load_hand("human", points="landmarks")
    time = np.arange(count) / rate
    landmarks = []
    for t in time:
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_rpy([0.2 * np.sin(2 * t), 1.5 * t, 0.1])
        pose[:3, 3] = [0.1 * np.sin(3 * t), 0.2 * t, 0.0]
        landmarks.append(human.points(human.rest, pose))
    return Recording("turn", time, np.array(landmarks), np.ones(count), "right")


@pytest.mark.parametrize("cutoff", [2.0, 6.0])
def test_the_cutoff_passes_at_half_and_without_phase(cutoff: float) -> None:
    time = np.arange(2000) / 250.0
    for share, expected in (
        (0.25, 1.0 / (1.0 + 0.25**4)),
        (1.0, 0.5),
        (2.0, 1.0 / 17.0),
    ):
        angle = 2.0 * np.pi * share * cutoff * time
        waves = np.stack([np.sin(angle), np.cos(angle)], axis=1)
        found = whittaker(time, waves, np.ones(2000), cutoff)[500:1500]
        gain, *_ = np.linalg.lstsq(waves[500:1500], found, rcond=None)
        np.testing.assert_allclose(gain, expected * np.eye(2), atol=5e-3)


def test_uneven_instants_do_not_bend_a_straight_line() -> None:
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.005, 0.05, 80))
    line = np.stack([3.0 * time - 1.0, -time], axis=1)
    weight = (rng.uniform(size=80) < 0.7).astype(float)
    weight[[0, -1]] = 1.0
    found = whittaker(time, np.where(weight[:, None] > 0.0, line, np.nan), weight, 5.0)
    np.testing.assert_allclose(found, line, atol=1e-9)


def test_a_turning_hand_keeps_its_size_also_in_a_gap() -> None:
    given = turning_hand()
    valid = given.valid.copy()
    valid[40:60] = False
    landmarks = given.landmarks.copy()
    landmarks[~valid] = np.nan
    found = look_ahead(replace(given, valid=valid, landmarks=landmarks))
    assert found.valid.all()
    bones = [
        np.linalg.norm(np.diff(r.landmarks[:, 5:9], axis=1), axis=2)
        for r in (found, given)
    ]
    np.testing.assert_allclose(bones[0], bones[1], atol=1e-6)
    error = np.linalg.norm(found.landmarks - given.landmarks, axis=2)
    # 7 mm would be the sag of the chord that lines between landmarks are.
    assert error[40:60].max() < 2e-3
    assert error[10:-10].max() < 2e-3


def test_noise_falls_and_long_gaps_stay() -> None:
    given = turning_hand()
    rng = np.random.default_rng(1)
    noisy = given.landmarks + rng.normal(0.0, 1e-3, given.landmarks.shape)
    valid = given.valid.copy()
    valid[30:70] = False
    found = look_ahead(replace(given, landmarks=noisy, valid=valid))
    np.testing.assert_array_equal(found.valid, valid)
    inner = np.r_[5:25, 75:115]
    before = np.square(noisy - given.landmarks)[inner].mean()
    after = np.square(found.landmarks - given.landmarks)[inner].mean()
    assert after < 0.35 * before
    poses = np.tile(np.eye(4), (120, 1, 1))
    poses[:, 0, 3] = np.sin(given.time)
    smooth = smooth_poses(given.time, poses, valid)
    np.testing.assert_allclose(smooth[:, 0, 3], np.sin(given.time), atol=2e-3)
    np.testing.assert_allclose(smooth[:, :3, :3], poses[:, :3, :3], atol=1e-12)


def test_too_few_samples_are_left_as_they_are() -> None:
    given = turning_hand(5)
    valid = np.array([True, False, False, True, False])
    found = look_ahead(replace(given, valid=valid))
    np.testing.assert_array_equal(found.valid, valid)
    np.testing.assert_array_equal(found.landmarks, given.landmarks)


def test_a_recording_that_is_used_as_a_whole_is_smoother_without_more_lag() -> None:
    human = load_hand("human", points="landmarks")
    count, rate, pace = 180, 60.0, 1.0
    time = np.arange(count) / rate
    share = 0.5 - 0.5 * np.cos(2.0 * np.pi * pace * time)
    flexion = np.where(["flexion" in name for name in human.joint_names], 0.8, 0.0)
    flexion[:4] = human.rest[:4]
    landmarks = np.array([human.points(s * flexion) for s in share])
    landmarks += np.random.default_rng(3).normal(0.0, 1e-3, landmarks.shape)
    recording = Recording("wave", time, landmarks, np.ones(count), "right")
    robot = load_hand("allegro_right")
    person = measure_person(recording)
    mapped = partial(map_hands, robot=robot, person=person)
    calm = MappingArguments(smooth=True)
    online, *_ = mapped([recording], arguments=MappingArguments())
    filtered, *_ = mapped([recording], arguments=calm)
    ahead, *_ = mapped([look_ahead(recording)], arguments=calm)

    def lag(q: np.ndarray) -> float:
        """Phase of the middle finger's bend behind the human's [s]."""
        # Two whole periods.
        part = slice(60, 180)
        wave = np.exp(2j * np.pi * pace * time)[part]
        # Flexion of the middle finger: joints 5 to 7 of the Allegro.
        bend = q[part, 5:8].sum(axis=1)
        human_sum, robot_sum = (
            np.sum((x - x.mean()) * wave.conj()) for x in (share[part], bend)
        )
        return float(np.angle(human_sum * robot_sum.conj()) / (2.0 * np.pi * pace))

    assert lag(ahead.q) < lag(filtered.q) + 1e-3
    shaking, smooth = (
        rms_derivative(one.q, time, one.valid, order=3) for one in (online, ahead)
    )
    assert smooth < 0.5 * shaking
    assert ahead.limit_violation <= 1e-12
    speed = np.abs(np.diff(ahead.q, axis=0)) * rate
    assert (speed <= robot.velocity_limits * (1.0 + 1e-9) + 1e-9).all()
    assert GapMeter(robot).nearest(ahead.q).min() > -1e-4
