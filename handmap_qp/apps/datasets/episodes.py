"""Episodes of a batch: read a recording, map it, measure the episode, write and verify its file.

A job depends on nothing but its recording and the options, so its columns are the same bytes in any
process, in any order.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from hashlib import file_digest, sha256
from io import BytesIO
from pathlib import Path
from time import process_time
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from handmap_core.core import core
from handmap_core.errors import (
    DiskFullError,
    HandmapError,
    InvalidInputError,
    RecordingError,
    expect,
    reason_of,
)
from handmap_core.se3 import Array, Arrays
from handmap_qp.apps.offline.long_motion import map_long
from handmap_qp.apps.offline.look_ahead import look_ahead, look_ahead_parts
from handmap_qp.apps.offline.metrics import Metric
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.offline.trajectory import Trajectory, map_hands
from handmap_qp.hands import FINGERS, Hand, Values, load_whole
from handmap_qp.human import Person, Recording, newest_at, tip_gaps
from handmap_qp.output_files import make_folder, replaced_file, sync_all, writing
from handmap_qp.stream import measure_person
from handmap_qp.trackers import (
    OVERVIEW,
    DiskColumn,
    LongRecording,
    all_long,
    array_shapes,
    check_recording,
    hints,
    in_memory,
    read_archive,
    read_long_hands,
    read_rows,
    reading,
    recording_facts,
    write_npz,
)
from .manifest import Line
from .sources import BOTH, Job
from .workers import time_limit

_READING = 120
"""Longest time for which a worker reads a recording [s]."""
_COLUMNS = ("time", "q", "wrist", "valid")
"""What a data set for training is made of."""
MOST_SURFACES = 60
"""Surfaces are measured in at most this many samples, evenly spread."""
_CLOSED, _DEEP = 0.003, 0.001  # m
_PINCHING = 0.004  # m above the contact gap
MEASURES: tuple[Metric, ...] = msgspec.yaml.decode(
    Path(__file__).with_suffix(".yaml").read_bytes(), type=tuple[Metric, ...]
)
"""All measures, in the order of the report."""


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
    results: Values = {"status": "failed"}
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


def _run(job: Job) -> Values:
    """Map one recording, write its episode, and return the results for its line."""
    if not job.source:
        raise InvalidInputError(job.line.error)
    side = job.line.side
    options = job.options
    if side not in options.robots:
        raise InvalidInputError(
            f"there is no robot for the {side} hand", argument="--robot"
        )
    with time_limit(_READING * max(1.0, job.line.frames / OVERVIEW)):
        if side == BOTH:
            found = [*read_long_hands([job.line.path]).values()]
        else:
            found = [job.source.read_long()]
        long = all_long(found)
        recordings = [in_memory(each) for each in long or found]
    for recording in recordings:
        check_recording(recording)
    unusual = [hint for each in recordings for hint in hints(recording_facts(each))]
    robot = _robot(options.robots[side], options.arguments.robot_points)
    person = measure_person(*recordings)
    results: Values = {
        "status": "done",
        "task": recordings[0].task,
        "hints": tuple(unusual),
        "out": job.out,
    }
    if long:
        if options.look_ahead:
            # Free the overviews of the samples as they were before those of the smooth ones.
            del found, recordings
            long = [each.filtered(look_ahead_parts) for each in long]
        return results | _map_long(job, long, robot, person)
    if options.look_ahead:
        recordings = list(map(look_ahead, recordings))
    trajectory, _, valid = map_hands(recordings, robot, person, options.arguments)
    columns = {"side": np.array(side)}
    if side == BOTH:
        trajectory = _at_once(trajectory, valid)
        columns |= {"valid": valid, "wrist": _wrists(robot, trajectory.q)}
    metrics = measure_episode(recordings, robot, trajectory, person.contact_gap)
    return results | {
        "frames": len(trajectory.time),
        "metrics": metrics,
        "sha256": save_episode(job.folder / job.out, trajectory.columns | columns),
    }


def _at_once(trajectory: Trajectory, followed: Array) -> Trajectory:
    """Return a motion that is valid where both hands are followed.

    Args:
        trajectory: The motion.
        followed: Whether each hand was followed, shape (T, number of hands).

    Raises:
        InvalidInputError: If they never are.
    """
    at_once = followed.all(axis=1)
    expect(at_once.any(), "hands", "both at once", got="one at a time")
    return dataclasses.replace(trajectory, valid=at_once)


def _wrists(robot: Hand, q: Array) -> Array:
    """Return the wrist poses of all hands of a robot, shape (T, number of hands, 4, 4).

    Args:
        robot: The hands as one.
        q: Joint positions [rad or m], shape (T, n).
    """
    return np.array([[h.frame_pose("wrist", row) for h in robot.hands] for row in q])


def _map_long(
    job: Job, long: Sequence[LongRecording], robot: Hand, person: Person
) -> Values:
    """Map long recordings by pieces; measures are those of their overviews."""
    file = job.folder / job.out
    make_folder(file.parent, "--out")
    with map_long(
        long, robot, person, job.options.arguments, file, argument="--out"
    ) as motion:
        blocks = max(long, key=len).blocks
        trajectory = motion.trajectory(*blocks)
        columns = motion.columns | {"side": np.array(job.line.side)}
        if job.line.side == BOTH:
            trajectory = _at_once(trajectory, motion.followed.blocks(blocks))
            with writing(file, "--out"):
                wrists = motion.derive(lambda q: _wrists(robot, q))
            columns |= {"valid": motion.followed, "wrist": wrists}
        overviews = [each.overview for each in long]
        return {
            "frames": len(motion),
            "metrics": measure_episode(
                overviews, robot, trajectory, person.contact_gap
            ),
            "sha256": save_long_episode(file, columns),
        }


_robot = lru_cache(maxsize=8)(load_whole)
"""Loads a robot once in each process."""


@lru_cache(maxsize=8)
def _meter(robot: Hand) -> GapMeter | None:
    """Read the robot's surfaces once in each process; None if it has none that can be measured."""
    try:
        return GapMeter(robot)
    except HandmapError:
        return None


