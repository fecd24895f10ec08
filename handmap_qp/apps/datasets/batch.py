"""The command `handmap batch`: what is left to do, and what has been done."""

import json
import os
import re
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

from msgspec import structs
from tyro.conf import Positional, arg

from handmap_core.errors import InvalidInputError, RecordingError, expect, warn
from handmap_qp.apps.arguments import MappingArguments, MappingFlags, hinted
from handmap_qp.apps.tables import print_rows, progress
from handmap_qp.hands import Names, hand_sides, load_whole
from handmap_qp.output_files import make_folder
from handmap_qp.trackers import first_of
from .assemble import assemble
from .engines import SERIAL, Engine, IsStopped, pool_engine, ray_engine
from .episodes import is_intact
from .manifest import MOST_KILLS, WHOLE, Line, Shard, open_manifest, read_manifests
from .sources import BOTH, Job, JobOptions, find_files, list_jobs


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
        handmap batch egodex/part1 --robot g1 --out mapped --format lerobot
        handmap batch recordings/ --robot allegro_right --out mapped --look-ahead
        handmap batch egodex/ --robot L.yaml R.yaml --out mapped --shard 3/16
        handmap report mapped

    Attributes:
        inputs: Files, data sets, or folders of them; forms as in `handmap convert --help`.
        robot: Robot hand; for both human hands a left and a right one (or `allegro` for the two of
            a family), or a robot with both
            (`handmap robots list`), which needs files with both. Recordings of a hand without a
            robot fail.
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

    inputs: Positional[Annotated[tuple[Path, ...], hinted("INPUT...", "(required)")]]
    robot: Annotated[Names, arg(metavar="HAND [HAND]")]
    out: Annotated[Path, arg(metavar="DIR")]
    format: Literal["npz", "lerobot", "robomimic"] = "npz"
    fps: float = 30.0
    look_ahead: bool = False
    workers: Annotated[
        int | None, arg(help_behavior_hint="(default: one for each CPU)")
    ] = None
    engine: Literal["pool", "ray"] = "pool"
    shard: Annotated[str | None, hinted("I/N", "(default: everything)")] = None
    json: bool = False
    arguments: MappingFlags = MappingArguments()

    def run(self) -> None:
        """List, map, and say what was done."""
        shard = _shard(self.shard)
        options = self._options()
        # Ray starts here.
        engine = self._engine()
        tally = self._map(options, engine, shard)
        try:
            written = self._assemble(options, tally)
        except RecordingError:
            # An episode was damaged after it had been verified: the second plan maps it again.
            tally = self._map(options, engine, shard)
            written = self._assemble(options, tally)
        self._report(tally, written)
        if not tally.is_complete:
            raise SystemExit(130)
        failed = [line.name for line in (*tally.failed, *tally.plan.left_alone)]
        if failed:
            reasons = f"failed; the reasons are in {self.out}/manifest*.jsonl"
            _warn(failed, "recordings", reasons)
            raise SystemExit(1)

    def _map(self, options: JobOptions, engine: Engine, shard: Shard) -> "Tally":
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

            return run_batch(plan, self.out, engine, shard, advance, is_stopped)

    def _options(self) -> JobOptions:
        """Check the options, and collect what all jobs have in common."""
        rate = "a rate of at most 1000 per second, and > 0"
        expect(0.0 < self.fps <= 1000.0, "--fps", rate, value=self.fps)
        robots: dict[str, str] = {}
        for name in self._robots():
            robot = load_whole(name, self.arguments.robot_points)
            side = BOTH if robot.parts else robot.side
            got = f"{robots.get(side)} and {name}, both {side}"
            expect(side not in robots, "--robot", "one robot for each side", got=got)
            robots[side] = name
        alone = "no other robot beside one with two hands"
        expect(
            BOTH not in robots or len(robots) < 2, "--robot", alone, value=self.robot
        )
        if self.look_ahead and self.arguments.smooth:
            problem = "has no effect with --look-ahead, which smooths itself"
            raise InvalidInputError(problem, argument="--smooth")
        arguments = replace(
            self.arguments, smooth=self.arguments.smooth or self.look_ahead
        )
        return JobOptions(robots, arguments, self.look_ahead)

    def _robots(self) -> list[str]:
        """Return the robots' names; a family of hands, such as `allegro`, is its hands."""
        named = [hand_sides(name).values() or [name] for name in self.robot]
        return [*chain.from_iterable(named)]

    def _engine(self) -> Engine:
        workers = len(os.sched_getaffinity(0)) if self.workers is None else self.workers
        number = "a number from 0 to 1024"
        expect(0 <= workers <= 1024, "--workers", number, value=workers)
        if self.engine == "ray":
            return ray_engine(max(1, workers))
        return pool_engine(workers) if workers else SERIAL

    def _assemble(self, options: JobOptions, tally: "Tally") -> Path | None:
        """Write the data set, unless something is left for other shards or another run."""
        lines = [*tally.plan.done, *tally.done]
        if self.format == "npz" or self.shard or not (tally.is_complete and lines):
            return None
        robots = {
            side: load_whole(name, self.arguments.robot_points)
            for side, name in options.robots.items()
        }
        return assemble(lines, self.out, self.format, self.fps, robots)

    def _report(self, tally: "Tally", written: Path | None) -> None:
        plan = tally.plan
        frames = sum(line.frames for line in tally.done)
        if self.json:
            result = {
                "done": len(tally.done),
                "failed": len(tally.failed),
                "skipped": len(plan.done),
                "left_alone": len(plan.left_alone),
                "unusual": len(tally.unusual),
                "frames": frames,
                "cpu_s": round(tally.useful_cpu, 3),
                "all_cpu_s": round(tally.all_cpu, 3),
                "complete": tally.is_complete,
                "data_set": written and str(written),
            }
            print(json.dumps(result))
            return
        rows = {
            "episodes": f"{len(tally.done)} mapped, {len(plan.done)} done before",
            "failed": f"{len(tally.failed)}, {len(plan.left_alone)} more left alone",
            "unusual": f"{len(tally.unusual)}",
            "samples": f"{frames}",
        }
        if frames:
            rows["CPU time of a sample"] = f"{1e6 * tally.useful_cpu / frames:.0f} us"
        print_rows(str(self.out), rows)
        for line in tally.failed[:10]:
            print(f"failed: {line.name}: {line.error}")
        for line in tally.unusual[:10]:
            print(f"unusual: {line.name}: {'; '.join(line.hints)}")
        if written:
            print(f"wrote {written}")
        if not tally.is_complete:
            left = f"{len(plan.jobs) - len(tally.lines)} recordings are left"
            warn(f"interrupted, {left}: run the same command to go on")


