"""Trajectories: their speeds, and derivatives of samples at uneven instants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from joint_motion import map_motion
from motion_cases import HUMAN, waving
from strategies import generators

from handmap_core.human.recording import Recording
from handmap_qp import HandMapper, load_hand
from handmap_qp.apps.offline.trajectory import map_recording, rms_derivative


def test_the_motions_sample_times_bound_the_speed() -> None:
    # Samples are 1 to 20 ms apart; the mapper's own sample time would allow any displacement.
    motion = waving()
    dt = np.where(np.arange(len(motion.time)) % 2 == 0, 0.001, 0.02)
    motion = replace(motion, time=np.cumsum(dt), dt=dt)
    robot, tracked = load_hand("three_finger"), load_hand("human", points="landmarks")
    landmarks = [
        tracked.points(q, at) for q, at in zip(motion.q, motion.wrist, strict=True)
    ]
    recording = Recording(
        "waving", motion.time, np.array(landmarks), motion.valid, "right"
    )
    for mapped in (
        map_motion(HandMapper(HUMAN, robot, "paper", dt=1e3), motion),
        map_recording(HandMapper(tracked, robot, "paper", dt=1e3), recording),
    ):
        displacement = np.abs(np.diff(mapped.q, axis=0))
        assert (displacement <= dt[1:, None] * robot.velocity_limits + 1e-9).all()
        assert displacement.max() > 0.5 * 0.001 * robot.velocity_limits.min()


@given(generator=generators, cubic=st.floats(-10.0, 10.0))
def test_the_jerk_of_a_cubic_is_exact_at_uneven_instants(
    generator: np.random.Generator, cubic: float
) -> None:
    time = np.cumsum(generator.uniform(0.5, 1.5, size=20))
    values = np.column_stack([cubic * time**3 - time**2 + 3.0, np.full(20, 7.0)])
    # Third differences of numbers near 1e5 lose ten digits.
    jerk = rms_derivative(values, time, np.ones(20, dtype=bool), order=3)
    assert jerk == pytest.approx(6.0 * abs(cubic) / np.sqrt(2.0), abs=1e-8)


def test_a_derivative_takes_only_samples_in_a_row() -> None:
    time, values = np.arange(6.0), np.array([0.0, 1.0, 2.0, 50.0, 10.0, 12.0])[:, None]
    valid = np.array([True, True, True, False, True, True])
    assert rms_derivative(values, time, valid, order=1) == pytest.approx(
        np.sqrt((1.0 + 1.0 + 4.0) / 3.0)
    )
    assert np.isnan(rms_derivative(values, time, valid, order=3))
