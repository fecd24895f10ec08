"""A person's file: round trip of measured values, and errors of invalid files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml
from person_cases import LENGTHS, worn

from handmap_core.human.recording import Recording, mirrored
from handmap_qp import HandMapper, HumanLengths, InvalidInputError, load_hand
from handmap_qp.human.contact_gap import ContactGapMeter, tip_gaps
from handmap_qp.human.measure import scaled_human
from handmap_qp.human.person import Person, read_person, write_person
from handmap_qp.stream.measurement import measure_person

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow


def recording(lengths: HumanLengths = LENGTHS) -> Recording:
    hand = load_hand("human", points="landmarks", lengths=lengths)
    rng = np.random.default_rng(0)
    postures = hand.rest + 0.2 * rng.uniform(size=(20, 20)) * (
        hand.upper_limits - hand.rest
    )
    landmarks = np.array([hand.points(q) for q in postures])
    return Recording(
        "anna", np.arange(20) / 60.0, landmarks, np.ones(20, dtype=bool), "right"
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_person(measure_person(recording()), tmp_path / "anna.yaml")
    return tmp_path / "anna.yaml"


def test_what_is_measured_is_what_is_read(file: Path) -> None:
    measured, read = measure_person(recording()), read_person(file)
    assert read.name == "anna"
    assert read.contact_gap == pytest.approx(measured.contact_gap, abs=5e-6)
    np.testing.assert_allclose(read.lengths.bases, measured.lengths.bases, atol=6e-6)
    np.testing.assert_allclose(read.lengths.segments, LENGTHS.segments, atol=6e-6)
    np.testing.assert_allclose(read.lengths.rolls, measured.lengths.rolls, atol=6e-6)
    assert list(file.parent.iterdir()) == [file]


def test_a_person_fits_both_hands(file: Path) -> None:
    person, right = read_person(file), recording()
    one = scaled_human(right, points="landmarks", lengths=person.lengths)
    other = scaled_human(mirrored(right), points="landmarks", lengths=person.lengths)
    assert (one.side, other.side) == ("right", "left")
    np.testing.assert_allclose(
        one.points(one.rest), other.points(other.rest) * (-1.0, 1.0, 1.0), atol=1e-9
    )


def test_a_file_without_rolls_is_read_as_a_hand_without(file: Path) -> None:
    document = yaml.safe_load(file.read_text())
    for finger in document["fingers"].values():
        del finger["roll"]
    file.write_text(yaml.safe_dump(document))
    np.testing.assert_array_equal(read_person(file).lengths.rolls, np.zeros(5))


def changed(document: Any, key: str, value: Any) -> Any:
    *path, last = key.split(".")
    place = document
    for part in path:
        place = place[part]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return document


BAD = {
    "no name": ("name", ..., "person"),
    "no gap": ("contact_gap", ..., "person"),
    "gap of text": ("contact_gap", "wide", "contact_gap"),
    "gap in millimetres": ("contact_gap", 13.0, "contact_gap"),
    "negative gap": ("contact_gap", -0.001, "contact_gap"),
    "gap NaN": ("contact_gap", float("nan"), "contact_gap"),
    "no thumb": ("fingers.thumb", ..., "fingers"),
    "sixth finger": ("fingers.sixth", {}, "fingers"),
    "two bones": ("fingers.index.bones", [0.04, 0.02], "fingers.index.bones"),
    "bone of no length": ("fingers.index.bones", [0.04, 0.02, 0.0], "fingers.*.bones"),
    "bone NaN": (
        "fingers.index.bones",
        [0.04, 0.02, float("nan")],
        "fingers.index.bones[2]",
    ),
    "bone of text": (
        "fingers.index.bones",
        [0.04, 0.02, "short"],
        "fingers.index.bones[2]",
    ),
    "roll in degrees": ("fingers.little.roll", 15, "fingers.*.roll"),
    "left hand": ("fingers.index.base", [0.09, 0.09, 0.0], "fingers.*.base"),
    "hand in millimetres": (
        "fingers.middle.bones",
        [45.0, 28.0, 25.0],
        "fingers.*.bones",
    ),
    "unknown key": ("age", 40, "person"),
}


@pytest.mark.parametrize(("key", "value", "argument"), BAD.values(), ids=BAD.keys())
def test_what_cannot_be_used_is_named(
    file: Path, key: str, value: Any, argument: str
) -> None:
    file.write_text(
        yaml.safe_dump(changed(yaml.safe_load(file.read_text()), key, value))
    )
    with pytest.raises(InvalidInputError) as caught:
        read_person(file)
    assert caught.value.argument == argument
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text", ["", "- 1\n", "{", "\x00", "name: 2020-99-99\n", "&a [*a]"]
)
def test_a_file_that_is_no_description_is_rejected(file: Path, text: str) -> None:
    file.write_text(text)
    with pytest.raises(InvalidInputError, match=r"anna\.yaml"):
        read_person(file)


@pytest.mark.parametrize("path", [3, None, Path("nowhere.yaml"), Path()])
def test_a_path_that_leads_nowhere_is_rejected(path: Any) -> None:
    with pytest.raises(InvalidInputError):
        read_person(path)


def test_a_folder_that_does_not_exist_is_an_error_and_a_failed_write_leaves_no_file(
    tmp_path: Path,
) -> None:
    person = Person("anna", LENGTHS, 0.013)
    with pytest.raises(InvalidInputError):
        write_person(person, tmp_path / "nowhere" / "anna.yaml")
    (tmp_path / "taken").mkdir()
    with pytest.raises(InvalidInputError):
        write_person(person, tmp_path / "taken")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


# -- noise, dropouts, outliers


def spoilt(recording: Recording, noise: float = 0.002) -> Recording:
    """Add noise, 10 % of samples with one landmark 0.1 m off, and 10 % without a hand."""
    random = np.random.default_rng(3)
    landmarks = recording.landmarks + random.normal(
        scale=noise, size=recording.landmarks.shape
    )
    outliers = random.random(len(recording)) < 0.1
    for i in np.flatnonzero(outliers):
        direction = random.normal(size=3)
        landmarks[i, random.integers(21)] += 0.1 * direction / np.linalg.norm(direction)
    valid = random.random(len(recording)) >= 0.1
    landmarks[~valid] = np.nan
    return replace(recording, landmarks=landmarks, valid=valid)


def test_noise_dropouts_and_outliers_hardly_change_the_person() -> None:
    clean, measured = measure_person(worn()), measure_person(spoilt(worn()))
    # Noise of 2 mm lengthens a bone of 25 mm by (2 * 2^2 / 25) mm.
    np.testing.assert_allclose(measured.lengths.segments, LENGTHS.segments, atol=1e-3)
    np.testing.assert_allclose(measured.lengths.bases, clean.lengths.bases, atol=1.5e-3)
    assert clean.contact_gap == pytest.approx(0.015, abs=1e-3)
    assert measured.contact_gap == pytest.approx(0.015, abs=2e-3)


def test_recordings_of_both_hands_count_together() -> None:
    right, small = worn(300), recording(HumanLengths.from_hand_length(0.16))
    both = measure_person(right, mirrored(right))
    alone = measure_person(right)
    np.testing.assert_allclose(both.lengths.segments, alone.lengths.segments, atol=1e-6)
    np.testing.assert_allclose(both.lengths.bases, alone.lengths.bases, atol=1e-6)
    assert both.name == "worn"
    # The longer recording decides where two persons are mixed up.
    mixed = measure_person(small, right)
    np.testing.assert_allclose(mixed.lengths.segments, LENGTHS.segments, atol=1e-3)
    with pytest.raises(InvalidInputError, match="recordings: expected at least one"):
        measure_person()


@pytest.mark.parametrize(
    ("gap", "expected"), [(0.018, 0.017), (0.006, 0.012), (0.024, 0.017)]
)
def test_touches_correct_the_contact_gap_step_by_step_and_only_between_pinches(
    gap: float, expected: float
) -> None:
    record = worn(1080, gap=gap)
    meter = ContactGapMeter(0.013)
    gaps = tip_gaps(record.landmarks).min(axis=1)
    before = meter.gap
    for i, t in enumerate(record.time):
        changed = meter.add(float(t), record.landmarks[i])
        assert changed == (meter.gap != before)
        assert abs(meter.gap - before) <= 1e-3 + 1e-12
        # Medians over 0.1 s lag a little.
        assert not changed or gaps[max(0, i - 3) : i + 1].max() > 0.07
        before = meter.gap
    assert meter.gap == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("rise", "ends"), [(0.009, False), (0.011, True)])
def test_a_touch_ends_where_the_gap_has_risen_by_10_mm(rise: float, ends: bool) -> None:
    """Three touches move the contact gap; a hand that opens once has ended one."""
    meter = ContactGapMeter(0.013)
    gaps = [0.08, *[0.016, 0.016 + rise] * 4, 0.08]
    for k, gap in enumerate(np.repeat(gaps, 12)):
        landmarks = np.full((21, 3), 1.0)
        landmarks[4] = 0.0
        landmarks[8] = (gap, 0.0, 0.0)
        meter.add(k / 60.0, landmarks)
    assert (meter.gap > 0.013) is ends


def test_a_hand_that_never_touches_keeps_the_contact_gap() -> None:
    meter = ContactGapMeter(0.013)
    record = worn(300, gap=0.05)
    for time, landmarks in zip(record.time, record.landmarks, strict=True):
        assert not meter.add(float(time), landmarks)
    assert meter.gap == 0.013


def cupped(motion: float, noise: float = 0.0) -> Recording:
    """Record a hand whose little finger moves with its metacarpal by up to `motion` [m]."""
    still = worn(300)
    rng = np.random.default_rng(3)
    share = np.sin(np.linspace(0.0, 40.0, len(still)))[:, None, None]
    landmarks = still.landmarks.copy()
    axes = landmarks[:, 9] - landmarks[:, 0]
    across = np.cross(axes, landmarks[:, 5] - landmarks[:, 17])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    landmarks[:, 17:21] += motion * share * across[:, None]
    landmarks += noise * rng.normal(size=landmarks.shape)
    return replace(still, landmarks=landmarks)


def test_a_knuckle_that_moves_on_the_palm_has_less_weight_there() -> None:
    weights = measure_person(cupped(0.008)).lengths.palm_weights
    np.testing.assert_array_equal(weights[:4], 1.0)
    assert weights[4] < 0.05
    # A millimetre leaves a third.
    weights = measure_person(cupped(0.001)).lengths.palm_weights
    assert weights[4] == pytest.approx(0.32, abs=0.1)


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.003])
def test_noise_alone_leaves_all_knuckles_their_weight(noise: float) -> None:
    weights = measure_person(cupped(0.0, noise)).lengths.palm_weights
    assert weights[4] > 0.5


def test_the_palm_of_a_cupped_hand_keeps_its_axes() -> None:
    """With the weights that were measured, the fit does not turn as the little finger moves."""
    recording = cupped(0.008)
    reader = HandMapper(scaled_human(recording), load_hand("three_finger")).landmarks
    still = worn(300)
    turns = []
    for moved, at_rest in zip(recording.landmarks, still.landmarks, strict=True):
        poses = [reader.read(points)[0] for points in (moved, at_rest)]
        one, other = (pose.wrist[:3, :3] for pose in poses if pose.wrist is not None)
        turns.append(np.linalg.norm(pin.log3(one.T @ other)))
    assert np.degrees(max(turns)) < 0.5


def test_a_file_keeps_the_weight_of_a_knuckle(tmp_path: Path) -> None:
    person = measure_person(cupped(0.008))
    file = tmp_path / "cupped.yaml"
    write_person(person, file)
    weights = read_person(file).lengths.palm_weights
    np.testing.assert_allclose(weights, person.lengths.palm_weights, atol=1e-5)
    assert "palm_weight" in file.read_text()


@pytest.mark.parametrize("wrong", [[1.0] * 4, [1, 1, 1, 1, 1.5], [1, 0, 1, 1, 1]])
def test_weights_that_cannot_be_are_refused(wrong: list[float]) -> None:
    with pytest.raises(InvalidInputError, match="palm_weights"):
        HumanLengths(LENGTHS.bases, LENGTHS.segments, palm_weights=np.array(wrong))
