"""Files that hold landmarks and little else: the user says the side and the rate."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handmap_qp import HandMapper, InvalidInputError, RecordingError, load_hand
from handmap_qp.cli import main
from handmap_qp.human.measure import scaled_human
from handmap_qp.trackers.formats import list_sources, read_hands, read_recording
from handmap_qp.trackers.formats.base import SIDES

DEMO = {side: read_recording("demo", side).part(slice(0, 90)) for side in SIDES}
"""Three seconds of each hand, in which a few samples are not valid."""
FPS = 30.0
OPTIONS = ("--fps", "30", "--side", "right")


def save(path: Path, **arrays: Any) -> Path:
    """Write arrays, or the only one of an `.npy`, and return the path."""
    if path.suffix == ".npy":
        (array,) = arrays.values()
        np.save(path, array, allow_pickle=True)
    else:
        np.savez(path, allow_pickle=True, **arrays)
    return path


def as_is(points: np.ndarray) -> np.ndarray:
    return points


def flattened(points: np.ndarray) -> np.ndarray:
    return points.reshape(len(points), -1)


def narrowed(points: np.ndarray) -> np.ndarray:
    return points.astype(np.float32)


@pytest.mark.parametrize("form", [as_is, flattened, narrowed])
@pytest.mark.parametrize(
    "file",
    [
        ("x.npz", "landmarks"),
        ("x.npz", "keypoints"),
        ("x.npz", "pred_keypoints_3d"),
        ("x.npz", "arr_0"),
        ("x.npy", ""),
    ],
    ids=" ".join,
)
def test_an_array_of_landmarks_is_a_recording_by_side_and_rate(
    tmp_path: Path, file: tuple[str, str], form: Any
) -> None:
    given = DEMO["right"]
    name, array = file
    path = save(tmp_path / name, **{array or "points": form(given.landmarks)})
    found = read_recording(path, "right", fps=FPS)
    assert found.side == "right"
    np.testing.assert_allclose(found.time, np.arange(len(given)) / FPS)
    np.testing.assert_allclose(found.landmarks, given.landmarks, atol=1e-7)
    np.testing.assert_array_equal(
        found.valid, np.isfinite(given.landmarks).all(axis=(1, 2))
    )


@pytest.mark.parametrize("file", ["x.npz", "x.npy"])
@pytest.mark.parametrize("robot", ["allegro_right", "allegro"])
def test_the_command_takes_side_and_rate(
    tmp_path: Path, file: str, robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = save(tmp_path / file, landmarks=DEMO["right"].landmarks)
    out = tmp_path / "out.npz"
    words = ["map", str(path), "--robot", robot, "--out", str(out), "--json", *OPTIONS]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["robot"] == "allegro_right"
    with np.load(out) as mapped:
        np.testing.assert_allclose(mapped["time"], np.arange(90) / FPS)


@pytest.mark.parametrize(
    ("name", "unit"),
    [("timestamps", 1.0), ("timestamp", 1.0), ("t", 1.0), ("time_ms", 1e3)],
)
def test_times_have_the_names_that_people_give(
    tmp_path: Path, name: str, unit: float
) -> None:
    given = DEMO["left"]
    arrays = {"landmarks": given.landmarks, name: unit * given.time}
    path = save(tmp_path / "x.npz", handedness="left", **arrays)
    found = read_recording(path)
    assert found.side == "left"
    np.testing.assert_allclose(np.diff(found.time), np.diff(given.time), atol=1e-12)
    # A rate that the user gives counts more.
    again = read_recording(path, fps=FPS)
    np.testing.assert_allclose(again.time, np.arange(len(given)) / FPS)


def test_nanoseconds_since_1970_keep_their_differences(tmp_path: Path) -> None:
    given = DEMO["left"]
    nanoseconds = 1_780_000_000_000_000_000 + np.arange(len(given)) * 33_333_333
    path = save(
        tmp_path / "x.npz",
        landmarks=given.landmarks,
        time_ns=nanoseconds,
        handedness="left",
    )
    steps = np.diff(read_recording(path).time)
    np.testing.assert_allclose(steps, 0.033333333, atol=1e-12)


def test_a_rate_in_the_file_is_its_time(tmp_path: Path) -> None:
    path = save(
        tmp_path / "x.npz", keypoints=DEMO["left"].landmarks, fps=25.0, side="left"
    )
    found = read_recording(path)
    np.testing.assert_allclose(found.time, np.arange(90) / 25.0)
    assert list_sources(path)[0].entry.samples == 90


def test_time_that_cannot_be_used_gives_way_to_a_rate(tmp_path: Path) -> None:
    given = DEMO["right"]
    arrays = {"landmarks": given.landmarks, "time": given.time[::-1]}
    path = save(tmp_path / "x.npz", handedness="right", **arrays)
    with pytest.raises(RecordingError, match="strictly increasing"):
        read_recording(path)
    assert read_recording(path, fps=FPS).time[1] == pytest.approx(1.0 / FPS)


def test_both_hands_may_share_their_time(tmp_path: Path) -> None:
    arrays = {f"{side}_keypoints": DEMO[side].landmarks for side in SIDES}
    path = save(tmp_path / "x.npz", timestamps=DEMO["left"].time, **arrays)
    for side, found in read_hands([path]).items():
        np.testing.assert_array_equal(found.landmarks, DEMO[side].landmarks)
        np.testing.assert_array_equal(found.time, DEMO["left"].time)


def test_two_files_are_the_left_hand_and_the_right_one(tmp_path: Path) -> None:
    paths = [
        save(tmp_path / f"{side}.npy", points=DEMO[side].landmarks) for side in SIDES
    ]
    found = read_hands(paths, fps=FPS)
    for side in SIDES:
        np.testing.assert_array_equal(found[side].landmarks, DEMO[side].landmarks)


LANDMARKS = DEMO["right"].landmarks
PAIR = np.stack([LANDMARKS, LANDMARKS], axis=1)
REFUSED: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "no side": (
        {"landmarks": LANDMARKS},
        {"fps": FPS},
        "does not say which hand it is of: give --side right or left",
    ),
    "no time": (
        {"landmarks": LANDMARKS},
        {"side": "right"},
        "has no time stamps: give --fps",
    ),
    "two hands": (
        {"landmarks": PAIR},
        {"side": "right", "fps": FPS},
        "landmarks: expected landmarks of one hand, shape (T, 21, 3), got shape "
        "(90, 2, 21, 3): save those of each hand as left_landmarks and right_landmarks",
    ),
    "two hands and no side": ({"landmarks": PAIR}, {}, "landmarks of one hand"),
    "one sample": (
        {"landmarks": LANDMARKS[0]},
        {"side": "right", "fps": FPS},
        "landmarks: expected landmarks of one hand, shape (T, 21, 3), got shape (21, 3)",
    ),
    "other points": (
        {"keypoints": LANDMARKS[:, :20]},
        {"side": "right", "fps": FPS},
        "keypoints: expected landmarks of one hand, shape (T, 21, 3), got shape (90, 20, 3)",
    ),
    "pixels": (
        {"keypoints": LANDMARKS[..., :2]},
        {"side": "right", "fps": FPS},
        "got shape (90, 21, 2)",
    ),
    "no sample": (
        {"landmarks": LANDMARKS[:0]},
        {"side": "right", "fps": FPS},
        "time: expected at least one instant, got none",
    ),
    "all lost": (
        {"landmarks": np.full_like(LANDMARKS, np.nan)},
        {"side": "right", "fps": FPS},
        "valid: expected at least one valid sample",
    ),
    "words": (
        {"landmarks": LANDMARKS.astype(str)},
        {"side": "right", "fps": FPS},
        "landmarks: expected numbers",
    ),
    "complex": (
        {"landmarks": LANDMARKS.astype(complex)},
        {"side": "right", "fps": FPS},
        "landmarks: expected numbers",
    ),
    "objects": (
        {"landmarks": np.array([*LANDMARKS, None], dtype=object)},
        {"side": "right", "fps": FPS},
        "landmarks: holds Python objects, which are not read",
    ),
    "a side that is none": (
        {"landmarks": LANDMARKS, "handedness": "both"},
        {"fps": FPS},
        "handedness: expected right or left, got 'both'",
    ),
    "short time": (
        {"landmarks": LANDMARKS, "timestamps": np.arange(9.0)},
        {"side": "right"},
        "expected numbers of shape (9, 21, 3)",
    ),
    "camera": (
        {"pred_keypoints_3d": LANDMARKS, "cam_t": LANDMARKS[:, 0]},
        {"side": "right", "fps": FPS},
        "install packages/hamer",
    ),
}


@pytest.mark.parametrize(
    ("name", "suffix"),
    [
        (name, suffix)
        for name, (arrays, _, _) in REFUSED.items()
        # An .npy file has one array.
        for suffix in (".npz", ".npy")[: 3 - len(arrays)]
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, name: str, suffix: str) -> None:
    arrays, options, message = REFUSED[name]
    if suffix == ".npy":
        (array,) = arrays
        message = message.removeprefix(f"{array}: ")
    path = save(tmp_path / f"x{suffix}", **arrays)
    with pytest.raises(RecordingError) as caught:
        read_recording(path, options.get("side"), fps=options.get("fps"))
    assert message in str(caught.value)
    assert caught.value.file == path
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fps", [0.0, -30.0, np.nan, np.inf, "30", [30.0], 30j])
def test_a_rate_that_is_none_is_refused(tmp_path: Path, fps: Any) -> None:
    path = save(tmp_path / "x.npz", landmarks=LANDMARKS)
    with pytest.raises(InvalidInputError, match="fps: expected a rate > 0"):
        read_recording(path, "right", fps=fps)


def test_samples_with_nan_are_not_valid(tmp_path: Path) -> None:
    points = LANDMARKS.copy()
    points[[3, 7], 5, 1] = np.nan, np.inf
    found = read_recording(save(tmp_path / "x.npy", points=points), "right", fps=FPS)
    assert not found.valid[[3, 7]].any()


@pytest.mark.parametrize(
    ("points", "side", "message"),
    [
        (1e3 * LANDMARKS, "right", "millimetres"),
        ((1e3 * LANDMARKS).round(), "right", "millimetres"),
        (LANDMARKS, "left", "the right one (--side right; side= in Python)"),
    ],
    ids=["millimetres", "whole millimetres", "other hand"],
)
def test_the_plausibility_check_finds_wrong_units_and_sides(
    tmp_path: Path,
    points: np.ndarray,
    side: str,
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    seen = np.isfinite(points).all(axis=(1, 2))
    numbers = points[seen]
    path = save(tmp_path / "x.npz", landmarks=numbers.astype(int))
    if not (numbers == numbers.round()).all():
        path = save(tmp_path / "x.npz", landmarks=numbers)
    words = ["map", str(path), "--robot", f"allegro_{side}", "--side", side]
    assert main([*words, "--fps", "30", "--out", str(tmp_path / "out.npz")]) == 2
    assert message in capsys.readouterr().err


def test_options_that_the_message_names_are_those_that_help(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = save(tmp_path / "x.npz", landmarks=LANDMARKS)
    out = tmp_path / "out.csv"
    for options, message in [
        ((), "--side"),
        (("--side", "right"), "--fps"),
        (OPTIONS, ""),
    ]:
        code = main(["convert", str(path), str(out), *options])
        assert code == (2 if message else 0)
        assert message in capsys.readouterr().err
    assert len(read_recording(out)) == 90


def test_a_csv_without_time_or_side_is_read_likewise(tmp_path: Path) -> None:
    from handmap_qp.trackers.formats.base import COLUMNS

    path = tmp_path / "x.csv"
    rows = [",".join(map(repr, row)) for row in flattened(LANDMARKS).tolist()]
    path.write_text("\n".join([",".join(COLUMNS["landmarks"]), *rows]))
    with pytest.raises(RecordingError, match="give --side"):
        read_recording(path, fps=FPS)
    with pytest.raises(RecordingError, match="give --fps"):
        read_recording(path, "right")
    found = read_recording(path, "right", fps=FPS)
    np.testing.assert_array_equal(found.landmarks, LANDMARKS)


def test_values_in_a_layout_need_no_time_beside_a_rate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = save(tmp_path / "x.npz", values=LANDMARKS)
    words = ["map", str(path), "--robot", "allegro_right", "--layout", "mediapipe21"]
    out = ["--out", str(tmp_path / "out.npz")]
    assert main([*words, *out, "--side", "right"]) == 2
    assert "give --fps" in capsys.readouterr().err
    assert main([*words, *out, *OPTIONS]) == 0


def test_a_recording_of_a_plain_array_moves_a_robot(tmp_path: Path) -> None:
    recording = read_recording(
        save(tmp_path / "x.npy", points=LANDMARKS), "right", fps=FPS
    )
    mapper = HandMapper(scaled_human(recording), load_hand("three_finger"))
    q = [
        mapper.map_landmarks(points, dt=dt).command.q
        for points, dt, seen in zip(
            recording.landmarks, recording.steps, recording.valid, strict=True
        )
        if seen
    ]
    assert np.ptp(q, axis=0).max() > 0.1


def test_a_replay_takes_side_and_rate(tmp_path: Path) -> None:
    path = save(tmp_path / "x.npy", points=LANDMARKS)
    out = tmp_path / "out.npz"
    words = ["track", "replay", str(path), "--speed", "100", "--record", str(out)]
    assert main(words) == 2
    assert main([*words, *OPTIONS]) == 0
    assert read_recording(out).side == "right"


def test_a_simulation_takes_side_and_rate(tmp_path: Path) -> None:
    path = tmp_path / "x.npy"
    np.save(path, read_recording("pinch", "right").landmarks)
    out = tmp_path / "out.npz"
    words = ["simulate", str(path), "--robot", "allegro", "--out", str(out)]
    assert main([*words, *OPTIONS]) == 0
    assert out.is_file()


@given(st.data())
def test_a_damaged_array_is_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "x.npy"
    np.save(path, LANDMARKS[:4].astype(np.float32))
    content = bytearray(path.read_bytes())
    # The header is what decides, so most damages are there.
    last = data.draw(st.sampled_from([127, len(content) - 1]))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, last))] = data.draw(st.integers(0, 255))
    del content[data.draw(st.integers(len(content) // 2, len(content))) :]
    path.write_bytes(bytes(content))
    problems = []
    try:
        read_recording(path, "right", fps=FPS)
    except RecordingError as error:
        problems.append(str(error))
    assert not any("\n" in problem for problem in problems)


def test_a_header_that_asks_for_more_than_there_is_is_refused(tmp_path: Path) -> None:
    header = {"descr": "<f8", "fortran_order": False, "shape": (1 << 40, 21, 3)}
    path = tmp_path / "x.npy"
    with path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, header)
    with pytest.raises(RecordingError):
        read_recording(path, "right", fps=FPS)
