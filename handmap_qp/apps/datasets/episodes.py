"""Episodes of a batch: read a recording, map it, measure the episode, write and verify its file.

A job depends on nothing but its recording and the options, so its columns are the same bytes in any
process, in any order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import file_digest, sha256
from io import BytesIO
from pathlib import Path
from time import process_time
from typing import Any

import msgspec
import numpy as np

from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.datasets.manifest import Line, Status
from handmap_qp.apps.datasets.measures import measure_episode
from handmap_qp.apps.datasets.sources import Task
from handmap_qp.apps.datasets.workers import time_limit
from handmap_qp.apps.offline.look_ahead import LookAhead, map_hand
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.offline.trajectory import Trajectory
from handmap_qp.apps.refusals import naming
from handmap_qp.errors import (
    DiskFullError,
    HandmapError,
    InvalidInputError,
    RecordingError,
    reason_of,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.sources import urdf_path
from handmap_qp.hands.spec import Side
from handmap_qp.output_files import make_folder, replaced_file, sync_all, writing
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats.archive import read_archive
from handmap_qp.trackers.formats.base import reading
from handmap_qp.trackers.plausibility import check_recording

_READING = 120
"""Longest time for which a worker reads a recording [s]."""
_COLUMNS = ("time", "q", "wrist", "valid")
"""What a data set for training is made of."""


@dataclass(frozen=True)
class JobOptions:
    """What all jobs of a batch have in common.

    Attributes:
        robots: Name of the robot hand for each human hand.
        arguments: Reference points and options of the mapping.
        smoother: How the whole recording is used to smooth and to fill gaps; None for a mapping
            that knows the past only, as online.
    """

    robots: dict[Side, str]
    arguments: MappingArguments = field(default_factory=MappingArguments)
    smoother: LookAhead | None = None

    def load_robot(self, side: Side) -> Hand:
        """Load the robot hand of a side, with its reference points.

        Raises:
            HandError: If there is no such hand.
        """
        return self.arguments.load_robot(self.robots[side])

    @property
    def digest(self) -> str:
        """A short text that changes if the robots, their URDFs or the options do."""
        digest = sha256(repr((self.arguments, self.smoother)).encode())
        files = [self.arguments.options] if self.arguments.options else []
        for side in sorted(self.robots):
            robot = self.load_robot(side)
            digest.update(side.encode() + msgspec.json.encode(robot.spec, enc_hook=str))
            files.append(urdf_path(robot.spec))
        for file in files:
            with naming("--options", f"{file}: cannot be read"):
                digest.update(file.read_bytes())
        return digest.hexdigest()[:16]


@dataclass(frozen=True)
class Job:
    """A task with what it needs.

    Attributes:
        task: The recording.
        options: The options.
        digest: Their digest.
        folder: Folder of the batch.
    """

    task: Task
    options: JobOptions
    digest: str
    folder: Path

    def line(self, status: Status, **results: Any) -> Line:
        """Return a line of the manifest about this job; results are its fields by name."""
        task = self.task
        file = task.file
        side = task.side or ""
        frames = results.pop("frames", task.frames)
        return Line(
            task.key,
            status,
            str(file.path),
            file.size,
            file.mtime_ns,
            self.digest,
            task.entries,
            side,
            self.options.robots.get(side, ""),
            frames,
            **results,
        )


def run_job(job: Job) -> Line:
    """Map one recording and write its episode.

    Args:
        job: The job.

    Returns:
        What happened, for the manifest. An error of the recording is a line, never an exception.

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
    return job.line(**results, cpu_s=round(process_time() - started, 6))


def _run(job: Job) -> dict[str, Any]:
    """Map one recording, write its episode, and return the results for its line."""
    task = job.task
    if task.source is None or task.side is None:
        raise InvalidInputError(task.error)
    options = job.options
    if task.side not in options.robots:
        raise InvalidInputError(
            f"there is no robot for the {task.side} hand", argument="--robot"
        )
    with time_limit(_READING):
        recording = task.source.read()
    check_recording(recording)
    robot = _robot(options.robots[task.side], points=options.arguments.robot_points)
    person = measure_person(recording)
    recording, trajectory, _ = map_hand(
        recording, robot, person, options.arguments, smoother=options.smoother
    )
    metrics = measure_episode(recording, trajectory, person.contact_gap, _meter(robot))
    digest = save_episode(job.folder / task.out, trajectory, task.side)
    return {
        "status": "done",
        "frames": len(recording),
        "metrics": metrics,
        "out": task.out,
        "sha256": digest,
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
    """Write the columns of an episode, without those that a reader can compute again; see `synced`.

    They are not compressed: that would save a fifth of the space, and take as long as reading the
    recording.

    Args:
        file: The file; its folder is made.
        trajectory: What the robot does.
        side: Which hand.

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


def synced(folder: Path, lines: Sequence[Line]) -> Sequence[Line]:
    """Return lines for the manifest when their episodes are on the disk.

    Raises:
        DiskFullError: If the disk is full.
        InvalidInputError: If they cannot be written for another reason.
    """
    with writing(folder, "--out"):
        sync_all([folder / line.out for line in lines if line.out])
    return lines


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
