"""Recordings: reading, and one line for invalid ones."""

import pickle
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handmap_core.human.recording import mirrored, newest_at
from handmap_qp import (
    InvalidInputError,
    Recording,
    RecordingError,
    read_recording,
)


def arrays(count: int = 5) -> dict[str, np.ndarray]:
    """Return the arrays of a small valid recording."""
    rng = np.random.default_rng(0)
    return {
        "time": np.arange(count) / 60.0,
        "landmarks": rng.normal(size=(count, 21, 3)).astype(np.float32),
        "valid": np.ones(count, dtype=bool),
        "handedness": np.array("right"),
    }


def write(folder: Path, **changes: np.ndarray | None) -> Path:
    """Write the small recording with arrays changed, or removed if None."""
    path = folder / "hand.npz"
    np.savez(
        path,
        **{
            name: value
            for name, value in {**arrays(), **changes}.items()
            if value is not None
        },  # ty: ignore[invalid-argument-type]
    )
    return path


def test_reads_what_was_written(tmp_path: Path) -> None:
    recording = read_recording(write(tmp_path))
    expected = arrays()
    assert (recording.name, recording.side, len(recording)) == ("hand", "right", 5)
    np.testing.assert_array_equal(
        recording.landmarks, expected["landmarks"].astype(float)
    )
    np.testing.assert_allclose(recording.steps, 1.0 / 60.0)


def test_samples_with_holes_are_not_valid(tmp_path: Path) -> None:
    landmarks = arrays()["landmarks"]
    landmarks[2, 7, 1] = np.nan
    for valid in (None, np.ones(5, dtype=bool), np.ones(5, dtype=int)):
        recording = read_recording(write(tmp_path, landmarks=landmarks, valid=valid))
        np.testing.assert_array_equal(recording.valid, [True, True, False, True, True])


def test_the_first_step_is_the_median_of_the_others(tmp_path: Path) -> None:
    recording = read_recording(
        write(tmp_path, time=np.array([0.0, 0.01, 0.03, 0.05, 0.5]))
    )
    np.testing.assert_allclose(recording.steps, [0.02, 0.01, 0.02, 0.02, 0.45])


def test_wrist_poses_are_xyz_and_wxyz(tmp_path: Path) -> None:
    rows = np.tile([0.1, 0.2, 0.3, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], (5, 1))
    rows[1] = np.nan
    valid = np.array([True, False, True, True, True])
    path = write(tmp_path, wrist_pose=rows, valid=valid)
    poses = read_recording(path).wrist
    assert poses is not None
    quarter = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    np.testing.assert_allclose(poses[[0, 2, 3, 4]], [quarter] * 4, atol=1e-12)
    np.testing.assert_array_equal(poses[1], np.eye(4))


def test_wrist_poses_may_be_missing_and_must_be_poses(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert read_recording(path).wrist is None
    rows = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (5, 1))
    rows[3] = np.nan
    path = write(tmp_path, wrist_pose=rows)
    assert read_recording(path).wrist is None
    for bad in (rows[:, :6], rows[:4], np.zeros((5, 7))):
        path = write(tmp_path, wrist_pose=bad)
        with pytest.raises(RecordingError) as caught:
            read_recording(path)
        assert caught.value.array == "wrist_pose"


def test_mirror_makes_the_other_hand(tmp_path: Path) -> None:
    right = read_recording(write(tmp_path))
    left = mirrored(right)
    assert left.side == "left"
    np.testing.assert_array_equal(left.landmarks, right.landmarks * [-1.0, 1.0, 1.0])
    np.testing.assert_array_equal(mirrored(left).landmarks, right.landmarks)


BAD = {
    "no time": {"time": None},
    "no landmarks": {"landmarks": None},
    "no side": {"handedness": None},
    "unknown side": {"handedness": np.array("both")},
    "landmark count": {"landmarks": np.zeros((5, 20, 3))},
    "sample count": {"landmarks": np.zeros((4, 21, 3))},
    "valid count": {"valid": np.ones(4, dtype=bool)},
    "time stands still": {"time": np.zeros(5)},
    "time is not finite": {"time": np.array([0.0, 1.0, np.nan, 3.0, 4.0])},
    "no samples": {
        "time": np.zeros(0),
        "landmarks": np.zeros((0, 21, 3)),
        "valid": np.zeros(0, dtype=bool),
    },
    "nothing valid": {"valid": np.zeros(5, dtype=bool)},
    "words for landmarks": {"landmarks": np.full((5, 21, 3), "x")},
    "pickled objects": {"landmarks": np.full((5, 21, 3), None)},
    "digits for time": {"time": np.array(list("01234"))},
    "complex landmarks": {"landmarks": np.full((5, 21, 3), 1j)},
    "flat time": {"time": np.zeros((5, 1))},
    "words for valid": {"valid": np.array(["True"] * 5)},
    "counts for valid": {"valid": np.array([2, 1, 1, 1, 1])},
    "number for a side": {"handedness": np.array(1.0)},
    "two sides": {"handedness": np.array(["right", "left"])},
}


