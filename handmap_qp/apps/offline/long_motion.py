"""Map recordings of hours piece by piece: `map_long` returns a `LongMotion`.

Every sample is mapped as by `map_recording`, by one follower that goes on from piece to piece. The
columns of the motion are on the disk, in files without names.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from handmap_core.se3 import Array
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.hands import Hand, Values
from handmap_qp.human import Person, sample_columns
from handmap_qp.output_files import writing
from handmap_qp.stream import Follower, StepTable
from handmap_qp.trackers import DiskColumn, LongRecording
from .trajectory import (
    Progress,
    Trajectory,
    hand_mapper,
    nothing_followed,
    trajectory_of_table,
)

_MARKS = 6
"""Last columns of a `StepTable`, which a sample has before the robot has a place."""
_LEFT_OUT = ("targets", "points")
_RULE, _HELD = -5, -4
"""Columns of a `StepTable`: what is wrong with a sample, and whether it was held."""


class LongMotion:
    """A robot's motion whose columns are on the disk.

    Args:
        robot: The robot hand.
        method: The method that made it.
        folder: Where the columns are.

    Attributes:
        robot: As given.
        method: As given.
        columns: Arrays by name, as `Trajectory.columns`; those of samples are on the disk.
        all_columns: As `Trajectory.all_columns`, likewise.
    """

    def __init__(self, robot: Hand, method: object, folder: Path) -> None:
        self.robot = robot
        self.method = method
        self.columns: dict[str, Array | DiskColumn] = {}
        self.all_columns: dict[str, Array | DiskColumn] = {}
        self._samples: dict[str, DiskColumn] = {}
        self._folder = folder

    def __len__(self) -> int:
        """Number of samples."""
        return len(self._samples["time"]) if self._samples else 0

    def append(self, part: Trajectory) -> None:
        """Write the next samples.

        Raises:
            OSError: If the disk is full.
        """
        arrays = part.all_columns
        if not self._samples:
            own = {field.name for field in fields(part)} - {"robot"}
            for name, array in (arrays | {"step_cpu": part.step_cpu}).items():
                if name in own or name == "all_q":
                    self._samples[name] = DiskColumn(
                        self._folder, array.dtype, array.shape[1:]
                    )
            self.all_columns = {
                name: self._samples.get(name, array) for name, array in arrays.items()
            }
            self.columns = {name: self.all_columns[name] for name in part.columns}
        arrays["step_cpu"] = part.step_cpu
        for name, column in self._samples.items():
            column.append(arrays[name])

    def column(self, name: str) -> Array:
        """Read one column of all samples."""
        return self._samples[name].rows(slice(None))

    def rule_at(self, sample: int) -> str:
        """Return what is wrong with a sample."""
        return str(self._samples["rule"].rows(slice(sample, sample + 1))[0])

    def trajectory(self, *blocks: slice) -> Trajectory:
        """Read blocks of samples, one behind the other, without points and their targets.

        These are half of the numbers, and no summary needs them: they have no rows here.
        """
        columns: Values = {
            field.name: self._samples[field.name].blocks(
                [slice(0, 0)] if field.name in _LEFT_OUT else blocks
            )
            for field in fields(Trajectory)
            if field.name in self._samples
        }
        return Trajectory(robot=self.robot, **columns)

    def close(self) -> None:
        """Remove the columns."""
        for column in self._samples.values():
            column.close()


@contextmanager
def map_long(
    recording: LongRecording,
    robot: Hand,
    person: Person,
    arguments: MappingArguments,
    out: Path,
    progress: Progress = None,
    *,
    argument: str = "path",
) -> Iterator[LongMotion]:
    """Map a long recording of a person to a robot hand with the options of a command.

    Args:
        recording: The recording.
        robot: The robot hand.
        person: The person.
        arguments: Reference points and options.
        out: The file that will be written; the motion is in its folder until the block ends.
        progress: Called after each piece with the number of samples done.
        argument: Argument or option that names the file.

    Yields:
        The motion. The numbers are those of `map_hands`, to the last bit.

    Raises:
        DiskFullError: If the disk of that folder is full.
        HandmapError: If the recording cannot be read or mapped.
    """
    mapper = hand_mapper(recording.overview, robot, person, arguments)
    follower = Follower(mapper)
    pieces = _Pieces(mapper.robot)
    motion = LongMotion(mapper.robot, mapper.method, out.parent)
    try:
        done = 0
        for part in recording.parts():
            table = follower.map_samples(sample_columns(part))
            made = pieces.follow(part.time, table)
            with writing(out, argument):
                for trajectory in made:
                    motion.append(trajectory)
            done += len(part)
            if progress:
                progress(done)
        pieces.expect_followed()
        yield motion
    finally:
        motion.close()


class _Pieces:
    """Turns the steps of consecutive pieces into those of one motion.

    Args:
        robot: The robot hand.
    """

    def __init__(self, robot: Hand) -> None:
        self._robot = robot
        # The row of the last sample that has a place for the robot.
        self._last: Array | None = None
        # Instants and marks of the pieces before the first sample that is followed.
        self._before: list[tuple[Array, Array]] = []

    def follow(self, time: Array, table: StepTable) -> Iterator[Trajectory]:
        """Yield the motion of the next piece, and of those before it that had no place yet."""
        rows = table.rows
        if self._last is None:
            is_held = rows[:, _HELD] > 0.0
            if is_held.all():
                self._before.append((time, rows[:, -_MARKS:].copy()))
                return
            first = int(np.argmin(is_held))
            self._last = rows[first].copy()
            # Nothing before the first sample that is followed has a place of its own.
            rows[:first, 0] = np.nan
            for instants, marks in self._before:
                waiting = np.full((len(marks), rows.shape[1]), np.nan)
                waiting[:, -_MARKS:] = marks
                yield self._trajectory(instants, waiting)
            self._before = []
        yield self._trajectory(time, rows)
        placed = np.flatnonzero(~np.isnan(rows[:, 0]))
        if len(placed):
            self._last = rows[placed[-1]].copy()
            self._last[_HELD] = 0.0

    def expect_followed(self) -> None:
        """Reject a motion without a sample that is followed."""
        if self._last is None:
            rules = [marks[:, _RULE + _MARKS] for _, marks in self._before]
            raise nothing_followed(np.concatenate(rules))

    def _trajectory(self, time: Array, rows: Array) -> Trajectory:
        """Return the motion of steps behind the last one that has a place."""
        table = StepTable(self._robot, 0)
        table.rows = np.concatenate([[self._last], rows])
        found = trajectory_of_table(self._robot, np.append(np.nan, time), table)
        columns = {
            field.name: value[1:]
            for field in fields(found)
            if isinstance(value := vars(found)[field.name], Array)
        }
        return replace(found, **columns)
