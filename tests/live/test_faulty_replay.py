"""The script that replays a recording with faults: what it sends and writes, and its mistakes."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import faulty_replay
import pytest
from injection import FAULT_KINDS, parse_faults
from live_cases import moving_hand, save_recording
from service_tools import address_of, serving

from handmap_qp.trackers.formats import read_recording

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    python tests/judges faulty_replay (.+)$", PAGE, re.M)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return save_recording(moving_hand(), tmp_path / "moving.npz")


def test_it_records_with_faults(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "spoilt.npz"
    command = [str(recording), "--record", str(out), "--speed", "50", "--json"]
    faulty_replay.main([*command, "--faults", "dropout@0.01+0.005"])
    summary = json.loads(capsys.readouterr().out)
    copy = read_recording(out)
    assert summary["samples"] == len(copy) == 60
    assert summary["hand_seen"] == int(copy.valid.sum()) < 50
    lost = copy.time[~copy.valid]
    assert lost[-1] == pytest.approx(0.015, abs=0.001)


def test_the_seed_decides(recording: Path, tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.npz" for name in "abc"]
    for file, seed in zip(files, "778", strict=True):
        words = ["--faults", "noise@0", "--seed", seed, "--speed", "50"]
        faulty_replay.main([str(recording), "--record", str(file), *words])
    one, same, other = (read_recording(file).landmarks[20] for file in files)
    assert (one == same).all()
    assert not (one == other).any()


@pytest.mark.usefixtures("patient")
def test_it_leads_the_service(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving() as server:
        command = [str(recording), "--to", address_of(server), "--robot"]
        command += ["three_finger", "--json", "--faults"]
        faulty_replay.main([*command, "dropout@0.3+0.4"])
        summary = json.loads(capsys.readouterr().out)
        assert summary["robot"] == "three_finger"
        assert summary["hand_lost"] == pytest.approx(25, abs=2)
        assert summary["sent"] == 60
        with pytest.raises(SystemExit) as end:
            faulty_replay.main([*command, "noise@0:1", "--speed", "5"])
        assert end.value.code == 2
        refused = capsys.readouterr()
        assert "refused every sample" in refused.err
        assert refused.err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--faults", "fall@1", "--record", "OUT"], "fall"),
        (["--faults", "jump", "--record", "OUT"], "NAME@START"),
        (["--faults", "jump@1"], "--record"),
        (["--faults", "jump@1", "--to", "127.0.0.1"], "--robot: missing"),
        (["--faults", "jump@1", "--record", "OUT", "--speed", "0"], "speed"),
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
    with pytest.raises(SystemExit) as end:
        faulty_replay.main([str(recording), *words])
    assert end.value.code == 2
    message = capsys.readouterr().err
    assert complaint in message
    assert message.count("\n") == 1
    assert list(tmp_path.iterdir()) == [recording]


def test_the_help_lists_every_kind(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        faulty_replay.main(["--help"])
    assert not end.value.code
    page = capsys.readouterr().out
    assert all(f"\n  {name} " in page for name in FAULT_KINDS)
    assert "--robot HAND" in page


def test_the_page_lists_every_kind_and_its_commands_are_understood() -> None:
    table = PAGE.split("\n## Faults on purpose\n")[1].split("\n## ")[0]
    assert re.findall(r"^\| `(\w+)` \|", table, re.M) == [*FAULT_KINDS]
    assert len(COMMANDS) >= 2
    for line in COMMANDS:
        arguments = faulty_replay.make_parser().parse_args(shlex.split(line))
        assert parse_faults(arguments.faults)