@dataclass(frozen=True)
class Plan:
    """What a batch has to do.

    Attributes:
        jobs: Recordings to map, the longest first.
        done: Lines of the recordings that are done already.
        left_alone: Lines of the recordings that are not tried again.
        damaged: Lines of the episodes that are missing, or are not what was written; `jobs` has
            their recordings.
        repeated: Paths that lead to files and folders which others had led to.
    """

    jobs: Sequence[Job]
    done: Sequence[Line]
    left_alone: Sequence[Line]
    damaged: Sequence[Line] = ()
    repeated: Sequence[Path] = ()


@dataclass(frozen=True)
class Tally:
    """What a run of a batch has done.

    Attributes:
        plan: What it had to do.
        lines: The last line of every recording of this run.
        all_cpu: CPU time of this process and its workers [s].
    """

    plan: Plan
    lines: Sequence[Line]
    all_cpu: float

    @property
    def is_complete(self) -> bool:
        """Whether all jobs have ended; False if the run was interrupted."""
        ended = sum(line.status != "killed" for line in self.lines)
        return ended == len(self.plan.jobs)

    @property
    def useful_cpu(self) -> float:
        """CPU time inside the jobs [s]."""
        return sum(line.cpu_s for line in self.lines)

    @property
    def done(self) -> list[Line]:
        """Lines of the recordings that were mapped."""
        return [line for line in self.lines if line.status == "done"]

    @property
    def unusual(self) -> list[Line]:
        """Lines of the recordings that were mapped, and have something to look at."""
        return [line for line in self.done if line.hints]

    @property
    def failed(self) -> list[Line]:
        """Lines of the recordings that failed."""
        return [line for line in self.lines if line.status != "done"]


