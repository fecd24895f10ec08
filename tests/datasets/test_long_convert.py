"""`handmap convert` of recordings of hours: by pieces, with the same result."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from lerobot_tables import columns_of, episodes_of
from long_cases import FORMATS, PIECE, played, shorten_pieces, traced_peak, without

from handmap_qp import read_recording
from handmap_qp.apps.datasets import convert
from handmap_qp.cli import main
from handmap_qp.human import Recording, mirrored
from handmap_qp.trackers import FORMATS as KINDS
from handmap_qp.trackers import DiskColumn, LongRecording, find_source
from handmap_qp.trackers.formats.base import Entry, RecordingFormat

pytest.importorskip("h5py")
pytest.importorskip("pyarrow")
pytest.importorskip("rosbags")

COUNT = 230
OUTPUTS = {
    "npz": "out.npz",
    "csv": "out.csv",
    "robomimic": "out.hdf5",
    "egodex": "out.h5",
    "lerobot": "out",
    "mcap": "out.mcap",
}
"""Files that are written, by their forms."""
INPUTS = {name: f"hours{Path(OUTPUTS[name]).suffix}" for name in ("npz", "csv")}
INPUTS |= {"robomimic": "hours.hdf5", "egodex": "hours.h5"}
"""Files that are read by pieces, by their forms."""


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let recordings of seconds be long ones, of many pieces."""
    shorten_pieces(monkeypatch)


def both_hands(count: int = COUNT) -> list[Recording]:
    """Return both hands, unseen for more than a piece, with wrists and confidence."""
    recording = without(played("hours", count), slice(0, 60), slice(100, 160))
    wrist = np.tile(np.eye(4), (count, 1, 1))
    # The wrist that a tracker gives is not its first landmark.
    wrist[:, :3, 3] = recording.landmarks[:, 0] + 0.01
    wrist[~recording.valid] = np.nan
    shares = np.where(recording.valid, np.linspace(0.5, 1.0, count), np.nan)
    right = replace(recording, wrist=wrist, confidence=shares, source="a test")
    return [mirrored(right), right]


def written(folder: Path, form: str = "npz", count: int = COUNT) -> Path:
    """Write both hands in a form."""
    file = folder / INPUTS[form]
    KINDS[form].write(both_hands(count), file)
    return file


