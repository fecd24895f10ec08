"""LeRobot data sets as pyarrow reads them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np


def feature_names(root: Path, feature: str) -> list[str]:
    """Return the names of a feature's numbers."""
    info = json.loads((root / "meta" / "info.json").read_text(encoding="utf-8"))
    return info["features"][feature]["names"]


def episodes_of(root: Path) -> list[dict[str, Any]]:
    """Return the rows of `meta/episodes`."""
    from pyarrow import parquet

    (file,) = root.glob("meta/episodes/*/*.parquet")
    return parquet.read_table(file).to_pylist()


def columns_of(root: Path, episode: int) -> dict[str, np.ndarray]:
    """Return the columns of an episode, shape (T,) or (T, n)."""
    from pyarrow import parquet

    wanted = [("episode_index", "=", episode)]
    table = parquet.read_table(root / "data", filters=wanted)
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}
