"""The commands `handmap convert`, `handmap batch` and `handmap report`."""

from __future__ import annotations

import json
import os
import re
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from handmap_qp.apps.arguments import MappingArguments, MappingFlags, hinted
from handmap_qp.apps.datasets.assemble import assemble
from handmap_qp.apps.datasets.batch import (
    Plan,
    Tally,
    plan_batch,
    run_batch,
    stopped_by_signals,
)
from handmap_qp.apps.datasets.convert import convert
from handmap_qp.apps.datasets.engines import SERIAL, Engine, pool_engine, ray_engine
from handmap_qp.apps.datasets.manifest import Line
from handmap_qp.apps.datasets.report import (
    assess,
    summary_rows,
    worst_rows,
    write_report,
)
from handmap_qp.apps.datasets.sources import JobOptions
from handmap_qp.apps.offline.look_ahead import LookAhead
from handmap_qp.apps.tables import print_rows, print_table, progress
from handmap_qp.errors import InvalidInputError, RecordingError, expect
from handmap_qp.hands.spec import Side
from handmap_qp.trackers.formats import FORMATS
from handmap_qp.trackers.formats.base import first_of


@dataclass(frozen=True)
class Convert:
    """Convert recordings of human hands between file formats.

    The suffix of OUT tells its format; a name without suffix is a LeRobot data set. Says in one
    line what the new format cannot hold.

      npz        arrays of numpy by name; lossless, one of each hand
      csv        a text table, numbers kept exactly; one of each hand
      lerobot    a folder, LeRobot v3 (parquet); any number; written, not read
      robomimic  HDF5 as of robomimic; lossless, any number
      egodex     HDF5 as of EgoDex, poses of joints; one of each hand
      mcap       ROS 2 bag, JointState and landmarks; one of each hand
      mano       npz of MANO's joints; reads parameters with your model

    All but npz, csv and mano need the extra `handmap-qp[files]`.

    Examples:
        handmap convert take.npz take.csv
        handmap convert left.npz right.npz both.hdf5 --format egodex
        handmap convert episode.hdf5 lerobot_set
        handmap convert demos.hdf5 takes --format npz   (a file for each)
        handmap convert demo demo.mcap

    Attributes:
        paths: Files or data sets to read, then the file or folder to write. `FILE::NAME` is one
            recording of several in a file, `demo` the one that comes with the package.
        format: Format to write, where the suffix does not tell it.
        mano: The licensed MANO model: MANO_RIGHT.pkl, or the folder that holds both hands.
        json: Print one JSON object.
    """

    paths: tyro.conf.Positional[
        Annotated[
            tuple[Path, ...],
            hinted("IN... OUT", "(required)"),
        ]
    ]
    format: Annotated[
        str | None,
        tyro.conf.arg(
            metavar=f"{{{','.join(FORMATS)}}}",
            help_behavior_hint="(default: by the suffix of OUT)",
        ),
    ] = None
    mano: Annotated[
        Path | None,
        hinted("FILE", "(default: $HANDMAP_MANO)"),
    ] = None
    json: bool = False

    def run(self) -> None:
        """Read, write, and say what was lost."""
        expect(
            len(self.paths) >= 2,
            "IN OUT",
            "a file to read and one to write",
            got="one path",
        )
        done = convert(self.paths[:-1], self.paths[-1], self.format, self.mano)
        if self.json:
            print(json.dumps(done._asdict(), default=str))
            return
        lost = [*done.not_read, *done.lost]
        print(f"{done.recordings} recordings, {done.samples} samples")
        print(f"lost: {', '.join(lost)}" if lost else "nothing was lost")
        for file in done.files:
            print(f"wrote {file}")


