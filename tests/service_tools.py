"""What the tests of the service share: a server in a thread, a session without one, and a hand that moves."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handmap_qp.client import Client, ServiceError
from handmap_qp.service.messages import PROTOCOL, Command, Configure, Open, Pose, Reset, Step
from handmap_qp.service.opening import Calibration, Hands, HandShelf, prepare_hands
from handmap_qp.service.server import Server, Settings
from handmap_qp.service.session import Posture, Session

SHELF = HandShelf()
"""Hands are loaded once for all tests."""
HERE = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
SECRET = "a-secret-of-the-tests"
PERIOD = 1.0 / 60.0
RESET = Reset(protocol=PROTOCOL, seq=99)
LOCAL = Settings(port=0, stream_port=0, health_port=None)


def human_q(phase: float = 0.0, robot: str = "three_finger") -> np.ndarray:
    """Joint angles of a human hand that closes and opens, shape (20,)."""
    human = SHELF.human("right", None)
    middle, half = 0.5 * (human.lower_limits + human.upper_limits), 0.5 * (human.upper_limits - human.lower_limits)
    return human.rest + (middle - human.rest) * 0.3 + 0.4 * half * np.sin(phase)


def opening(robot: str = "three_finger", **choices: Any) -> Open:
    """A request to open a session."""
    return Open(protocol=PROTOCOL, seq=1, session=SECRET, robot=robot, **choices)


def change(**changes: Any) -> Configure:
    """A request to change options."""
    return Configure(protocol=PROTOCOL, seq=99, session=SECRET, **changes)


def code_of(raised: pytest.ExceptionInfo[ServiceError]) -> tuple[str, str]:
    """What a refusal says: its code, and the field at fault."""
    return raised.value.error.code, raised.value.error.field


def run_now(work: Callable[[], Hands]) -> Future[Hands]:
    """What a server does in another thread, done at once."""
    done: Future[Hands] = Future()
    try:
        done.set_result(work())
    except Exception as error:
        done.set_exception(error)
    return done


def make_session(now: float = 0.0, robot: str = "three_finger", **choices: Any) -> Session:
    """A session without a server."""
    request = opening(robot, **choices)
    return Session(request, prepare_hands(request, SHELF), "test", now, calibration=Calibration(request, SHELF, run_now))


class Sampler:
    """Makes samples with numbers that increase, as of a client."""

    def __init__(self) -> None:
        self.seq = 1

    def __call__(self, time: float = 0.0, q: Any = None, wrist: Pose | None = HERE, **human: Any) -> Step:
        self.seq += 1
        angles = None if human else tuple(np.asarray(human_q() if q is None else q).tolist())
        pose = None if "landmarks" in human else wrist
        return Step(protocol=PROTOCOL, seq=self.seq, session=SECRET, time=time, q=angles, wrist=pose, **human)


def speeds(session: Session, before: np.ndarray, command: Command, time: float) -> np.ndarray:
    """Joint speeds as parts of their limits, shape (n,)."""
    return np.abs(np.array(command.q) - before) / (session.robot.velocity_limits * time)


def moved_points(session: Session, before: Posture) -> float:
    """How far the fingertips have gone [m]: at a new reference not far, though joints may drift towards rest meanwhile."""
    return float(np.linalg.norm(session.robot.points(*session.posture) - session.robot.points(*before), axis=1).max())


def follow(session: Session, sample: Sampler, start: float, count: int = 20) -> float:
    """Steps at 60 Hz; the time of the last one."""
    for i in range(count):
        session.step(sample(i * PERIOD, human_q(0.1 * i)), start + i * PERIOD)
    return start + (count - 1) * PERIOD


@contextmanager
def serving(settings: Settings = LOCAL, **changes: Any) -> Iterator[Server]:
    """A server in a thread of its own, on ports of the system's choice."""
    started: Future[Server] = Future()
    ended: Future[Callable[[], Any]] = Future()

    async def main() -> None:
        server = Server(replace(settings, **changes))
        done = asyncio.Event()
        loop = asyncio.get_running_loop()
        ended.set_result(lambda: loop.call_soon_threadsafe(done.set))
        try:
            await server.start()
            started.set_result(server)
            await done.wait()
        except BaseException as error:
            started.set_exception(error)
            raise
        finally:
            await server.stop()

    def run() -> None:
        try:
            asyncio.run(main())
        except BaseException as error:
            if not started.done():
                started.set_exception(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield started.result(timeout=10.0)
    finally:
        # The loop is closed already where the server could not start.
        with suppress(RuntimeError):
            ended.result(timeout=10.0)()
        thread.join(timeout=10.0)


def address_of(server: Server) -> str:
    return f"tcp://127.0.0.1:{server.ports['requests']}"


@contextmanager
def connected(server: Server, **choices: Any) -> Iterator[Client]:
    """A client with an open session."""
    with Client(address_of(server), timeout=3.0) as client:
        client.open(choices.pop("robot", "three_finger"), **choices)
        yield client
