"""Recordings of hours of both hands are mapped to one robot by pieces: the same numbers."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from long_cases import FORMATS, PIECE, played, shorten_pieces, traced_peak, without

from handmap_qp import load_hand
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.offline.long_motion import LongMotion, map_long
from handmap_qp.apps.offline.long_summary import summarise_long
from handmap_qp.apps.offline.summary import summarise
from handmap_qp.apps.offline.trajectory import Trajectory, map_hands
from handmap_qp.cli import main
from handmap_qp.hands import Side, load_whole
from handmap_qp.human import Recording, mirrored
from handmap_qp.stream import measure_person, paired, paired_parts
from handmap_qp.stream.guard import BEHIND
from handmap_qp.trackers import (
    DiskColumn,
    LongRecording,
    all_long,
    find_source,
    in_memory,
    read_long_hands,
    write_npz,
    write_recordings,
)

ROBOT = "g1"


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let recordings of seconds be long ones, of many pieces."""
    shorten_pieces(monkeypatch)


def hand(side: str, count: int, rate: float, start: float) -> Recording:
    """Return the hand of the demo, played to and fro."""
    recording = played("right", count, rate=rate, start=start)
    return recording if side == "right" else mirrored(recording)


def both_hands() -> list[Recording]:
    """Return both hands, of other rates and spans, that are unseen for longer than a piece."""
    # The left hand begins later, so that the robot has one hand at first.
    left = without(hand("left", 130, 21.0, 6.1), slice(35, 90))
    right = without(hand("right", 200, 30.0, 5.0), slice(0, 60), slice(110, 165))
    return [left, right]


def written(hands: list[Recording], folder: Path) -> list[Path]:
    """Write a file of each hand."""
    files = []
    for each in hands:
        files.append(folder / f"{each.side}.npz")
        write_recordings([each], files[-1])
    return files


def opened(hands: list[Recording], folder: Path) -> list[LongRecording]:
    """Write both hands, and open them to be read by pieces."""
    found = all_long([*read_long_hands(written(hands, folder)).values()])
    assert found is not None
    return found


@pytest.fixture
def motion(tmp_path: Path) -> Iterator[LongMotion]:
    """Both hands, mapped by pieces."""
    long = opened(both_hands(), tmp_path)
    person = measure_person(*(each.overview for each in long))
    with map_long(
        long, load_whole(ROBOT), person, MappingArguments(), tmp_path / "out.npz"
    ) as found:
        yield found


def test_a_robot_with_two_hands_moves_the_same_to_the_last_bit(
    motion: LongMotion, tmp_path: Path
) -> None:
    hands = both_hands()
    person = measure_person(*hands)
    arguments = MappingArguments()
    whole, _, followed = map_hands(hands, load_whole(ROBOT), person, arguments)
    assert not followed.all(axis=0).any()
    assert followed.any(axis=0).all()
    np.testing.assert_array_equal(motion.followed.rows(slice(None)), followed)
    expected = whole.all_columns
    assert [*expected] == [*motion.all_columns]
    for name, array in expected.items():
        stored = motion.all_columns[name]
        is_by_sample = len(array.shape) > 0 and len(array) == len(motion)
        assert isinstance(stored, DiskColumn) == is_by_sample, name
        rows = stored.rows(slice(None)) if isinstance(stored, DiskColumn) else stored
        assert rows.tobytes() == array.tobytes(), name
    summary = summarise_long(motion, motion.trajectory(slice(0, len(motion))))
    for name, value in summarise(whole).items():
        assert "cpu" in name or summary[name] == value, name


@pytest.mark.parametrize("start", [6.1, 5.0, 1.0])
def test_pairs_have_the_newest_sample_once_whatever_the_parts(start: float) -> None:
    right = hand("right", 200, 30.0, 5.0)
    left = hand("left", 130, 21.0, start)
    hands: dict[Side, Recording] = {"left": left, "right": right}
    rng = np.random.default_rng(3)
    expected = []
    # What is staler than `BEHIND` at the start is left out.
    before = int((left.time < right.time[0] - BEHIND).sum()) - 1
    for time in right.time.tolist():
        newest = int((left.time <= time).sum()) - 1
        is_new = newest > before
        expected.append(
            ({"left": left.time[newest]} if is_new else {}) | {"right": time}
        )
        before = newest
    assert {len(pair) for pair in expected} == {1, 2}

    def parts(recording: Recording) -> Iterator[Recording]:
        start = 0
        while start < len(recording):
            stop = start + int(rng.integers(1, 40))
            yield recording.part(slice(start, stop))
            start = stop

    found = [{s: sample.time for s, sample in pair.items()} for pair in paired(hands)]
    assert found == expected
    for _ in range(5):
        split = {side: parts(each) for side, each in hands.items()}
        found = [
            {side: sample.time for side, sample in pair.items()}
            for _, pairs in paired_parts(split, "right")
            for pair in pairs
        ]
        assert found == expected


