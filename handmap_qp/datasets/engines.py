"""Engines that run the jobs of a batch: in this process, or in a pool of processes.

An engine yields a line of the manifest for every job, in the order in which jobs end. It survives
workers that die: `killed` lines say so, and a recording that kills its worker `MOST_KILLS` times is
given up with a `failed` line.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import Protocol

from handmap_qp.datasets.episode_files import synced
from handmap_qp.datasets.job import Job, run_job
from handmap_qp.datasets.manifest import MOST_KILLS, Line
from handmap_qp.errors import InvalidInputError
from handmap_qp.output_files import remove_torn, writing

IN_FLIGHT = 3
"""Groups of jobs given to each worker in advance, so that it never waits."""
GROUP_FRAMES = 1024
"""Short recordings are given to a worker in groups of up to so many frames, some 0.3 s of work: a
message to another process takes 3 ms of CPU time of both."""
RUNNING = ".running"
"""Folder of a file for each job that a worker is busy with."""
_MOST_STARTS = 10
"""Pools in a row that break before a job begins; after that, no pool is started any more."""
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of a worker, read by its BLAS when it starts."""


class Engine(Protocol):
    """Runs jobs."""

    def outcomes(
        self, jobs: Sequence[Job], kills: dict[str, int], is_stopped: Callable[[], bool]
    ) -> Iterator[Line]:
        """Run jobs, the first ones first.

        Args:
            jobs: The jobs.
            kills: How often the worker of a recording has died before, by key; kept up to date.
            is_stopped: Asked now and then; after it said True, what is under way is finished, and
                nothing more is begun.

        Yields:
            A line for every job that has ended, and one for every death of a worker.

        Raises:
            DiskFullError: If an episode cannot be written because the disk is full.
        """
        ...


class SerialEngine:
    """Runs jobs one after the other in this process."""

    def outcomes(
        self, jobs: Sequence[Job], kills: dict[str, int], is_stopped: Callable[[], bool]
    ) -> Iterator[Line]:
        """Run jobs in order; see `Engine`."""
        for job in jobs:
            if is_stopped():
                return
            yield from synced(job.folder, [run_job(job)])


