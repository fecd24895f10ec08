"""`handmap track`: what it writes and prints, and one line for every mistake."""

from __future__ import annotations

import itertools
import json
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live_cases import moving_hand, save_recording
from service_tools import address_of, serving

from handmap_core.human.sample import HumanSample
from handmap_qp import cli
from handmap_qp.apps.live.source import Recorder
from handmap_qp.trackers.formats import read_recording

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return save_recording(moving_hand(), tmp_path / "moving.npz")


def test_replay_records(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "copy.npz"
    command = ["track", "replay", str(recording), "--record", str(out), "--speed", "50"]
    assert cli.main([*command, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    copy = read_recording(out)
    assert summary["samples"] == len(copy) == 60
    assert summary["hand_seen"] == int(copy.valid.sum()) == 59


@pytest.mark.usefixtures("patient")
def test_replay_leads_the_service(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = moving_hand()
    millimetres = save_recording(
        replace(plain, landmarks=1e3 * plain.landmarks), tmp_path / "millimetres.npz"
    )
    with serving() as server:
        target = ["--to", address_of(server), "--robot", "three_finger"]
        assert cli.main(["track", "replay", str(recording), *target]) == 0
        table = capsys.readouterr().out
        assert "three_finger" in table
        assert "calibrating: " in table
        # Of a file with both hands, the robot's is played.
        copy = tmp_path / "copy.npz"
        command = ["track", "replay", "demo", "--speed", "50", "--record", str(copy)]
        assert cli.main([*command, *target[:3], "g1_left"]) == 0
        assert read_recording(copy).side == "left"
        capsys.readouterr()
        command = ["track", "replay", str(millimetres), "--speed", "5"]
        assert cli.main([*command, *target]) == 2
        refused = capsys.readouterr()
        assert "refused every sample" in refused.err
        assert refused.err.count("\n") == 1


def test_a_loop_ends_by_sigterm_and_writes_its_file(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, put = tmp_path / "loop.npz", Recorder.put
    count = itertools.count()

    def put_and_end(recorder: Recorder, sample: HumanSample) -> None:
        put(recorder, sample)
        # In the second round.
        if next(count) == 80:
            signal.raise_signal(signal.SIGTERM)

    def refuse(*_: object) -> None:
        raise AssertionError("nobody takes the signal")

    monkeypatch.setattr(Recorder, "put", put_and_end)
    before = signal.signal(signal.SIGTERM, refuse)
    words = [
        "track",
        "replay",
        str(recording),
        "--loop",
        "--record",
        str(out),
        "--json",
    ]
    try:
        assert cli.main([*words, "--speed", "10"]) == 0
        assert signal.getsignal(signal.SIGTERM) is refuse
    finally:
        signal.signal(signal.SIGTERM, before)
    copy = read_recording(out)
    assert len(copy) == json.loads(capsys.readouterr().out)["recorded"] > 60
    assert (np.diff(copy.time) > 0.0).all()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ([], "--record"),
        (["--to", "127.0.0.1"], "--robot: missing"),
        (["--robot", "allegro_right", "--record", "OUT"], "--robot: needs --to"),
        (["--session", "a", "--record", "OUT"], "--session: needs --to"),
        (["--shared", "--record", "OUT"], "--shared: needs --to"),
        (["--record", "out.txt"], "--record"),
        (["--record", "OUT", "--speed", "0"], "speed"),
        (["--to", "nowhere.invalid", "--robot", "allegro_right"], "nowhere.invalid"),
    ],
)
def test_every_mistake_is_one_line(
    recording: Path,
    tmp_path: Path,
    words: list[str],
    complaint: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = str(tmp_path / "out.npz")
    words = [out if word == "OUT" else word for word in words]
    assert cli.main(["track", "replay", str(recording), *words]) == 2
    message = capsys.readouterr().err
    assert complaint in message
    assert message.startswith("handmap: ")
    assert message.count("\n") == 1
    assert list(tmp_path.iterdir()) == [recording]


@pytest.mark.parametrize(
    "words", [["track"], ["track", "--help"], ["track", "replay", "--help"]]
)
def test_help_is_given(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    assert not end.value.code
    assert "replay" in capsys.readouterr().out


def test_a_wrong_source_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["track", "replai"]) == 2
    assert "did you mean replay?" in capsys.readouterr().err
