"""Write data sets in the form of LeRobot v3: many episodes in a few parquet files, and `meta/`.

Written from the documentation of LeRobotDataset v3.0 (huggingface.co/docs/lerobot):
`meta/info.json` with the features, `meta/stats.json`, `meta/tasks.parquet`,
`meta/episodes/chunk-000/` with a row for each episode, and `data/chunk-000/file-000.parquet` with a
row for each frame. pyarrow alone reads them.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.output_files import make_folder, sync, writing
from handmap_qp.trackers.formats.base import require

VERSION = "v3.0"
DATA_FILE_SIZE = 100 * 2**20
"""Size from which a new data file is begun [bytes in memory]."""
CHUNK_FILES = 1000
"""Files of a chunk, which is a folder."""
_DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
_ROW_GROUP = 1000


class Feature(NamedTuple):
    """One column of a data set.

    Attributes:
        dtype: `float64`, `float32`, `int64`, `bool` or `string`.
        names: Names of its numbers; None for a single one.
    """

    dtype: str
    names: tuple[str, ...] | None = None

    @property
    def size(self) -> int:
        """How many numbers a frame has."""
        return 1 if self.names is None else len(self.names)


_INDEX_FEATURES = {
    "timestamp": Feature("float32"),
    "frame_index": Feature("int64"),
    "episode_index": Feature("int64"),
    "index": Feature("int64"),
    "task_index": Feature("int64"),
}


class LeRobotWriter:
    """Writes a data set episode by episode; memory does not grow with their number.

    Use as a context manager. The folder appears when the block has succeeded.

    Args:
        root: Folder to write; must not exist, or be empty.
        fps: Frames per second of all episodes.
        features: Columns by name, without those that every data set has.
        robot_type: Name of the robot or hand.
        argument: Argument or option that names the folder, for errors.

    Raises:
        InvalidInputError: If the folder exists and is not empty, or cannot be written.
        MissingExtraError: If pyarrow is not installed.
    """

    def __init__(
        self,
        root: Path,
        *,
        fps: float,
        features: Mapping[str, Feature],
        robot_type: str,
        argument: str = "path",
    ) -> None:
        self._pa, self._pq = require("pyarrow"), require("pyarrow.parquet")
        if root.exists() and (not root.is_dir() or any(root.iterdir())):
            raise InvalidInputError(
                argument=argument, problem=f"{root} exists already", advice="remove it first"
            )
        self._root, self._argument = root, argument
        self._fps, self._robot_type = fps, robot_type
        self._features = {**features, **_INDEX_FEATURES}
        self._tasks: dict[str, int] = {}
        self._stats = {name: _Stats() for name, item in self._numeric()}
        self._episodes: list[dict[str, Any]] = []
        self._episode_count = self._frame_count = self._file_index = self._file_size = 0
        self._data: Any = None
        self._meta: Any = None

    def __enter__(self) -> Self:
        parent = self._root.parent
        make_folder(parent, self._argument)
        with writing(self._root, self._argument):
            self._folder = Path(tempfile.mkdtemp(prefix=f".{self._root.name}-", dir=parent))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                with writing(self._root, self._argument):
                    self._finish()
                    if self._root.exists():
                        self._root.rmdir()
                    self._folder.chmod(0o755)
                    for path in (*self._folder.rglob("*"), self._folder):
                        sync(path)
                    self._folder.rename(self._root)
                    sync(self._root.parent)
        finally:
            for writer in (self._data, self._meta):
                if writer is not None:
                    # After an error, pyarrow would write its last part when it is deleted.
                    writer.is_open = False
            shutil.rmtree(self._folder, ignore_errors=True)

    def add(
        self, columns: Mapping[str, np.ndarray], task: str, about: Mapping[str, Any] | None = None
    ) -> int:
        """Add an episode.

        Args:
            columns: An array (T,) or (T, n) for each feature.
            task: What is done in it, in words.
            about: Further values of the episode, for columns in `meta/episodes`; the same names in
                every episode.

        Returns:
            Index of the episode.

        Raises:
            InvalidInputError: If the disk is full.
        """
        count = len(next(iter(columns.values())))
        task_index = self._tasks.setdefault(task, len(self._tasks))
        start, episode = self._frame_count, self._episode_count
        frames = np.arange(count)
        values = {
            **{name: np.asarray(columns[name]) for name in self._features if name in columns},
            "timestamp": (frames / self._fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(count, episode),
            "index": start + frames,
            "task_index": np.full(count, task_index),
        }
        table = self._table(values)
        with writing(self._root, self._argument):
            self._write_data(table)
            stats = {name: _Stats.of(values[name]) for name, _ in self._numeric()}
            for name, own in stats.items():
                self._stats[name].add(own)
            self._episodes.append(
                {
                    "episode_index": episode,
                    "tasks": [task],
                    "length": count,
                    "data/chunk_index": self._file_index // CHUNK_FILES,
                    "data/file_index": self._file_index % CHUNK_FILES,
                    "dataset_from_index": start,
                    "dataset_to_index": start + count,
                    "meta/episodes/chunk_index": 0,
                    "meta/episodes/file_index": 0,
                    **(about or {}),
                    **{
                        f"stats/{name}/{key}": value
                        for name, own in stats.items()
                        for key, value in own.as_dict().items()
                    },
                }
            )
            if len(self._episodes) >= _ROW_GROUP:
                self._flush_episodes()
        self._frame_count += count
        self._episode_count += 1
        return episode

    def _numeric(self) -> list[tuple[str, Feature]]:
        return [(name, item) for name, item in self._features.items() if item.dtype != "string"]

    def _table(self, values: Mapping[str, np.ndarray]) -> Any:
        pa, arrays = self._pa, []
        for name, feature in self._features.items():
            kind = pa.type_for_alias(feature.dtype)
            if feature.names is None:
                arrays.append(pa.array(values[name].reshape(-1), type=kind))
            else:
                flat = pa.array(np.ascontiguousarray(values[name]).reshape(-1), type=kind)
                arrays.append(pa.FixedSizeListArray.from_arrays(flat, feature.size))
        return pa.Table.from_arrays(arrays, names=list(self._features))

    def _write_data(self, table: Any) -> None:
        """Write an episode as a row group of its own, so that it is found without the others."""
        if self._data is not None and self._file_size + table.nbytes > DATA_FILE_SIZE:
            self._data.close()
            self._data, self._file_size = None, 0
            self._file_index += 1
        if self._data is None:
            place = _DATA_PATH.format(
                chunk_index=self._file_index // CHUNK_FILES,
                file_index=self._file_index % CHUNK_FILES,
            )
            file = self._folder / place
            file.parent.mkdir(parents=True, exist_ok=True)
            self._data = self._pq.ParquetWriter(file, table.schema, compression="snappy")
        self._data.write_table(table, row_group_size=max(1, table.num_rows))
        self._file_size += table.nbytes

    def _flush_episodes(self) -> None:
        if not self._episodes:
            return
        table = self._pa.Table.from_pylist(self._episodes)
        if self._meta is None:
            file = self._folder / _EPISODES_PATH
            file.parent.mkdir(parents=True, exist_ok=True)
            self._meta = self._pq.ParquetWriter(file, table.schema, compression="snappy")
        self._meta.write_table(table.cast(self._meta.schema))
        self._episodes.clear()

    def _finish(self) -> None:
        self._flush_episodes()
        meta = self._folder / "meta"
        meta.mkdir(exist_ok=True)
        self._write_tasks(meta / "tasks.parquet")
        stats = {name: own.as_dict() for name, own in self._stats.items()}
        (meta / "stats.json").write_text(json.dumps(stats, indent=1) + "\n", encoding="utf-8")
        info = {
            "codebase_version": VERSION,
            "robot_type": self._robot_type,
            "total_episodes": self._episode_count,
            "total_frames": self._frame_count,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": DATA_FILE_SIZE // 2**20,
            "video_files_size_in_mb": 500,
            "fps": int(self._fps) if float(self._fps).is_integer() else self._fps,
            "splits": {"train": f"0:{self._episode_count}"},
            "data_path": _DATA_PATH,
            "video_path": None,
            "features": {
                name: {
                    "dtype": item.dtype,
                    "shape": [item.size],
                    "names": None if item.names is None else list(item.names),
                }
                for name, item in self._features.items()
            },
        }
        (meta / "info.json").write_text(json.dumps(info, indent=4) + "\n", encoding="utf-8")
        for writer in (self._data, self._meta):
            if writer is not None:
                writer.close()

    def _write_tasks(self, file: Path) -> None:
        """Write the tasks with the index that pandas, and so LeRobot, reads them by."""
        columns = {"task_index": list(self._tasks.values()), "task": list(self._tasks)}
        table = self._pa.table(columns)
        kinds = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        about = {
            "index_columns": ["task"],
            "column_indexes": [],
            "columns": [
                {
                    "name": name,
                    "field_name": name,
                    "pandas_type": kind,
                    "numpy_type": own,
                    "metadata": None,
                }
                for name, kind, own in kinds
            ],
            "creator": {"library": "pyarrow", "version": self._pa.__version__},
            "pandas_version": "2.0.0",
        }
        self._pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), file)


_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""Quantiles by the names of LeRobot, some of whose policies are normalised by them."""


