"""Client of the mapping service (`handmap serve`).

One file that needs numpy, msgspec and pyzmq, and may be copied anywhere.

    with Client() as client:
        client.open("allegro_right", mapping={"rigid_from": "wrist"})
        command = client.step(q=human_q, wrist=wrist_pose)    # every sample is answered
        client.send(q=human_q, wrist=wrist_pose)              # or samples in and commands out,
        where the newest counts command = client.latest(timeout=0.1)

Another process, say the robot's driver, calls `watch` with the session's name, and `latest`.
`AsyncClient` is the same with `await`. A call without an answer in time raises
`ServiceTimeoutError`. On a server that was restarted, the session is opened anew where the robot
is. SI and radians; `handmap serve --schema` describes all fields. A client is for one thread, or
one event loop.
"""

from __future__ import annotations

import asyncio
import math
import secrets
import time as clock
from collections.abc import Callable, Generator
from contextlib import AbstractAsyncContextManager, AbstractContextManager, suppress
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
import zmq
import zmq.auth

PROTOCOL = 1
ADDRESS = "tcp://127.0.0.1:5570"
Numbers = tuple[float, ...]
Names = tuple[str, ...]
KeyFiles = tuple[Path | str, Path | str]


class Pose(msgspec.Struct, frozen=True):
    """A pose: origin [m] and unit quaternion, its scalar last."""

    position: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]

    @property
    def matrix(self) -> np.ndarray:
        """The same as (4, 4)."""
        x, y, z, w = np.array(self.quat_xyzw) / np.linalg.norm(self.quat_xyzw)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        rotation = np.eye(3) + 2.0 * (w * cross + cross @ cross)
        return np.vstack([np.column_stack([rotation, self.position]), [0.0, 0.0, 0.0, 1.0]])

    @classmethod
    def of(cls, pose: Pose | npt.ArrayLike, name: str = "pose") -> Pose:
        """The pose of a (4, 4) matrix, or of seven numbers x y z qx qy qz qw.

        Raises `ValueError` if it is none.
        """
        if isinstance(pose, Pose):
            return pose
        values = np.asarray(pose, dtype=float)
        if values.shape == (7,):
            return cls(tuple(values[:3].tolist()), tuple(values[3:].tolist()))
        if values.shape != (4, 4):
            raise ValueError(
                f"{name}: expected shape (4, 4), or 7 numbers, got shape {values.shape}"
            )
        R, K = values[:3, :3], np.empty((4, 4))
        # Of a hand that is lost, many trackers send zeros.
        if not (
            np.abs(R.T @ R - np.eye(3)).max() <= 1e-3
            and np.linalg.det(R) > 0.0
            and (values[3] == (0, 0, 0, 1)).all()
        ):
            raise ValueError(
                f"{name}: expected a rotation and a translation, got {values.tolist()}"
            )
        # The quaternion is an eigenvector of this matrix (Bar-Itzhack 2000), which has no singular
        # case; its lower half will do.
        K[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
        K[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], np.trace(R)
        return cls(tuple(values[:3, 3].tolist()), tuple(np.linalg.eigh(K)[1][:, 3].tolist()))


class _Reply(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag=str.lower):
    seq: int = 0


class Opened(_Reply, frozen=True):
    """An open session.

    Its name, the robot's joints with their limits, and where the robot is taken to be [rad].
    """

    name: str
    joint_names: Names
    lower: Numbers
    upper: Numbers
    speed: Numbers
    q: Numbers
    human_joint_names: Names
    human_point_names: Names
    is_floating: bool
    stream_port: int = 0


class Command(_Reply, frozen=True):
    """What a robot's driver takes.

    `q` [rad] in the order of `joint_names`, the wrist's pose, and how they came about.
    """

    name: str
    time: float
    server_time: float
    joint_names: Names
    q: Numbers
    wrist: Pose | None
    status: str
    flags: Names = ()
    point_error: Numbers = ()
    residual: float = 0.0
    at_limit: Names = ()
    out_of_range: Names = ()
    epoch: int = 0
    dt: float = 0.0
    solve_time: float = 0.0
    detail: dict[str, Any] | None = None


class State(_Reply, frozen=True):
    """How a session is, or the server."""

    version: str
    uptime: float
    names: Names
    mode: str = "serving"
    counts: dict[str, int] = {}
    robots: Names = ()
    is_released: bool = False
    q: Numbers = ()
    stream_port: int = 0
    about: dict[str, Any] | None = None


class Done(_Reply, frozen=True):
    """A request was carried out."""


class Error(_Reply, frozen=True):
    """A request was refused; the session goes on as it was."""

    code: str
    message: str
    field: str = ""


class ServiceError(RuntimeError):
    """The server has refused a request: `error` says why, and names the field."""

    def __init__(self, error: Error) -> None:
        super().__init__(
            ": ".join(part for part in (error.code, error.field, error.message) if part)
        )
        self.error = error


class ServiceTimeoutError(TimeoutError):
    """No answer came in time."""


# Heartbeats find out about lines that are dead, of which nobody tells.
_OPTIONS = (
    (zmq.IPV6, 1),
    (zmq.LINGER, 0),
    (zmq.RECONNECT_IVL, 50),
    (zmq.HEARTBEAT_IVL, 1000),
    (zmq.HEARTBEAT_TIMEOUT, 3000),
)
# Arrays of any kind, wherever they are, travel as lists.
_ENCODE = msgspec.msgpack.Encoder(enc_hook=lambda value: np.asarray(value).tolist()).encode
R = TypeVar("R")
_Work = Generator[tuple[zmq.Socket, int, float], bool, R]
"""What a call does, but for the waiting.

It yields a socket, an event and until when, and is sent whether the event came.
"""


def _call(work: Callable[..., _Work[Any]]) -> Callable[..., Any]:
    """A method of both clients, written once.

    It gives the answer itself in `Client`, and what can be awaited in `AsyncClient`.
    """
    return wraps(work)(lambda client, *args, **kwargs: client._run(work(client, *args, **kwargs)))


class _Connection:
    """Sockets and messages: all that `Client` and `AsyncClient` share.

    A call takes `timeout` [s] at most, over `attempts` connections one after the other. `keys` are
    files of `handmap keys`: this client's `NAME.key_secret`, and `server.key`. `opened` is the
    session, and `reopened` how often it had to be opened anew.
    """

    def __init__(
        self,
        address: str = ADDRESS,
        *,
        timeout: float = 2.0,
        attempts: int = 2,
        keys: KeyFiles | None = None,
    ) -> None:
        if "://" not in address or not address.rpartition(":")[2].isdigit():
            raise ValueError(f"expected an address such as {ADDRESS}, got {address!r}")
        self.address, self.timeout, self.attempts = address, timeout, attempts
        self._keys = (
            None
            if keys is None
            else (*zmq.auth.load_certificate(keys[0]), zmq.auth.load_certificate(keys[1])[0])
        )
        if self._keys is not None and self._keys[1] is None:
            raise ValueError(
                f"{keys}: expected NAME.key_secret and server.key; the first holds no secret key"
            )
        self.opened: Opened | None = None
        self._decode = msgspec.msgpack.Decoder(Opened | Command | State | Done | Error).decode
        self._sockets, self._waits = dict[str, zmq.Socket](), dict[zmq.Socket, asyncio.Event]()
        self._request, self._last = dict[str, Any](), None
        self.reopened, self._seq, self._who, self._stream = 0, 0, {"session": ""}, ("", 0)
        self._acted, self._turns = 0, (asyncio.Lock(), asyncio.Lock())

    def _socket(self, use: str) -> zmq.Socket:
        """The socket for `requests`, `samples` or the `stream`, made when it is first needed."""
        if use in self._sockets:
            return self._sockets[use]
        socket = self._sockets[use] = zmq.Context.instance().socket(
            zmq.SUB if use == "stream" else zmq.DEALER
        )
        host, _, port = self.address.rpartition(":")
        # A request waits here until there is a connection; of samples and commands, the newest one
        # waits in the socket.
        socket.setsockopt(zmq.IMMEDIATE if use == "requests" else zmq.CONFLATE, 1)
        for option, value in _OPTIONS:
            socket.setsockopt(option, value)
        if self._keys is not None:
            socket.curve_publickey, socket.curve_secretkey, socket.curve_serverkey = self._keys
        if use == "stream":
            name, port = self._stream
            socket.setsockopt(zmq.SUBSCRIBE, name.encode() + b"\0")
        socket.connect(f"{host}:{port}")
        return socket

    def _drop(self, *uses: str) -> None:
        for use in self._sockets.keys() & uses:
            # A task that waits for it goes on, before its descriptor becomes another socket's.
            if changed := self._waits.pop(socket := self._sockets.pop(use), None):
                asyncio.get_running_loop().remove_reader(socket.FD)
                changed.set()
            socket.close(linger=0)

    def _number(self, request: dict[str, Any]) -> dict[str, Any]:
        """The request as it is sent next: its number, and the session that it is for."""
        self._seq += 1
        return (
            ({} if request["type"] == "open" else self._who)
            | request
            | {"protocol": PROTOCOL, "seq": self._seq}
        )

    open = _call(
        lambda self, robot, **choices: self._exchange(
            _message("open", robot=robot, **choices), Opened
        )
    )
    open.__doc__ = "Open a session on `robot`; choices are the fields of `open`: `input`, `robot_q`, `mapping` and so on."
    step = _call(lambda self, **sample: self._exchange(_message("step", **sample), Command))
    step.__doc__ = "Map one sample: `q` [rad] and `wrist` (4, 4), `landmarks` (21, 3) [m], or `points` (n, 3) [m]; `time` [s]."
    clutch = _call(lambda self: self._exchange(_message("clutch"), Done))
    clutch.__doc__ = "Take hold (again): the next sample is the reference, and the robot goes on from where it is."
    release = _call(lambda self: self._exchange(_message("release"), Done))
    release.__doc__ = "Let go: the robot holds still until `clutch`."
    reset = _call(lambda self, **start: self._exchange(_message("reset", **start), Done))
    reset.__doc__ = "Start anew where `robot_q` and `robot_wrist` say the robot is; without them it goes to rest within its limits."
    configure = _call(
        lambda self, **changes: self._exchange(_message("configure", **changes), Done)
    )
    configure.__doc__ = "Change `mapping`, `ik`, `has_detail` as of `open`; options not named, and the reference, stay as they are."
    status = _call(lambda self: self._exchange(_message("status"), State))
    status.__doc__ = "How the session is; the server, if none is open."

    @_call
    def send(self, **sample: Any) -> _Work[None]:
        """Send a sample as of `step` and do not wait for its command, which comes in the stream.

        The newest counts.
        """
        if self.opened is None:
            raise RuntimeError("open a session first")
        if self._socket("samples").poll(0) and isinstance(reply := self._take("samples"), Error):
            # Of an earlier sample; what is wrong inside one is told in the stream.
            if reply.code != "no_session":
                raise ServiceError(reply)
            yield from self._reopen(clock.monotonic() + self.timeout)
        self._socket("samples").send(
            _ENCODE(self._number(_message("sample", **sample))), zmq.NOBLOCK
        )

    @_call
    def latest(self, timeout: float = 0.0) -> _Work[Command | None]:
        """The newest command of the stream.

        None if there has been none since the last call, nor is within `timeout` [s].
        """
        until = clock.monotonic() + timeout
        if not self._stream[1]:
            raise RuntimeError("open a session first, or watch one")
        while not (yield self._socket("stream"), zmq.POLLIN, until):
            # Another task's call may have put another socket in its place, or closed the client.
            if not self._stream[1] or clock.monotonic() >= until:
                return None
        reply = self._take("stream")
        if isinstance(reply, Error) and reply.code not in ("no_session", "taken"):
            raise ServiceError(reply)
        return reply if isinstance(reply, Command) else None

    @_call
    def watch(self, name: str) -> _Work[State]:
        """Look on another's session.

        `latest` gives its commands, and if it is shared, it can be steered from here.
        """
        if self.opened is not None:
            raise RuntimeError("this client has a session of its own; watch with another one")
        state = yield from self._exchange(_message("status", name=name), State)
        self._who = {"name": name}
        self._listen(name, state.stream_port)
        return state

    @_call
    def close(self) -> _Work[None]:
        """End the session, if there is one and the server can be reached, and let go of the sockets."""
        try:
            with suppress(ServiceError, ServiceTimeoutError):
                if self.opened is not None:
                    yield from self._exchange(_message("close"), Done)
        finally:
            self.opened, self._request, self._last, self._who, self._stream = (
                None,
                {},
                None,
                {"session": ""},
                ("", 0),
            )
            self._drop(*tuple(self._sockets))

    def _exchange(
        self, request: dict[str, Any], kind: type[R], deadline: float | None = None
    ) -> _Work[R]:
        """Ask, and once more in a new session if the server has lost the old one."""
        deadline = clock.monotonic() + self.timeout if deadline is None else deadline
        reply = yield from self._ask(numbered := self._number(request), deadline)
        if (
            isinstance(reply, Error)
            and reply.code == "no_session"
            and self._request
            and request["type"] not in ("open", "close")
        ):
            yield from self._reopen(deadline)
            reply = yield from self._ask(self._number(request), deadline)
        if not isinstance(reply, kind):
            raise ServiceError(
                reply
                if isinstance(reply, Error)
                else Error(code="protocol", message=f"unexpected {reply}")
            )
        if isinstance(reply, Opened):
            self._request, self.opened, self._last, self._who = (
                numbered,
                reply,
                None,
                {"session": numbered["session"]},
            )
            self._acted = reply.seq
            self._drop("samples")
            self._listen(reply.name, reply.stream_port)
        elif self._request and request["type"] in ("clutch", "release", "reset"):
            self._request["is_released"], self._acted = request["type"] == "release", reply.seq
        elif self._request and request["type"] == "configure":
            for field in request.keys() & {"mapping", "ik", "has_detail"}:
                self._request[field] = (
                    request[field]
                    if field == "has_detail"
                    else self._request.get(field, {}) | request[field]
                )
        return reply

    def _listen(self, name: str, port: int) -> None:
        """Take a session's stream from now on."""
        if self._stream != (name, port):
            self._drop("stream")
        self._stream = name, port
        self._socket("stream")

    def _take(self, use: str) -> _Reply:
        """What waits in a socket.

        Of commands it is kept what a session that has to be opened anew goes on from.
        """
        reply = self._decode(
            self._socket(use).recv(zmq.NOBLOCK).split(b"\0", 1 if use == "stream" else 0)[-1]
        )
        if isinstance(reply, Command) and (self._last is None or reply.seq >= self._last.seq):
            self._last = reply
            # Others may let go of a shared session too; what was done here since the sample that
            # this answers is newer.
            if self._request and reply.seq > self._acted:
                self._request["is_released"] = "released" in reply.flags
        return reply

    def _reopen(self, deadline: float) -> _Work[None]:
        """The session anew, where it was.

        A server that does not remember that takes where its last command left the robot.
        """
        if self._socket("stream").poll(0):
            self._take("stream")
        start, last = {"session": secrets.token_urlsafe(24)}, self._last
        if self.opened is not None:
            start |= {"name": self.opened.name, "restore": True, "robot_q": (last or self.opened).q}
            start |= (
                {"robot_wrist": last.wrist} if last is not None and self.opened.is_floating else {}
            )
        yield from self._exchange(self._request | start, Opened, deadline)
        self._last, self.reopened = last, self.reopened + 1

    def _ask(self, request: dict[str, Any], deadline: float) -> _Work[_Reply]:
        """Send a request and wait for its answer, each time on a new connection."""
        payload = _ENCODE(request)
        for left in range(self.attempts, 0, -1):
            until = (now := clock.monotonic()) + (deadline - now) / left
            socket = self._socket("requests")
            if (yield socket, zmq.POLLOUT, until):
                socket.send(payload, zmq.NOBLOCK)
                while (yield socket, zmq.POLLIN, until):
                    reply = self._take("requests")
                    # An answer to a request that was given up is of no use any more; 0 is a refusal
                    # to look at this one.
                    if reply.seq == request["seq"] or (reply.seq == 0 and isinstance(reply, Error)):
                        return reply
            self._drop("requests")
        raise ServiceTimeoutError(
            f"{self.address}: no answer to {request['type']!r} within {self.timeout:g} s"
        )


def _message(kind: str, **fields: Any) -> dict[str, Any]:
    """A request: poses in any form as `Pose`, and nothing where there is None."""
    given = {name: value for name, value in fields.items() if value is not None}
    poses = {name: Pose.of(given[name], name) for name in ("wrist", "robot_wrist") if name in given}
    given |= {"session": secrets.token_urlsafe(24)} if kind == "open" else {}
    return (
        {"type": kind}
        | ({"time": clock.monotonic()} if kind in ("step", "sample") else {})
        | given
        | poses
    )


class Client(_Connection, AbstractContextManager["Client"]):
    """A client that waits for answers; also a context manager.

    Any method may raise `ServiceError` or `ServiceTimeoutError`.
    """

    def _run(self, work: _Work[R]) -> R:
        try:
            socket, event, until = next(work)
            while True:
                socket, event, until = work.send(
                    socket.poll(max(0, math.ceil(1e3 * (until - clock.monotonic()))), event) != 0
                )
        except StopIteration as end:
            return end.value

    def __exit__(self, *_: object) -> None:
        self.close()


class AsyncClient(_Connection, AbstractAsyncContextManager["AsyncClient"]):
    """The same for asyncio; calls of several tasks take turns."""

    async def _run(self, work: _Work[R]) -> R:
        # One task may wait for the stream while another sends what makes it flow.
        async with self._turns[getattr(work, "__name__", "") == "latest"]:
            try:
                wanted = next(work)
                while True:
                    wanted = work.send(await self._wait(*wanted))
            except StopIteration as end:
                return end.value

    async def _wait(self, socket: zmq.Socket, event: int, until: float) -> bool:
        """Whether the event comes in time.

        ZeroMQ's descriptor tells that something has changed, and `EVENTS` what.
        """
        changed, loop, descriptor = asyncio.Event(), asyncio.get_running_loop(), socket.FD
        loop.add_reader(descriptor, changed.set)
        self._waits[socket] = changed
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout_at(loop.time() + until - clock.monotonic()):
                    while not (socket.closed or int(socket.EVENTS) & event):
                        await changed.wait()
                        changed.clear()
            return not socket.closed and int(socket.EVENTS) & event != 0
        finally:
            if self._waits.pop(socket, None):
                loop.remove_reader(descriptor)

    async def __aexit__(self, *_: object) -> None:
        await self.close()
