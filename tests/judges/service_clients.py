"""Clients for the load and fault runs: a moving hand, a steady client, and a robot's driver."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from checker import Checker
from service_process import ServiceProcess

from handmap_qp import load_hand
from handmap_qp.client import (
    Client,
    Command,
    KeyFiles,
    ServiceError,
    ServiceTimeoutError,
)

TIMEOUT = 1.0
_OPENING = 20.0
# Calls may exceed their timeout by this much, because the machine runs other programs too [s].
_GRACE = 0.5
_MEMORY = 15.0
_MAX_DT = 1.0 / 30.0


class HumanMotion:
    """A hand that opens, closes and moves about.

    Args:
        seed: Seed of frequency and phase.
    """

    def __init__(self, seed: int = 0) -> None:
        human = load_hand("human")
        generator = np.random.default_rng(seed)
        self._rest = human.rest
        self._span = 0.25 * (human.upper_limits - human.lower_limits)
        self._middle = 0.5 * (human.upper_limits + human.lower_limits)
        self._frequency, self._phase = (
            generator.uniform(0.2, 1.0),
            generator.uniform(0.0, 6.28),
        )

    def __call__(self, time: float) -> dict[str, Any]:
        """Return the sample at a time [s]: `q` and `wrist`."""
        phase = 2.0 * np.pi * self._frequency * time + self._phase
        q = 0.5 * (self._rest + self._middle) + self._span * np.sin(phase)
        wrist = np.array(
            [
                0.1 * np.sin(0.5 * phase),
                0.05 * np.cos(0.3 * phase),
                0.2,
                0.0,
                0.0,
                0.0,
                1.0,
            ]
        )
        return {"q": q, "wrist": wrist}


class Driver:
    """A robot's driver that only judges its commands.

    Args:
        robot: The robot hand.

    Attributes:
        checker: Judges the commands of one epoch after the other.
        speed: Speed limits of the joints [rad/s].
        commands: Number of commands.
        epochs: Number of changes of the epoch.
        flags: All flags of the commands.
    """

    def __init__(self, robot: str) -> None:
        self._hand = load_hand(robot, mount="fixed")
        self.checker = Checker(self._hand)
        self.speed = self._hand.velocity_limits
        self.commands = self.epochs = 0
        self.flags: set[str] = set()
        self._last: Command | None = None

    def take(self, command: Command) -> None:
        """Take one command, and judge it by the server's time stamps.

        They are of a monotonic clock, which is the machine's and survives a restart. Commands that
        were not heard are within the time between two that were.
        """
        self.flags |= set(command.flags)
        last, self._last = self._last, command
        self.commands += 1
        q = self._hand.configuration_vector(command.q)
        if last is None or last.epoch != command.epoch:
            self.epochs += last is not None
            self.checker.start(q, command.server_time)
            return
        self.checker.take(q, command.server_time)


def open_driver(
    client: Client,
    robot: str = "three_finger",
    **choices: Any,
) -> Driver:
    """Open a session, and return a driver for its robot."""
    client.open(robot, **choices)
    return Driver(robot)


def pace(rate: float, duration: float) -> Iterator[float]:
    """Yield times since the start [s] at a steady rate; late ones follow at once."""
    started = time.monotonic()
    for i in range(round(rate * duration)):
        wait = started + i / rate - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        yield time.monotonic() - started


class Honest(threading.Thread):
    """A well-behaved client at 60 Hz, and the driver that measures its commands.

    Args:
        service: The service.
        seed: Seed of the hand's motion.
        keys: Keys of an encrypted connection.
        streams: Whether samples are only sent, and the driver listens in a client of its own.
            Otherwise each sample is answered.
        jumps: Whether its time stamps jump.
        is_shared: Whether others may steer its session.
        releases: Whether it releases the robot after a second.

    Attributes:
        gaps: Times between its commands [s].
        times: Time of each call [s].
        start_offset: Distance of the assumed posture from the last command where a session was
            reopened, as a share of what three commands may account for.
        is_disobeyed: Whether a released robot moved.
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
        releases: bool = False,
    ) -> None:
        super().__init__(daemon=True)
        # Only opening may take longer, while hands are loaded.
        self.client = Client(service.address, timeout=_OPENING, keys=keys)
        choices = {"name": f"honest-{seed}", "max_dt": _MAX_DT, "is_shared": is_shared}
        self.driver: Driver = open_driver(self.client, "three_finger", **choices)
        self.client.timeout = TIMEOUT
        self._listener = Client(service.address, timeout=TIMEOUT, keys=keys)
        if streams:
            self._listener.watch(choices["name"])
        self.start_offset, self.is_disobeyed = 0.0, False
        self._releases, self._has_released, self._reopened = releases, False, 0
        self.answered, self.timeouts, self.longest = 0, 0, 0.0
        self.gaps: list[float] = []
        self.times: list[float] = []
        self.refusals: list[str] = []
        self.last: Command | None = None
        self._motion, self._streams, self._jumps = HumanMotion(seed), streams, jumps
        self._generator = np.random.default_rng(seed)
        self._ended = threading.Event()

    def run(self) -> None:
        """Work until `end` is called."""
        last = time.monotonic()
        for now in pace(60.0, 1e6):
            if self._ended.is_set():
                break
            started = time.monotonic()
            try:
                command = self._work(now)
                self.times.append(time.monotonic() - started)
                self._look_where_it_starts()
                if command is not None:
                    self.driver.take(command)
                    self.is_disobeyed |= (
                        self._has_released
                        and self.last is not None
                        and command.q != self.last.q
                    )
                    self.last = command
                    self.answered += 1
                    self.gaps.append(time.monotonic() - last)
                    last = time.monotonic()
            except ServiceTimeoutError:
                self.timeouts += 1
            except ServiceError as error:
                self.refusals.append(str(error))
            self.longest = max(self.longest, time.monotonic() - started)

    def end(self) -> None:
        """Stop, and close the session."""
        self._ended.set()
        self.join(10.0)
        with suppress(ServiceError, ServiceTimeoutError):
            self.client.close()
            self._listener.close()

    def _look_where_it_starts(self) -> None:
        """Compare the assumed posture of a reopened session with the last command."""
        opened = self.client.opened
        if (
            self.client.reopened != self._reopened
            and opened is not None
            and self.last is not None
        ):
            offset = np.abs(np.subtract(opened.q, self.last.q)) / (
                self.driver.speed * 3.0 * _MAX_DT
            )
            self.start_offset = max(self.start_offset, float(offset.max()))
        self._reopened = self.client.reopened

    def _work(self, now: float) -> Command | None:
        stamp = (
            now
            if not self._jumps
            else float(
                self._generator.choice([now, -1e9, 1e9, 1e15, 0.0, now - 3600.0])
            )
        )
        if self._releases and now > 1.0 and not self._has_released:
            self.client.release()
            self._has_released = True
        if not self._streams:
            return self.client.step(**self._motion(now), time=stamp)
        self.client.send(**self._motion(now), time=stamp)
        return self._listener.latest(0.005)


