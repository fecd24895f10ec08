"""The motion between samples, of each by itself and of all at once."""

from __future__ import annotations

import numpy as np
import pytest
from faulty_recordings import DEMO, faulty
from hypothesis import given
from hypothesis import strategies as st
from pinocchio import exp3

from handmap_qp.hands.hand import Hand
from handmap_qp.human.landmarks import scaled_human
from handmap_qp.human.recording import recording_samples
from handmap_qp.stream.guard import StreamGuard
from handmap_qp.stream.motion import change_between, first_track, measure

FAULTS = (
    "",
    "dropout@0.3+0.2,jump@0.8+0.2,outlier@1.3+0.05",
    "silence@0.4+0.3,flip@1.2+0.1,zero@1.6+0.1",
    "frozen@0.2+0.5,mirror@1.0+0.3",
    "noise@0.5+0.5:0.02",
)


@pytest.fixture(scope="module")
def human() -> Hand:
    return scaled_human(DEMO, points="landmarks")


@pytest.mark.parametrize("text", FAULTS)
def test_the_guard_says_the_same_of_all_samples_at_once(text: str, human: Hand) -> None:
    samples = recording_samples(faulty(text) if text else DEMO.part(slice(0, 240)))
    one_by_one, at_once = StreamGuard(human), StreamGuard(human)
    live = [one_by_one.check(sample) for sample in samples]
    found = at_once.judge(samples[:100]) + at_once.judge(samples[100:])
    columns = [[v.rule, v.is_held, v.is_return, v.dt, v.finding] for v in live]
    assert [[v.rule, v.is_held, v.is_return, v.dt, v.finding] for v in found] == columns
    assert any(verdict.is_held for verdict in live) == bool(text)
    np.testing.assert_allclose(
        [v.consistency for v in found], [v.consistency for v in live], atol=1e-15
    )


def test_motion_of_many_samples_is_that_of_each() -> None:
    recording = DEMO.part(slice(0, 60))
    time, shortest = recording.time, np.full(60, 1e-3)
    sights, last = measure(None, time, recording.landmarks, shortest), None
    for i, sight in enumerate(sights):
        assert sight.is_after(last)
        (own,) = measure(
            last, time[i : i + 1], recording.landmarks[i : i + 1], shortest[:1]
        )
        assert own.size == pytest.approx(sight.size)
        assert (own.is_zero, own.is_same) == (sight.is_zero, sight.is_same)
        if own.change is not None and sight.change is not None:
            numbers = np.array(own.change[1:], float), np.array(sight.change[1:], float)
            np.testing.assert_allclose(*numbers, rtol=1e-6, atol=1e-6)
        last = own.fresh if own.change is None else own.change.track
        expected = sight.fresh if sight.change is None else sight.change.track
        for one, other in zip(last, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)


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
    first, second, third = (
        first_track(t, palm + v * t + 0.5 * a * t**2) for t in times
    )
    change = change_between(first, second, steps[0])
    # A first motion has nothing to be compared with.
    assert change.palm == change.turn == change.fingers == 0.0
    change = change_between(change.track, third, steps[1])
    assert change.palm == pytest.approx(np.linalg.norm(a), abs=1e-9)
    np.testing.assert_allclose(
        change.track.velocity, v + a * (steps[0] + 0.5 * steps[1]), atol=1e-9
    )
    assert change.turn < 1e-6
    assert change.fingers < 1e-6


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
    change = change_between(
        first_track(0.0, hand), first_track(dt, moved @ rotation.T), dt
    )
    np.testing.assert_allclose(change.track.turning, turning, atol=1e-9)
    speeds = np.linalg.norm(change.track.bending, axis=1)
    assert speeds[8] == pytest.approx(0.2)
    np.testing.assert_allclose(change.track.bending[8], [0.0, 0.0, 0.2], atol=1e-9)
    np.testing.assert_allclose(np.delete(speeds, 8), 0.0, atol=1e-9)
