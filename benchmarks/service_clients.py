"""Clients for the load and fault runs: a hand that moves, a client that works steadily, a driver that watches what it is told."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from service_process import ServiceProcess

from handmap_qp import load_hand
from handmap_qp.client import Client, Command, KeyFiles, ServiceError, ServiceTimeoutError

TIMEOUT = 1.0
# Calls may be this much longer than their timeout: other programs want the machine too [s].
_GRACE = 0.5
_MEMORY = 15.0
_ROUNDING = 1e-6


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
        if last is not None and last.restarts != command.restarts:
            # A reset has said that the robot is elsewhere.
            return
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


class Honest(threading.Thread):
    """A client that goes on with its work at 60 Hz, and a driver that watches what it is told.

    Args:
        service: The service.
        seed: Whose hand moves.
        keys: Keys of an encrypted connection.
        streams: Whether samples are streamed rather than answered one by one.
        jumps: Whether its time stamps jump about.
        is_shared: Whether others may steer its session.
    """

    def __init__(
        self,
        service: ServiceProcess,
        seed: int = 0,
        *,
        keys: KeyFiles | None = None,
        streams: bool = False,
        jumps: bool = False,
        is_shared: bool = False,
    ) -> None:
        super().__init__(daemon=True)
        self.client = Client(service.address, timeout=TIMEOUT, keys=keys)
        choices = {"name": f"honest-{seed}", "max_dt": 1.0 / 30.0, "is_shared": is_shared}
        self.driver: Driver = open_driver(self.client, "three_finger", **choices)
        self.answered, self.timeouts, self.longest = 0, 0, 0.0
        self.refusals: list[str] = []
        self.last: Command | None = None
        self._motion, self._streams, self._jumps = HumanMotion(seed), streams, jumps
        self._generator = np.random.default_rng(seed)
        self._ended = threading.Event()

    def run(self) -> None:
        """Work until told to end."""
        for now in pace(60.0, 1e6):
            if self._ended.is_set():
                break
            started = time.monotonic()
            try:
                command = self._work(now)
                if command is not None:
                    self.driver.take(command)
                    self.last = command
                    self.answered += 1
            except ServiceTimeoutError:
                self.timeouts += 1
            except ServiceError as error:
                self.refusals.append(str(error))
            self.longest = max(self.longest, time.monotonic() - started)

    def end(self) -> None:
        """End, and close the session."""
        self._ended.set()
        self.join(10.0)
        with suppress(ServiceError, ServiceTimeoutError):
            self.client.close()

    def _work(self, now: float) -> Command | None:
        stamp = now if not self._jumps else float(self._generator.choice([now, -1e9, 1e9, 1e15, 0.0, now - 3600.0]))
        if not self._streams:
            return self.client.step(**self._motion(now), time=stamp)
        self.client.send(**self._motion(now), time=stamp)
        return self.client.latest(0.005)


@contextmanager
def honest(service: ServiceProcess, count: int = 2, *, first: int = 0, **choices: Any) -> Iterator[list[Honest]]:
    """Honest clients at work while the block runs; their names are honest-0 and so on, or from another number."""
    clients = [Honest(service, first + i, **choices) for i in range(count)]
    for client in clients:
        client.start()
    try:
        yield clients
    finally:
        for client in clients:
            client.end()


def told(clients: Sequence[Honest], **more: Any) -> dict[str, Any]:
    """What honest clients have seen, and whether it is as it should be."""
    found = {
        "commands": sum(client.answered for client in clients),
        "timeouts": sum(client.timeouts for client in clients),
        "refused": sum(len(client.refusals) for client in clients),
        "longest_call_s": max(client.longest for client in clients),
        "fastest_joint": max(client.driver.fastest for client in clients),
        **more,
    }
    wrong = []
    if any(client.is_alive() for client in clients) or found["longest_call_s"] > TIMEOUT + _GRACE:
        wrong.append("a call hung")
    if not found["fastest_joint"] <= 1.0 + _ROUNDING:
        wrong.append("a robot jumped")
    if found.get("memory_growth_MB", 0.0) > _MEMORY:
        wrong.append("memory grew")
    if found.get("failures"):
        wrong.append("the service failed at a request")
    if not found["commands"]:
        wrong.append("nobody was served")
    return found | {"wrong": wrong}
