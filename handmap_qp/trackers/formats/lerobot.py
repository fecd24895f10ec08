"""Data sets in the form of LeRobot v3, and recordings as their episodes; written, not read.

Written from the documentation of LeRobotDataset v3.0 (huggingface.co/docs/lerobot):
`meta/info.json` with the features, `meta/stats.json`, `meta/tasks.parquet`,
`meta/episodes/chunk-000/` with a row for each episode, and `data/chunk-000/file-000.parquet` with a
row for each frame. pyarrow alone reads them.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handmap_core.errors import InvalidInputError, expect, require
from handmap_core.se3 import Array, Arrays
from handmap_qp.hands import Names, Values
from handmap_qp.human import Recording, finite_samples
from handmap_qp.output_files import check_new, make_folder, sync, writing
from .base import COLUMNS, WORDS, Entry, WrittenByPieces, column, known_columns
from .disk_columns import DiskColumn
from .long import LongRecording

VERSION = "v3.0"
_SAME_RATE = 1.25
"""Largest ratio of a recording's rate and that of its set: rates of webcams vary."""
_LEAST_SAMPLES = 16
"""Samples of a recording whose rate is judged: the steps of a few say nothing."""
DATA_FILE_SIZE = 100 * 2**20
"""Size from which a new data file is begun [bytes in memory]."""
CHUNK_FILES = 1000
"""Files of a chunk, which is a folder."""
_DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
_ROW_GROUP = 1000
_TASKS = Path(__file__).with_name("lerobot_tasks.json")
"""The columns of the tasks, as pandas describes them in its own files."""
_QUANTILES = {"min": 0.0, "max": 1.0} | {
    f"q{share:02d}": share / 100 for share in (1, 10, 50, 90, 99)
}
"""Quantiles by the names of LeRobot, some of whose policies are normalised by them."""


