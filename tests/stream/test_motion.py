"""The motion between samples."""

from __future__ import annotations

import numpy as np
import pytest
from faulty_recordings import DEMO
from hypothesis import given
from hypothesis import strategies as st
from pinocchio import exp3

from handmap_core.core import core


@given(
    steps=st.tuples(st.floats(0.005, 0.05), st.floats(0.005, 0.05)),
    acceleration=st.tuples(*[st.floats(-5.0, 5.0)] * 3),
    speed=st.tuples(*[st.floats(-2.0, 2.0)] * 3),
)
def test_the_change_of_a_palms_speed_is_its_acceleration_at_any_times(
    steps: tuple[float, float],
    acceleration: tuple[float, float, float],
    speed: tuple[float, float, float],
) -> None:
    times = np.cumsum([0.0, *steps])
    palm, (a, v) = DEMO.landmarks[0], np.array([acceleration, speed])
    first, second, third = (core.Track(t, palm + v * t + 0.5 * a * t**2) for t in times)
    change = core.change_between(first, second, steps[0])
    # A first motion has nothing to be compared with.
    np.testing.assert_array_equal(change.sizes[:3], 0.0)
    change = core.change_between(change.track, third, steps[1])
    assert change.sizes[0] == pytest.approx(np.linalg.norm(a), abs=1e-9)
    np.testing.assert_allclose(
        change.track.velocity, v + a * (steps[0] + 0.5 * steps[1]), atol=1e-9
    )
    assert (change.sizes[1:3] < 1e-6).all()


def test_a_turn_is_measured_about_its_axis_and_fingers_in_the_axes_of_the_palm() -> (
    None
):
    hand, turning, dt = DEMO.landmarks[0], np.array([3.0, -4.0, 5.0]), 0.02
    rotation = exp3(dt * turning)
    moved = hand.copy()
    moved[8] += rotation.T @ [
        0.0,
        0.0,
        0.004,
    ]  # of the index fingertip, in the world after it
    change = core.change_between(
        core.Track(0.0, hand), core.Track(dt, moved @ rotation.T), dt
    )
    np.testing.assert_allclose(change.track.turning, turning, atol=1e-9)
    speeds = np.linalg.norm(change.track.bending, axis=1)
    assert speeds[8] == pytest.approx(0.2)
    np.testing.assert_allclose(change.track.bending[8], [0.0, 0.0, 0.2], atol=1e-9)
    np.testing.assert_allclose(np.delete(speeds, 8), 0.0, atol=1e-9)