@pytest.mark.parametrize("changes", BAD.values(), ids=BAD.keys())
def test_a_bad_recording_is_rejected_in_one_line(tmp_path: Path, changes: dict) -> None:
    path = write(tmp_path, **changes)
    with pytest.raises(RecordingError) as caught:
        read_recording(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"not a zip", b"PK\x03\x04torn"], ids=["empty", "text", "torn"]
)
def test_a_file_that_is_not_a_recording_is_rejected(
    tmp_path: Path, content: bytes
) -> None:
    path = tmp_path / "hand.npz"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"hand\.npz"):
        read_recording(path)


def test_a_missing_file_and_a_folder_are_rejected(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.npz", tmp_path):
        with pytest.raises(RecordingError, match="cannot be read"):
            read_recording(path)


@pytest.mark.parametrize("path", [None, 5, b"hand.npz", ["hand.npz"]], ids=str)
def test_what_is_not_a_path_is_named(path: Any) -> None:
    with pytest.raises(InvalidInputError, match="path: expected the path"):
        read_recording(path)


def recording(**changes: Any) -> Recording:
    """Return the small recording, built in code."""
    values: dict[str, Any] = {**arrays(), "name": "hand", "side": "right", **changes}
    values.pop("handedness")
    return Recording(**values)


WRONG = {
    "time": [
        None,
        "x",
        ["0", "1", "2", "3", "4"],
        [0.0, np.nan, 2.0, 3.0, 4.0],
        np.zeros(5),
        [],
    ],
    "landmarks": [
        None,
        "x",
        np.zeros((5, 21)),
        np.zeros((4, 21, 3)),
        np.full((5, 21, 3), 1j),
    ],
    "valid": [None, "x", [True] * 4, [2] * 5, np.zeros(5, dtype=bool), [np.nan] * 5],
    "side": [None, "up", 5, ["right"]],
}


@pytest.mark.parametrize(("argument", "values"), WRONG.items(), ids=WRONG.keys())
def test_a_recording_built_in_code_is_checked(argument: str, values: list[Any]) -> None:
    for value in values:
        with pytest.raises(InvalidInputError) as caught:
            recording(**{argument: value})
        assert caught.value.argument == argument


def test_a_valid_sample_must_be_finite() -> None:
    landmarks = arrays()["landmarks"].copy()
    landmarks[3, 0, 0] = np.inf
    with pytest.raises(InvalidInputError, match=r"landmarks: .* sample 3"):
        recording(landmarks=landmarks)
    recording(landmarks=landmarks, valid=[True, True, True, False, True])


def test_recordings_share_nothing_with_their_makers() -> None:
    given = arrays()
    one = recording(**{name: given[name] for name in ("time", "landmarks", "valid")})
    for array in given.values():
        array[...] = array.dtype.type(7) if array.dtype.kind != "U" else "left"
    np.testing.assert_array_equal(one.landmarks, arrays()["landmarks"])
    again = pickle.loads(pickle.dumps(one))
    for value in (one, again):
        for field in fields(value):
            array = getattr(value, field.name)
            if isinstance(array, np.ndarray):
                with pytest.raises(ValueError, match="read-only"):
                    array[...] = 0
    np.testing.assert_array_equal(again.landmarks, one.landmarks)


def test_real_recordings_are_read(recordings: Path) -> None:
    for path in sorted(recordings.glob("*.npz")):
        recording = read_recording(path)
        assert np.isfinite(recording.landmarks[recording.valid]).all()
        assert path.stem.endswith(recording.side)


@pytest.mark.parametrize(
    "samples", [slice(1, 3), np.array([0, 2]), np.array([True, False, True])]
)
def test_a_part_has_all_columns_of_its_samples(samples: Any) -> None:
    recording = Recording(
        name="small",
        time=np.array([0.0, 0.1, 0.2]),
        landmarks=np.arange(3 * 63, dtype=float).reshape(3, 21, 3),
        valid=np.ones(3, dtype=bool),
        side="left",
        wrist=np.tile(np.eye(4), (3, 1, 1)),
        confidence=np.array([0.1, 0.2, 0.3]),
    )
    part = recording.part(samples)
    assert (part.name, part.side) == ("small", "left")
    for name in ("time", "landmarks", "valid", "wrist", "confidence"):
        np.testing.assert_array_equal(
            getattr(part, name), getattr(recording, name)[samples]
        )
    with pytest.raises(InvalidInputError, match="time"):
        recording.part(slice(None, None, -1))


def test_the_newest_sample_is_the_last_one_not_after_an_instant() -> None:
    time = np.array([1.0, 2.0, 4.0])
    instants = np.array([0.5, 1.0, 1.5, 2.0, 3.9, 4.0, 9.0])
    expected = [sum(time <= instant) - 1 for instant in instants]
    assert newest_at(time, instants).tolist() == expected
    before = [sum(time < instant) - 1 for instant in instants]
    assert newest_at(time, instants, "left").tolist() == before
    assert [newest_at(time, instant) for instant in instants] == expected
