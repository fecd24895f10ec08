"""A mapping service in a separate process, for the load and fault runs."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar


class ServiceProcess:
    """`handmap serve` in a separate process, on loopback, on ports that it keeps over a restart.

    Args:
        **choices: Fields of the command.

    Attributes:
        ports: Its ports by name.
        workers: Numbers of its worker processes, as they were at the start.
        failures: After `stop`: log lines of unexpected exceptions.
        stop_times: Time from SIGTERM to the end of the process, of every service so far [s].
    """

    stop_times: ClassVar[list[float]] = []

    def __init__(self, **choices: Any) -> None:
        self._choices = {
            "port": 0,
            "stream_port": 0,
            "health_port": 0,
            "log_level": "error",
            # Other programs of the machine must not make it refuse sessions.
            "max_load": 1.0,
            **choices,
        }
        self.log = Path(tempfile.mkstemp(suffix=".log")[1])
        self.ports: dict[str, int] = {}
        self.workers: list[int] = []
        self.failures: list[str] = []
        self.start()

    def start(self) -> None:
        """Start the service, and wait until it is ready."""
        kept = {
            "requests": "port",
            "stream": "stream_port",
            "health": "health_port",
            "web": "web_port",
        }
        choices = self._choices | {
            kept[name]: port for name, port in self.ports.items()
        }
        code = (
            "from pathlib import Path, PosixPath\nfrom handmap_qp.apps.service.cli import Serve\n"
            f"Serve(**{choices!r}).run()"
        )
        with self.log.open("a") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-c", code],
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        ready = self.process.stdout.readline() if self.process.stdout else ""
        if not ready:
            raise RuntimeError(
                f"the service did not start: {self.log.read_text()[-2000:]}"
            )
        self.ports = json.loads(ready)["ports"]
        self.workers = json.loads(ready).get("workers", [])

    @property
    def address(self) -> str:
        """Address of the requests."""
        return f"tcp://127.0.0.1:{self.ports['requests']}"

    def kill(self) -> None:
        """Kill the process."""
        self.process.send_signal(signal.SIGKILL)
        self.process.communicate()

    def stop(self) -> None:
        """Stop the service, and delete its log."""
        asked = time.monotonic()
        self.process.terminate()
        try:
            self.process.communicate(timeout=5.0)
        except subprocess.TimeoutExpired:
            self.kill()
        self.stop_times.append(time.monotonic() - asked)
        self.failures = [
            line
            for line in self.log.read_text().splitlines()
            if '"event": "failed"' in line
        ]
        self.log.unlink()

    def memory(self) -> float:
        """Resident memory [MB]."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def busy(self) -> float:
        """Longest CPU time between two turns of the event loop in the last second [s].

        Unlike a gap that a client sees, it does not contain the time of other programs.
        """
        return self.metric("handmap_busy_seconds")

    def metric(self, name: str) -> float:
        """Return a counter or gauge of `/metrics`, 0 for one that does not exist."""
        url = f"http://127.0.0.1:{self.ports['health']}/metrics"
        with urllib.request.urlopen(url, timeout=5.0) as answer:
            text = answer.read().decode()
        return float(text.partition(f"\n{name} ")[2].partition("\n")[0] or 0.0)

    def files(self) -> int:
        """Open files and sockets."""
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    def cpu(self) -> float:
        """CPU time of all its threads so far [s]."""
        return _cpu_of(self.process.pid)

    def worker_cpu(self) -> list[float]:
        """CPU time of each worker process so far [s]."""
        return [_cpu_of(pid) for pid in self.workers]


def _cpu_of(pid: int) -> float:
    """CPU time of all threads of a process so far [s]."""
    # The clock of a process by its number, as of clock_getcpuclockid(3).
    return time.clock_gettime(~pid << 3 | 2)


@contextmanager
def serving(**choices: Any) -> Iterator[ServiceProcess]:
    """Run a service during the block."""
    service = ServiceProcess(**choices)
    try:
        yield service
    finally:
        service.stop()


class MemoryWatch(threading.Thread):
    """Sample a service's resident memory twice per second; a context manager.

    Args:
        service: The service.
    """

    def __init__(self, service: ServiceProcess) -> None:
        super().__init__(daemon=True)
        self._service = service
        self._seen: list[float] = []
        self._ended = threading.Event()

    def run(self) -> None:
        """Sample until the block ends."""
        while not self._ended.is_set():
            self._seen.append(self._service.memory())
            self._ended.wait(0.5)

    def __enter__(self) -> MemoryWatch:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self.join()

    def found(self) -> dict[str, float]:
        """Return memory at the start and at the end [MB], and its growth.

        The growth is counted after two fifths of the time, when caches are filled.
        """
        warm = max(self._seen[: max(1, 2 * len(self._seen) // 5)])
        return {
            "memory_start_MB": self._seen[0],
            "memory_end_MB": self._seen[-1],
            "memory_growth_MB": max(0.0, self._seen[-1] - warm),
        }


@contextmanager
def echoing() -> Iterator[dict[str, int]]:
    """Run a bare echo of both transports in a separate process; yield its ports."""
    process = subprocess.Popen(
        [sys.executable, __file__], stdout=subprocess.PIPE, text=True
    )
    try:
        yield json.loads(process.stdout.readline() if process.stdout else "")
    finally:
        process.terminate()
        process.communicate(timeout=30.0)


async def _echo() -> None:
    """Send every message back, with the event loop and libraries of the service."""
    import zmq.asyncio
    from websockets.asyncio.server import ServerConnection, serve

    async def answer(connection: ServerConnection) -> None:
        async for message in connection:
            await connection.send(message)

    router = zmq.asyncio.Context.instance().socket(zmq.ROUTER)
    port = router.bind_to_random_port("tcp://127.0.0.1")
    async with serve(answer, "127.0.0.1", 0, compression=None) as web:
        print(
            json.dumps(
                {"requests": port, "web": next(iter(web.sockets)).getsockname()[1]}
            ),
            flush=True,
        )
        while True:
            await router.send_multipart(await router.recv_multipart())


if __name__ == "__main__":
    asyncio.run(_echo())