class PoolEngine:
    """Runs jobs in processes of their own on this machine.

    When a worker dies, all recordings that were under way are suspects. They are run again one at a
    time in a pool of one, so that the one that is to blame is found.

    Args:
        workers: Number of processes.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._failed_starts = 0

    def outcomes(
        self, jobs: Sequence[Job], kills: dict[str, int], is_stopped: Callable[[], bool]
    ) -> Iterator[Line]:
        """Run jobs in the pool; see `Engine`.

        Raises:
            InvalidInputError: If workers die again and again while they start.
        """
        waiting = deque(job for job in jobs if not kills.get(job.task.key))
        suspects = deque(job for job in jobs if kills.get(job.task.key))
        while (waiting or suspects) and not is_stopped():
            queue = suspects or waiting
            yield from self._until_one_dies(queue, suspects, kills, is_stopped)

    def _until_one_dies(
        self,
        queue: deque[Job],
        suspects: deque[Job],
        kills: dict[str, int],
        is_stopped: Callable[[], bool],
    ) -> Iterator[Line]:
        """Run the jobs of a queue until all are done, or a worker dies: suspects one at a time."""
        is_alone = queue is suspects
        workers, most = (1, 1) if is_alone else (self._workers, IN_FLIGHT * self._workers)
        flying: dict[Future[Sequence[Line]], tuple[Job, ...]] = {}
        with _pool(workers) as pool:
            try:
                while (queue and not is_stopped()) or flying:
                    if is_stopped():
                        # Cancelled ones are given up: a next run begins with them.
                        flying = {
                            future: jobs for future, jobs in flying.items() if not future.cancel()
                        }
                    while queue and not is_stopped() and len(flying) < most:
                        jobs = (queue[0],) if is_alone else self._next_group(queue)
                        flying[pool.submit(run_group, jobs, is_alone)] = jobs
                        for _ in jobs:
                            queue.popleft()
                    for future in wait(flying, return_when=FIRST_COMPLETED).done:
                        lines = future.result()
                        del flying[future]
                        self._failed_starts = 0
                        yield from lines
            except BrokenProcessPool:
                self._failed_starts += 1
                yield from self._sorted_out(flying, queue, suspects, kills)
                self._check_starts()

    def _next_group(self, waiting: Sequence[Job]) -> tuple[Job, ...]:
        """Return the next jobs for one worker; towards the end fewer, so that all have some."""
        most, frames, group = max(1, len(waiting) // (2 * self._workers)), 0, []
        for job in islice(waiting, most):
            frames += job.task.frames
            if group and frames > GROUP_FRAMES:
                break
            group.append(job)
        return tuple(group)

    def _sorted_out(
        self,
        flying: dict[Future[Sequence[Line]], tuple[Job, ...]],
        queue: deque[Job],
        suspects: deque[Job],
        kills: dict[str, int],
    ) -> Iterator[Line]:
        """Sort the jobs of a broken pool: ended, under way when it broke, or not begun."""
        for future, jobs in flying.items():
            if future.done() and future.exception() is None:
                self._failed_starts = 0
                yield from future.result()
                continue
            for job in reversed(jobs):
                if _took_marker(job):
                    self._failed_starts = 0
                    yield killed(job, kills)
                    if kills[job.task.key] < MOST_KILLS:
                        suspects.append(job)
                else:
                    # Mapped again, if it had ended when a later one of its group died.
                    queue.appendleft(job)

    def _check_starts(self) -> None:
        """Give up if no worker comes up: memory, or the way this program starts processes."""
        if self._failed_starts >= _MOST_STARTS:
            raise InvalidInputError(
                argument="--workers",
                expected="processes that start",
                got=f"{self._failed_starts} in a row that died before they began",
                advice="take fewer if memory is short, or 0 to map in this process; in a script, "
                "call it below `if __name__ == '__main__':`",
            )


def run_group(jobs: tuple[Job, ...], is_alone: bool = False) -> Sequence[Line]:
    """Run jobs one after the other in a worker.

    Args:
        jobs: The jobs of one batch.
        is_alone: Whether no other jobs run beside them.

    Returns:
        What happened, when the episodes are on the disk.
    """
    return synced(jobs[0].folder, [_run_marked(job, is_alone) for job in jobs])


def _run_marked(job: Job, is_alone: bool) -> Line:
    """Run a job, with a file that says so as long as it runs."""
    marker = _marker(job)
    content = {"key": job.task.key, "alone": is_alone, "out": job.task.out}
    try:
        with writing(marker, "--out"):
            marker.parent.mkdir(exist_ok=True)
            marker.write_text(json.dumps(content), encoding="utf-8")
        return run_job(job)
    finally:
        marker.unlink(missing_ok=True)


def left_behind(folder: Path) -> dict[str, bool]:
    """Take away the markers and torn files that an earlier batch left behind when it was killed.

    Args:
        folder: Folder of the batch.

    Returns:
        For the key of every recording that was under way whether it was alone.
    """
    found = {}
    for marker in sorted((folder / RUNNING).glob("*")):
        try:
            content = json.loads(marker.read_text(encoding="utf-8"))
            found[str(content["key"])] = bool(content["alone"])
            remove_torn(folder / content["out"])
        except (OSError, ValueError, LookupError, TypeError):
            pass  # killed while it wrote the marker
        marker.unlink(missing_ok=True)
    return found


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Start a pool of spawned workers with one thread each."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    pool = ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=start_worker
    )
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def start_worker() -> None:
    """Prepare a worker: it leaves Ctrl-C to its parent, and ends when the parent has died."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent has: it would wait for jobs for ever (CPython 111873)."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def killed(job: Job, kills: dict[str, int]) -> Line:
    """Count a death of a worker, take away the file that it was writing, and return a line."""
    key = job.task.key
    kills[key] = kills.get(key, 0) + 1
    remove_torn(job.folder / job.task.out)
    times = f"the worker died {kills[key]} times"
    if kills[key] >= MOST_KILLS:
        return job.line("failed", kills=kills[key], error=f"given up: {times}")
    return job.line("killed", kills=kills[key], error=times)


def _took_marker(job: Job) -> bool:
    """Take away the marker of a job whose worker died; return if it had begun."""
    try:
        _marker(job).unlink()
    except FileNotFoundError:
        return False
    return True


def _marker(job: Job) -> Path:
    name = sha256(job.task.key.encode()).hexdigest()[:24]
    return job.folder / RUNNING / name
