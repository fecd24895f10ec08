"""Mistakes of users are found and named within a second, and real hands are never refused."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from handmap_qp import HandMapper, InvalidInputError, Recording, load_hand, read_recording
from handmap_qp.trackers.hand_geometry import own_distances, own_misfit, palmar_evidence
from handmap_qp.trackers.plausibility import (
    Finding,
    InputCheck,
    check_recording,
    examine_recording,
)
from handmap_qp.trackers.sample import HumanSample

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def lies() -> Iterator[ModuleType]:
    """The mistakes of `benchmarks/bench_lies.py`, which has the whole table."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield importlib.import_module("lies")
    finally:
        sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def take(lies: ModuleType) -> Any:
    """Six seconds of the human model, which bends its fingers in each of them."""
    return lies.model_take("left", 0.185, seed=4, duration=6.0)


def find(take: Any) -> Finding | None:
    check = InputCheck(take.side)
    for time, landmarks, wrist in zip(take.time, take.landmarks, take.wrist, strict=True):
        if finding := check.update(time, landmarks, wrist):
            return finding
    return check.finish()


def as_recording(take: Any) -> Recording:
    valid = np.ones(len(take.time), dtype=bool)
    return Recording(take.name, take.time, take.landmarks, valid, take.side, wrist=take.wrist)


def test_every_mistake_is_found_within_a_second(lies: ModuleType, take: Any) -> None:
    for start in range(5):
        part = take.part(float(start), 1.0)
        assert find(part) is None
        for lie in lies.all_lies():
            if lies.is_visible(lie, part):
                finding = find(lie.tell(part))
                assert finding is not None, lie.name
                # The palm of a mirrored world does not agree with its wrist either.
                assert finding.kind in (lie.kind, "wrist"), (lie.name, finding)
                assert finding.problem
                assert finding.advice


def test_real_hands_pass_and_mistakes_in_them_do_not(lies: ModuleType, recordings: Path) -> None:
    for file in sorted(recordings.glob("*.npz")):
        recording = read_recording(file)
        assert examine_recording(recording) is None, file
        seen = recording.valid
        assert recording.wrist is not None
        whole = lies.Take(
            file.stem,
            recording.time[seen],
            recording.landmarks[seen],
            recording.wrist[seen],
            recording.side,
        )
        part = whole.part(whole.time[0] + 2.0, 1.0)
        for lie in lies.all_lies():
            if lies.is_visible(lie, part):
                assert find(lie.tell(part)) is not None, (file, lie.name)


def test_a_change_in_a_running_session_is_found_and_so_is_its_end(take: Any) -> None:
    check = InputCheck(take.side)
    mirrored = take.landmarks * (-1.0, 1.0, 1.0)
    found = []
    for i, time in enumerate(take.time):
        landmarks = mirrored[i] if 2.0 <= time < 4.0 else take.landmarks[i]
        found.append(check.update(time, landmarks) is not None)
    changes = take.time[1:][np.diff(np.array(found, dtype=int)) != 0]
    assert len(changes) == 2
    assert 2.0 < changes[0] < 3.0
    assert 4.0 < changes[1] < 5.0


def test_few_bad_samples_change_nothing(take: Any) -> None:
    landmarks = take.landmarks.copy()
    landmarks[10] = 0.0  # a zero pose
    landmarks[20, 8] += 0.2  # one landmark far off
    landmarks[30] = -landmarks[30]
    landmarks[50:] += 0.5  # a jump of the whole hand
    check = InputCheck(take.side)
    for i, time in enumerate(take.time):
        assert check.update(time, landmarks[i]) is None


def test_the_measures_do_not_depend_on_place_size_and_rate(lies: ModuleType, take: Any) -> None:
    moved = 3.0 * take.landmarks[:, :, [1, 2, 0]] + (5.0, -2.0, 1.0)
    one, other = palmar_evidence(take.landmarks), palmar_evidence(moved)
    np.testing.assert_allclose(np.array(one), np.array(other), atol=1e-9)
    pair = [own_misfit(own_distances(points[:16])) for points in (take.landmarks, moved)]
    assert pair[0] == pytest.approx(pair[1], abs=1e-9)
    # A mirror changes the sign of the evidence and nothing else.
    mirrored = palmar_evidence(take.landmarks * (-1.0, 1.0, 1.0))
    np.testing.assert_allclose(np.array(one), -np.array(mirrored), atol=1e-9)


def test_short_recordings_are_judged_by_what_they_have(take: Any) -> None:
    whole = as_recording(take)
    for count in (1, 5, 12, 20):
        short = replace(
            whole,
            time=whole.time[:count],
            landmarks=whole.landmarks[:count],
            valid=whole.valid[:count],
            wrist=None,
        )
        check_recording(short)
        with pytest.raises(InvalidInputError) as caught:
            check_recording(replace(short, landmarks=short.landmarks * 1000.0), name="hand.npz")
        assert caught.value.argument == "hand.npz"
        assert "millimetres" in str(caught.value)
        assert "multiply them by 0.001" in str(caught.value)


def test_a_session_can_start_again(take: Any) -> None:
    check = InputCheck("right")
    for i in range(60):
        check.update(take.time[i], take.landmarks[i])
    assert check.finding is not None
    assert check.finding.kind == "side"
    check.reset()
    assert check.finding is None
    with pytest.raises(InvalidInputError):
        InputCheck("both")


