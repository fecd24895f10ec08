"""Map recordings of hours piece by piece: `map_long` returns a `LongMotion`.

Every sample is mapped as by `map_hands`, by one follower that goes on from piece to piece. The
columns of the motion are on the disk, in files without names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from time import thread_time
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.hands import Hand, Values
from handmap_qp.human import Person, sample_columns
from handmap_qp.output_files import writing
from handmap_qp.stream import Follower, RobotFollower, StepTable, paired_parts
from handmap_qp.trackers import DiskColumn, LongRecording
from .trajectory import (
    Progress,
    Trajectory,
    followed_hands,
    hand_mapper,
    nothing_followed,
    robot_follower,
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
        # Which hands were followed, and columns that `derive` has made.
        self._others: list[DiskColumn] = []
        self._followed: DiskColumn | None = None
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
            own |= {"all_q", *part.wrist_columns}
            for name, array in (arrays | {"step_cpu": part.step_cpu}).items():
                if name in own:
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

    def append_followed(self, flags: Array) -> None:
        """Write whether each hand was followed in the next samples, shape (T, number of hands).

        Raises:
            OSError: If the disk is full.
        """
        if self._followed is None:
            self._followed = DiskColumn(self._folder, flags.dtype, flags.shape[1:])
            self._others.append(self._followed)
        self._followed.append(flags)

    @property
    def followed(self) -> DiskColumn:
        """Whether each hand was followed, shape (T, number of hands)."""
        assert self._followed is not None
        return self._followed

    def derive(self, compute: Callable[[Array], Array]) -> DiskColumn:
        """Make a further column of the joint positions.

        Args:
            compute: Takes joint positions of T samples, shape (T, n), and returns the T rows.

        Raises:
            OSError: If the disk is full.
        """
        column: DiskColumn | None = None
        for q in self._samples["q"].pieces():
            rows = compute(q)
            if column is None:
                column = DiskColumn(self._folder, rows.dtype, rows.shape[1:])
                self._others.append(column)
            column.append(rows)
        assert column is not None
        return column

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
        for column in (*self._samples.values(), *self._others):
            column.close()


class _Mapped(NamedTuple):
    """What a follower made of some consecutive samples.

    Attributes:
        time: Their instants [s], shape (T,).
        table: Their steps.
        followed: Whether each hand was followed, shape (T, number of hands).
    """

    time: Array
    table: StepTable
    followed: Array


@contextmanager
def map_long(
    recordings: Sequence[LongRecording],
    robot: Hand,
    person: Person,
    arguments: MappingArguments,
    out: Path,
    progress: Progress = None,
    *,
    argument: str = "path",
) -> Iterator[LongMotion]:
    """Map long recordings of a person to a robot with the options of a command.

    Args:
        recordings: A recording for the robot hand, or of each hand of the robot in its order.
        robot: The robot hand, or the hands of the robot as one.
        person: The person.
        arguments: Reference points and options.
        out: The file that will be written; the motion is in its folder until the block ends.
        progress: Called after each piece with the number of samples done.
        argument: Argument or option that names the file.

    Yields:
        The motion. The numbers are those of `map_hands`, to the last bit.

    Raises:
        DiskFullError: If the disk of that folder is full.
        HandmapError: If a recording cannot be read or mapped.
    """
    first = recordings[0]
    overviews = [each.overview for each in recordings]
    if robot.parts:
        follower, method = robot_follower(overviews, robot, person, arguments)
        whole = follower.mapper.robot
        mapped = _mapped_both(follower, whole, recordings)
    else:
        mapper = hand_mapper(first.overview, robot, person, arguments)
        method = mapper.method
        whole = mapper.robot
        mapped = _mapped_hand(Follower(mapper), first)
    pieces = _Pieces(whole)
    motion = LongMotion(whole, method, out.parent)
    try:
        done = 0
        for time, table, followed in mapped:
            made = pieces.follow(time, table)
            with writing(out, argument):
                motion.append_followed(followed)
                for trajectory in made:
                    motion.append(trajectory)
            done += len(time)
            if progress:
                progress(done)
        pieces.expect_followed()
        yield motion
    finally:
        motion.close()


def _mapped_hand(follower: Follower, recording: LongRecording) -> Iterator[_Mapped]:
    """Let a robot hand follow a recording."""
    for part in recording.parts():
        table = follower.map_samples(sample_columns(part))
        is_held = table.rows[:, _HELD] > 0.0
        yield _Mapped(part.time, table, ~is_held[:, None])


def _mapped_both(
    follower: RobotFollower, robot: Hand, recordings: Sequence[LongRecording]
) -> Iterator[_Mapped]:
    """Let a robot follow a recording of each hand, at the instants of the longest one."""
    leading = max(recordings, key=len).overview.side
    parts = {each.overview.side: each.parts() for each in recordings}
    for time, pairs in paired_parts(parts, leading):
        table = StepTable(robot, len(time))
        followed = []
        for i, samples in enumerate(pairs):
            started = thread_time()
            step = follower.map_samples(samples)
            table.write(i, step, thread_time() - started)
            followed.append(followed_hands(step))
        yield _Mapped(time, table, np.array(followed))


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
