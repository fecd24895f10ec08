"""Recordings judged by column: the guard of live streams says the same, sample by sample."""

from __future__ import annotations

import numpy as np
import pytest
from faulty_recordings import DEMO, faulty
from hypothesis import given
from hypothesis import strategies as st
from pinocchio import exp3

from handmap_qp import load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.human.landmarks import scaled_human
from handmap_qp.human.recording import recording_samples
from handmap_qp.stream.guard import StreamGuard
from handmap_qp.stream.motion import change_between, first_track
from handmap_qp.stream.recorded_motion import RecordedSamples

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
def test_the_guard_says_the_same_by_column(text: str, human: Hand) -> None:
    recording = faulty(text) if text else DEMO.part(slice(0, 240))
    guard = StreamGuard(human)
    live = [guard.check(sample) for sample in recording_samples(recording)]
    recorded = RecordedSamples(recording)
    # Of a person with other bones first: nothing of theirs remains.
    recorded.judged(load_hand("human", points="landmarks"))
    found = recorded.judged(human)
    columns = [[v.rule, v.is_held, v.is_return, v.dt, v.finding] for v in live]
    assert [[v.rule, v.is_held, v.is_return, v.dt, v.finding] for v in found] == columns
    assert any(verdict.is_held for verdict in live) == bool(text)
    # Recordings without any fault are judged as a whole.
    assert recorded._is_calm == (not text)
    np.testing.assert_allclose(
        [v.consistency for v in found], [v.consistency for v in live], atol=1e-15
    )


def test_motion_by_column_is_that_of_samples(human: Hand) -> None:
    recording = DEMO.part(slice(0, 60))
    guard, samples = StreamGuard(human), recording_samples(recording)
    for sample, sight in zip(samples, RecordedSamples(recording).sights, strict=True):
        guard.check(sample)
        last = guard.state.last
        assert sight is not None
        assert last is not None
        if sight.change is not None and sight.before is not None:
            one = change_between(sight.before, sight.fresh, sight.change.track.dt)
            np.testing.assert_allclose(
                np.array(sight.change[1:], float), np.array(one[1:], float), rtol=1e-6, atol=1e-6
            )
        expected = last if sight.change is None else sight.change.track
        for own, other in zip(last, expected, strict=True):
            np.testing.assert_allclose(own, other, rtol=1e-6, atol=1e-9)


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
    first, second, third = (first_track(t, palm + v * t + 0.5 * a * t**2) for t in times)
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


def test_a_turn_is_measured_about_its_axis_and_fingers_in_the_axes_of_the_palm() -> None:
    hand, turning, dt = DEMO.landmarks[0], np.array([3.0, -4.0, 5.0]), 0.02
    rotation = exp3(dt * turning)
    moved = hand.copy()
    moved[8] += rotation.T @ [0.0, 0.0, 0.004]  # of the index fingertip, in the world after it
    change = change_between(first_track(0.0, hand), first_track(dt, moved @ rotation.T), dt)
    np.testing.assert_allclose(change.track.turning, turning, atol=1e-9)
    speeds = np.linalg.norm(change.track.bending, axis=1)
    assert speeds[8] == pytest.approx(0.2)
    np.testing.assert_allclose(change.track.bending[8], [0.0, 0.0, 0.2], atol=1e-9)
    np.testing.assert_allclose(np.delete(speeds, 8), 0.0, atol=1e-9)
