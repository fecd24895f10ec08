"""Shared by the tests of the service: a server in a thread, a session without one, samples."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import pytest
import zmq
from patience import PATIENCE, wait_until
from zmq.auth import load_certificate
from zmq.utils.monitor import recv_monitor_message

from handmap_qp.apps.service.opening import HandCache, Hands, prepare_hands
from handmap_qp.apps.service.server import Server
from handmap_qp.apps.service.session import Posture, Session
from handmap_qp.apps.service.settings import Settings
from handmap_qp.client import Client, KeyFiles, ServiceError
from handmap_qp.client import Command as HeardCommand
from handmap_qp.client.messages import (
    PROTOCOL,
    Command,
    Configure,
    Open,
    Pose,
    Preset,
    Reset,
    Sample,
    Step,
)

CACHE = HandCache()
"""Load hands once for all tests."""
HERE = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
SECRET = "a-secret-of-the-tests"
PERIOD = 1.0 / 60.0
RESET = Reset(protocol=PROTOCOL, seq=99)
# No session is refused because the machine of the tests is busy.
LOCAL = Settings(port=0, stream_port=0, health_port=-1, max_load=1.0)
WEB: dict[str, Any] = {"web": True, "web_port": 0}
"""Settings of a server with WebSocket."""
T = TypeVar("T")


def human_q(phase: float = 0.0) -> np.ndarray:
    """Return joint angles of a human hand that closes and opens [rad], shape (20,)."""
    human = CACHE.human("right", None)
    middle, half = (
        0.5 * (human.lower_limits + human.upper_limits),
        0.5 * (human.upper_limits - human.lower_limits),
    )
    return human.rest + (middle - human.rest) * 0.3 + 0.4 * half * np.sin(phase)


def opening(
    robot: str = "three_finger", preset: Preset | None = "paper", **choices: Any
) -> Open:
    """Return a request to open a session.

    With the preset `paper`, the robot stays where it is at the first sample.
    """
    return Open(
        protocol=PROTOCOL, seq=1, session=SECRET, robot=robot, preset=preset, **choices
    )


def change(**changes: Any) -> Configure:
    """Return a request to change options."""
    return Configure(protocol=PROTOCOL, seq=99, session=SECRET, **changes)


def code_of(raised: pytest.ExceptionInfo[ServiceError]) -> tuple[str, str]:
    """Return the code of a refusal and the field at fault."""
    return raised.value.error.code, raised.value.error.field


def run_now(work: Callable[..., Hands], *values: Any, **choices: Any) -> Future[Hands]:
    """Run at once what a server runs in another thread."""
    done: Future[Hands] = Future()
    try:
        done.set_result(work(*values, **choices))
    except Exception as error:
        done.set_exception(error)
    return done


def make_session(
    now: float = 0.0, robot: str = "three_finger", **choices: Any
) -> Session:
    """Make a session without a server."""
    request = opening(robot, **choices)
    hands = prepare_hands(request, CACHE, defer=run_now)
    return Session(request, hands, "test", now)


class Sampler:
    """Make samples with increasing numbers, as a client does."""

    def __init__(self) -> None:
        self.seq = 1
        self._landmarks: Any = None

    def __call__(
        self, time: float = 0.0, q: Any = None, wrist: Pose | None = HERE, **human: Any
    ) -> Step:
        self.seq += 1
        if (points := human.get("landmarks")) is not None:
            if points == self._landmarks:
                # Landmarks that repeat exactly would be frozen data.
                (x, y, z), *others = points
                human = human | {"landmarks": ((x + 1e-9 * self.seq, y, z), *others)}
            self._landmarks = points
        angles = (
            None if human else tuple(np.asarray(human_q() if q is None else q).tolist())
        )
        pose = None if "landmarks" in human else wrist
        return Step(
            protocol=PROTOCOL,
            seq=self.seq,
            session=SECRET,
            time=time,
            q=angles,
            wrist=pose,
            **human,
        )


def streamed(step: Step) -> Sample:
    """Convert to a sample without an answer."""
    return Sample(**msgspec.structs.asdict(step))


def speeds(
    session: Session, before: np.ndarray, command: Command, time: float
) -> np.ndarray:
    """Return joint speeds as shares of their limits, shape (n,)."""
    return np.abs(np.array(command.q) - before) / (session.robot.velocity_limits * time)


def accelerations(commands: Sequence[Command]) -> np.ndarray:
    """Return joint accelerations from command to command, by the times of the commands.

    Args:
        commands: Commands of one robot, k of them with n joints, also of several sessions.

    Returns:
        Accelerations [rad/s^2], shape (k - 2, n).
    """
    times = np.diff([command.server_time for command in commands])[:, None]
    velocities = np.diff([command.q for command in commands], axis=0) / times
    return np.diff(velocities, axis=0) / times[1:]


def moved_points(session: Session, before: Posture) -> float:
    """Return the largest displacement of a reference point [m].

    At a new reference it is small, but joints may drift towards rest meanwhile.
    """
    return float(
        np.linalg.norm(
            session.robot.points(*session.posture) - session.robot.points(*before),
            axis=1,
        ).max()
    )


def follow(session: Session, sample: Sampler, start: float, count: int = 20) -> float:
    """Map samples at 60 Hz; return the time of the last one [s]."""
    for i in range(count):
        session.step(sample(i * PERIOD, human_q(0.1 * i)), start + i * PERIOD)
    return start + (count - 1) * PERIOD


def token_file(folder: Path, token: str) -> Path:
    """Write a file with a token that only its owner can read."""
    file = folder / "token"
    file.touch(mode=0o600)
    file.write_text(token, encoding="utf-8")
    return file


@contextmanager
def serving(settings: Settings = LOCAL, **changes: Any) -> Iterator[Server]:
    """Run a server in a thread, on free ports."""
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
        yield started.result(timeout=PATIENCE)
    finally:
        # The loop is closed already if the server could not start.
        with suppress(RuntimeError):
            # A server that could not be made has nothing to end.
            if ended.done():
                ended.result()()
        thread.join(timeout=PATIENCE)


def in_loop(server: Server, work: Callable[[], T]) -> T:
    """Run a function in the event loop of a running server."""

    async def act() -> T:
        return work()

    return asyncio.run_coroutine_threadsafe(act(), server._loop).result(PATIENCE)


def lose_sessions(server: Server) -> None:
    """Make a running server lose its sessions as by a restart with `--state`, silently."""
    sessions = server.dispatcher.sessions

    def lose() -> None:
        for session in sessions.by_secret.values():
            sessions.store.note(session.record)
        sessions.by_secret.clear()

    in_loop(server, lose)


def skip(server: Server, seconds: float) -> None:
    """Advance the clock of a running server, and let it act [s]."""
    dispatcher = server.dispatcher

    def act() -> None:
        before = dispatcher.sessions.clock
        dispatcher.sessions.clock = lambda: before() + seconds
        dispatcher.tick()

    in_loop(server, act)


def address_of(server: Server) -> str:
    return f"tcp://127.0.0.1:{server.ports['requests']}"


def client_of(server: Server, **choices: Any) -> Client:
    """Make a client with a long timeout."""
    return Client(address_of(server), timeout=PATIENCE, **choices)


@contextmanager
def connected(
    server: Server,
    robot: str = "three_finger",
    preset: Preset | None = "paper",
    **choices: Any,
) -> Iterator[Client]:
    """Make a client with an open session."""
    with client_of(server) as client:
        client.open(robot, preset=preset, **choices)
        yield client


def heard(listener: Client, stamp: float) -> HeardCommand:
    """Wait for the command that answers a sample, by its time stamp.

    The watchdog repeats it, in case the first one was missed.
    """

    def listen() -> HeardCommand | None:
        command = listener.latest(0.1)
        return command if command is not None and command.time == stamp else None

    return wait_until(listen)


def send_until_reopened(client: Client, **sample: Any) -> None:
    """Send a sample until the client has reopened its lost session."""

    def send() -> int:
        client.send(**sample)
        return client.reopened

    wait_until(send)


def assert_no_jump(client: Client, before: HeardCommand, after: HeardCommand) -> None:
    """Assert that the robot moved no farther than one command may move it."""
    assert client.opened is not None
    assert (
        np.abs(np.subtract(after.q, before.q))
        <= np.array(client.opened.speed) / 30.0 + 1e-9
    ).all()


@contextmanager
def bare_connection(
    server: Server, keys: KeyFiles | None = None
) -> Iterator[tuple[zmq.Socket, Callable[[], int]]]:
    """Connect a bare socket; yield it and a function that returns the next connection event."""
    with (
        zmq.Context() as context,
        context.socket(zmq.DEALER) as socket,
        socket.get_monitor_socket() as monitor,
    ):
        socket.linger, monitor.rcvtimeo = 0, int(1e3 * PATIENCE)
        if keys is not None:
            socket.curve_publickey, socket.curve_secretkey = load_certificate(keys[0])
            socket.curve_serverkey = load_certificate(keys[1])[0]
        socket.connect(address_of(server))
        yield socket, lambda: recv_monitor_message(monitor)["event"]