@dataclass(frozen=True)
class Batch:
    """Map whole data sets of human hands to robot hands.

    Every recording of every input becomes an episode: DIR/episodes/NAME.npz. A line in
    DIR/manifest.jsonl says what became of it: frames, CPU time, quality, error. Run the same
    command again to go on: it skips what is done, maps again what has changed, and retries what has
    failed. A recording that kills its worker three times is left alone. Ctrl-C finishes what is
    under way. An episode that is not what was written is mapped again. The exit code is 1 if a
    recording failed or the disk is full.

    With --format the episodes are also written as one data set for training, at a fixed rate, as
    soon as none is left: DIR/lerobot (LeRobot v3) or DIR/episodes.hdf5 (robomimic).

    Examples:
        handmap batch recordings/ --robot allegro_right --out mapped
        handmap batch egodex/part1 --robot allegro_left allegro_right --out mapped
        handmap batch recordings/ --robot allegro_right --out mapped --look-ahead
        handmap batch egodex/ --robot L.yaml R.yaml --out mapped --shard 3/16
        handmap report mapped

    Attributes:
        inputs: Files, data sets, or folders of them; forms as of `handmap convert --help`.
        robot: Robot hand; for both human hands a left and a right one. Recordings of a hand
            without a robot fail.
        out: Folder to write to.
        format: Data set to write besides the episodes.
        fps: Frames per second of that data set; episodes are interpolated to it.
        look_ahead: Use each recording as a whole: smooth it, fill short gaps, and follow it without
            lag. Limits hold exactly. Takes three times as long.
        workers: Processes; 0 maps in this one.
        engine: `pool` of processes on this machine, or `ray` (extra `cluster`).
        shard: This part of so many, for a cluster's job array; each has a manifest of its own.
        json: Print one JSON object.
        arguments: Reference points and options.
    """

    inputs: tyro.conf.Positional[
        Annotated[
            tuple[Path, ...],
            hinted("INPUT...", "(required)"),
        ]
    ]
    robot: Annotated[tuple[str, ...], tyro.conf.arg(metavar="HAND [HAND]")]
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    format: Literal["npz", "lerobot", "robomimic"] = "npz"
    fps: float = 30.0
    look_ahead: bool = False
    workers: Annotated[
        int | None, tyro.conf.arg(help_behavior_hint="(default: one for each CPU)")
    ] = None
    engine: Literal["pool", "ray"] = "pool"
    shard: Annotated[
        str | None,
        hinted("I/N", "(default: everything)"),
    ] = None
    json: bool = False
    arguments: MappingFlags = field(default_factory=MappingArguments)

    def run(self) -> None:
        """List, map, and say what was done."""
        shard = _shard(self.shard)
        engine = self._engine()
        options = self._options()
        plan, tally = self._map(options, engine, shard)
        try:
            written = self._assemble(options, plan, tally)
        except RecordingError:
            # An episode was damaged after it had been verified: the second plan maps it again.
            plan, tally = self._map(options, engine, shard)
            written = self._assemble(options, plan, tally)
        self._report(plan, tally, written)
        if not tally.is_complete:
            raise SystemExit(130)
        failed = [line.name for line in (*tally.failed, *plan.left_alone)]
        if failed:
            reasons = f"failed; the reasons are in {self.out}/manifest*.jsonl"
            _warn(failed, "recordings", reasons)
            raise SystemExit(1)

    def _map(
        self, options: JobOptions, engine: Engine, shard: tuple[int, int]
    ) -> tuple[Plan, Tally]:
        """List the recordings, say what is odd about them, and map those that are not done."""
        with progress("listing"):
            plan = plan_batch(self.inputs, self.out, options, shard)
        damaged = [line.name for line in plan.damaged]
        _warn(damaged, "episodes", "are damaged or missing, and are mapped again")
        _warn(
            plan.repeated,
            "paths",
            "lead to files that are listed already, and are left out",
        )
        counts = Counter[str]()
        # The time left is by samples, not by files.
        frames = sum(job.line.frames for job in plan.jobs)
        with (
            stopped_by_signals() as is_stopped,
            progress("mapping", frames or None) as show,
        ):

            def advance(line: Line) -> None:
                if line.status != "killed":
                    counts.update({line.status: 1, "frames": line.frames})
                    show(
                        counts["frames"],
                        f"{counts['done']} episodes, {counts['failed']} failed",
                    )

            return plan, run_batch(plan, self.out, engine, shard, advance, is_stopped)

    def _options(self) -> JobOptions:
        """Check the options, and collect what all jobs have in common."""
        rate = "a rate of at most 1000 per second, and > 0"
        expect(0.0 < self.fps <= 1000.0, "--fps", rate, value=self.fps)
        robots: dict[Side, str] = {}
        for name in self.robot:
            side = self.arguments.load_robot(name).spec.side
            got = f"{robots.get(side)} and {name}, both {side}"
            expect(side not in robots, "--robot", "one robot for each side", got=got)
            robots[side] = name
        if self.look_ahead and self.arguments.smooth:
            problem = "has no effect with --look-ahead, which smooths itself"
            raise InvalidInputError(problem, argument="--smooth")
        return JobOptions(
            robots, self.arguments, LookAhead() if self.look_ahead else None
        )

    def _engine(self) -> Engine:
        workers = len(os.sched_getaffinity(0)) if self.workers is None else self.workers
        number = "a number from 0 to 1024"
        expect(0 <= workers <= 1024, "--workers", number, value=workers)
        if self.engine == "ray":
            return ray_engine(max(1, workers))
        return pool_engine(workers) if workers else SERIAL

    def _assemble(self, options: JobOptions, plan: Plan, tally: Tally) -> Path | None:
        """Write the data set, unless something is left for other shards or another run."""
        lines = [*plan.done, *tally.done]
        if (
            self.format == "npz"
            or self.shard is not None
            or not (tally.is_complete and lines)
        ):
            return None
        robots = {side: options.load_robot(side) for side in options.robots}
        return assemble(lines, self.out, self.format, self.fps, robots)

    def _report(self, plan: Plan, tally: Tally, written: Path | None) -> None:
        frames = sum(line.frames for line in tally.done)
        if self.json:
            result = {
                "done": len(tally.done),
                "failed": len(tally.failed),
                "skipped": len(plan.done),
                "left_alone": len(plan.left_alone),
                "frames": frames,
                "cpu_s": round(tally.useful_cpu, 3),
                "all_cpu_s": round(tally.all_cpu, 3),
                "complete": tally.is_complete,
                "data_set": None if written is None else str(written),
            }
            print(json.dumps(result))
            return
        rows = {
            "episodes": f"{len(tally.done)} mapped, {len(plan.done)} done before",
            "failed": f"{len(tally.failed)}, {len(plan.left_alone)} more left alone",
            "samples": f"{frames}",
        }
        if frames:
            rows["CPU time of a sample"] = f"{1e6 * tally.useful_cpu / frames:.0f} us"
        print_table(str(self.out), rows)
        for line in tally.failed[:10]:
            print(f"failed: {line.name}: {line.error}")
        if written is not None:
            print(f"wrote {written}")
        if not tally.is_complete:
            left = f"{len(plan.jobs) - len(tally.lines)} recordings are left"
            print(
                f"handmap: interrupted, {left}: run the same command to go on",
                file=sys.stderr,
            )


