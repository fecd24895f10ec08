"""Recordings of hours are mapped by pieces: the same numbers, in a memory that does not grow."""

from __future__ import annotations

import errno
import io
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from long_cases import FORMATS, PIECE, played, shorten_pieces, traced_peak

from handmap_qp import load_hand, read_recording
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.offline.long_motion import LongMotion, map_long
from handmap_qp.apps.offline.long_summary import summarise_long
from handmap_qp.apps.offline.summary import summarise
from handmap_qp.apps.offline.trajectory import Trajectory, map_hands
from handmap_qp.cli import main
from handmap_qp.errors import DiskFullError, InvalidInputError, RecordingError
from handmap_qp.hands import Values
from handmap_qp.human import Person, Recording
from handmap_qp.stream import measure_person
from handmap_qp.trackers import (
    DiskColumn,
    LongRecording,
    blocks_of,
    find_source,
    write_npz,
    write_recordings,
)

ROBOT = "three_finger"


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let recordings of seconds be long ones, of many pieces."""
    shorten_pieces(monkeypatch)


def with_losses(count: int = 430) -> Recording:
    """Return a hand that is unseen at first and later on, for longer than a piece."""
    recording = played("hours", count)
    valid = recording.valid.copy()
    valid[: 2 * PIECE + 7] = False
    valid[180 : 180 + 2 * PIECE] = False
    valid[300] = False
    landmarks = np.where(valid[:, None, None], recording.landmarks, np.nan)
    # An outlier, which the guard holds.
    landmarks[330] += 0.3
    wrist = np.tile(np.eye(4), (count, 1, 1))
    wrist[:, :3, 3] = recording.landmarks[:, 0]
    wrist[~valid] = np.nan
    shares = np.where(valid, np.linspace(0.5, 1.0, count), np.nan)
    return replace(
        recording, landmarks=landmarks, valid=valid, wrist=wrist, confidence=shares
    )


def opened(recording: Recording, folder: Path) -> LongRecording:
    """Write a recording, and open it to read it by pieces."""
    file = folder / f"{recording.name}.npz"
    write_recordings([recording], file)
    found = find_source(file).read_long()
    assert isinstance(found, LongRecording)
    return found


def mapped(recording: Recording, person: Person) -> Trajectory:
    """Map a recording as a whole."""
    return map_hands([recording], load_hand(ROBOT), person, MappingArguments())[0]


@pytest.fixture
def pieced(tmp_path: Path) -> Iterator[tuple[Trajectory, LongMotion]]:
    """The same motion, mapped as a whole and by pieces."""
    long = opened(with_losses(), tmp_path)
    person = measure_person(long.overview)
    with map_long(
        [long], load_hand(ROBOT), person, MappingArguments(), tmp_path / "out.npz"
    ) as motion:
        yield mapped(read_recording(tmp_path / "hours.npz"), person), motion


def without_time(summary: Values) -> Values:
    """Return a summary without the time that the processor took."""
    return {name: value for name, value in summary.items() if "cpu" not in name}


def test_an_overview_of_all_samples_is_the_recording(tmp_path: Path) -> None:
    long = opened(with_losses(), tmp_path)
    whole = read_recording(tmp_path / "hours.npz")
    parts = list(long.parts())
    assert len(parts) > 8
    for name in ("time", "landmarks", "valid", "wrist", "confidence"):
        values = getattr(whole, name)
        np.testing.assert_array_equal(getattr(long.overview, name), values)
        pieces = [getattr(part, name) for part in parts]
        np.testing.assert_array_equal(np.concatenate(pieces), values)


def test_pieces_give_the_same_columns_and_summary_to_the_last_bit(
    pieced: tuple[Trajectory, LongMotion],
) -> None:
    whole, motion = pieced
    assert 0 < whole.valid.sum() < len(whole.time)
    expected = whole.all_columns
    assert [*expected] == [*motion.all_columns]
    for name, array in expected.items():
        stored = motion.all_columns[name]
        found = stored.rows(slice(None)) if isinstance(stored, DiskColumn) else stored
        assert (found.dtype, found.shape) == (array.dtype, array.shape)
        assert found.tobytes() == array.tobytes(), name
    summary = summarise_long(motion, motion.trajectory(slice(0, len(motion))))
    assert without_time(summary) == without_time(summarise(whole))


def test_counts_and_largest_values_of_a_part_are_those_of_all(
    pieced: tuple[Trajectory, LongMotion],
) -> None:
    whole, motion = pieced
    found = summarise_long(motion, motion.trajectory(slice(110, 160), slice(350, 400)))
    expected = summarise(whole)
    for name in (
        "samples",
        "held",
        "rules",
        "events",
        "samples_at_limit",
        "limit_violation_max",
        "point_error_mm_max",
        "speed_over_limit_max",
        "acceleration_max",
        "steps_ms",
    ):
        assert found[name] == expected[name], name


def test_the_overview_of_hours_has_blocks_that_end_without_a_hand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{FORMATS}.long.OVERVIEW", 200)
    monkeypatch.setattr(f"{FORMATS}.long._BLOCK", 10)
    long = opened(played("hours", 1003), tmp_path)
    rows = np.concatenate([np.arange(1003)[block] for block in blocks_of(1003)])
    assert (len(rows), rows[0], rows[-1]) == (120, 0, 1002)
    whole = read_recording(tmp_path / "hours.npz")
    np.testing.assert_array_equal(long.overview.time, whole.time[rows])
    np.testing.assert_array_equal(long.overview.landmarks, whole.landmarks[rows])
    assert np.flatnonzero(~long.overview.valid).tolist() == [*range(9, 120, 10)]


def test_a_hand_that_is_never_followed_is_refused_in_the_same_words(
    tmp_path: Path,
) -> None:
    hand = played("hours", 200)
    person = measure_person(hand)
    # The tracker does not trust one of its samples.
    recording = replace(hand, confidence=np.zeros(200))
    long = opened(recording, tmp_path)
    with pytest.raises(InvalidInputError) as expected:
        mapped(recording, person)
    with ExitStack() as stack, pytest.raises(InvalidInputError) as found:
        stack.enter_context(
            map_long(
                [long], load_hand(ROBOT), person, MappingArguments(), tmp_path / "a.npz"
            )
        )
    assert str(found.value) == str(expected.value)


@pytest.mark.parametrize("fault", ["time", "landmarks", "confidence", "wrist", "torn"])
def test_a_fault_is_named_as_in_a_short_recording(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = with_losses()
    file = tmp_path / "faulty.npz"
    write_recordings([recording], file)
    arrays = dict(np.load(file))
    if fault == "time":
        arrays["time"][150] = arrays["time"][149]
    elif fault == "landmarks":
        arrays["valid"][:] = False
    elif fault == "confidence":
        arrays["confidence"][150:260] = np.nan
        arrays["valid"][155] = True
    elif fault == "wrist":
        arrays["wrist"][150] *= 2.0
    np.savez(file, **arrays)
    if fault == "torn":
        content = bytearray(file.read_bytes())
        content[len(content) // 3] ^= 1
        file.write_bytes(content)
    with pytest.raises(RecordingError) as found:
        find_source(file).read_long()
    monkeypatch.setattr(f"{FORMATS}.long.SHORTEST", 10**6)
    with pytest.raises(RecordingError) as expected:
        find_source(file).read_long()
    assert str(found.value) == str(expected.value)


def test_the_commands_write_the_same_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "hours.npz"
    # Its wrists do not turn with the palm, which the commands refuse.
    write_recordings([replace(with_losses(), wrist=None)], file)
    written = []
    for name, shortest in (("long", 2), ("short", 10**6)):
        monkeypatch.setattr(f"{FORMATS}.long.SHORTEST", shortest)
        out = tmp_path / f"{name}.npz"
        words = ("--robot", ROBOT, "--out", str(out), "--json")
        assert main(["retarget", str(file), *words]) == 0
        folder = tmp_path / name
        words = ("--robot", ROBOT, "--out", str(folder), "--workers", "0")
        assert main(["batch", str(file), *words]) == 0
        (episode,) = (folder / "episodes").iterdir()
        assert not [*folder.rglob(".*")]
        manifest = (folder / "manifest.jsonl").read_text()
        metrics = manifest[manifest.index('"metrics"') :]
        written.append((out.read_bytes(), episode.read_bytes(), metrics))
    assert written[0] == written[1]


def test_memory_does_not_grow_with_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{FORMATS}.long.OVERVIEW", 1000)
    monkeypatch.setattr(f"{FORMATS}.long._BLOCK", 50)
    monkeypatch.setattr(f"{FORMATS}.disk_columns._AT_ONCE", 1 << 14)
    person = measure_person(played("hours", 500))
    robot = load_hand(ROBOT)
    peaks: list[int] = []
    for count in (2000, 6000):
        write_recordings([played("hours", count)], tmp_path / "hours.npz")
        with traced_peak(peaks):
            long = find_source(tmp_path / "hours.npz").read_long()
            assert isinstance(long, LongRecording)
            out = tmp_path / "out.npz"
            with map_long([long], robot, person, MappingArguments(), out) as motion:
                with out.open("wb") as stream:
                    write_npz(stream, motion.all_columns, is_compressed=False)
                summarise_long(motion, motion.trajectory(*blocks_of(count)))
    # Instants, flags and what is measured of them; a sample has 500 bytes, and its motion 1000.
    assert peaks[1] - peaks[0] < 100 * 4000


def test_a_full_disk_leaves_the_file_that_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, out = tmp_path / "hours.npz", tmp_path / "out.npz"
    write_recordings([played("hours", 300)], file)
    out.write_bytes(b"before")
    append = DiskColumn.append

    def append_a_little(column: DiskColumn, rows: np.ndarray) -> None:
        if len(column) >= 2 * PIECE:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(column, rows)

    monkeypatch.setattr(DiskColumn, "append", append_a_little)
    long = find_source(file).read_long()
    assert isinstance(long, LongRecording)
    person = measure_person(long.overview)
    with (
        ExitStack() as stack,
        pytest.raises(DiskFullError, match="make room"),
    ):
        stack.enter_context(
            map_long([long], load_hand(ROBOT), person, MappingArguments(), out)
        )
    assert main(["retarget", str(file), "--robot", ROBOT, "--out", str(out)]) == 1
    assert out.read_bytes() == b"before"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["hours.npz", "out.npz"]


@pytest.mark.parametrize("is_compressed", [False, True])
def test_archives_are_those_of_numpy(tmp_path: Path, *, is_compressed: bool) -> None:
    rng = np.random.default_rng(1)
    arrays: dict[str, np.ndarray] = {
        "numbers": rng.normal(size=(3000, 4, 4)),
        "flags": rng.normal(size=3000) > 0.0,
        "words": np.array(["solved", "held"])[rng.integers(2, size=3000)],
        "name": np.array("robot"),
    }
    save = np.savez_compressed if is_compressed else np.savez
    expected, found = io.BytesIO(), io.BytesIO()
    save(expected, allow_pickle=False, **arrays)
    with ExitStack() as opened_columns:
        columns: dict[str, np.ndarray | DiskColumn] = {**arrays}
        for name in ("numbers", "flags", "words"):
            column = DiskColumn(tmp_path, arrays[name].dtype, arrays[name].shape[1:])
            opened_columns.callback(column.close)
            for rows in np.array_split(arrays[name], 7):
                column.append(rows)
            columns[name] = column
        write_npz(found, columns, is_compressed=is_compressed)
    assert found.getvalue() == expected.getvalue()
