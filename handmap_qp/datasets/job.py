"""One job of a batch: read a recording, map it, measure the episode, write it.

A job depends on nothing but its recording and the options, so its columns are the same bytes in any
process, in any order.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from time import process_time

import msgspec

from handmap_qp.arguments import MappingArguments
from handmap_qp.datasets.episode_files import save_episode
from handmap_qp.datasets.manifest import Line, Status
from handmap_qp.datasets.measures import measure_episode
from handmap_qp.datasets.sources import Task
from handmap_qp.errors import DiskFullError, HandmapError, InvalidInputError
from handmap_qp.hands.hand import Hand, urdf_path
from handmap_qp.hands.spec import Side
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.offline.look_ahead import LookAhead, look_ahead, map_both_ways
from handmap_qp.offline.surface_gaps import GapMeter
from handmap_qp.offline.trajectory import Trajectory, map_recording
from handmap_qp.trackers.landmarks import scaled_human
from handmap_qp.trackers.person import Person, measure_person
from handmap_qp.trackers.plausibility import check_recording
from handmap_qp.trackers.recording import Recording


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
        digest = hashlib.sha256(repr((self.arguments, self.smoother)).encode())
        files = [self.arguments.options] if self.arguments.options else []
        for side in sorted(self.robots):
            robot = self.load_robot(side)
            digest.update(side.encode() + msgspec.json.encode(robot.spec, enc_hook=str))
            files.append(urdf_path(robot.spec))
        for file in files:
            try:
                digest.update(file.read_bytes())
            except OSError as error:
                problem = f"{file}: cannot be read: {error.strerror or error}"
                raise InvalidInputError(argument="--options", problem=problem) from error
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

    def line(self, status: Status, *, error: str = "", kills: int = 0, cpu_s: float = 0.0) -> Line:
        """Return a line of the manifest about this job, without results."""
        task = self.task
        side = task.side or ""
        return Line(
            key=task.key,
            status=status,
            path=str(task.file.path),
            size=task.file.size,
            mtime_ns=task.file.mtime_ns,
            options=self.digest,
            entries=task.entries,
            side=side,
            robot=self.options.robots.get(task.side, "") if task.side else "",
            frames=task.frames,
            cpu_s=round(cpu_s, 6),
            kills=kills,
            error=error,
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
    try:
        return _run(job, started)
    except DiskFullError:
        raise
    except HandmapError as error:
        text = " ".join(str(error).split())
    except Exception as error:  # a bug must not end the batch
        text = " ".join(f"{type(error).__name__}: {error}".split())
    return job.line("failed", error=text, cpu_s=process_time() - started)


def _run(job: Job, started: float) -> Line:
    task = job.task
    if task.source is None or task.side is None:
        raise InvalidInputError(problem=task.error)
    if task.side not in job.options.robots:
        raise InvalidInputError(
            argument="--robot", problem=f"there is no robot for the {task.side} hand"
        )
    recording = task.source.read()
    check_recording(recording)
    robot = _robot(job.options.robots[task.side], job.options.arguments.robot_points)
    recording, trajectory, person = map_episode(recording, robot, job.options)
    metrics = measure_episode(recording, trajectory, person.contact_gap, _meter(robot))
    digest = save_episode(job.folder / task.out, trajectory, task.side)
    line = job.line("done", cpu_s=process_time() - started)
    return msgspec.structs.replace(
        line, frames=len(recording), metrics=metrics, out=task.out, sha256=digest
    )


def map_episode(
    recording: Recording, robot: Hand, options: JobOptions
) -> tuple[Recording, Trajectory, Person]:
    """Map a recording to a robot, looking ahead if asked to.

    Args:
        recording: The recording.
        robot: The robot hand.
        options: The options.

    Returns:
        The recording as it was mapped, the trajectory, and the person.

    Raises:
        HandmapError: If the recording cannot be mapped.
    """
    person = measure_person(recording)
    if options.smoother is not None:
        recording = look_ahead(recording, options.smoother)
    human = scaled_human(recording, points=options.arguments.human_points, lengths=person.lengths)
    choice = options.arguments.preset_for(human, robot, person.contact_gap)
    if options.smoother is not None:
        trajectory = map_both_ways(human, robot, choice.method, choice.ik, recording)
        return recording, trajectory, person
    smoothing = options.arguments.smoothing
    mapper = HandMapper(human, robot, choice.method, ik=choice.ik, smoothing=smoothing)
    return recording, map_recording(mapper, recording), person


@lru_cache(maxsize=8)
def _robot(name: str, points: str | None) -> Hand:
    """Load a robot once in each process."""
    return MappingArguments(robot_points=points).load_robot(name)


@lru_cache(maxsize=8)
def _meter(robot: Hand) -> GapMeter | None:
    """Read the robot's surfaces once in each process; None if it has none that can be measured."""
    try:
        return GapMeter(robot)
    except HandmapError:
        return None
