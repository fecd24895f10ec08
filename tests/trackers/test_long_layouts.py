"""Recordings of hours in a tracker's own layout are read by pieces: the same numbers."""

from __future__ import annotations

import errno
import tempfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from layout_cases import wrist_beside
from long_cases import FORMATS, PIECE, played, shorten_pieces, traced_peak

from handmap_core.se3 import affine, rigid_fit
from handmap_qp.cli import main
from handmap_qp.errors import RecordingError
from handmap_qp.human import PALM, HumanSample, Recording, landmarks_at_rest
from handmap_qp.trackers import (
    LAYOUTS,
    DiskColumn,
    Layout,
    LongRecording,
    read_long_with_layout,
    side_with_layout,
)
from handmap_qp.trackers.layouts.base import Hands, HandsOf, sized_human

COSTLY = [name for name, layout in LAYOUTS.items() if layout.is_costly]


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let recordings of seconds be long ones, of many pieces."""
    shorten_pieces(monkeypatch)


def written(folder: Path, layout: Layout, count: int = 230, **changes: Any) -> Path:
    """Write a hand in a layout, unseen for more than a piece, with wrists where it takes them."""
    # The hand of the demo moves little in 30 samples, which are enough.
    hand = played("hours", 30)
    palm = landmarks_at_rest(sized_human("right"))[PALM]
    values, wrists = [], []
    for points in hand.landmarks:
        wrist = affine(np.eye(3), points[0]) @ affine(
            rigid_fit(palm, points[PALM])[:3, :3], np.zeros(3)
        )
        values.append(layout.write(HumanSample(0.0, "right", points, wrist)))
        wrists.append(wrist_beside(layout, wrist, "right"))
    order = np.resize([*range(30), *reversed(range(30))], count)
    rows = np.array(values)[order]
    rows[: PIECE + 7] = np.nan
    rows[120] = np.nan
    arrays: dict[str, Any] = {
        "time": 5.0 + np.arange(count) / 30.0,
        layout.arrays[0] if layout.arrays else "values": rows,
        "handedness": np.array("right"),
        "valid": np.arange(count) % 70 != 60,
    }
    if wrists[0] is not None:
        arrays["wrist"] = np.array(wrists)[order]
    file = folder / "hours.npz"
    np.savez(file, allow_pickle=False, **arrays | changes)
    return file


def tabulated(folder: Path, layout: Layout, count: int = 230) -> Path:
    """Write the same hand as a table, whose cells are empty where it is not seen."""
    arrays = np.load(written(folder, layout, count))
    values = arrays[layout.arrays[0] if layout.arrays else "values"]
    # Tables of joints have their positions.
    if values.ndim > 2 and layout.columns[0].endswith("_x"):
        values = values[..., :3, 3] if values.shape[2:] == (4, 4) else values[..., :3]
    table = np.column_stack([arrays["time"], values.reshape(count, -1)])
    lines = [",".join(["time", *layout.columns])]
    for row in table.tolist():
        lines.append(",".join("" if cell != cell else repr(cell) for cell in row))
    file = folder / "hours.csv"
    file.write_text("\n".join(lines) + "\n")
    return file


def same_in_pieces(
    file: Path, layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> list[Recording]:
    """Expect the recording of the whole file to the last bit, and return its parts."""
    long = read_long_with_layout(file, layout, "right")
    assert isinstance(long, LongRecording)
    whole = as_whole(file, layout, monkeypatch)
    parts = [*long.parts()]
    assert max(map(len, parts)) == PIECE
    for field in fields(Recording):
        expected = getattr(whole, field.name)
        if not isinstance(expected, np.ndarray):
            assert getattr(long.overview, field.name) == expected, field.name
            assert {getattr(part, field.name) for part in parts} == {expected}
            continue
        assert getattr(long.overview, field.name).tobytes() == expected.tobytes()
        found = np.concatenate([getattr(part, field.name) for part in parts])
        assert found.tobytes() == expected.tobytes(), field.name
    return parts


def as_whole(file: Path, layout: Layout, monkeypatch: pytest.MonkeyPatch) -> Recording:
    """Read a recording as a whole."""
    with monkeypatch.context() as patch:
        patch.setattr(f"{FORMATS}.long.SHORTEST", 10**6)
        found = read_long_with_layout(file, layout, "right")
    assert isinstance(found, Recording)
    return found


@pytest.mark.parametrize("name", LAYOUTS)
def test_pieces_are_the_recording_to_the_last_bit(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = LAYOUTS[name]
    parts = same_in_pieces(written(tmp_path, layout), layout, monkeypatch)
    assert not parts[0].valid.any()


@pytest.mark.parametrize("name", ["manus", "markers13", "openxr26"])
def test_pieces_of_a_table_are_the_recording_to_the_last_bit(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = LAYOUTS[name]
    same_in_pieces(tabulated(tmp_path, layout), layout, monkeypatch)


@pytest.mark.parametrize("name", COSTLY)
def test_landmarks_that_take_long_are_found_once(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = LAYOUTS[name]
    file = written(tmp_path, layout)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    sizes: list[int] = []
    follow = type(layout).follow

    def counting(*words: Any) -> HandsOf:
        hands = follow(*words)

        def counted(values: np.ndarray, wrists: np.ndarray | None) -> Hands:
            sizes.append(len(values))
            return hands(values, wrists)

        return counted

    monkeypatch.setattr(type(layout), "follow", counting)
    long = read_long_with_layout(file, layout, "right")
    assert isinstance(long, LongRecording)
    for _ in range(2):
        assert sum(int(part.valid.sum()) for part in long.parts()) > 100
    # And a single sample, which shows whether there are wrists.
    assert sum(sizes) == long.overview.valid.sum() + 1
    assert [each.name for each in tmp_path.iterdir()] == [file.name]


def test_the_command_writes_the_same_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = written(tmp_path, LAYOUTS["webxr25"])
    found = []
    for shortest in (2, 10**6):
        monkeypatch.setattr(f"{FORMATS}.long.SHORTEST", shortest)
        out = tmp_path / f"{shortest}.npz"
        words = ["--layout", "webxr25", "--robot", "three_finger", "--out", str(out)]
        assert main(["retarget", str(file), *words]) == 0
        found.append(out.read_bytes())
    assert found[0] == found[1]


@pytest.mark.parametrize("fault", ["time", "unit", "shape", "valid", "unseen", "torn"])
def test_a_fault_is_named_as_in_a_short_recording(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = LAYOUTS["webxr25"]
    file = written(tmp_path, layout)
    arrays = dict(np.load(file))
    name = layout.arrays[0]
    if fault == "time":
        arrays["time"][150] = arrays["time"][149]
    elif fault == "unit":
        arrays[name] = 1000.0 * arrays[name]
    elif fault == "shape":
        arrays[name] = arrays[name][:, :20]
    elif fault == "valid":
        arrays["valid"] = arrays["valid"][:100]
    elif fault == "unseen":
        arrays["valid"][:] = False
    np.savez(file, allow_pickle=False, **arrays)
    if fault == "torn":
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content)
    with pytest.raises(RecordingError) as found:
        read_long_with_layout(file, layout)
    with pytest.raises(RecordingError) as expected:
        as_whole(file, layout, monkeypatch)
    assert str(found.value) == str(expected.value)
    if fault in ("time", "unit"):
        # Longer ones are not read as a whole, and say it themselves.
        monkeypatch.setattr(f"{FORMATS}.long.OVERVIEW", 100)
        monkeypatch.setattr(f"{FORMATS}.long._BLOCK", 10)
        with pytest.raises(RecordingError, match=r"increasing|millimetres"):
            read_long_with_layout(file, layout)


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("angles20", "unit"),
        ("angles20", "sign"),
        ("angles20", "number"),
        ("manus", "sign"),
        ("markers13", "unit"),
        ("markers13", "number"),
    ],
)
@pytest.mark.parametrize("line", [100, -3])
def test_a_fault_of_any_piece_is_named_as_in_a_short_recording(
    name: str, fault: str, line: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = LAYOUTS[name]
    file = tabulated(tmp_path, layout)
    lines = file.read_text().splitlines()
    cells = lines[line].split(",")
    if fault == "unit":
        cells[1:] = [repr(1e9 * float(cell)) for cell in cells[1:]]
    elif fault == "sign":
        cells[1:] = [repr(-5.0 * float(cell)) for cell in cells[1:]]
    else:
        cells[-1] = "oops"
    lines[line] = ",".join(cells)
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(RecordingError) as expected:
        as_whole(file, layout, monkeypatch)
    # Longer ones are not read as a whole, and say it themselves.
    for longest in (10**6, 100):
        monkeypatch.setattr(f"{FORMATS}.long.OVERVIEW", longest)
        monkeypatch.setattr(f"{FORMATS}.long._BLOCK", 10)
        with pytest.raises(RecordingError) as found:
            read_long_with_layout(file, layout, "right")
        assert str(found.value) == str(expected.value)


def test_a_full_disk_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written(tmp_path, LAYOUTS["angles20"], 430)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(f"{FORMATS}.long.OVERVIEW", 100)
    append = DiskColumn.append

    def append_a_little(column: DiskColumn, rows: np.ndarray) -> None:
        if len(column) >= 2 * PIECE:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(column, rows)

    monkeypatch.setattr(DiskColumn, "append", append_a_little)
    out = tmp_path / "out.npz"
    words = ["--layout", "angles20", "--robot", "three_finger", "--out", str(out)]
    assert main(["retarget", str(file), *words]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "TMPDIR" in line
    assert "No space left on device" in line
    assert "make room" in line
    assert [each.name for each in tmp_path.iterdir()] == [file.name]


@pytest.mark.parametrize("name", ["openxr26", "angles20"])
@pytest.mark.parametrize("suffix", ["npz", "csv"])
def test_memory_does_not_grow(
    name: str, suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{FORMATS}.long.OVERVIEW", 200)
    monkeypatch.setattr(f"{FORMATS}.long._BLOCK", 10)
    layout = LAYOUTS[name]
    make = tabulated if suffix == "csv" else written
    peaks: list[int] = []
    for count in (1000, 4000):
        file = make(tmp_path, layout, count)
        with traced_peak(peaks):
            long = read_long_with_layout(file, layout, "right")
            assert isinstance(long, LongRecording)
            assert sum(len(part) for part in long.parts()) == count
    # Instants and flags; a sample has up to 1456 bytes, and its landmarks 504.
    assert peaks[1] - peaks[0] < 100 * 3000


@pytest.mark.parametrize("name", ["angles20", "openxr26"])
@pytest.mark.parametrize("suffix", ["npz", "csv"])
def test_the_side_is_known_without_landmarks(
    name: str, suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = LAYOUTS[name]
    file = (tabulated if suffix == "csv" else written)(tmp_path, layout)

    def unwanted(*words: Any) -> HandsOf:
        raise AssertionError

    monkeypatch.setattr(type(layout), "follow", unwanted)
    given = "left" if suffix == "csv" else None
    assert side_with_layout(file, layout, given) == (given or "right")
    if suffix == "csv":
        with pytest.raises(RecordingError, match="--side"):
            side_with_layout(file, layout)


def test_fits_of_markers_are_not_kept(tmp_path: Path) -> None:
    layout = LAYOUTS["markers13"]
    values = np.load(written(tmp_path, layout))[layout.arrays[0]][-70:]
    values = values[np.isfinite(values).all(axis=(1, 2))]
    peaks: list[int] = []
    for count in (60, 60, 240):
        rows = np.resize(values, (count, *values.shape[1:]))
        with traced_peak(peaks):
            layout.convert(rows, "right", None, None, None)
    # The first run loads the human hand. A fit has 40 kB, and landmarks and wrist 632 bytes.
    assert peaks[2] - peaks[1] < 180 * 3000
