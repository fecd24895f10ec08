"""Data sets for training of episodes of hours are written by pieces: the same numbers."""

from __future__ import annotations

import json
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from lerobot_tables import columns_of, episodes_of
from long_cases import PIECE, shorten_pieces, traced_peak
from msgspec import structs
from scipy.spatial.transform import Rotation

from handmap_core.se3 import affine
from handmap_qp import load_hand
from handmap_qp.apps.datasets.assemble import assemble
from handmap_qp.apps.datasets.manifest import Line
from handmap_qp.hands import Hand, Side
from handmap_qp.trackers.formats import lerobot, long
from handmap_qp.trackers.formats.lerobot import Feature, LeRobotWriter, writing_set

HANDS = {"left": "allegro_left", "right": "allegro_right"}
RATE = 30.0
"""Samples a second of the episodes."""
FRAMES = 47.0
"""Frames a second of the data sets."""


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let episodes of seconds have many pieces."""
    shorten_pieces(monkeypatch)


@pytest.fixture
def hands() -> dict[str, Hand]:
    """The robots of both sides."""
    return {side: load_hand(name) for side, name in HANDS.items()}


def stored(folder: Path, side: Side, count: int, hand: Hand) -> Line:
    """Write an episode whose joints and wrist turn far, and which is not valid all the time."""
    rng = np.random.default_rng(len(side))
    time = 2.0 + np.cumsum(rng.uniform(0.5, 1.5, count)) / RATE
    turns = np.cumsum(rng.normal(scale=0.5, size=(count, 3)), axis=0)
    columns = {
        "time": time if side == "right" else 2.0 + np.arange(count) / RATE,
        "q": rng.uniform(*hand.limits, (count, len(hand.joint_names))),
        "wrist": affine(
            Rotation.from_rotvec(turns).as_matrix(), rng.normal(size=(count, 3))
        ),
        "valid": rng.random(count) > 0.1,
    }
    file = folder / f"episodes/{side}.npz"
    file.parent.mkdir(exist_ok=True)
    np.savez(file, allow_pickle=False, **columns)
    return Line(
        f"take.hdf5::{side}",
        "done",
        path="take.hdf5",
        size=1,
        mtime_ns=1,
        options="",
        side=side,
        frames=count,
        out=f"episodes/{side}.npz",
        sha256=sha256(file.read_bytes()).hexdigest(),
    )


def at_instants(folder: Path, line: Line, time: np.ndarray) -> Line:
    """Let an episode have other instants [s]."""
    file = folder / line.out
    columns = dict(np.load(file))
    np.savez(file, allow_pickle=False, **columns | {"time": time})
    return structs.replace(line, sha256=sha256(file.read_bytes()).hexdigest())


@pytest.mark.parametrize("count", [1, PIECE - 1, PIECE, PIECE + 1, 330])
@pytest.mark.parametrize("is_both", [True, False])
def test_lerobot_has_the_same_frames_and_statistics(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    hands: dict[str, Hand],
    count: int,
    *,
    is_both: bool,
) -> None:
    pytest.importorskip("pyarrow")
    lines = [stored(tmp_path, side, count, hands[side]) for side in ("left", "right")]
    if is_both:
        time = 2.0 + np.cumsum(np.linspace(0.5, 1.5, count)) / RATE
        lines = [at_instants(tmp_path, line, time) for line in lines]
    found = []
    for size in (PIECE, 10**6):
        monkeypatch.setattr(long, "PIECE", size)
        root = assemble(lines, tmp_path, "lerobot", FRAMES, hands)
        episodes = range(1 if is_both else 2)
        frames = [columns_of(root, i) for i in episodes]
        stats = json.loads((root / "meta/stats.json").read_text())
        found.append((frames, episodes_of(root), stats))
    (frames, about, stats), (whole, whole_about, whole_stats) = found
    for own, expected in zip(frames, whole, strict=True):
        assert own.keys() == expected.keys()
        for name, array in expected.items():
            assert own[name].tobytes() == array.tobytes(), name
    for row, whole_row in zip(about, whole_about, strict=True):
        assert row.keys() == whole_row.keys()
        for name, value in whole_row.items():
            if name.endswith(("/mean", "/std")):
                # Sums in another order.
                np.testing.assert_allclose(row[name], value, rtol=1e-12, atol=1e-12)
            else:
                assert row[name] == value, name
    for name, values in whole_stats.items():
        for key, value in values.items():
            np.testing.assert_allclose(
                stats[name][key], value, rtol=1e-12, atol=1e-12, err_msg=f"{name} {key}"
            )


@pytest.mark.parametrize("count", [1, PIECE + 1, 330])
def test_robomimic_has_the_same_arrays(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    hands: dict[str, Hand],
    count: int,
) -> None:
    h5py = pytest.importorskip("h5py")
    line = stored(tmp_path, "right", count, hands["right"])
    found = []
    for size in (PIECE, 10**6):
        monkeypatch.setattr(long, "PIECE", size)
        file = assemble([line], tmp_path, "robomimic", FRAMES, hands)
        arrays: dict[str, np.ndarray] = {}
        with h5py.File(file) as opened:
            demo = opened["data/demo_0"]
            names: list[str] = []
            demo.visit(names.append)
            for name in names:
                if isinstance(demo[name], h5py.Dataset):
                    arrays[name] = demo[name][()]
            assert demo.attrs["num_samples"] == len(arrays["states"])
        found.append(arrays)
    assert found[0].keys() == found[1].keys()
    for name, array in found[1].items():
        assert found[0][name].dtype == array.dtype
        assert found[0][name].tobytes() == array.tobytes(), name
    states, arrays = found[0]["states"], found[0]
    after = np.concatenate([states[1:], states[-1:]])
    for name in ("actions", "next_obs/state"):
        np.testing.assert_array_equal(arrays[name], after)


def test_frames_of_a_long_gap_come_by_pieces_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hands: dict[str, Hand]
) -> None:
    pytest.importorskip("pyarrow")
    line = stored(tmp_path, "right", 3, hands["right"])
    line = at_instants(tmp_path, line, np.array([0.0, 0.1, 60.0]))
    sizes: list[int] = []
    write = LeRobotWriter._write_frames

    def noted(writer: LeRobotWriter, values: dict[str, np.ndarray]) -> None:
        sizes.append(len(values["action"]))
        write(writer, values)

    monkeypatch.setattr(LeRobotWriter, "_write_frames", noted)
    assemble([line], tmp_path, "lerobot", FRAMES, hands)
    assert sum(sizes) == 60 * FRAMES + 1
    assert max(sizes) == PIECE


@pytest.mark.parametrize("form", ["lerobot", "robomimic"])
def test_memory_does_not_grow_with_an_episode(
    form: Literal["lerobot", "robomimic"],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    hands: dict[str, Hand],
) -> None:
    pytest.importorskip("pyarrow" if form == "lerobot" else "h5py")
    monkeypatch.setattr("handmap_qp.trackers.formats.disk_columns._AT_ONCE", 1 << 14)
    right = {"right": hands["right"]}
    peaks: list[int] = []
    for count in (500, 2000, 8000):
        line = stored(tmp_path, "right", count, hands["right"])
        with traced_peak(peaks):
            assemble([line], tmp_path, form, RATE, right)
    # Instants, and the numbers of one joint; a frame has 23 numbers as state and as action, and a
    # sample 33.
    assert peaks[2] - peaks[1] < 100 * 6000


@pytest.mark.parametrize("size", [1, 3])
def test_statistics_by_parts_are_those_of_all_frames(tmp_path: Path, size: int) -> None:
    pytest.importorskip("pyarrow")
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=(40, size)).astype(np.float32)
    # Frames without a number do not count.
    numbers[5, 0] = np.nan
    numbers[30:33] = np.nan
    lost = np.full((40, size), np.nan, dtype=np.float32)
    columns = {"some": numbers.squeeze(), "none": lost.squeeze()}
    names = "abc"[:size] if size > 1 else ""
    features = dict.fromkeys(columns, Feature("float32", tuple(names)))
    found = []
    for ends in ([], [7, 8, 31]):
        root = tmp_path / f"{len(ends)}"
        with writing_set(
            root, fps=RATE, features=features, robot_type="hand"
        ) as writer:
            split = {name: np.split(rows, ends) for name, rows in columns.items()}
            parts = [
                {name: rows[i] for name, rows in split.items()}
                for i in range(len(ends) + 1)
            ]
            writer.add_parts(parts, 40, "task", {})
        found.append(json.loads((root / "meta/stats.json").read_text()))
        assert not [*root.rglob("tmp*")]
    for name, values in found[0].items():
        for key, value in values.items():
            np.testing.assert_allclose(found[1][name][key], value, atol=1e-12)
    assert found[1]["some"]["count"] == [36]
    assert found[1]["none"]["count"] == [0]


def test_an_episode_is_in_one_file_whose_size_is_known_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    tables: list[int] = []
    write = LeRobotWriter._write

    def noted(writer: LeRobotWriter, place: str, table: Any) -> None:
        if place.startswith("data"):
            tables.append(table.nbytes)
        write(writer, place, table)

    monkeypatch.setattr(LeRobotWriter, "_write", noted)
    features = {
        "state": Feature("float32", ("a", "b", "c")),
        "seen": Feature("bool", ("left", "right", "both")),
        "alone": Feature("bool"),
    }
    every = {**features, "timestamp": Feature("float32")}
    every |= dict.fromkeys(lerobot._INDICES, Feature("int64"))
    parts = [
        {
            "state": np.zeros((count, 3)),
            "seen": np.zeros((count, 3)),
            "alone": np.zeros(count),
        }
        for count in (13, 14)
    ]
    size = sum(feature.nbytes(27) for feature in every.values())
    monkeypatch.setattr(lerobot, "DATA_FILE_SIZE", size)
    root = tmp_path / "set"
    with writing_set(root, fps=RATE, features=features, robot_type="hand") as writer:
        writer.add(parts[0], "task", {})
        writer.add_parts(parts, 27, "task", {})
        writer.add(parts[1], "task", {})
    assert tables[0] == sum(feature.nbytes(13) for feature in every.values())
    assert tables[3] == sum(feature.nbytes(14) for feature in every.values())
    files = [row["data/file_index"] for row in episodes_of(root)]
    # The second one fills a file alone.
    assert files == [0, 1, 2]
    assert len(columns_of(root, 1)["state"]) == 27
