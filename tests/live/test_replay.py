"""Replay: a recording arrives sample by sample, at its time."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from injection import inject, parse_faults
from live_cases import moving_hand

from handmap_core.human.recording import sample_columns
from handmap_qp import InvalidInputError
from handmap_qp.apps.live import source
from handmap_qp.apps.live.source import Replay


class Clock:
    """A monotonic clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0.0
        self.now += seconds


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(source, "time", clock)
    return clock


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_each_sample_arrives_at_its_time(clock: Clock, speed: float) -> None:
    recording = moving_hand()
    start = clock.now
    arrivals, stamps = [], []
    for sample in Replay(recording, speed=speed):
        arrivals.append(clock.now)
        stamps.append(sample.time)
    expected = start + (recording.time - recording.time[0]) / speed
    np.testing.assert_allclose(arrivals, expected, atol=1e-9)
    np.testing.assert_allclose(stamps, expected, atol=1e-9)


def test_samples_are_those_of_the_recording() -> None:
    recording = moving_hand()
    samples = list(Replay(recording))
    assert len(samples) == len(recording)
    assert [sample.valid for sample in samples] == recording.valid.tolist()
    np.testing.assert_array_equal(
        [sample.landmarks for sample in samples], recording.landmarks
    )
    assert {sample.side for sample in samples} == {"right"}


def test_a_loop_goes_on_without_a_step_in_time() -> None:
    recording = moving_hand()
    count = len(recording)
    samples = list(itertools.islice(Replay(recording, loop=True), 3 * count))
    times = np.array([sample.time for sample in samples])
    steps = np.diff(times)
    assert (steps > 0.0).all()
    np.testing.assert_allclose(
        steps[count - 1 :: count], np.median(recording.steps), atol=1e-9
    )
    np.testing.assert_allclose(steps[:count], steps[count : 2 * count], atol=1e-9)
    for i in range(count):
        np.testing.assert_array_equal(
            samples[i].landmarks, samples[2 * count + i].landmarks
        )


def test_faults_count_in_the_time_of_the_replay(clock: Clock) -> None:
    start = clock.now
    lost = [
        sample.time - start
        for sample in inject(
            Replay(moving_hand(), speed=0.5), parse_faults("dropout@1+0.5")
        )
        if not sample.valid
    ]
    lost = [
        time for time in lost if time > 0.5
    ]  # sample 10 of the recording is lost anyway
    assert lost[0] == pytest.approx(1.0, abs=0.04)
    assert lost[-1] == pytest.approx(1.5, abs=0.04)
    assert len(lost) == pytest.approx(15, abs=1)


def test_a_fault_of_the_clock_does_not_delay_samples(clock: Clock) -> None:
    start = clock.now
    stamps = [
        sample.time
        for sample in inject(Replay(moving_hand()), parse_faults("clock@0.5:1000"))
    ]
    assert clock.now - start == pytest.approx(
        moving_hand().time[-1] - moving_hand().time[0]
    )
    assert stamps[-1] == pytest.approx(clock.now + 1000.0)


def test_a_late_reader_gets_every_sample(clock: Clock) -> None:
    recording = moving_hand()
    samples = []
    for sample in Replay(recording):
        samples.append(sample)
        clock.now += 0.05
    assert len(samples) == len(recording)


@given(st.floats(0.01, 100.0))
def test_the_rate_goes_with_the_speed(speed: float) -> None:
    assert Replay(moving_hand(), speed=speed).rate == pytest.approx(
        60.0 * speed, rel=0.02
    )


@pytest.mark.parametrize("speed", [0.0, -1.0, 1e-3, 101.0, math.nan, math.inf])
def test_a_wrong_speed_is_rejected(speed: float) -> None:
    with pytest.raises(InvalidInputError, match="speed"):
        Replay(moving_hand(), speed=speed)


def test_samples_of_a_recording_have_its_confidence_and_no_wrist_of_foreign_axes() -> (
    None
):
    plain = moving_hand()
    shares = np.linspace(0.2, 1.0, len(plain))
    wrist = np.tile(np.eye(4), (len(plain), 1, 1))
    samples = [
        *sample_columns(dataclasses.replace(plain, confidence=shares, wrist=wrist))
    ]
    assert all(sample.wrist is None for sample in samples)
    expected = np.where(plain.valid, shares, 0.0)
    np.testing.assert_array_equal([sample.confidence for sample in samples], expected)