def measure_episode(
    recordings: Sequence[Recording],
    robot: Hand,
    trajectory: Trajectory,
    contact_gap: float,
) -> Values:
    """Measure an episode.

    Args:
        recordings: What each hand of the human did.
        robot: The robot whose hands follow them.
        trajectory: What the robot does, valid where it follows all of them.
        contact_gap: Gap of tip landmarks where the skin touches [m].

    Returns:
        Values by the keys of `MEASURES`, rounded to six digits, the worse one where they differ
        between hands; None where a question does not arise.
    """
    found = []
    for recording in recordings:
        newest = newest_at(recording.time, trajectory.time)
        found.append(
            core.measure_episode(
                _samples_at(recording, trajectory.time, newest),
                trajectory.valid,
                trajectory.point_error,
                trajectory.at_limit,
                trajectory.at_speed_limit,
                trajectory.q,
            )
        )
        if meter := _meter(robot.by_side[recording.side]):
            found[-1] |= _surfaces(recording, newest, trajectory, contact_gap, meter)
    rounded = {}
    for each in MEASURES:
        worse = np.fmax if each.better == "low" else np.fmin
        value = worse.reduce([values.get(each.key, np.nan) for values in found])
        rounded[each.key] = float(f"{value:.6g}") if np.isfinite(value) else None
    return rounded


def _samples_at(recording: Recording, time: Array, newest: Array) -> core.Samples:
    """Return the samples of a recording, one for each of T instants.

    Hands of different rates have different numbers of samples; the newest one at each instant
    counts, as it does where they are mapped.

    Args:
        recording: The recording.
        time: The instants [s], shape (T,).
        newest: Index of the newest sample at each of them, shape (T,).
    """
    if len(recording) == len(time):
        return core.Samples(recording.time, recording.landmarks, recording.valid)
    is_known = newest >= 0
    newest = np.maximum(newest, 0)
    valid = recording.valid[newest] & is_known
    return core.Samples(time, recording.landmarks[newest], valid)


