"""Recordings as HDF5 in the form of robomimic: a group for each demonstration.

Written from its documentation (robomimic.github.io/docs/datasets/overview.html): the group `data`
has the attributes `total` and `env_args` (JSON); `data/demo_0` has the attribute `num_samples`, and
`obs` with an array (N, ...) for each observation.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from handmap_qp.errors import RecordingError, expect
from handmap_qp.human.recording import Recording
from handmap_qp.trackers.formats.base import (
    COLUMNS,
    Entry,
    RecordingFormat,
    build_recording,
    column,
    known_columns,
    side_of,
)
from handmap_qp.trackers.formats.hdf5 import (
    SUFFIXES,
    created,
    has_group,
    numbers,
    opened,
)


class RobomimicFormat(RecordingFormat):
    """A file with one demonstration for each hand and recording; lossless.

    `obs` of each demonstration has `landmarks (N, 63)` [m], `time (N,)` [s], `valid (N,)`, and
    where they are known `confidence (N,)` and `wrist (N, 12)`, the upper three rows of its pose.
    Name, side and source are attributes.
    """

    name = "robomimic"
    suffixes = SUFFIXES
    about = "HDF5 in the form of robomimic; lossless, any number of recordings"

    def recognises(self, path: Path) -> bool:
        """Tell whether the file has demonstrations."""
        return has_group(path, "data")

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the demonstrations by their numbers."""
        with opened(path) as file:
            demos = file["data"]
            names = sorted(demos, key=_number)
            return tuple(_entry(path, name, demos[name]) for name in names)

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one demonstration."""
        with opened(path) as file:
            demo = file["data"][entry.name]
            obs = demo["obs"]
            columns: dict[str, Any] = {}
            for name, names in COLUMNS.items():
                if name in obs or name == "time":
                    size = (len(names),) if len(names) > 1 else ()
                    if name == "landmarks" and len(obs[name].shape) == 3:
                        size = (len(names) // 3, 3)
                    columns[name] = numbers(path, obs, name, (entry.samples, *size))
            for key in ("name", "source"):
                columns[key] = str(demo.attrs.get(key, ""))
        prefix = f"data/{entry.name}/obs/"
        return build_recording(path, entry, **columns, prefix=prefix)

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name the arrays that a recording cannot hold."""
        with opened(path) as file:
            found: set[str] = set()
            for demo in file["data"].values():
                found |= {name for name in demo if name != "obs"}
                found |= {f"obs/{name}" for name in set(demo["obs"]) - set(COLUMNS)}
            return tuple(sorted(found))

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write each recording as a demonstration."""
        expect(recordings, "recordings", "at least one", got="none")
        with created(path) as file:
            data = file.create_group("data")
            data.attrs["total"] = sum(len(recording) for recording in recordings)
            env = {"env_name": "human_hand", "env_type": 2, "env_kwargs": {}}
            data.attrs["env_args"] = json.dumps(env)
            for i, recording in enumerate(recordings):
                demo = data.create_group(f"demo_{i}")
                demo.attrs["num_samples"] = len(recording)
                for key in ("name", "side", "source"):
                    demo.attrs[key] = getattr(recording, key)
                obs = demo.create_group("obs")
                for name in known_columns(recording):
                    values = column(recording, name)
                    obs[name] = values if values.shape[1] > 1 else values[:, 0]


def _number(name: str) -> tuple[int, str]:
    """Return the key that sorts `demo_2` before `demo_10`."""
    digits = re.fullmatch(r"demo_(\d{1,18})", name)
    return (int(digits.group(1)) if digits else -1, name)


def _entry(
    path: Path,
    name: str,
    demo: Any,
) -> Entry:
    found = demo["obs"] if hasattr(demo, "keys") and "obs" in demo else {}
    if "landmarks" not in found:
        names = ", ".join(sorted(found)) if hasattr(found, "name") else "no group obs"
        problem = f"has no landmarks; it has {names}"
        raise RecordingError(
            problem,
            file=path,
            array=f"data/{name}",
        )
    side = side_of(demo.attrs.get("side"), path, f"data/{name}")
    return Entry(name, side, len(found["landmarks"]))
