"""Run the jobs of a batch under Ray, on one machine or many."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from handmap_qp.datasets.engines import IN_FLIGHT, ONE_THREAD, killed
from handmap_qp.datasets.episode_files import synced
from handmap_qp.datasets.job import Job, run_job
from handmap_qp.datasets.manifest import MOST_KILLS, Line
from handmap_qp.errors import DiskFullError, MissingExtraError


class RayEngine:
    """Runs jobs as Ray tasks of one CPU each, by the same function as the pool.

    Ray is started on this machine unless `RAY_ADDRESS` names a cluster. Inputs and the folder of
    the batch must be on a file system that all nodes share.

    Args:
        workers: Number of CPUs of this machine that Ray may use; a cluster uses all of its own.

    Raises:
        MissingExtraError: If Ray is not installed.
    """

    def __init__(self, workers: int) -> None:
        try:
            import ray
        except ImportError as error:
            raise MissingExtraError("ray", "cluster") from error
        self._ray: Any = ray
        self._workers = workers

    def outcomes(
        self, jobs: Sequence[Job], kills: dict[str, int], is_stopped: Callable[[], bool]
    ) -> Iterator[Line]:
        """Run jobs under Ray; see `Engine`."""
        ray = self._ray
        is_ours = not ray.is_initialized()
        if is_ours:
            self._start()
        try:
            cpus = max(1, int(ray.cluster_resources().get("CPU", self._workers)))
            yield from self._run(deque(jobs), kills, IN_FLIGHT * cpus, is_stopped)
        finally:
            if is_ours:
                ray.shutdown()

    def _start(self) -> None:
        options: dict[str, Any] = {
            "include_dashboard": False,
            "log_to_driver": False,
            "runtime_env": {"env_vars": ONE_THREAD},
        }
        if not os.environ.get("RAY_ADDRESS"):
            options["num_cpus"] = self._workers
        self._ray.init(**options)

    def _run(
        self,
        waiting: deque[Job],
        kills: dict[str, int],
        most: int,
        is_stopped: Callable[[], bool],
    ) -> Iterator[Line]:
        ray = self._ray
        remote = ray.remote(num_cpus=1, max_retries=0)(_run_in_worker)
        flying: dict[Any, Job] = {}
        while (waiting and not is_stopped()) or flying:
            while waiting and not is_stopped() and len(flying) < most:
                job = waiting.popleft()
                flying[remote.remote(job)] = job
            for reference in ray.wait(list(flying), num_returns=1)[0]:
                job = flying.pop(reference)
                try:
                    yield ray.get(reference)
                except DiskFullError as error:
                    # Ray's own class of it has the worker's traceback in its text.
                    raise getattr(error, "cause", error) from None
                except ray.exceptions.RayError:
                    yield killed(job, kills)
                    if kills[job.task.key] < MOST_KILLS:
                        waiting.append(job)


def _run_in_worker(job: Job) -> Line:
    """Run a job in a process that Ray watches."""
    return synced(job.folder, [run_job(job)])[0]