class Feature(NamedTuple):
    """One column of a data set.

    Attributes:
        dtype: `float64`, `float32`, `int64` or `bool`.
        names: Names of its numbers; empty for a single one without.
    """

    dtype: str
    names: Sequence[str] = ()

    @property
    def size(self) -> int:
        """How many numbers a frame has."""
        return max(1, len(self.names))

    def nbytes(self, count: int) -> int:
        """Return what so many frames take in memory; flags are packed [bytes]."""
        numbers = count * self.size
        bits = 1 if self.dtype == "bool" else 8 * np.dtype(self.dtype).itemsize
        return -(-bits * numbers // 8)


_INDICES = ("frame_index", "episode_index", "index", "task_index")


class LeRobotFormat(WrittenByPieces):
    """A folder with one episode for each hand and recording; lossless.

    LeRobot's own `timestamp` is the frame over `fps`; the tracker's instants are in
    `observation.time` [s]. The words about a recording are columns of `meta/episodes`.
    """

    name = "lerobot"
    suffixes: Names = ()

    def recognises(self, path: Path) -> bool:
        """Tell whether the folder has the description of a data set."""
        return (path / "meta" / "info.json").is_file()

    def entries(self, path: Path) -> Sequence[Entry]:
        """Refuse: no data set is read."""
        problem = "is a LeRobot data set, which is written and not read"
        advice = "read the recordings that it was made from"
        raise InvalidInputError(problem, advice=advice)

    def read(self, path: Path, entry: Entry) -> Recording:
        """Refuse: no data set is read."""
        raise NotImplementedError("entries refuses every path")

    def write_long(self, recordings: Sequence[LongRecording], path: Path) -> None:
        """Write each recording as an episode."""
        expect(recordings, "recordings", "at least one", got="none")
        fields = known_columns(*(each.overview for each in recordings))
        features = {
            f"observation.{field}": Feature(
                "bool" if field == "valid" else "float64", COLUMNS[field]
            )
            for field in fields
        }
        fps = _common_rate(recordings)
        kind = "human_hand"
        with writing_set(path, fps=fps, features=features, robot_type=kind) as writer:
            for recording in recordings:
                head = recording.overview
                parts = (
                    {f"observation.{name}": column(part, name) for name in fields}
                    for part in recording.parts()
                )
                about = {key: getattr(head, key) for key in ("name", "side", *WORDS)}
                task = head.task or f"{head.side} human hand"
                writer.add_parts(parts, len(recording), task, about)


def _common_rate(recordings: Sequence[LongRecording]) -> int:
    """Return the frames per second of recordings that have the same rate.

    LeRobot's time stamp is the frame over one rate of the whole set, so recordings of other rates
    would run too fast or too slow in it.

    Raises:
        InvalidInputError: If rates differ.
    """
    found = [recording.steps() for recording in recordings]
    fps = max(1, round(1.0 / np.median(np.concatenate(found))))
    judged = [steps for steps in found if len(steps) >= _LEAST_SAMPLES]
    rates = np.array([1.0 / np.median(steps) for steps in judged])
    is_same = (rates <= _SAME_RATE * fps) & (_SAME_RATE * rates >= fps)
    expect(
        is_same.all(),
        "recordings",
        "recordings of one rate",
        got=f"{rates.min(initial=fps):.3g} to {rates.max(initial=fps):.3g} samples/s",
        advice="write a set for each rate",
    )
    return fps


@contextmanager
def writing_set(
    root: Path,
    *,
    fps: float,
    features: Mapping[str, Feature],
    robot_type: str,
    argument: str = "path",
    overwrite: bool = False,
) -> Iterator[LeRobotWriter]:
    """Write a data set; the folder appears when the block has succeeded.

    Args:
        root: Folder to write; must not exist, or be empty, unless `overwrite`.
        fps: Frames per second of all episodes.
        features: Columns by name, without those that every data set has.
        robot_type: Name of the robot or hand.
        argument: Argument or option that names the folder, for errors.
        overwrite: Whether to replace a folder that exists.

    Raises:
        InvalidInputError: If the folder exists and is not empty, or cannot be written.
        MissingExtraError: If pyarrow is not installed.
    """
    is_free = overwrite or (root.is_dir() and not any(root.iterdir()))
    check_new(argument, root, overwrite=is_free, advice="remove it first")
    make_folder(root.parent, argument)
    with (
        writing(root, argument),
        tempfile.TemporaryDirectory(prefix=f".{root.name}-", dir=root.parent) as hidden,
    ):
        folder = Path(hidden) / root.name
        writer = LeRobotWriter(folder, fps, features)
        try:
            yield writer
            writer.finish(robot_type)
        finally:
            writer.abandon()
        for path in (*folder.rglob("*"), folder):
            sync(path)
        if overwrite:
            shutil.rmtree(root, ignore_errors=True)
        folder.rename(root)
        sync(root.parent)


class LeRobotWriter:
    """Writes a data set episode by episode; memory does not grow with their number.

    Nor does it grow with the length of an episode that is added by parts, but for the numbers of
    one joint at a time, whose quantiles are taken of all frames. See `writing_set`.
    """

    def __init__(
        self, folder: Path, fps: float, features: Mapping[str, Feature]
    ) -> None:
        self._pa = require("pyarrow", "files")
        self._pq = require("pyarrow.parquet", "files")
        self._folder = folder
        self._fps = fps
        indices = dict.fromkeys(_INDICES, Feature("int64"))
        self._features = {**features, "timestamp": Feature("float32"), **indices}
        self._tasks: dict[str, int] = {}
        self._stats: dict[str, Stats] = {}
        self._episodes: list[Values] = []
        self._episode_count = self._frame_count = self._file_index = self._file_size = 0
        self._open: Values = {}

    def add(self, columns: Arrays, task: str, about: Mapping[str, Any]) -> None:
        """Add an episode.

        Args:
            columns: An array (T,) or (T, n) for each feature.
            task: What is done in it, in words.
            about: Further values of the episode, for columns in `meta/episodes`; the same names in
                every episode.

        Raises:
            OSError: If the disk is full.
        """
        self.add_parts([columns], len(next(iter(columns.values()))), task, about)

    def add_parts(
        self,
        parts: Iterable[Arrays],
        count: int,
        task: str,
        about: Mapping[str, Any],
    ) -> None:
        """Add an episode by parts, each of which is a row group.

        Args:
            parts: Columns of consecutive frames, as of `add`; taken one by one.
            count: Number of frames of all parts, T.
            task: As of `add`.
            about: As of `add`.

        Raises:
            OSError: If the disk is full.
        """
        start = self._frame_count
        episode = self._episode_count
        number = self._tasks.setdefault(task, len(self._tasks))
        self._begin_episode(count)
        done = 0
        with closing(_EpisodeValues(self._folder, count)) as written:
            for columns in parts:
                size = len(next(iter(columns.values())))
                frames = np.arange(done, done + size)
                given = {
                    **columns,
                    "timestamp": frames / self._fps,
                    "frame_index": frames,
                    "episode_index": np.full_like(frames, episode),
                    "index": start + frames,
                    "task_index": np.full_like(frames, number),
                }
                values = {
                    name: np.asarray(given[name], dtype=feature.dtype)
                    for name, feature in self._features.items()
                }
                self._write_frames(values)
                written.add(values)
                done += size
            assert done == count
            stats = written.stats()
        self._frame_count += count
        self._episode_count += 1
        chunk, file = divmod(self._file_index, CHUNK_FILES)
        row = {
            "episode_index": episode,
            "tasks": [task],
            "length": count,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": start,
            "dataset_to_index": self._frame_count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            **about,
        }
        for name, own in stats.items():
            row |= {f"stats/{name}/{key}": each.tolist() for key, each in own.items()}
            self._stats[name] = joined_stats(self._stats.get(name), own)
        self._episodes.append(row)
        if len(self._episodes) >= _ROW_GROUP:
            self._write_episodes()

    def _begin_episode(self, count: int) -> None:
        """Begin a new file if the last one has no room for so many frames.

        Args:
            count: Number of frames of the episode, all of which are in one file.
        """
        size = sum(feature.nbytes(count) for feature in self._features.values())
        if self._file_size and self._file_size + size > DATA_FILE_SIZE:
            self._open.pop(self._data_path).close()
            self._file_size = 0
            self._file_index += 1
        self._file_size += size

    def _write_frames(self, values: Arrays) -> None:
        """Write frames of one episode as a row group, so that they are found without the others."""
        lists = self._pa.FixedSizeListArray
        arrays = {}
        for name, array in values.items():
            flat = self._pa.array(array.reshape(-1))
            size = self._features[name].size
            arrays[name] = lists.from_arrays(flat, size) if size > 1 else flat
        self._write(self._data_path, self._pa.table(arrays))

    @property
    def _data_path(self) -> str:
        chunk, file = divmod(self._file_index, CHUNK_FILES)
        return _DATA_PATH.format(chunk_index=chunk, file_index=file)

    def _write_episodes(self) -> None:
        if self._episodes:
            self._write(EPISODES_PATH, self._pa.Table.from_pylist(self._episodes))
            self._episodes.clear()

    def _write(self, place: str, table: Any) -> None:
        """Append a row group to a parquet file."""
        if place not in self._open:
            self._open[place] = self._pq.ParquetWriter(self._place(place), table.schema)
        writer = self._open[place]
        writer.write_table(table.cast(writer.schema), max(1, table.num_rows))

    def _place(self, place: str) -> Path:
        """Return a file of the data set, in a folder that exists."""
        file = self._folder / place
        file.parent.mkdir(parents=True, exist_ok=True)
        return file

    def finish(self, robot_type: str) -> None:
        """Write what describes all episodes of a robot or hand; `OSError` if the disk is full."""
        self._write_episodes()
        # With the index that pandas, and so LeRobot, reads the tasks by.
        about = json.loads(_TASKS.read_bytes())
        about["creator"]["version"] = self._pa.__version__
        columns = {"task_index": list(self._tasks.values()), "task": list(self._tasks)}
        metadata = {"pandas": json.dumps(about)}
        self._write("meta/tasks.parquet", self._pa.table(columns, metadata=metadata))
        info = {
            "codebase_version": VERSION,
            "robot_type": robot_type,
            "total_episodes": self._episode_count,
            "total_frames": self._frame_count,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": DATA_FILE_SIZE // 2**20,
            "video_files_size_in_mb": 500,
            "fps": self._fps if self._fps % 1.0 else int(self._fps),
            "splits": {"train": f"0:{self._episode_count}"},
            "data_path": _DATA_PATH,
            "video_path": None,
            "features": {
                name: {"dtype": f.dtype, "shape": [f.size], "names": f.names or None}
                for name, f in self._features.items()
            },
        }
        for name, values in (("info", info), ("stats", self._stats)):
            text = json.dumps(values, indent=1, default=Array.tolist) + "\n"
            self._place(f"meta/{name}.json").write_text(text, encoding="utf-8")
        for writer in self._open.values():
            writer.close()

    def abandon(self) -> None:
        """Leave open files as they are: pyarrow would write their ends when it is deleted."""
        for writer in self._open.values():
            writer.is_open = False


Stats = Arrays
"""Statistics of a column by the names that LeRobot gives them, shape (n,); `count` is (1,)."""


def episode_stats(values: Array) -> Stats:
    """Return the statistics of one episode, (T,) or (T, n), over the frames without NaN."""
    rows = values.reshape(len(values), -1).astype(float)
    rows = rows[finite_samples(rows)]
    count = len(rows)
    rows = rows if count else np.zeros((1, rows.shape[1]))
    quantiles = np.quantile(rows, list(_QUANTILES.values()), axis=0)
    return {
        **dict(zip(_QUANTILES, quantiles, strict=True)),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([count]),
    }


class _EpisodeValues:
    """The frames of an episode, of which `stats` is taken; on the disk if they come by parts.

    Args:
        folder: Where they are, in files without names.
        count: Number of frames of the episode.
    """

    def __init__(self, folder: Path, count: int) -> None:
        self._folder = folder
        self._count = count
        self._columns: dict[str, DiskColumn] = {}
        self._stats: dict[str, Stats] = {}

    def add(self, values: Arrays) -> None:
        """Take the next frames.

        Raises:
            OSError: If the disk is full.
        """
        for name, array in values.items():
            if len(array) == self._count:
                self._stats[name] = episode_stats(array)
                continue
            if name not in self._columns:
                self._columns[name] = DiskColumn(
                    self._folder, array.dtype, array.shape[1:]
                )
            self._columns[name].append(array)

    def stats(self) -> dict[str, Stats]:
        """Return the statistics of each column over all frames (`episode_stats`)."""
        return self._stats or {
            name: _stats_on_disk(values) for name, values in self._columns.items()
        }

    def close(self) -> None:
        """Remove the frames from the disk."""
        for values in self._columns.values():
            values.close()


def _stats_on_disk(values: DiskColumn) -> Stats:
    """Return `episode_stats`, with all frames of one number in memory at a time."""

    def matrices() -> Iterator[tuple[slice, Array]]:
        start = 0
        for rows in values.pieces():
            yield (
                slice(start, start + len(rows)),
                rows.reshape(len(rows), -1).astype(float),
            )
            start += len(rows)

    is_known = np.empty(len(values), dtype=bool)
    for frames, rows in matrices():
        is_known[frames] = finite_samples(rows)
    numbers = np.empty(len(values))
    found = []
    for k in range(int(np.prod(values.shape[1:], dtype=int))):
        for frames, rows in matrices():
            numbers[frames] = rows[:, k]
        # A frame without one of its numbers does not count.
        numbers[~is_known] = np.nan
        found.append(episode_stats(numbers))
    return {
        name: found[0][name]
        if name == "count"
        else np.concatenate([stats[name] for stats in found])
        for name in found[0]
    }


def joined_stats(one: Stats | None, other: Stats) -> Stats:
    """Return the statistics of both (Chan, Golub and LeVeque 1979).

    Quantiles are the means of the episodes' own, weighted by their frames, as LeRobot itself puts
    them together.
    """
    if one is None or not one["count"].all():
        return other
    if not other["count"].all():
        return one
    count = one["count"] + other["count"]
    share = other["count"] / count
    rest = 1.0 - share
    mixed = {name: rest * one[name] + share * other[name] for name in one}
    shift = other["mean"] - one["mean"]
    square = rest * one["std"] ** 2 + share * other["std"] ** 2
    return {
        **mixed,
        "min": np.minimum(one["min"], other["min"]),
        "max": np.maximum(one["max"], other["max"]),
        "std": np.sqrt(square + share * rest * shift**2),
        "count": count,
    }