class _Stats:
    """Least, largest, mean, standard deviation and quantiles of a column.

    Quantiles of many episodes are the means of the episodes' own, weighted by their frames, as
    LeRobot itself puts them together.
    """

    def __init__(self) -> None:
        self._count = 0
        self._low = self._high = self._mean = self._square = np.zeros(0)
        self._quantiles = np.zeros((len(_QUANTILES), 0))

    @classmethod
    def of(cls, values: np.ndarray) -> Self:
        """Return those of one episode, (T,) or (T, n), over the frames without NaN."""
        own, rows = cls(), values.reshape(len(values), -1).astype(float)
        rows = rows[np.isfinite(rows).all(axis=1)]
        if (count := len(rows)) == 0:
            own._low = own._high = own._mean = own._square = np.zeros(rows.shape[1])
            own._quantiles = np.zeros((len(_QUANTILES), rows.shape[1]))
            return own
        own._count = count
        own._low, own._high, own._mean = rows.min(axis=0), rows.max(axis=0), rows.mean(axis=0)
        own._square = np.square(rows - own._mean).sum(axis=0)
        own._quantiles = np.quantile(rows, list(_QUANTILES.values()), axis=0)
        return own

    def add(self, other: _Stats) -> None:
        """Add those of an episode (Chan, Golub and LeVeque 1979)."""
        if self._count == 0 or other._count == 0:
            if self._count == 0:
                self.__dict__.update(other.__dict__)
            return
        count = self._count + other._count
        shift = other._mean - self._mean
        self._low = np.minimum(self._low, other._low)
        self._high = np.maximum(self._high, other._high)
        self._square = (
            self._square + other._square + shift**2 * (self._count * other._count / count)
        )
        self._mean = self._mean + shift * (other._count / count)
        share = other._count / count
        self._quantiles = self._quantiles + share * (other._quantiles - self._quantiles)
        self._count = count

    def as_dict(self) -> dict[str, list[float]]:
        """Return the numbers by the names that LeRobot gives them."""
        spread = np.sqrt(self._square / max(1, self._count))
        values = {"min": self._low, "max": self._high, "mean": self._mean, "std": spread}
        values |= dict(zip(_QUANTILES, self._quantiles, strict=True))
        lists: dict[str, list[float]] = {name: a.tolist() for name, a in values.items()}
        return {**lists, "count": [self._count]}
