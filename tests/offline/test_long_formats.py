"""Recordings of hours in other forms than `.npz` are read by pieces: the same numbers."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from long_cases import FORMATS, PIECE, played, shorten_pieces, traced_peak, without

from handmap_qp.cli import main
from handmap_qp.errors import RecordingError
from handmap_qp.human import Recording, mirrored
from handmap_qp.trackers import FORMATS as KINDS
from handmap_qp.trackers import LongRecording, find_source, list_sources

FILES = ("csv", "robomimic.hdf5", "egodex.hdf5")


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let recordings of seconds be long ones, of many pieces."""
    shorten_pieces(monkeypatch)


def unseen_at_times(count: int = 330, *, has_more: bool = True) -> Recording:
    """Return the hand of the demo, unseen for more than a piece, with wrist and confidence."""
    recording = without(played("played", count), slice(0, 60), slice(150, 260))
    if not has_more:
        return recording
    wrist = np.tile(np.eye(4), (count, 1, 1))
    wrist[:, :3, 3] = recording.landmarks[:, 0]
    wrist[~recording.valid] = np.nan
    shares = np.where(recording.valid, np.linspace(0.5, 1.0, count), np.nan)
    return replace(recording, wrist=wrist, confidence=shares)


def written(folder: Path, form: str, *hands: Recording) -> Path:
    """Write recordings in a form, named by its suffix and, of several, its name."""
    name, _, suffix = form.rpartition(".")
    file = folder / f"played.{suffix}"
    KINDS[name or suffix].write(hands, file)
    return file


def as_whole(file: Path, side: str, monkeypatch: pytest.MonkeyPatch) -> Recording:
    """Read a recording as a whole."""
    with monkeypatch.context() as patch:
        patch.setattr(f"{FORMATS}.long.SHORTEST", 10**6)
        (source,) = (s for s in list_sources(file) if s.entry.side == side)
        found = source.read_long()
    assert isinstance(found, Recording)
    return found


@pytest.mark.parametrize("has_more", [True, False])
@pytest.mark.parametrize("form", FILES)
def test_pieces_are_the_recording_to_the_last_bit(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, has_more: bool
) -> None:
    right = unseen_at_times(has_more=has_more)
    file = written(tmp_path, form, mirrored(right), right)
    for source in list_sources(file):
        long = source.read_long()
        assert isinstance(long, LongRecording)
        assert len(long) == len(right)
        parts = [*long.parts()]
        assert max(map(len, parts)) == PIECE
        whole = as_whole(file, source.entry.side, monkeypatch)
        assert whole.valid.tolist() == right.valid.tolist()
        for field in fields(Recording):
            expected = getattr(whole, field.name)
            if not isinstance(expected, np.ndarray):
                assert getattr(long.overview, field.name) == expected, field.name
                assert {getattr(part, field.name) for part in parts} == {expected}
                continue
            overview = getattr(long.overview, field.name)
            assert overview.tobytes() == expected.tobytes(), field.name
            found = np.concatenate([getattr(part, field.name) for part in parts])
            assert found.tobytes() == expected.tobytes(), field.name


@pytest.mark.parametrize("form", FILES)
def test_retarget_writes_the_same_file(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Its wrists do not turn with the palm, which the commands refuse.
    file = written(tmp_path, form, unseen_at_times(has_more=False))
    contents = []
    for shortest in (2, 10**6):
        monkeypatch.setattr(f"{FORMATS}.long.SHORTEST", shortest)
        out = tmp_path / f"{shortest}.npz"
        words = ["--robot", "three_finger", "--out", str(out)]
        assert main(["retarget", str(file), *words]) == 0
        contents.append(out.read_bytes())
    assert contents[0] == contents[1]


def test_a_rate_is_given_to_pieces_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = written(tmp_path, "csv", unseen_at_times())
    source = find_source(file, fps=25.0)
    long = source.read_long()
    assert isinstance(long, LongRecording)
    monkeypatch.setattr(f"{FORMATS}.long.SHORTEST", 10**6)
    whole = source.read_long()
    assert isinstance(whole, Recording)
    np.testing.assert_array_equal(long.overview.time, whole.time)
    assert long.overview.time_source == whole.time_source
    assert "25" in whole.time_source


@pytest.mark.parametrize("fault", ["time", "number", "wrist"])
def test_a_fault_is_named_as_in_a_short_recording(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = written(tmp_path, "csv", unseen_at_times())
    lines = file.read_text().splitlines()
    header = lines[0].split(",")
    # The first sample of a piece: the one before is of another.
    cells = lines[1 + 2 * PIECE].split(",")
    column = {"time": "time", "number": "wrist_x", "wrist": "wrist_pose_00"}[fault]
    value = {"time": "5.0", "number": "oops", "wrist": "2.0"}[fault]
    cells[header.index(column)] = value
    lines[1 + 2 * PIECE] = ",".join(cells)
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(RecordingError) as found:
        find_source(file).read_long()
    monkeypatch.setattr(f"{FORMATS}.long.SHORTEST", 10**6)
    with pytest.raises(RecordingError) as expected:
        find_source(file).read_long()
    assert str(found.value) == str(expected.value)
    # Longer ones are not read as a whole, and say it themselves.
    monkeypatch.setattr(f"{FORMATS}.long.SHORTEST", 2)
    monkeypatch.setattr(f"{FORMATS}.long.OVERVIEW", 100)
    with pytest.raises(RecordingError, match=column.removesuffix("_pose_00")):
        find_source(file).read_long()


@pytest.mark.parametrize("form", FILES)
def test_memory_does_not_grow(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{FORMATS}.long.OVERVIEW", 200)
    monkeypatch.setattr(f"{FORMATS}.long._BLOCK", 10)
    peaks: list[int] = []
    for count in (500, 1500):
        file = written(tmp_path, form, unseen_at_times(count))
        (source,) = list_sources(file)
        with traced_peak(peaks):
            long = source.read_long()
            assert isinstance(long, LongRecording)
            assert sum(len(part) for part in long.parts()) == count
    # A sample has 500 bytes, and 2700 where each joint has a pose.
    assert peaks[1] - peaks[0] < 50 * 1000
