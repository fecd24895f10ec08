"""Episodes of a batch: read a recording, map it, measure the episode, write and verify its file.

A job depends on nothing but its recording and the options, so its columns are the same bytes in any
process, in any order.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from hashlib import file_digest, sha256
from io import BytesIO
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from msgspec.structs import replace

from handmap_qp.apps.datasets.manifest import Line
from handmap_qp.apps.datasets.measures import measure_episode
from handmap_qp.apps.datasets.sources import Job
from handmap_qp.apps.datasets.workers import time_limit
from handmap_qp.apps.offline.look_ahead import map_hand
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.offline.trajectory import Trajectory
from handmap_qp.errors import (
    DiskFullError,
    HandmapError,
    InvalidInputError,
    RecordingError,
    reason_of,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.output_files import make_folder, replaced_file, sync_all, writing
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats.archive import read_archive
from handmap_qp.trackers.formats.base import reading
from handmap_qp.trackers.plausibility import check_recording

_READING = 120
"""Longest time for which a worker reads a recording [s]."""
_COLUMNS = ("time", "q", "wrist", "valid")
"""What a data set for training is made of."""


def run_group(jobs: Sequence[Job]) -> Sequence[Line]:
    """Run jobs of one batch one after the other; return their lines when episodes are on the disk.

    Raises:
        DiskFullError: If the disk is full.
        InvalidInputError: If they cannot be written for another reason.
    """
    folder = jobs[0].folder
    lines = [run_job(job) for job in jobs]
    with writing(folder, "--out"):
        sync_all([folder / line.out for line in lines if line.out])
    return lines


def run_job(job: Job) -> Line:
    """Map one recording and write its episode; return what happened, for the manifest.

    An error of the recording is a line, never an exception.

    Raises:
        DiskFullError: If the disk is full: no other recording of the batch can be written either.
    """
    started = process_time()
    results: dict[str, Any] = {"status": "failed"}
    try:
        results = _run(job)
    except DiskFullError:
        raise
    except HandmapError as error:
        results["error"] = reason_of(error)
    except Exception as error:  # a bug must not end the batch
        results["error"] = " ".join(f"{type(error).__name__}: {error}".split())
    cpu_s = round(process_time() - started, 6)
    return replace(job.line, kills=0, cpu_s=cpu_s, **results)


def _run(job: Job) -> dict[str, Any]:
    """Map one recording, write its episode, and return the results for its line."""
    if job.source is None:
        raise InvalidInputError(job.line.error)
    side = job.source.entry.side
    options = job.options
    if side not in options.robots:
        raise InvalidInputError(
            f"there is no robot for the {side} hand", argument="--robot"
        )
    with time_limit(_READING):
        recording = job.source.read()
    check_recording(recording)
    robot = _robot(options.robots[side], points=options.arguments.robot_points)
    person = measure_person(recording)
    recording, trajectory, _ = map_hand(
        recording, robot, person, options.arguments, smoother=options.smoother
    )
    metrics = measure_episode(recording, trajectory, person.contact_gap, _meter(robot))
    return {
        "status": "done",
        "frames": len(recording),
        "metrics": metrics,
        "out": job.out,
        "sha256": save_episode(job.folder / job.out, trajectory, side),
    }


_robot = lru_cache(maxsize=8)(load_hand)
"""Loads a robot once in each process."""


@lru_cache(maxsize=8)
def _meter(robot: Hand) -> GapMeter | None:
    """Read the robot's surfaces once in each process; None if it has none that can be measured."""
    try:
        return GapMeter(robot)
    except HandmapError:
        return None


def save_episode(file: Path, trajectory: Trajectory, side: str) -> str:
    """Write the columns of an episode, without those that a reader can compute again.

    It is on the disk when its group is (`run_group`). Columns are not compressed: that would save a
    fifth of the space, and take as long as reading the recording.

    Returns:
        SHA-256 of the file, as `sha256sum` prints it.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    columns = trajectory.columns | {"side": np.array(side)}
    # Written at once: the parts of an archive, one by one, take twice as long.
    archive = BytesIO()
    np.savez(archive, allow_pickle=False, **columns)
    make_folder(file.parent, "--out")
    with replaced_file(file, "--out", is_synced=False) as stream:
        stream.write(archive.getbuffer())
    return sha256(archive.getbuffer()).hexdigest()


def read_episode(folder: Path, line: Line) -> dict[str, np.ndarray]:
    """Verify an episode, and read what a data set for training needs of it.

    Args:
        folder: Folder of the batch.
        line: The episode's line in the manifest. Where it has no digest, as up to version 0.2, all
            arrays are read, because the archive has a checksum of each.

    Returns:
        `time`, `q`, `wrist` and `valid`, each with `line.frames` rows.

    Raises:
        RecordingError: If the file is missing, or is not what was written.
    """
    file = folder / line.out
    with reading(file), file.open("rb") as stream:
        is_same = line.sha256 in ("", file_digest(stream, "sha256").hexdigest())
    if not is_same:
        raise RecordingError("is not what was written: its digest differs", file=file)
    arrays = read_archive(file, _COLUMNS if line.sha256 else None)
    for name in _COLUMNS:
        if name not in arrays or arrays[name].shape[:1] != (line.frames,):
            raise RecordingError("is missing or torn", file=file, array=name)
    return {name: arrays[name] for name in _COLUMNS}


def is_intact(folder: Path, line: Line) -> bool:
    """Return whether an episode is what was written; see `read_episode`."""
    try:
        read_episode(folder, line)
    except RecordingError:
        return False
    return True