@contextmanager
def honest(
    service: ServiceProcess, count: int = 2, *, first: int = 0, **choices: Any
) -> Iterator[list[Honest]]:
    """Run well-behaved clients during the block, named honest-0 and so on.

    Args:
        service: The service.
        count: Number of clients.
        first: Number of the first client.
        **choices: Arguments of `Honest`.
    """
    clients = [Honest(service, first + i, **choices) for i in range(count)]
    for client in clients:
        client.start()
    try:
        yield clients
    finally:
        for client in clients:
            client.end()


def summary(clients: Sequence[Honest], **more: Any) -> dict[str, Any]:
    """Summarise what well-behaved clients measured, and what of it is wrong."""
    found = {
        "commands": sum(client.answered for client in clients),
        "timeouts": sum(client.timeouts for client in clients),
        "refused": sum(len(client.refusals) for client in clients),
        "longest_call_s": max(client.longest for client in clients),
        "fastest_joint": max(
            client.driver.checker.worst["speed"] for client in clients
        ),
        "violations": sum(
            client.driver.checker.violations.total() for client in clients
        ),
        "epochs": sum(client.driver.epochs for client in clients),
        **more,
    }
    wrong = []
    if (
        any(client.is_alive() for client in clients)
        or found["longest_call_s"] > TIMEOUT + _GRACE
    ):
        wrong.append("a call hung")
    if found["violations"]:
        wrong.append("a robot jumped")
    if any(client.start_offset > 1.0 for client in clients):
        wrong.append("a robot was assumed at another posture")
    if any(client.is_disobeyed for client in clients):
        wrong.append("a released robot moved")
    if found.get("memory_growth_MB", 0.0) > _MEMORY:
        wrong.append("memory grew")
    if found.get("failures"):
        wrong.append("the service failed at a request")
    if not found["commands"]:
        wrong.append("no client was served")
    return found | {"wrong": wrong}