def converted(
    file: Path, form: str, capsys: pytest.CaptureFixture[str]
) -> tuple[Path, dict[str, object]]:
    """Convert a file to a form, and return the new file and what the command says."""
    out = file.with_name(OUTPUTS[form])
    assert main(["convert", str(file), str(out), "--format", form, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert not [*file.parent.rglob(".*")]
    return out, said


def content_of(out: Path, form: str) -> object:
    """Return what a file of a form has, to the last bit."""
    if form in ("npz", "csv"):
        return out.read_bytes()
    if form == "lerobot":
        return [
            {name: array.tobytes() for name, array in columns_of(out, i).items()}
            for i in range(2)
        ], [row["length"] for row in episodes_of(out)]
    found = [read_recording(f"{out}::{e.name}") for e in KINDS[form].entries(out)]
    return [
        value.tobytes() if isinstance(value, np.ndarray) else value
        for recording in found
        for value in (getattr(recording, field.name) for field in fields(Recording))
    ]


def in_both_ways(
    file: Path,
    form: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> list[tuple[object, dict[str, object]]]:
    """Convert a file by pieces and as a whole; return the contents and what is said."""
    found = []
    for shortest in (2, 10**6):
        monkeypatch.setattr(f"{FORMATS}.long.SHORTEST", shortest)
        # As a whole, it is written as a whole too.
        monkeypatch.setattr(f"{FORMATS}.long.PIECE", PIECE if shortest == 2 else 10**6)
        out, said = converted(file, form, capsys)
        found.append((content_of(out, form), said))
        if out.is_dir():
            out.rename(out.with_name(f"{shortest}"))
        else:
            out.unlink()
    return found


@pytest.mark.parametrize("form", OUTPUTS)
def test_pieces_become_the_same_file(
    form: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pieces, whole = in_both_ways(written(tmp_path), form, monkeypatch, capsys)
    assert pieces == whole
    assert pieces[1]["samples"] == 2 * COUNT


@pytest.mark.parametrize("form", ["csv", "robomimic", "egodex"])
def test_pieces_of_each_form_become_the_same_file(
    form: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = written(tmp_path, form)
    pieces, whole = in_both_ways(file, "npz", monkeypatch, capsys)
    assert pieces == whole


def test_a_loss_of_the_last_piece_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = played("hours", COUNT)
    wrist = np.tile(np.eye(4), (COUNT, 1, 1))
    wrist[:, :3, 3] = recording.landmarks[:, 0]
    wrist[-1, 0, 3] += 0.01
    file = tmp_path / INPUTS["npz"]
    KINDS["npz"].write([replace(recording, wrist=wrist)], file)
    _, said = converted(file, "egodex", capsys)
    assert said["lost"] == [
        "the wrist's position where it is not its landmark",
        "that the confidence is unknown",
    ]


def test_hands_at_other_instants_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left, right = both_hands()
    late = replace(right, time=np.append(right.time[:-1], right.time[-1] + 0.001))
    file = tmp_path / INPUTS["npz"]
    KINDS["npz"].write([left, late], file)
    out = tmp_path / OUTPUTS["egodex"]
    assert main(["convert", str(file), str(out), "--format", "egodex"]) == 2
    assert "both hands at the same instants" in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == [file.name]


@pytest.mark.parametrize("form", ["npz", "csv", "robomimic", "egodex", "lerobot"])
def test_memory_does_not_grow(
    form: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(f"{FORMATS}.long.OVERVIEW", 200)
    monkeypatch.setattr(f"{FORMATS}.long._BLOCK", 10)
    monkeypatch.setattr(f"{FORMATS}.disk_columns._AT_ONCE", 1 << 14)
    peaks: list[int] = []
    for count in (500, 500, 2000):
        folder = tmp_path / str(len(peaks))
        folder.mkdir()
        file = written(folder, count=count)
        with traced_peak(peaks):
            converted(file, form, capsys)
    # The first run imports. Instants and flags of two hands, and of a data set one number of each
    # frame; a sample of a hand has 650 bytes.
    assert peaks[2] - peaks[1] < 150 * 1500


def test_a_form_of_another_package_gets_the_whole_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    got: list[Recording] = []

    class Other(RecordingFormat):
        name = "other"
        suffixes = (".other",)
        lacks = ("source", "confidence")

        def entries(self, path: Path) -> Sequence[Entry]:
            raise NotImplementedError

        def read(self, path: Path, entry: Entry) -> Recording:
            raise NotImplementedError

        def write(self, recordings: Sequence[Recording], path: Path) -> None:
            got.extend(recordings)

    file = written(tmp_path)
    form = Other()
    longs = [find_source(f"{file}::{side}").read_long() for side in ("left", "right")]
    light = [each.without_overview() for each in longs if type(each) is LongRecording]
    form.write_long(light, tmp_path / "out.other")
    for recording, expected in zip(got, both_hands(), strict=True):
        assert type(recording) is Recording
        for field in fields(Recording):
            value = getattr(expected, field.name)
            if isinstance(value, np.ndarray):
                assert getattr(recording, field.name).tobytes() == value.tobytes()
    assert form.in_order(
        {"the confidence", "something", "the words about the source"}
    ) == (
        "the words about the source",
        "the confidence",
        "something",
    )


@pytest.mark.parametrize("form", OUTPUTS)
def test_ctrl_c_leaves_what_was_there(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = written(tmp_path)
    out = tmp_path / OUTPUTS[form]
    if form != "lerobot":
        out.write_bytes(b"before")
    count = convert._Written._count

    def interrupted(self: convert._Written, index: int, part: Recording) -> None:
        if index == 1 and part.time[0] > 8.0:
            raise KeyboardInterrupt
        count(self, index, part)

    monkeypatch.setattr(convert._Written, "_count", interrupted)
    assert main(["convert", str(file), str(out), "--format", form]) == 130
    left = sorted(each.name for each in tmp_path.iterdir())
    if form == "lerobot":
        assert left == [file.name]
        return
    assert left == sorted([file.name, out.name])
    assert out.read_bytes() == b"before"


def test_a_full_disk_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written(tmp_path)
    out = tmp_path / OUTPUTS["npz"]
    out.write_bytes(b"before")
    append = DiskColumn.append

    def append_a_little(column: DiskColumn, rows: np.ndarray) -> None:
        if len(column) >= 2 * PIECE:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(column, rows)

    monkeypatch.setattr(DiskColumn, "append", append_a_little)
    assert main(["convert", str(file), str(out)]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert str(out) in line
    assert "make room" in line
    assert out.read_bytes() == b"before"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["hours.npz", "out.npz"]


@pytest.mark.parametrize("form", ["csv", "lerobot"])
def test_progress_counts_samples_to_the_end(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: dict[str, tuple[int | None, list[int]]] = {}

    @contextmanager
    def progress(
        what: str, total: int | None = None
    ) -> Iterator[Callable[[int], None]]:
        done: list[int] = []
        shown[what] = total, done
        yield done.append

    monkeypatch.setattr(convert, "progress", progress)
    file = written(tmp_path)
    assert main(["convert", str(file), str(tmp_path / OUTPUTS[form])]) == 0
    total, done = shown["converting"]
    assert max(done) == done[-1] == total == 2 * COUNT
    # For a data set, the instants are read first.
    pieces = 2 * -(-COUNT // PIECE)
    assert len(done) == (pieces if form == "csv" else 2 * pieces)
    assert form == "lerobot" or done == sorted(done)