def _surfaces(
    recording: Recording,
    newest: Array,
    trajectory: Trajectory,
    contact_gap: float,
    meter: GapMeter,
) -> Values:
    """Measure pinches and self-penetration in some of the samples."""
    count = len(trajectory.time)
    pinching = tip_gaps(recording.landmarks)[newest] < contact_gap + _PINCHING
    pinching &= trajectory.valid[:, None]
    pinches = np.flatnonzero(pinching.any(axis=1))
    chosen = pinches[:: -(-len(pinches) // MOST_SURFACES) or 1]
    gaps = meter.pinches(trajectory.q[chosen]) if len(chosen) else {}
    closed = [
        gaps[finger][pinching[chosen, i]] < _CLOSED
        for i, finger in enumerate(FINGERS[1:])
        if finger in gaps
    ]
    spread = np.linspace(0, count - 1, min(MOST_SURFACES, count)).astype(int)
    # Deeper overlaps than this are counted, and how deep they are is not asked.
    nearest = meter.nearest(trajectory.q[spread], most=-_DEEP)
    found = {"self_penetration": (nearest < -_DEEP).mean()}
    if any(map(len, closed)):
        found["pinch_closed"] = np.concatenate(closed).mean()
    return found


def save_episode(file: Path, columns: Arrays) -> str:
    """Write the columns of an episode.

    It is on the disk when its group is (`run_group`). Columns are not compressed: that would save a
    fifth of the space, and take as long as reading the recording.

    Returns:
        SHA-256 of the file, as `sha256sum` prints it.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    # Written at once: the parts of an archive, one by one, take twice as long.
    archive = BytesIO()
    np.savez(archive, allow_pickle=False, **columns)
    make_folder(file.parent, "--out")
    with replaced_file(file, "--out", is_synced=False) as stream:
        stream.write(archive.getbuffer())
    return sha256(archive.getbuffer()).hexdigest()


def save_long_episode(file: Path, columns: Mapping[str, Array | DiskColumn]) -> str:
    """Write the same bytes as `save_episode`, by pieces.

    Returns:
        SHA-256 of the file.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    with replaced_file(file, "--out", is_synced=False) as stream:
        write_npz(stream, columns, is_compressed=False)
    with writing(file, "--out"), file.open("rb") as stream:
        return file_digest(stream, "sha256").hexdigest()


class StoredEpisode(NamedTuple):
    """An episode on the disk, verified, whose columns are read by pieces.

    Attributes:
        file: Its file.
        time: Its instants [s], shape (T,).
    """

    file: Path
    time: Array

    def pieces(self) -> Iterator[Arrays]:
        """Read it from the start.

        Yields:
            `time`, `q`, `wrist` and `valid` of the next samples; the last two have one more axis
            for the hands of a robot with two.

        Raises:
            RecordingError: If the file was damaged after it had been verified.
        """
        for rows in read_rows(self.file, _COLUMNS, len(self.time)):
            yield dict(zip(_COLUMNS, rows, strict=True))


def open_episode(folder: Path, line: Line) -> StoredEpisode:
    """Verify an episode, to read what a data set for training needs of it.

    Args:
        folder: Folder of the batch.
        line: The episode's line in the manifest. Where it has no digest, as up to version 0.2, all
            arrays are read, because the archive has a checksum of each.

    Raises:
        RecordingError: If the file is missing, or is not what was written.
    """
    file = _verified(folder, line)
    return StoredEpisode(file, read_archive(file, {"time"})["time"])


def _verified(folder: Path, line: Line) -> Path:
    """Return the file of an episode, if it is what was written; see `open_episode`."""
    file = folder / line.out
    with reading(file), file.open("rb") as stream:
        is_same = line.sha256 in ("", file_digest(stream, "sha256").hexdigest())
    if not is_same:
        raise RecordingError("is not what was written: its digest differs", file=file)
    if not line.sha256:
        read_archive(file)
    # The digest is that of all numbers: they need not be read.
    shapes = array_shapes(file, {*_COLUMNS})
    for name in _COLUMNS:
        if shapes.get(name, ())[:1] != (line.frames,):
            raise RecordingError("is missing or torn", file=file, array=name)
    return file


def is_intact(folder: Path, line: Line) -> bool:
    """Return whether an episode is what was written; see `open_episode`."""
    try:
        _verified(folder, line)
    except RecordingError:
        return False
    return True