def test_the_commands_write_the_same_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "both.npz"
    left, right = both_hands()
    # One file has instants of its own for each hand.
    write_recordings([left, right], file)
    found = []
    for name, shortest in (("long", 2), ("short", 10**6)):
        monkeypatch.setattr(f"{FORMATS}.long.SHORTEST", shortest)
        out = tmp_path / f"{name}.npz"
        words = ("--robot", ROBOT, "--out", str(out), "--json")
        assert main(["retarget", str(file), *words]) == 0
        folder = tmp_path / name
        words = ("--robot", ROBOT, "--out", str(folder), "--workers", "0")
        assert main(["batch", str(file), *words]) == 0
        (episode,) = (folder / "episodes").iterdir()
        manifest = (folder / "manifest.jsonl").read_text()
        metrics = manifest[manifest.index('"metrics"') :]
        found.append((out.read_bytes(), episode.read_bytes(), metrics))
    assert found[0] == found[1]


def test_overviews_of_hours_show_the_same_spans_of_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{FORMATS}.long._BLOCK_OF_BOTH", 10)
    # More than 240 samples together.
    left = hand("left", 133, 21.0, 5.0)
    right = hand("right", 190, 30.0, 5.0)
    long = opened([left, right], tmp_path)
    starts = np.linspace(0, 180, 12).astype(int)
    rows = np.concatenate([np.arange(start, start + 10) for start in starts])
    np.testing.assert_array_equal(long[1].overview.time, right.time[rows])
    spans = right.time[starts], right.time[starts + 9]
    is_inside = [
        (spans[0] <= time).sum() > (spans[1] < time).sum() for time in left.time
    ]
    np.testing.assert_array_equal(long[0].overview.time, left.time[is_inside])
    assert 60 < sum(is_inside) < 90
    for each in long:
        # Nothing goes on from one block to the next.
        assert (~each.overview.valid).sum() == 12


def test_samples_in_memory_of_a_short_recording_are_all(tmp_path: Path) -> None:
    left, right = both_hands()
    assert in_memory(left) is left
    assert all_long([left, right]) is None
    (file,) = written([right], tmp_path)
    long = find_source(file).read_long()
    pair = all_long([left, long])
    assert pair is not None
    assert pair[0].overview is left
    np.testing.assert_array_equal(
        np.concatenate([part.landmarks for part in pair[0].parts()]), left.landmarks
    )
    assert max(len(part) for part in pair[0].parts()) == PIECE


def test_overviews_of_both_hands_are_made_when_they_are_needed(tmp_path: Path) -> None:
    hands = both_hands()
    seen: list[int] = []
    found = read_long_hands(
        written(hands, tmp_path), check=lambda recording: seen.append(len(recording))
    )
    assert seen == [len(each) for each in hands]
    for expected in hands:
        light = found[expected.side]
        assert isinstance(light, LongRecording)
        assert len(light.overview) == PIECE
        assert len(light) == len(light.instants()) == len(expected)
        long = light.with_overview()
        assert long.with_overview() is long
        for recording in (long.overview, light.whole()):
            np.testing.assert_array_equal(recording.landmarks, expected.landmarks)
            np.testing.assert_array_equal(recording.steps, light.steps())


def test_memory_does_not_grow_with_the_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{FORMATS}.long.OVERVIEW", 150)
    monkeypatch.setattr(f"{FORMATS}.long._BLOCK", 12)
    monkeypatch.setattr(f"{FORMATS}.long._BLOCK_OF_BOTH", 6)
    monkeypatch.setattr(f"{FORMATS}.disk_columns._AT_ONCE", 1 << 14)
    person = measure_person(hand("right", 300, 30.0, 5.0))
    robot = load_whole(ROBOT)
    peaks: list[int] = []
    for count in (200, 600):
        hands = [hand(side, count, 30.0, 5.0) for side in ("left", "right")]
        files = written(hands, tmp_path)
        del hands
        with traced_peak(peaks):
            long = all_long([*read_long_hands(files).values()])
            assert long is not None
            out = tmp_path / "out.npz"
            with (
                map_long(long, robot, person, MappingArguments(), out) as found,
                out.open("wb") as stream,
            ):
                write_npz(stream, found.all_columns, is_compressed=False)
    # Instants and flags; a sample of both hands has 1000 bytes, and the robot's motion 4000.
    assert peaks[1] - peaks[0] < 200 * 400


def test_a_hand_of_a_robot_with_one_is_mapped_by_pieces(tmp_path: Path) -> None:
    right = hand("right", 120, 30.0, 5.0)
    (file,) = written([right], tmp_path)
    out = tmp_path / "out.npz"
    words = ["--robot", "three_finger", "--out", str(out)]
    assert main(["retarget", str(file), *words]) == 0
    assert len(np.load(out)["time"]) == len(right)
    assert load_hand("three_finger").parts == ()


def test_two_robots_do_not_have_their_motions_in_memory_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    motions: list[weakref.ref[Trajectory]] = []
    alive: list[int] = []
    read = LongMotion.trajectory

    def noted(motion: LongMotion, *blocks: slice) -> Trajectory:
        gc.collect()
        alive.append(sum(each() is not None for each in motions))
        found = read(motion, *blocks)
        motions.append(weakref.ref(found))
        return found

    monkeypatch.setattr(LongMotion, "trajectory", noted)
    files = [str(file) for file in written(both_hands(), tmp_path)]
    words = ["--robots", "allegro_left", "allegro_right", "--out", str(tmp_path)]
    assert main(["retarget", *files, *words, "--json"]) == 0
    assert alive == [0, 0]