def plan_batch(
    inputs: Sequence[Path], folder: Path, options: JobOptions, shard: Shard = WHOLE
) -> Plan:
    """List the recordings, and compare them with the manifest.

    Args:
        inputs: Files, data sets and folders.
        folder: Folder of the batch; created if it does not exist.
        options: What all jobs have in common.
        shard: Which part of how many.

    Returns:
        The plan. A recording is done if its last line says so, its file has the same size and time
        of change, the options are the same, and its episode is what was written.

    Raises:
        InvalidInputError: If an input cannot be used, or the folder not be written.
        HandError: If a robot cannot be loaded.
    """
    make_folder(folder / "episodes", "--out")
    files, repeated = find_files(inputs, folder)
    listed = list_jobs(files, folder, options, shard)
    state = read_manifests(folder)
    if shard == WHOLE:
        # What is torn was being written when a batch was killed; shards may be writing now.
        for torn in (folder / "episodes").rglob(".*.part"):
            torn.unlink(missing_ok=True)
    jobs = []
    done = []
    damaged = []
    left_alone = []
    for job in listed:
        line = state.get(job.line.key)
        if not line or line.version != job.line.version:
            jobs.append(job)
        elif line.status == "done" and is_intact(folder, line):
            done.append(line)
        elif line.status == "done":
            damaged.append(line)
            jobs.append(job)
        elif line.kills >= MOST_KILLS:
            left_alone.append(line)
        else:
            tried = structs.replace(job.line, kills=line.kills)
            jobs.append(replace(job, line=tried))
    return Plan(jobs, done, left_alone, damaged, repeated)


def run_batch(
    plan: Plan,
    folder: Path,
    engine: Engine,
    shard: Shard = WHOLE,
    progress: Callable[[Line], None] = lambda _: None,
    is_stopped: IsStopped = lambda: False,
) -> Tally:
    """Run the jobs of a plan; each episode is on the disk before its line in the manifest.

    Args:
        plan: The plan.
        folder: Folder of the batch.
        engine: What runs the jobs.
        shard: Which part of how many.
        progress: Called with every line.
        is_stopped: See `IsStopped`.

    Raises:
        DiskFullError: If the disk is full. The episodes that have a line are done.
        InvalidInputError: If the manifest cannot be written.
    """
    started = _cpu_time()
    last: dict[str, Line] = {}
    with open_manifest(folder, shard) as append:
        for line in engine.outcomes(plan.jobs, is_stopped):
            append(line)
            last[line.key] = line
            progress(line)
    return Tally(plan, [*last.values()], _cpu_time() - started)


@contextmanager
def stopped_by_signals() -> Iterator[IsStopped]:
    """Note Ctrl-C, and SIGTERM, by which schedulers end jobs, inside the block.

    A second Ctrl-C interrupts at once.

    Yields:
        A function that returns whether one of them has come.
    """
    seen = []

    def note(number: int, _: object) -> None:
        if seen and number == signal.SIGINT:
            raise KeyboardInterrupt
        seen.append(number)

    before = {
        number: signal.signal(number, note)
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield lambda: bool(seen)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _cpu_time() -> float:
    """CPU time of this process and of its children that have ended [s]."""
    return sum(os.times()[:4])


def _warn(names: Sequence[object], what: str, problem: str) -> None:
    """Say in one line of stderr what is wrong with some of many, unless there are none."""
    if names:
        warn(f"{len(names)} {what} {problem}: {first_of(names, 3)}")


def _shard(text: str | None) -> Shard:
    """Read `I/N`, and reject what is not of this form, with 1 <= I <= N."""
    if text is None:
        return WHOLE
    found = re.fullmatch(r"(\d{1,7})/(\d{1,7})", text)
    part, parts = map(int, found.groups()) if found else (0, 0)
    expect(1 <= part <= parts <= 10**6, "--shard", "I/N with 1 <= I <= N", value=text)
    return part, parts
