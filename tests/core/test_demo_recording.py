"""The recording that comes with the package: its bytes, its gestures, and its place."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from coarse_drawing import draw_coarsely
from demo_recording import GESTURES, HAND_LENGTH, PICK, write_demo

from handmap_qp import read_recording
from handmap_qp.apps.offline.poses import find_poses
from handmap_qp.apps.simulation.commands import find_pinch
from handmap_qp.cli import main
from handmap_qp.hands import Side
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats import DEMO_FILE

SIDES: tuple[Side, ...] = ("left", "right")


def members(file: Path) -> dict[str, bytes]:
    """Return the arrays of a file by name; the archive around them differs between Pythons."""
    with zipfile.ZipFile(file) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_the_command_makes_the_same_bytes(tmp_path: Path) -> None:
    write_demo(tmp_path / "demo.npz")
    assert members(tmp_path / "demo.npz") == members(DEMO_FILE)
    assert DEMO_FILE.stat().st_size < 300_000
    file = DEMO_FILE.with_name("pinch.npz")
    write_demo(tmp_path / "pinch.npz", PICK)
    assert members(tmp_path / "pinch.npz") == members(file)
    assert file.stat().st_size < 100_000


def test_both_hands_of_pinch_pick_something_up(capsys: pytest.CaptureFixture) -> None:
    pytest.importorskip("mujoco")
    for side in SIDES:
        window = find_pinch(read_recording("pinch", side))
        assert 2.0 < (window.end - window.closed) / 30.0 < 3.5
    assert main(["simulate", "pinch", "--robot", "three_finger", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    # As it is, and with the grip of a robot with encoders.
    assert [row["held"] for row in rows] == ["yes", "yes"]


@pytest.mark.parametrize("side", SIDES)
def test_every_gesture_is_seen_by_the_landmarks_alone(side: Side) -> None:
    recording = read_recording("demo", side)
    assert recording.side == side
    poses = find_poses(recording)
    assert all(index is not None for index in poses.values()), poses
    person = measure_person(recording)
    assert person.hand_length == pytest.approx(0.99 * HAND_LENGTH, abs=2e-3)
    assert 0.012 <= person.contact_gap < 0.02


@pytest.mark.parametrize("side", SIDES)
def test_it_has_the_faults_of_a_tracker(side: Side) -> None:
    recording = read_recording("demo", side)
    steps = np.diff(recording.time)
    assert steps.std() > 1e-3, "jitter"
    assert (steps > 1.7 / 30.0).sum() == 2, "dropped frames"
    assert recording.valid.all() == (side == "right")
    assert recording.wrist is not None
    assert recording.confidence is not None
    assert "no person" in recording.source
    still = recording.time < 0.4
    assert 2e-4 < recording.landmarks[still].std(axis=0).mean() < 2e-3
    assert {"open", "fist", "point", "spread", "thumb across"} <= {
        g.name for g in GESTURES
    }


@pytest.mark.slow
def test_the_first_lines_run_without_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    # The pictures of the demo have tests of their own.
    draw_coarsely(monkeypatch)
    assert main(["demo", "--robot", "three_finger"]) == 0
    assert (tmp_path / "demo" / "gestures.png").read_bytes().startswith(b"\x89PNG")
    assert main(["map", "demo", "--robot", "three_finger"]) == 0
    assert (tmp_path / "demo_right_three_finger.npz").exists()
    assert main(["convert", "demo", "demo.csv"]) == 0
    capsys.readouterr()
    assert main(["map", "demo", "--robots", "three_finger", "three_finger"]) == 2
    assert (
        "--robots: expected a left hand, then a right hand" in capsys.readouterr().err
    )


def test_two_hands_from_one_file_or_two(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["convert", "demo::left", "l.npz"]) == 0
    assert main(["map", "l.npz", "--robots", "allegro_left", "allegro_right"]) == 2
    assert (
        "one recording of the left and one of the right hand, got left"
        in capsys.readouterr().err
    )
    assert main(["map", "demo", "l.npz", "--robot", "allegro_left"]) == 2
    assert main(["map", "demo"]) == 2
    assert "--robot HAND or --robots LEFT RIGHT" in capsys.readouterr().err
