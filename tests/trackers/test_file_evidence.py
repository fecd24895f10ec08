"""What a file shows of wrong rates, wrists that were not measured, and hands that grow."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from long_cases import traced_peak

from handmap_qp import Recording, read_recording
from handmap_qp.se3 import lengths
from handmap_qp.trackers.file_evidence import (
    USUAL_FREQUENCY,
    hints,
    recording_facts,
)


@pytest.fixture(scope="module")
def model(lies: ModuleType) -> Recording:
    """Twelve seconds of the human model, whose wrist travels and turns."""
    take = lies.model_take("left", 0.185, seed=4, duration=12.0)
    valid = np.ones(len(take.time), dtype=bool)
    return Recording(
        take.name, take.time, take.landmarks, valid, take.side, wrist=take.wrist
    )


def lost_at_times(recording: Recording) -> Recording:
    """Return a recording in which the hand is not seen for a while, and once has another size."""
    valid = recording.valid.copy()
    valid[40:55] = False
    landmarks = np.where(valid[:, None, None], recording.landmarks, np.nan)
    landmarks[100] *= 3.0
    return replace(recording, valid=valid, landmarks=landmarks)


@pytest.fixture(scope="module")
def real(recordings: Path) -> list[Recording]:
    return [read_recording(file) for file in sorted(recordings.glob("*.npz"))]


def slowed(recording: Recording, factor: float) -> Recording:
    """Let the time of a recording run a factor as slowly."""
    return replace(recording, time=factor * recording.time)


def grown(recording: Recording, end: float) -> Recording:
    """Let the hand grow steadily, to `end` times its size."""
    sizes = np.linspace(1.0, end, len(recording))[:, None, None]
    wrist = recording.landmarks[:, :1]
    return replace(
        recording, landmarks=wrist + sizes * (recording.landmarks - wrist), wrist=None
    )


def with_constant_wrist(recording: Recording) -> Recording:
    """Give the wrist poses one orientation."""
    wrist = np.tile(np.eye(4), (len(recording), 1, 1))
    wrist[:, :3, 3] = recording.landmarks[:, 0]
    return replace(recording, wrist=wrist)


def test_nothing_is_unusual_about_people(
    real: list[Recording], model: Recording
) -> None:
    for recording in (*real, model):
        assert hints(recording_facts(recording)) == [], recording.name


@pytest.mark.parametrize("name", ["demo", "pinch", "held"])
def test_nothing_is_unusual_about_the_recordings_of_the_package(name: str) -> None:
    assert hints(recording_facts(read_recording(name, "right"))) == []


@pytest.mark.parametrize("noise", [0.002, 0.005])
def test_noise_is_not_taken_for_motion(real: list[Recording], noise: float) -> None:
    random = np.random.default_rng(0)
    for recording in real:
        noisy = recording.landmarks + random.normal(0.0, noise, (len(recording), 21, 3))
        facts = recording_facts(replace(recording, landmarks=noisy))
        assert hints(facts) == [], recording.name


@pytest.mark.parametrize("factor", [10.0, 2.0, 0.5, 0.1])
def test_the_frequency_of_fingers_scales_with_the_rate(
    model: Recording, factor: float
) -> None:
    true = recording_facts(model).frequency
    found = recording_facts(slowed(model, factor)).frequency
    assert found == pytest.approx(true / factor, rel=1e-6)


@pytest.mark.parametrize("factor", [10.0, 0.1])
def test_time_that_runs_at_a_tenth_or_ten_times_the_rate_is_named(
    real: list[Recording], factor: float
) -> None:
    for recording in real:
        (hint,) = hints(recording_facts(slowed(recording, factor)))
        assert "--fps" in hint, recording.name


def test_a_person_who_takes_a_second_for_each_posture_is_not_too_slow(
    lies: ModuleType, recordings: Path
) -> None:
    poses = recordings.parent / "poses" / "handy_right.npz"
    if not poses.is_file():
        pytest.skip(f"there is no {poses}")
    take = lies.pose_take(poses, "right")
    valid = np.ones(len(take.time), dtype=bool)
    facts = recording_facts(
        Recording(take.name, take.time, take.landmarks, valid, take.side)
    )
    assert hints(facts) == []
    assert facts.frequency > 1.5 * USUAL_FREQUENCY[0]


def test_a_low_rate_alone_is_not_unusual(model: Recording) -> None:
    # Every sixth sample of 60 Hz, at the instants at which they were taken.
    assert hints(recording_facts(model.part(slice(None, None, 6)))) == []


def test_a_size_is_told_of_120_samples_or_more(model: Recording) -> None:
    few, many = (recording_facts(model.part(slice(0, count))) for count in (119, 120))
    assert math.isnan(few.growth)
    assert math.isnan(few.trend)
    assert math.isfinite(many.growth)


@pytest.mark.parametrize(("share", "is_named"), [(0.04, False), (0.06, True)])
def test_instants_rounded_to_more_than_a_twentieth_of_a_step_are_named(
    model: Recording, share: float, is_named: bool
) -> None:
    facts = recording_facts(model)
    found = hints(facts._replace(rounding=share / facts.rate))
    assert any("rounded" in hint for hint in found) is is_named


def test_wrist_poses_that_no_tracker_measured_are_named(real: list[Recording]) -> None:
    for recording in real:
        (hint,) = hints(recording_facts(with_constant_wrist(recording)))
        assert "never turn" in hint, recording.name


def test_a_wrist_that_never_travels_is_named(real: list[Recording]) -> None:
    for recording in real:
        assert recording.wrist is not None
        wrist = recording.wrist.copy()
        wrist[:, :3, 3] = wrist[np.argmax(recording.valid), :3, 3]
        (hint,) = hints(recording_facts(replace(recording, wrist=wrist)))
        assert "never travel" in hint, recording.name


def test_a_hand_in_the_frame_of_its_wrist_may_have_a_wrist_that_stays(
    real: list[Recording],
) -> None:
    for recording in real:
        assert recording.wrist is not None
        turn, place = recording.wrist[:, :3, :3], recording.wrist[:, None, :3, 3]
        own = (recording.landmarks - place) @ turn
        wrist = np.tile(np.eye(4), (len(recording), 1, 1))
        inside = replace(recording, landmarks=own, wrist=wrist)
        # Trackers that fit the wrist apart from the landmarks let the palm turn a little in it.
        if recording_facts(inside).palm_turn < math.radians(3.0):
            assert hints(recording_facts(inside)) == [], recording.name


@pytest.mark.parametrize("end", [1.5, 1.3, 0.7])
def test_a_hand_that_slowly_changes_its_size_is_named(
    real: list[Recording], end: float
) -> None:
    for recording in real:
        (hint,) = hints(recording_facts(grown(recording, end)))
        assert "bones keep" in hint, recording.name
        facts = recording_facts(grown(recording, end))
        assert facts.trend == pytest.approx(end, rel=0.1)


def test_a_hand_that_grows_and_shrinks_again_is_named(model: Recording) -> None:
    sizes = 1.0 + 0.4 * np.sin(np.linspace(0.0, np.pi, len(model)))[:, None, None]
    wrist = model.landmarks[:, :1]
    changed = replace(model, landmarks=wrist + sizes * (model.landmarks - wrist))
    facts = recording_facts(changed)
    assert facts.trend == pytest.approx(1.0, abs=0.05)
    assert "bones keep" in hints(facts)[0]


def test_no_part_of_four_seconds_of_a_person_changes_its_size(
    real: list[Recording],
) -> None:
    for recording in real:
        for start in np.arange(recording.time[0], recording.time[-1] - 4.0):
            inside = (recording.time >= start) & (recording.time < start + 4.0)
            facts = recording_facts(recording.part(inside))
            assert hints(facts) == [], (recording.name, start)


@pytest.mark.parametrize(
    ("kind", "start", "rounding"),
    [(np.float32, 1e5, 2.0**-7), (np.float16, 8.0, 2.0**-6)],
)
def test_instants_that_a_type_of_few_digits_has_rounded_are_named(
    model: Recording, kind: type[np.floating], start: float, rounding: float
) -> None:
    late = start + model.time
    rounded = np.unique(late.astype(kind)).astype(float)
    part = replace(model.part(slice(len(rounded))), time=rounded)
    facts = recording_facts(part)
    assert facts.rounding == pytest.approx(rounding)
    assert "store them in double precision" in hints(facts)[0]


def test_exact_instants_are_not_rounded_ones(model: Recording) -> None:
    late = replace(model, time=1e5 + model.time)
    assert recording_facts(late).rounding == 0.0
    # Steps of 1/64 s have few digits.
    exact = replace(model, time=np.arange(len(model)) / 64.0)
    assert hints(recording_facts(exact)) == []


def test_a_short_recording_says_nothing(model: Recording) -> None:
    for count in (1, 2, 10, 33):
        facts = recording_facts(model.part(slice(count)))
        assert hints(facts) == []
        assert math.isnan(facts.frequency) or count > 32


def test_samples_that_are_not_valid_do_not_count(model: Recording) -> None:
    landmarks, valid = model.landmarks.copy(), model.valid.copy()
    valid[100:140] = False
    landmarks[~valid] = np.nan
    facts = recording_facts(replace(model, landmarks=landmarks, valid=valid))
    assert hints(facts) == []
    whole = recording_facts(model)
    assert facts.frequency == pytest.approx(whole.frequency, rel=0.2)
    travelled = lengths(model.landmarks[:, 0] - model.landmarks[0, 0]).max()
    assert 0.5 * travelled < facts.palm_travel <= travelled


@pytest.mark.parametrize("fault", [0.0, 0.3, 1e200])
def test_outliers_of_the_tracker_are_no_motion(model: Recording, fault: float) -> None:
    landmarks = model.landmarks.copy()
    random = np.random.default_rng(1)
    bad = random.choice(len(model), len(model) // 20, replace=False)
    if fault:
        landmarks[bad, random.integers(1, 21, len(bad)), 0] += fault
    else:
        landmarks[bad] = 0.0
    whole, facts = (
        recording_facts(each) for each in (model, replace(model, landmarks=landmarks))
    )
    assert hints(facts) == []
    assert facts.frequency == pytest.approx(whole.frequency, rel=0.2)
    assert facts.growth == pytest.approx(whole.growth, rel=0.02)


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e60])
def test_points_that_are_not_a_hand_are_measured_without_an_error(scale: float) -> None:
    points = scale * np.random.default_rng(2).normal(size=(200, 21, 3))
    time, valid = np.arange(200) / 60.0, np.ones(200, dtype=bool)
    facts = recording_facts(Recording("noise", time, points, valid, "left"))
    assert all("nan" not in hint for hint in hints(facts))


@pytest.mark.parametrize("size", [1, 7, 100])
def test_parts_show_the_same(
    size: int, model: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = lost_at_times(model)
    expected = recording_facts(recording)
    assert not math.isnan(expected.growth)
    for module in ("human.measure", "trackers.file_evidence"):
        monkeypatch.setattr(f"handmap_qp.{module}._AT_ONCE", size)
    assert recording_facts(recording) == expected


def test_it_does_not_copy_the_landmarks(
    model: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("human.measure", "trackers.file_evidence"):
        monkeypatch.setattr(f"handmap_qp.{module}._AT_ONCE", 1000)
    recording = lost_at_times(model)
    peaks: list[int] = []
    for count in (5_000, 20_000):
        index = np.resize(np.arange(len(recording)), count)
        long = replace(
            recording,
            time=np.arange(count) / 60.0,
            landmarks=recording.landmarks[index],
            valid=recording.valid[index],
            wrist=None,
        )
        with traced_peak(peaks):
            recording_facts(long)
    # Landmarks of a sample have 504 bytes. What is measured of it, such as bones, has less.
    assert peaks[1] - peaks[0] < 504 * 15_000
