"""A mapping service in a process of its own, for the load and fault runs: started, watched, killed and started again."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp import load_hand
from handmap_qp.client import Client, Command

_TICKS = os.sysconf("SC_CLK_TCK")


class ServiceProcess:
    """`handmap serve` in a process of its own, on loopback, on ports of the system's choice that stay over a restart.

    Args:
        **choices: Fields of the command.
    """

    def __init__(self, **choices: Any) -> None:
        self._choices = {"port": 0, "stream_port": 0, "health_port": 0, "log_level": "error", **choices}
        self.log = Path(tempfile.mkstemp(suffix=".log")[1])
        self.ports: dict[str, int] = {}
        self.starts = 0
        self.start()

    def start(self) -> None:
        """Start it, and wait until it is ready."""
        kept = {"requests": "port", "stream": "stream_port", "health": "health_port", "web": "web_port"}
        choices = self._choices | {kept[name]: port for name, port in self.ports.items()}
        code = f"from pathlib import Path, PosixPath\nfrom handmap_qp.service.cli import Serve\nServe(**{choices!r}).run()"
        with self.log.open("a") as log:
            self.process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=log, text=True)
        ready = self.process.stdout.readline() if self.process.stdout else ""
        if not ready:
            raise RuntimeError(f"the service did not start: {self.log.read_text()[-2000:]}")
        self.ports = json.loads(ready)["ports"]
        self.starts += 1

    @property
    def address(self) -> str:
        """Where requests go."""
        return f"tcp://127.0.0.1:{self.ports['requests']}"

    def kill(self) -> None:
        """End it hard."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def stop(self) -> None:
        """End it, and throw its log away."""
        self.process.terminate()
        try:
            self.process.wait(5.0)
        except subprocess.TimeoutExpired:
            self.kill()
        self.log.unlink(missing_ok=True)

    def memory(self) -> float:
        """Resident memory [MB]."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def files(self) -> int:
        """Open files and sockets."""
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    def cpu(self) -> float:
        """CPU time so far [s]."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS

    def failures(self) -> int:
        """Failures that it logged: requests that met a bug."""
        return sum('"event": "failed"' in line for line in self.log.read_text().splitlines())


@contextmanager
def serving(**choices: Any) -> Iterator[ServiceProcess]:
    """A service while the block runs."""
    service = ServiceProcess(**choices)
    try:
        yield service
    finally:
        service.stop()


@contextmanager
def echoing() -> Iterator[dict[str, int]]:
    """A bare echo of both transports in a process of its own: no messages read, nothing mapped. Gives its ports."""
    process = subprocess.Popen([sys.executable, __file__], stdout=subprocess.PIPE, text=True)
    try:
        yield json.loads(process.stdout.readline() if process.stdout else "")
    finally:
        process.terminate()
        process.wait(5.0)


async def _echo() -> None:
    """Send everything back, in the same loop and by the same libraries as the service."""
    import zmq.asyncio
    from websockets.asyncio.server import ServerConnection, serve

    async def answer(connection: ServerConnection) -> None:
        async for message in connection:
            await connection.send(message)

    router = zmq.asyncio.Context.instance().socket(zmq.ROUTER)
    port = router.bind_to_random_port("tcp://127.0.0.1")
    async with serve(answer, "127.0.0.1", 0, compression=None) as web:
        print(json.dumps({"requests": port, "web": next(iter(web.sockets)).getsockname()[1]}), flush=True)
        while True:
            await router.send_multipart(await router.recv_multipart())


class HumanMotion:
    """A person whose hand opens, closes and wanders about, on embedded data.

    Args:
        seed: Whom and how fast.
    """

    def __init__(self, seed: int = 0) -> None:
        human = load_hand("human")
        generator = np.random.default_rng(seed)
        self._rest = human.rest
        self._span = 0.25 * (human.upper_limits - human.lower_limits)
        self._middle = 0.5 * (human.upper_limits + human.lower_limits)
        self._frequency, self._phase = generator.uniform(0.2, 1.0), generator.uniform(0.0, 6.28)

    def __call__(self, time: float) -> dict[str, Any]:
        """The sample at an instant [s]: `q` and `wrist`."""
        phase = 2.0 * np.pi * self._frequency * time + self._phase
        q = 0.5 * (self._rest + self._middle) + self._span * np.sin(phase)
        wrist = np.array([0.1 * np.sin(0.5 * phase), 0.05 * np.cos(0.3 * phase), 0.2, 0.0, 0.0, 0.0, 1.0])
        return {"q": q, "wrist": wrist}


@dataclass
class Driver:
    """A robot's driver that only looks: how fast was it told to go?

    Attributes:
        speed: Limits of the joints' speed [rad/s].
        fastest: Highest speed between two commands, as a part of its limit.
        commands: How many came.
    """

    speed: np.ndarray
    fastest: float = 0.0
    commands: int = 0
    flags: set[str] = field(default_factory=set)
    _last: Command | None = None

    def take(self, command: Command) -> None:
        """One more command; times are the server's, whose monotonic clock is the machine's and goes on over a restart."""
        self.flags |= set(command.flags)
        last, self._last = self._last, command
        self.commands += 1
        if last is not None and command.server_time > last.server_time:
            moved = np.abs(np.subtract(command.q, last.q))
            self.fastest = max(self.fastest, float((moved / (self.speed * (command.server_time - last.server_time))).max()))
        elif last is not None and command.q != last.q:
            self.fastest = np.inf


def open_driver(client: Client, robot: str = "three_finger", **choices: Any) -> Driver:
    """Open a session, and a driver for its robot."""
    return Driver(np.array(client.open(robot, **choices).speed))


def pace(rate: float, duration: float) -> Iterator[float]:
    """Instants since the start [s] at a steady rate; late ones follow at once, so that none is left out."""
    started = time.monotonic()
    for i in range(round(rate * duration)):
        wait = started + i / rate - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        yield time.monotonic() - started


if __name__ == "__main__":
    asyncio.run(_echo())
