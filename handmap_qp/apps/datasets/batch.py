"""Map whole data sets: what is left to do, and what has been done."""

from __future__ import annotations

import resource
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

from msgspec import structs

from handmap_qp.apps.datasets.engines import Asked, Engine
from handmap_qp.apps.datasets.episodes import is_intact
from handmap_qp.apps.datasets.manifest import (
    MOST_KILLS,
    Line,
    open_manifest,
    read_manifests,
)
from handmap_qp.apps.datasets.sources import Job, JobOptions, find_files, list_jobs
from handmap_qp.output_files import make_folder


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

    jobs: tuple[Job, ...]
    done: Sequence[Line]
    left_alone: Sequence[Line]
    damaged: Sequence[Line] = ()
    repeated: Sequence[Path] = ()


@dataclass(frozen=True)
class Tally:
    """What a run of a batch has done.

    Attributes:
        lines: The last line of every recording of this run.
        is_complete: False if it was interrupted.
        useful_cpu: CPU time inside the jobs [s].
        all_cpu: CPU time of this process and its workers [s].
    """

    lines: tuple[Line, ...]
    is_complete: bool
    useful_cpu: float
    all_cpu: float

    @property
    def done(self) -> list[Line]:
        """Lines of the recordings that were mapped."""
        return [line for line in self.lines if line.status == "done"]

    @property
    def failed(self) -> list[Line]:
        """Lines of the recordings that failed."""
        return [line for line in self.lines if line.status != "done"]


def plan_batch(
    inputs: Sequence[Path],
    folder: Path,
    options: JobOptions,
    shard: tuple[int, int] = (1, 1),
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
    digest = options.digest
    make_folder(folder / "episodes", "--out")
    files, repeated = find_files(inputs, folder)
    listed = list_jobs(files, folder, options, digest, shard)
    state = read_manifests(folder)
    if shard == (1, 1):
        # What is torn was being written when a batch was killed; shards may be writing now.
        for torn in (folder / "episodes").rglob(".*.part"):
            torn.unlink(missing_ok=True)
    jobs = []
    done = []
    damaged = []
    left_alone = []
    for job in listed:
        line = state.get(job.line.key)
        if line is None or line.version != job.line.version:
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
    return Plan(tuple(jobs), done, left_alone, damaged, repeated)


def run_batch(
    plan: Plan,
    folder: Path,
    engine: Engine,
    shard: tuple[int, int] = (1, 1),
    progress: Callable[[Line], None] = lambda _: None,
    is_stopped: Asked = lambda: False,
) -> Tally:
    """Run the jobs of a plan; each episode is on the disk before its line in the manifest.

    Args:
        plan: The plan.
        folder: Folder of the batch.
        engine: What runs the jobs.
        shard: Which part of how many.
        progress: Called with every line.
        is_stopped: Asked now and then; after it said True, what is under way is finished, and
            nothing more is begun.

    Returns:
        What was done.

    Raises:
        DiskFullError: If the disk is full. The episodes that have a line are done.
        InvalidInputError: If the manifest cannot be written.
    """
    started = _cpu_time()
    useful = 0.0
    last: dict[str, Line] = {}
    with open_manifest(folder, shard) as append:
        for line in engine.outcomes(plan.jobs, is_stopped):
            append(line)
            useful += line.cpu_s
            last[line.key] = line
            progress(line)
    is_complete = len(last) == len(plan.jobs)
    is_complete &= all(line.status != "killed" for line in last.values())
    return Tally(tuple(last.values()), is_complete, useful, _cpu_time() - started)


@contextmanager
def stopped_by_signals() -> Iterator[Asked]:
    """Note Ctrl-C, and SIGTERM, by which schedulers end jobs, inside the block.

    A second Ctrl-C interrupts at once.

    Yields:
        A function that returns whether one of them has come.
    """
    seen: list[int] = []

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
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return process_time() + children.ru_utime + children.ru_stime