def test_the_robot_holds_while_the_input_is_not_what_it_says(take: Any) -> None:
    human = load_hand("human_left", points="landmarks", hand_length=0.185)
    mapper = HandMapper(human, load_hand("allegro_left"))
    steps = []
    for i, time in enumerate(take.time[:240]):
        is_wrong = 0.5 <= time < 2.0
        landmarks = take.landmarks[i] * ((-1.0, 1.0, 1.0) if is_wrong else (1.0, 1.0, 1.0))
        steps.append(mapper.map_sample(HumanSample(float(time), "left", landmarks)))
    rules = np.array([step.rule for step in steps])
    time = take.time[:240]
    # The guard holds a flipped hand for half a second at first; from then on it is known.
    assert (rules[(time > 1.3) & (time < 1.99)] == "side").all()
    assert all(step.is_held for step, t in zip(steps, time, strict=True) if 0.5 <= t < 2.0)
    finding = steps[105].finding
    assert finding is not None
    assert "right hand" in str(finding)
    assert not steps[-1].is_held
    assert steps[-1].finding is None
    assert steps[10].finding is None


def test_the_order_is_named_and_no_order_is_not(lies: ModuleType, take: Any) -> None:
    part = take.part(1.0, 1.0)
    names = {lie.name: str(find(lie.tell(part))) for lie in lies.all_lies() if lie.kind == "order"}
    for layout in ("bighand21", "interhand21", "mano21", "rhd21"):
        assert f"that of the layout {layout}" in names[f"order of {layout}"]
    assert "index, middle, ring, little, thumb:" in names["thumb last"]
    assert "thumb, middle, index, ring, little:" in names["index and middle"]
    assert "no hand in any order known here" in names["random order"]


def test_metres_that_were_taken_for_millimetres_are_named(take: Any) -> None:
    finding = find(take.part(0.0, 1.0)._replace(landmarks=take.landmarks[:60] / 1000.0))
    assert finding is not None
    assert finding.advice == "multiply the landmarks by 1000"


@pytest.mark.parametrize(
    ("factor", "name"), [(1000.0, "millimetres"), (100.0, "centimetres"), (1 / 0.0254, "inches")]
)
def test_units_of_length_are_named(factor: float, name: str, take: Any) -> None:
    finding = find(take.part(0.0, 1.0)._replace(landmarks=take.landmarks[:60] * factor))
    assert finding is not None
    assert name in finding.problem
    assert finding.advice == f"multiply them by {1 / factor:g}"


def test_a_wrist_in_another_unit_or_world_is_found(take: Any) -> None:
    part = take.part(0.0, 1.0)
    for shift in (0.3, -1.0):
        wrist = part.wrist.copy()
        wrist[:, 2, 3] += shift
        finding = find(part._replace(wrist=wrist))
        assert finding is not None
        assert finding.kind == "wrist"
        assert f"{abs(shift):g} m from" in finding.problem


def test_one_batch_is_not_enough_and_lost_hands_are_no_mistake(take: Any) -> None:
    landmarks = take.landmarks.copy()
    landmarks[:16] *= (-1.0, 1.0, 1.0)  # exactly the first batch
    landmarks[100:200] = 0.0  # zero poses, in whole batches
    check = InputCheck(take.side)
    for i, time in enumerate(take.time):
        assert check.update(time, landmarks[i]) is None


def test_a_recording_is_refused_for_a_quarter_of_it_and_not_for_a_moment(take: Any) -> None:
    whole = as_recording(take)
    for start, share, is_refused in ((2.0, 0.1, False), (0.0, 0.15, False), (2.0, 0.6, True)):
        wrong = (whole.time > start) & (whole.time < start + 6.0 * share)
        landmarks = np.where(wrong[:, None, None], -1.0, 1.0) * whole.landmarks
        finding = examine_recording(replace(whole, landmarks=landmarks, wrist=None))
        assert (finding is not None) == is_refused


def test_the_wrist_tells_the_other_hand_from_a_mirrored_world(lies: ModuleType, take: Any) -> None:
    part = take.part(1.0, 1.0)
    told = {lie.name: lie.tell(part) for lie in lies.all_lies()}
    texts = {name: str(find(told[name])) for name in ("the other hand", "mirrored world")}
    assert "of a left hand, and so is the wrist's pose" in texts["the other hand"]
    assert "mirrored left hand; the wrist's pose is not: negate" in texts["mirrored world"]
    finding = find_without_wrist(told["mirrored world"])
    assert "of a right hand, or of a mirrored world" in str(finding)


def find_without_wrist(take: Any) -> Finding | None:
    check = InputCheck(take.side)
    for time, landmarks in zip(take.time, take.landmarks, strict=True):
        check.update(time, landmarks)
    return check.finding


def test_real_image_landmarks_are_no_world_landmarks(recordings: Path) -> None:
    file = recordings / "rgb_mediapipe_right.npz"
    recording, image = read_recording(file), np.load(file)["image_landmarks"].astype(float)
    for scale, word in (((1.0, 1.0, 1.0), "image coordinates"), ((640.0, 480.0, 640.0), "pixels")):
        finding = examine_recording(replace(recording, landmarks=image * scale, wrist=None))
        assert finding is not None
        assert finding.kind == "unit"
        assert word in finding.problem
