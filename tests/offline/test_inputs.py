"""`handmap retarget` says what it assumed of time, wrist and size, and what looks unusual."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handmap_qp import read_recording
from handmap_qp.apps.offline.cli import Retarget
from handmap_qp.apps.offline.inputs import describe_input, input_notes, input_rows
from handmap_qp.trackers.formats import write_recordings
from handmap_qp.trackers.formats.hdf5 import EgoDexFormat


def test_the_time_of_a_file_is_said_to_be_its_own_or_as_given() -> None:
    recording = read_recording("demo", "right")
    rows = input_rows([describe_input(recording)])
    assert rows["time"].startswith("the time stamps of the file: 29.9 samples/s")
    rows = input_rows([describe_input(recording.at_rate(90.0))])
    assert "90 samples/s, as given" in rows["time"]
    assert "those of the file say 29.9" in rows["time"]
    assert "equal steps" in rows["time"]


def test_numbered_samples_have_no_rate_of_their_own() -> None:
    recording = read_recording("demo", "right")
    numbered = replace(recording, time=np.arange(len(recording)) * 1.0)
    assert numbered.at_rate(30.0).time_source == "30 samples/s, as given"


@pytest.mark.parametrize("given", [{"fps": 25.0}, {"time": np.arange(90) / 25.0}])
def test_a_rate_that_a_file_declares_is_no_time_stamp(
    tmp_path: Path, given: dict[str, float | np.ndarray]
) -> None:
    file = tmp_path / "joints.npz"
    joints = read_recording("demo", "right").landmarks[:90]
    np.savez(file, allow_pickle=False, joints=joints, side="right", **given)
    said = read_recording(file).time_source
    assert said == (
        "25 samples/s, as the file or its format says" if "fps" in given else ""
    )


def test_the_time_of_an_egodex_file_is_that_of_the_format_or_its_own(
    tmp_path: Path,
) -> None:
    h5py = pytest.importorskip("h5py")
    file = tmp_path / "0.hdf5"
    write_recordings([read_recording("demo", "right")], file, EgoDexFormat())
    assert read_recording(file).time_source == ""
    with h5py.File(file, "a") as written:
        del written["time"]
    assert read_recording(file).time_source == "30 samples/s, as the format says"


def test_a_wrist_and_a_size_are_said_to_be_assumed() -> None:
    recording = read_recording("demo", "right")
    rows = input_rows([describe_input(recording)])
    assert "turns by" in rows["wrist"]
    assert "not mapped" in rows["wrist"]
    assert "taken as constant" in rows["size of the hand"]
    still = replace(
        recording,
        landmarks=recording.landmarks[:1]
        + np.random.default_rng(0).normal(0.0, 3e-4, recording.landmarks.shape),
        wrist=None,
    )
    rows = input_rows([describe_input(replace(still, valid=np.ones(len(still))))])
    assert "does not move in this file" in rows["wrist"]
    assert "no wrist poses" in rows["wrist"]


def test_both_hands_have_rows_and_notes_of_their_own() -> None:
    recordings = [read_recording("demo", side) for side in ("left", "right")]
    slow = [replace(each, time=20.0 * each.time) for each in recordings]
    inputs = [describe_input(each) for each in (recordings[0], slow[1])]
    assert {"time, left hand", "time, right hand"} < input_rows(inputs).keys()
    (note,) = input_notes(inputs)
    assert note.startswith("right hand: the fingers move at")


def test_map_prints_what_it_assumed_and_writes_it_as_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / "slow.npz", tmp_path / "out.npz"
    recording = read_recording("demo", "right").part(slice(120))
    write_recordings([replace(recording, time=10.0 * recording.time)], file)
    Retarget((file,), robot="allegro_right", out=out).run()
    printed = capsys.readouterr().out
    assert "the time stamps of the file" in printed
    assert "check its unit, or give the rate by --fps" in printed
    Retarget((file,), robot="allegro_right", out=out, json=True).run()
    (found,) = json.loads(capsys.readouterr().out)["inputs"]
    assert found["rate_hz"] == pytest.approx(3.0, rel=0.05)
    assert len(found["hints"]) == 1