@dataclass(frozen=True)
class Report:
    """Report the quality of the episodes of a batch, and write a filter.

    Writes DIR/report: report.md with the distribution of every measure and the worst episodes,
    distributions.png, worst_ROBOT.png (human and robot in the worst samples), episodes.csv with all
    numbers, and keep.txt with the files of the episodes to keep, one a line.

    No measure needs a reference: reach, saturation, pinches, jerk, valid samples, self-penetration
    and the like. An episode is as bad as its worst rank among them.

    Examples:
        handmap report mapped
        handmap report mapped --keep 0.9 --worst 20

    Attributes:
        folder: Folder of a batch.
        keep: Share of the episodes that the filter keeps.
        worst: How many of the worst episodes to list; the picture shows up to 8.
        pictures: Draw pictures (extra `plot`).
        json: Print one JSON object.
    """

    folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="DIR")]]
    keep: float = 0.95
    worst: int = 10
    pictures: bool = True
    json: bool = False

    def run(self) -> None:
        """Read the manifest, rank, write, and print."""
        expect(self.worst > 0, "--worst", "a number > 0", value=self.worst)
        quality = assess(self.folder, self.keep)
        files = write_report(self.folder, quality, self.worst, draws=self.pictures)
        count = len(quality.lines)
        kept = int(quality.is_kept.sum())
        measures = summary_rows(quality)
        worst = worst_rows(quality, self.worst)
        if self.json:
            result = {
                "episodes": count,
                "kept": kept,
                "failed": len(quality.failed),
                "measures": measures,
                "worst": worst,
                "files": files,
            }
            print(json.dumps(result, default=str))
            return
        print_rows(f"{count} episodes, {kept} kept", measures)
        print_rows("Worst episodes", worst)
        for file in files:
            print(f"wrote {file}")


def _warn(names: Sequence[object], what: str, problem: str) -> None:
    """Say in one line of stderr what is wrong with some of many, unless there are none."""
    if names:
        shown = f"{len(names)} {what} {problem}: {first_of(names, 3)}"
        print(f"handmap: {shown}", file=sys.stderr)


def _shard(text: str | None) -> tuple[int, int]:
    """Read `I/N`.

    Raises:
        InvalidInputError: If it is not of this form, with 1 <= I <= N.
    """
    if text is None:
        return (1, 1)
    found = re.fullmatch(r"(\d{1,7})/(\d{1,7})", text)
    part, parts = map(int, found.groups()) if found else (0, 0)
    expect(1 <= part <= parts <= 10**6, "--shard", "I/N with 1 <= I <= N", value=text)
    return (part, parts)
