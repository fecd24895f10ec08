"""Cost of mapping data sets: CPU time of a recording and of a frame, and what EgoDex would take.

    python benchmarks bench_batch

Files in EgoDex's form, both hands, are made from real recordings. Each hand is mapped by the
function that `handmap batch` runs, and the time of its stages is taken as CPU time of the thread.
Cost of a recording and of a frame come from recordings of two lengths. The extrapolation to EgoDex
(829 h at 30 Hz, 338,000 episodes, both hands) is printed with its terms.
"""

from __future__ import annotations

import resource
import shutil
import tempfile
from argparse import Namespace
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter, process_time, thread_time
from typing import Any
from unittest.mock import patch

import numpy as np
from common import (
    PALETTE,
    facts,
    find_recordings,
    make_parser,
    parse_arguments,
    print_table,
    save_picture,
    write_json,
)

import handmap_qp.apps.datasets.episodes as job_module
import handmap_qp.apps.offline.trajectory as mapping_module
from handmap_core.human.recording import Recording, mirrored, sample_columns
from handmap_qp import Follower, HandMapper, load_hand
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.datasets.batch import plan_batch, run_batch
from handmap_qp.apps.datasets.engines import pool_engine
from handmap_qp.apps.datasets.episodes import run_job
from handmap_qp.apps.datasets.sources import Job, JobOptions
from handmap_qp.human.measure import scaled_human
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats import Source, read_recording, write_recordings
from handmap_qp.trackers.formats.hdf5 import EgoDexFormat

HOURS, EPISODES, RATE = 829.0, 338_000, 30.0
"""EgoDex as published (Hoque et al. 2025): hours, episodes, frames per second."""
STAGES = (
    "read",
    "check",
    "measure person",
    "scale human",
    "bind method",
    "map",
    "measure",
    "write",
)
_SHORT = 65


