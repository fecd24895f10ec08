"""Engines that run the jobs of a batch: in this process, in a pool of processes, or under Ray.

All have one loop. It yields a line of the manifest for every job, in the order in which jobs end,
and survives workers that die: what was under way then is run again one at a time, so that the one
that is to blame is found. A recording that kills its worker `MOST_KILLS` times is given up.
"""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import (
    AbstractContextManager,
    contextmanager,
    nullcontext,
    suppress,
)
from dataclasses import replace
from functools import partial
from itertools import accumulate, islice
from typing import NamedTuple

from msgspec import structs

from handmap_core.errors import HandmapError, require
from handmap_qp.output_files import remove_torn
from .episodes import run_group
from .manifest import MOST_KILLS, Line
from .sources import Job
from .workers import ONE_THREAD, started_pool

GROUP_FRAMES = 1024
"""Short recordings are given to a worker in groups of up to so many frames, some 0.3 s of work: a
message to another process takes 3 ms of CPU time of both."""
_IN_FLIGHT = 3
"""Groups of jobs given to each worker in advance, so that it never waits."""

Group = tuple[Job, ...]
"""Jobs that a worker runs one after the other."""
Work = Future[Sequence[Line]]
"""Its result is the lines of a group, when they are on the disk."""
IsStopped = Callable[[], bool]
"""Returns whether to stop, now and then. What is under way is finished, and nothing more begun."""


Submit = Callable[[Group], Work]
"""Begins a group."""


class Engine(NamedTuple):
    """Where jobs are run: `SERIAL`, `pool_engine` or `ray_engine`.

    Attributes:
        start: Starts so many workers for a block, to which groups are submitted.
        count: Number of workers; 0 for this process.
        death: What a result raises if its worker has died.
    """

    start: Callable[[int], AbstractContextManager[Submit]]
    count: int
    death: type[Exception] = BrokenProcessPool

    def outcomes(self, jobs: Sequence[Job], is_stopped: IsStopped) -> Iterator[Line]:
        """Run jobs, the first ones first.

        Yields:
            A line for every job that has ended, and one before every try of a job whose worker may
            have died: a try that takes this process with it counts too.

        Raises:
            DiskFullError: If an episode cannot be written because the disk is full.
            InvalidInputError: If workers die again and again while they start.
        """
        waiting = deque(job for job in jobs if not job.line.kills)
        suspects = deque(job for job in jobs if job.line.kills)
        while (waiting or suspects) and not is_stopped():
            if suspects:
                yield from self._try_alone(suspects, is_stopped)
            else:
                yield from self._share(waiting, suspects, is_stopped)

    def _share(
        self, waiting: deque[Job], suspects: deque[Job], is_stopped: IsStopped
    ) -> Iterator[Line]:
        """Run jobs until all are done, or a worker dies: what was under way is suspect then."""
        flying: dict[Work, Group] = {}
        with self.start(self.count) as submit:
            most = max(1, _IN_FLIGHT * self.count)

            def has_room() -> bool:
                return not suspects and len(flying) < most and not is_stopped()

            while True:
                while waiting and has_room():
                    jobs = _next_group(waiting, self.count)
                    with suppress(self.death):
                        flying[submit(jobs)] = jobs
                        continue
                    suspects.extend(jobs)
                if is_stopped():
                    # Cancelled ones are given up: a next run begins with them.
                    flying = {f: jobs for f, jobs in flying.items() if not f.cancel()}
                if not flying:
                    return
                for future in wait(flying, return_when=FIRST_COMPLETED).done:
                    jobs = flying.pop(future)
                    try:
                        yield from _lines(future)
                    except self.death:
                        suspects.extend(jobs)

    def _try_alone(self, suspects: deque[Job], is_stopped: IsStopped) -> Iterator[Line]:
        """Run jobs whose worker may have died over them one at a time, until one dies."""
        with self.start(1) as submit:
            while suspects and not is_stopped():
                job = suspects.popleft()
                remove_torn(job.folder / job.out)
                kills = job.line.kills + 1
                line = structs.replace(job.line, status="killed", kills=kills)
                yield structs.replace(line, error=f"try {kills} has not ended")
                try:
                    yield from _lines(submit((job,)))
                except self.death:
                    break
            else:
                return
        remove_torn(job.folder / job.out)
        if kills < MOST_KILLS:
            suspects.append(replace(job, line=line))
        else:
            error = f"given up: the worker died {kills} times"
            yield structs.replace(line, status="failed", error=error)


def _run_here(jobs: Group) -> Work:
    future: Work = Future()
    future.set_result(run_group(jobs))
    return future


SERIAL = Engine(lambda _: nullcontext(_run_here), 0)
"""Runs jobs one after the other in this process."""


@contextmanager
def _pool(count: int) -> Iterator[Submit]:
    with started_pool(count) as pool:
        yield partial(pool.submit, run_group)


def pool_engine(count: int) -> Engine:
    """Return what runs jobs in processes of their own on this machine, with one thread each."""
    return Engine(_pool, count)


def ray_engine(most: int) -> Engine:
    """Return what runs jobs as Ray tasks of one CPU each.

    Ray is started on this machine unless `RAY_ADDRESS` names a cluster, and stays until this
    process ends. Inputs and the folder of the batch must be on a file system that all nodes share.

    Args:
        most: Number of CPUs of this machine that Ray may use; a cluster uses all of its own.

    Raises:
        MissingExtraError: If Ray is not installed.
    """
    ray = require("ray", "cluster")
    if not ray.is_initialized():
        ray.init(
            include_dashboard=False,
            log_to_driver=False,
            runtime_env={"env_vars": ONE_THREAD},
            num_cpus=None if os.environ.get("RAY_ADDRESS") else most,
        )
    remote = ray.remote(num_cpus=1, max_retries=0)(run_group)

    def submit(jobs: Group) -> Work:
        future = remote.remote(jobs).future()
        # A task cannot be taken back.
        future.set_running_or_notify_cancel()
        return future

    cpus = int(ray.cluster_resources().get("CPU", most))
    death = ray.exceptions.RayError
    return Engine(lambda _: nullcontext(submit), max(1, cpus), death)


def _lines(future: Work) -> Sequence[Line]:
    """Return the lines of a group; raises `Engine.death` if its worker has died."""
    try:
        return future.result()
    except HandmapError as error:
        # Ray's own class of it has the worker's traceback in its text.
        raise getattr(error, "cause", error) from None


def _next_group(waiting: deque[Job], workers: int) -> Group:
    """Take the next jobs for one worker; towards the end fewer, so that all have some."""
    most = max(1, len(waiting) // (2 * workers)) if workers else 1
    frames = accumulate(job.line.frames for job in islice(waiting, most))
    count = max(1, sum(total <= GROUP_FRAMES for total in frames))
    return tuple(waiting.popleft() for _ in range(count))