def main() -> None:
    """Measure, print, and write."""
    parser = make_parser(__doc__ or "")
    parser.add_argument("--frames", type=int, default=265, help="frames of a recording")
    given = parse_arguments(parser)
    files = 12
    if given.quick:
        files, given.frames = 1, _SHORT + 15
    rows, results = [], {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        sources = find_recordings(given.recordings)
        make_files(sources, folder / "long", files, given.frames)
        make_files(sources, folder / "short", files, _SHORT)
        for name, ahead in (("online", False), ("look-ahead", True)):
            options = JobOptions(
                {"left": "allegro_left", "right": "allegro_right"},
                MappingArguments(smooth=ahead),
                look_ahead=ahead,
            )
            result = measure(folder, options, given.frames)
            results[name] = result
            rows.append(row_of(name, result))
        pool = pool_run(folder / "long", folder / "pool", given)
        threads = thread_run(sources, 1 if given.quick else 20)
    print_table(
        "CPU time of a recording of one hand, by stage [ms]", stage_rows(results)
    )
    print_table("Cost, and EgoDex's two hands by extrapolation", rows)
    print_table("Two workers", [pool])
    print_table("Threads of one process, guard and mapping alone", threads)
    write_json(
        given.json,
        "batch",
        {"results": results, "pool": pool, "threads": threads, "facts": facts()},
    )
    save_picture(given.picture, lambda: draw(results))


def make_files(sources: list[Path], folder: Path, count: int, frames: int) -> None:
    """Write files in EgoDex's form: a piece of a real recording at 30 Hz, and its mirror image."""
    folder.mkdir(parents=True)
    whole = [read_recording(file) for file in sources]
    for i in range(count):
        right = at_rate(whole[i % len(whole)], frames, i)
        write_recordings((right, mirrored(right)), folder / f"{i}.hdf5", EgoDexFormat())


def at_rate(recording: Recording, frames: int, seed: int) -> Recording:
    """Return a piece of a recording, interpolated to 30 Hz; its time runs back and forth."""
    seen = recording.valid
    time, landmarks = recording.time[seen], recording.landmarks[seen].reshape(-1, 63)
    span = time[-1] - time[0]
    phase = np.arange(frames) / RATE + 0.37 * seed
    # Back and forth, so that a short recording is long enough.
    instants = time[0] + span * np.abs((phase / span + 1.0) % 2.0 - 1.0)
    points = np.stack(
        [np.interp(instants, time, column) for column in landmarks.T], axis=1
    )
    return Recording(
        name=recording.name,
        time=np.arange(frames) / RATE,
        landmarks=points.reshape(frames, 21, 3),
        valid=np.ones(frames, dtype=bool),
        side=recording.side,
    )


def measure(folder: Path, options: JobOptions, frames: int) -> dict[str, Any]:
    """Measure jobs of two lengths, and split the cost into that of a recording and of a frame."""
    found: dict[int, dict[str, float]] = {}
    for name, count in (("short", _SHORT), ("long", frames)):
        plan = plan_batch([folder / name], folder / f"{name}-out", options)
        # The first recording of each hand loads the robot.
        for warm in plan.jobs[:2]:
            run_job(warm)
        found[count] = stage_times(plan.jobs)
    long, short = found[frames], found[_SHORT]
    slope = {name: (long[name] - short[name]) / (frames - _SHORT) for name in long}
    frame = sum(slope.values())
    recording = sum(long.values()) - frames * frame
    seconds = 2.0 * (HOURS * 3600.0 * RATE * frame + EPISODES * recording)
    return {
        "frames": frames,
        "stages": long,
        "frame": frame,
        "recording": recording,
        "egodex_hours": seconds / 3600.0,
    }


def stage_times(jobs: Sequence[Job]) -> dict[str, float]:
    """Return the mean CPU time of every stage of a job [s]; the median over recordings."""
    times: list[dict[str, float]] = []
    for job in jobs:
        clock: dict[str, float] = defaultdict(float)
        with timed_stages(clock):
            started = thread_time()
            line = run_job(job)
            spent = thread_time() - started
        if line.status != "done":
            raise SystemExit(line.error)
        times.append(dict(clock) | {"other": spent - sum(clock.values())})
    names = [*STAGES, "other"]
    return {
        name: float(np.median([row.get(name, 0.0) for row in times])) for name in names
    }


@contextmanager
def timed_stages(clock: dict[str, float]) -> Any:
    """Take the time of the functions that a job calls; of those within others, the outer ones."""
    running: list[str] = []

    def timed(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*values: Any, **named: Any) -> Any:
            started = thread_time()
            running.append(name)
            try:
                return call(*values, **named)
            finally:
                running.pop()
                if not running:
                    clock[name] += thread_time() - started

        return run

    places = {
        "check_recording": "check",
        "measure_person": "measure person",
        "scaled_human": "scale human",
        "HandMapper": "bind method",
        "map_recording": "map",
        "look_ahead": "measure person",
        "measure_episode": "measure",
        "save_episode": "write",
    }
    patches = []
    for name, stage in places.items():
        module = job_module if hasattr(job_module, name) else mapping_module
        patches.append(patch.object(module, name, timed(stage, getattr(module, name))))
    patches.append(patch.object(Source, "read", timed("read", Source.read)))
    for one in patches:
        one.start()
    try:
        yield
    finally:
        for one in patches:
            one.stop()


def row_of(name: str, result: dict[str, Any]) -> dict[str, Any]:
    """Return a row of the table, with EgoDex by extrapolation."""
    frames = 2.0 * HOURS * 3600.0 * RATE
    recordings = 2.0 * EPISODES
    return {
        "mapping": name,
        "recording [ms]": 1e3 * result["recording"],
        "frame [ms]": 1e3 * result["frame"],
        "EgoDex [core-hours]": result["egodex_hours"],
        "terms": f"{frames / 1e6:.0f} M frames, {recordings / 1e3:.0f} k recordings",
    }


def stage_rows(results: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the stages as rows."""
    return [
        {
            "mapping": name,
            **{stage: 1e3 * value for stage, value in result["stages"].items()},
        }
        for name, result in results.items()
    ]


def pool_run(inputs: Path, out: Path, given: Namespace) -> dict[str, Any]:
    """Map with two workers; return useful CPU time over all, and the memory of the largest one."""
    options = JobOptions({"left": "allegro_left", "right": "allegro_right"})
    copies = 1 if given.quick else 42
    for i in range(1, copies):
        for file in sorted(inputs.glob("?.hdf5")) + sorted(inputs.glob("??.hdf5")):
            # A link would be the same file, which is mapped once.
            shutil.copy(file, inputs / f"copy{i}_{file.name}")
    plan = plan_batch([inputs], out, options)
    started, cpu = perf_counter(), process_time()
    tally = run_batch(plan, out, pool_engine(2))
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    parent = process_time() - cpu
    return {
        "recordings": len(tally.done),
        "wall [s]": perf_counter() - started,
        "parent CPU [s]": parent,
        "useful CPU [s]": tally.useful_cpu,
        "all CPU [s]": tally.all_cpu,
        "start of a worker [s]": (tally.all_cpu - tally.useful_cpu - parent) / 2.0,
        "efficiency": tally.useful_cpu / tally.all_cpu,
        "largest process [MB]": usage.ru_maxrss / 1024.0,
    }


def thread_run(sources: list[Path], copies: int) -> list[dict[str, Any]]:
    """Map recordings in one thread and in two of one process; the core runs without the GIL."""
    whole = [read_recording(file) for file in sources]
    cases = []
    for recording in (each for each in whole if each.side == "right"):
        person = measure_person(recording)
        human = scaled_human(recording, points="landmarks", lengths=person.lengths)
        cases += [(human, sample_columns(recording))] * copies
    robot = load_hand("allegro_right")
    rows = []
    for threads in (1, 2):
        followers = [Follower(HandMapper(human, robot)) for human, _ in cases]
        started, cpu = perf_counter(), process_time()
        with ThreadPoolExecutor(threads) as pool:
            jobs = [
                pool.submit(follower.map_samples, columns)
                for follower, (_, columns) in zip(followers, cases, strict=True)
            ]
            frames = sum(len(job.result().rows) for job in jobs)
        wall, spent = perf_counter() - started, process_time() - cpu
        rows.append(
            {"threads": threads, "recordings": len(cases), "frames": frames}
            | {"us a frame": 1e6 * wall / frames, "CPU over wall": spent / wall}
        )
    return rows


def draw(results: dict[str, dict[str, Any]]) -> Any:
    """Draw the stages as bars."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 2.4), layout="constrained")
    axes = figure.subplots()
    left = np.zeros(len(results))
    for k, stage in enumerate((*STAGES, "other")):
        widths = np.array(
            [1e3 * result["stages"][stage] for result in results.values()]
        )
        axes.barh(
            list(results),
            widths,
            left=left,
            color=PALETTE[k % len(PALETTE)],
            label=stage,
        )
        left += widths
    axes.set_xlabel("CPU time of a recording of one hand [ms]")
    axes.legend(fontsize=7, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.35))
    return figure


if __name__ == "__main__":
    main()
