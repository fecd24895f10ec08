"""Client of the mapping service (`handmap serve`).

This file needs numpy, msgspec and pyzmq, and nothing else: copy it to where you need it.

    with Client() as client:
        client.open("allegro_right", preset="teleoperation")
        command = client.step(q=human_q, wrist=wrist_pose)    # wait for the answer to each sample
        client.send(q=human_q, wrist=wrist_pose)              # or send without waiting,
        command = client.latest(timeout=0.1)                  # and read the newest command

In another process, such as the robot's driver, call `watch` with the name of the session and then
`latest`. `AsyncClient` has the same methods as coroutines. A call raises `ServiceTimeoutError` if
no answer arrives in time, and `ServiceError` if the server refuses the request. If the server was
restarted, the client reopens its session where the robot is. Units are SI and radians; `handmap
serve --schema` describes all fields. Use one client per thread or per event loop.
"""

from __future__ import annotations

import asyncio
import math
import secrets
import time as clock
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
import zmq
import zmq.asyncio
import zmq.auth

PROTOCOL = 2
OLDEST_PROTOCOL = 1
ADDRESS = "tcp://127.0.0.1:5570"
Numbers = tuple[float, ...]
Names = tuple[str, ...]
KeyFiles = tuple[Path | str, Path | str]
Request = dict[str, Any]
_OPTIONS = ("options", "mapping", "teleoperation", "ik")


class Pose(msgspec.Struct, frozen=True):
    """A pose: position [m] and unit quaternion, scalar last."""

    position: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]

    @property
    def matrix(self) -> np.ndarray:
        """Return the pose as a homogeneous matrix, shape (4, 4)."""
        x, y, z, w = np.array(self.quat_xyzw) / np.linalg.norm(self.quat_xyzw)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        rotation = np.eye(3) + 2.0 * (w * cross + cross @ cross)
        return np.vstack([np.column_stack([rotation, self.position]), [0.0, 0.0, 0.0, 1.0]])

    @classmethod
    def of(cls, pose: Pose | npt.ArrayLike, name: str = "pose") -> Pose:
        """Convert a homogeneous matrix, or seven numbers.

        Args:
            pose: Shape (4, 4), or shape (7,): x y z qx qy qz qw.
            name: Name of the argument, for the error message.

        Raises:
            ValueError: If it is not a rigid pose.
        """
        if isinstance(pose, Pose):
            return pose
        try:
            values = np.asarray(pose, dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name}: expected numbers, got {type(pose).__name__}") from error
        if values.shape == (7,):
            return cls(tuple(values[:3].tolist()), tuple(values[3:].tolist()))
        if values.shape != (4, 4):
            raise ValueError(
                f"{name}: expected shape (4, 4), or 7 numbers, got shape {values.shape}"
            )
        R, K = values[:3, :3], np.empty((4, 4))
        # Many trackers send zeros when tracking is lost. `not a <= b` also rejects NaN.
        if not (
            np.abs(R.T @ R - np.eye(3)).max() <= 1e-3
            and np.linalg.det(R) > 0.0
            and (values[3] == (0, 0, 0, 1)).all()
        ):
            raise ValueError(
                f"{name}: expected a rotation and a translation, got {values.tolist()}"
            )
        # The quaternion is the dominant eigenvector of this matrix (Bar-Itzhack 2000). The method
        # has no singular case, and `eigh` needs the lower triangle only.
        K[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
        K[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], np.trace(R)
        return cls(tuple(values[:3, 3].tolist()), tuple(np.linalg.eigh(K)[1][:, 3].tolist()))


class Reply(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag=str.lower):
    """Base of all replies; `seq` is the number of the request that it answers."""

    seq: int = 0


class Opened(Reply, frozen=True):
    """An open session.

    It names the session, the robot's joints with their limits, and the posture `q` [rad] at which
    the server assumes the robot. Within `stop_time` [s] it stops, and no joint moves farther than
    its `stop_distance` meanwhile [rad].
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
    stop_time: float = 0.0
    stop_distance: Numbers = ()


class Command(Reply, frozen=True):
    """A command for the robot's driver.

    It has `q` [rad] in the order of `joint_names`, the pose of the wrist, and diagnostics. `rule`
    names what is wrong with the sample; its command holds the robot if `status` is `held`.
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
    rule: str = ""
    consistency: float | None = None
    confidence: float = 1.0


class State(Reply, frozen=True):
    """The state of a session or of the server."""

    version: str
    uptime: float
    names: Names
    mode: str = "serving"
    counts: dict[str, int] = {}
    robots: Names = ()
    missing: dict[str, str] = {}
    is_released: bool = False
    stop: int = 0
    protocols: tuple[int, ...] = ()
    q: Numbers = ()
    stream_port: int = 0
    about: dict[str, Any] | None = None


class Done(Reply, frozen=True):
    """The server carried the request out."""


class Error(Reply, frozen=True):
    """The server refused the request; the session is unchanged."""

    code: str
    message: str
    field: str = ""
    protocols: tuple[int, ...] = ()


class ServiceError(RuntimeError):
    """The server refused a request; `error` has the reason and the field at fault."""

    def __init__(self, error: Error) -> None:
        super().__init__(
            ": ".join(part for part in (error.code, error.field, error.message) if part)
        )
        self.error = error


class ServiceTimeoutError(TimeoutError):
    """No answer arrived in time."""


R = TypeVar("R", bound=Reply)
S = TypeVar("S", bound=zmq.Socket[Any])
Use = Literal["requests", "samples", "stream"]


class _Endpoint(NamedTuple):
    """Where a socket connects, and for which session; `key` differs if a new socket is needed."""

    address: str
    kind: int
    key: str


def _plain(value: Any) -> Any:
    """Convert an array, scalar or sequence of numpy's to lists and numbers."""
    plain = np.asarray(value)
    if plain.dtype == object:
        raise ValueError(f"expected numbers, got {type(value).__name__}")
    return plain.tolist()


_ENGAGING = ("clutch", "release", "reset", "stop", "clear")
_ENCODE = msgspec.msgpack.Encoder(enc_hook=_plain).encode
_DECODE = msgspec.msgpack.Decoder(Opened | Command | State | Done | Error).decode


def _given(**fields: Any) -> Request:
    """Return the fields that are not None, with poses in any form as `Pose`."""
    given = {name: value for name, value in fields.items() if value is not None}
    return given | {
        name: Pose.of(given[name], name) for name in ("wrist", "robot_wrist") if name in given
    }


def _stop_request(name: str | None, reason: str) -> Request:
    addressee = {} if name is None else {"session": "", "name": name}
    return {"type": "stop", "reason": reason} | addressee


class _Core:
    """Build requests and interpret replies: the state of both clients, without sockets."""

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
        self.opened: Opened | None = None
        self.reopened = 0
        self._keys = None if keys is None else _load_keys(keys)
        self._seq, self._protocol = 0, PROTOCOL
        self._addressee: Request = {"session": ""}  # or the public name of a watched session
        self._stream_name, self._stream_port = "", 0
        self._open_request: Request = {}  # as it must be repeated to reopen the session
        self._last_command: Command | None = None
        self._released_at = 0  # number of the last request that changed `is_released`

    def _sample(self, kind: str, time: float | None, human: Request) -> Request:
        stamp = clock.monotonic() if time is None else time
        return {"type": kind, "time": stamp} | human

    def _numbered(self, request: Request) -> Request:
        """Add the next number and the session to a request."""
        self._seq += 1
        addressee = {} if request["type"] == "open" else self._addressee
        return addressee | request | {"protocol": self._protocol, "seq": self._seq}

    def _reopen_request(self) -> Request:
        """Return a request that opens the session again, at the robot's last known posture.

        `restore` lets the server use its own record if it has one; it knows the owner's secret.
        """
        start: Request = {}
        if self.opened is not None:
            last = self._last_command
            start |= {"name": self.opened.name, "restore": True, "robot_q": (last or self.opened).q}
            if last is not None and self.opened.is_floating:
                start["robot_wrist"] = last.wrist
        return self._open_request | start

    def _endpoint(self, use: Use) -> _Endpoint:
        if use == "stream":
            address = f"{self.address.rpartition(':')[0]}:{self._stream_port}"
            return _Endpoint(address, zmq.SUB, self._stream_name)
        session = self._addressee.get("session", "") if use == "samples" else ""
        # Answers to samples before a reopening would reopen the session again.
        return _Endpoint(self.address, zmq.DEALER, f"{session}{self.reopened}" if session else "")

    def _attempt_ends(self, deadline: float) -> Iterator[float]:
        """Give each attempt an equal share of the time that is left [s, monotonic]."""
        for left in range(self.attempts, 0, -1):
            now = clock.monotonic()
            yield now + (deadline - now) / left

    def _read(self, payload: bytes, use: Use) -> Reply:
        """Decode a reply, and remember the last command for `_reopen_request`."""
        # In the stream, the name of the session precedes the message.
        reply = _DECODE(payload.split(b"\0", 1)[1] if use == "stream" else payload)
        last = self._last_command
        if isinstance(reply, Command) and (last is None or reply.seq >= last.seq):
            self._last_command = reply
            # Other clients may release a shared session too. A request of this client is newer than
            # a command that answers an earlier sample.
            if self._open_request and reply.seq > self._released_at:
                self._open_request["is_released"] = "released" in reply.flags
        return reply

    def _speaks_older(self, reply: Reply) -> bool:
        """Return whether the server answers an older version only, and speak that from now on."""
        if not (isinstance(reply, Error) and reply.code == "protocol"):
            return False
        # Servers of version 1 do not say which versions they answer.
        known = range(OLDEST_PROTOCOL, self._protocol)
        common = max(set(reply.protocols or (OLDEST_PROTOCOL,)) & set(known), default=None)
        if common is None:
            return False
        self._protocol = common
        return True

    def _is_lost(self, request: Request, reply: Reply) -> bool:
        """Return whether the server has lost the session, so that it must be reopened."""
        return (
            isinstance(reply, Error)
            and reply.code == "no_session"
            and bool(self._open_request)
            and request["type"] not in ("open", "close")
        )

    def _accept(self, request: Request, reply: Reply, kind: type[R]) -> R:
        """Return the reply if it is of the kind expected, and update the state.

        Raises:
            ServiceError: If it is not.
        """
        if isinstance(reply, Error):
            raise ServiceError(reply)
        if not isinstance(reply, kind):
            raise ServiceError(Error(code="protocol", message=f"unexpected {reply}"))
        if isinstance(reply, Opened):
            self._open_request, self.opened = request, reply
            self._last_command, self._released_at = None, reply.seq
            self._addressee = {"session": request["session"]}
            self._stream_name, self._stream_port = reply.name, reply.stream_port
        elif self._open_request and request["type"] in _ENGAGING and "name" not in request:
            self._open_request["is_released"] = request["type"] not in ("clutch", "reset")
            self._released_at = reply.seq
        elif self._open_request and request["type"] == "configure":
            self._note_options(request)
        return reply

    def _note_options(self, request: Request) -> None:
        """Add the changes of a `configure` to the request that reopens the session."""
        wanted = self._open_request
        if "preset" in request:
            # A preset replaces all options.
            for field in _OPTIONS:
                wanted.pop(field, None)
        for field in request.keys() & set(_OPTIONS):
            wanted[field] = wanted.get(field, {}) | request[field]
        wanted |= {name: request[name] for name in ("preset", "has_detail") if name in request}

    def _accept_watched(self, name: str, state: State) -> State:
        self._addressee = {"name": name}
        self._stream_name, self._stream_port = name, state.stream_port
        return state

    def _accept_streamed(self, reply: Reply) -> Command | None:
        """Return a command of the stream; None if the message says that the session ended.

        Raises:
            ServiceError: If the server could not use a streamed sample.
        """
        if isinstance(reply, Error) and reply.code not in ("no_session", "taken"):
            raise ServiceError(reply)
        return reply if isinstance(reply, Command) else None

    def _must_reopen_before_sample(self, reply: Reply) -> bool:
        """Return whether the answer to an earlier streamed sample says that the session is lost.

        Only samples that could not be read, or that are of no session, are answered. The stream
        reports samples that the mapping rejected.

        Raises:
            ServiceError: If the earlier sample was refused for another reason.
        """
        if isinstance(reply, Error) and reply.code != "no_session":
            raise ServiceError(reply)
        return isinstance(reply, Error)

    def _forget(self) -> None:
        """Forget the session."""
        self.opened, self._last_command = None, None
        self._open_request, self._addressee = {}, {"session": ""}
        self._stream_name, self._stream_port = "", 0

    def _check_open(self) -> None:
        if self.opened is None:
            raise RuntimeError("open a session first")

    def _check_stream(self) -> None:
        if not self._stream_port:
            raise RuntimeError("open a session first, or watch one")

    def _check_watch(self) -> None:
        if self.opened is not None:
            raise RuntimeError("this client has a session of its own; watch with another one")

    def _timeout_error(self, request: Request) -> ServiceTimeoutError:
        return ServiceTimeoutError(
            f"{self.address}: no answer to {request['type']!r} within {self.timeout:g} s"
        )


def _load_keys(files: KeyFiles) -> tuple[bytes, bytes, bytes]:
    """Return this client's public and secret key, and the server's public key."""
    (public, secret), (server, _) = (zmq.auth.load_certificate(file) for file in files)
    if secret is None:
        raise ValueError(
            f"{files}: expected NAME.key_secret and server.key; the first holds no secret key"
        )
    return public, secret, server


def _answers(reply: Reply, request: Request) -> bool:
    """Return whether a reply is for this request, and not for one that timed out before.

    An error with number 0 says that the server did not read the request.
    """
    return reply.seq == request["seq"] or (reply.seq == 0 and isinstance(reply, Error))


def _milliseconds(until: float) -> int:
    """Return the time left, at least 0."""
    return max(0, math.ceil(1e3 * (until - clock.monotonic())))


class _Sockets(Generic[S]):
    """Sockets by their use, connected when they are first needed.

    Args:
        context: Returns the ZeroMQ context.
        keys: Keys of an encrypted connection: public, secret, the server's.
    """

    # Heartbeats detect a connection that died without notice.
    _OPTIONS = (
        (zmq.IPV6, 1),
        (zmq.LINGER, 0),
        (zmq.RECONNECT_IVL, 50),
        (zmq.HEARTBEAT_IVL, 1000),
        (zmq.HEARTBEAT_TIMEOUT, 3000),
    )

    def __init__(
        self, context: Callable[[], zmq.Context[S]], keys: tuple[bytes, bytes, bytes] | None
    ) -> None:
        self._context, self._keys = context, keys
        self._held: dict[Use, tuple[_Endpoint, S]] = {}

    def get(self, use: Use, endpoint: _Endpoint) -> S:
        """Return the socket for this use; replace one that belongs to another endpoint."""
        if use in self._held:
            if self._held[use][0] == endpoint:
                return self._held[use][1]
            self.drop(use)
        socket = self._context().socket(endpoint.kind)
        self._held[use] = endpoint, socket
        # A request waits in the client until there is a connection. Of samples and commands, the
        # socket keeps the newest one.
        socket.setsockopt(zmq.IMMEDIATE if use == "requests" else zmq.CONFLATE, 1)
        for option, value in self._OPTIONS:
            socket.setsockopt(option, value)
        if self._keys is not None:
            socket.curve_publickey, socket.curve_secretkey, socket.curve_serverkey = self._keys
        if use == "stream":
            socket.setsockopt(zmq.SUBSCRIBE, endpoint.key.encode() + b"\0")
        socket.connect(endpoint.address)
        return socket

    def drop(self, use: Use) -> None:
        """Close the socket for this use, if there is one."""
        if use in self._held:
            self._held.pop(use)[1].close(linger=0)

    def close(self) -> None:
        """Close all sockets."""
        for use in tuple(self._held):
            self.drop(use)


class Client(_Core):
    """Client that blocks until the answer arrives; also a context manager.

    Every method that asks the server raises `ServiceError` if the server refuses, and
    `ServiceTimeoutError` if no answer arrives in time.

    Args:
        address: Address of the server's requests, `tcp://HOST:PORT`.
        timeout: Longest time of a call [s].
        attempts: Number of connections that a call tries, one after the other, within `timeout`.
        keys: Files of `handmap keys`: `NAME.key_secret` of this client, and `server.key`.

    Attributes:
        opened: The open session; None if there is none.
        reopened: How often the client had to reopen its session.

    Raises:
        ValueError: If `address` or `keys` cannot be used.
    """

    def __init__(
        self,
        address: str = ADDRESS,
        *,
        timeout: float = 2.0,
        attempts: int = 2,
        keys: KeyFiles | None = None,
    ) -> None:
        super().__init__(address, timeout=timeout, attempts=attempts, keys=keys)
        self._sockets = _Sockets[zmq.Socket[bytes]](zmq.Context.instance, self._keys)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(
        self,
        robot: str,
        *,
        name: str | None = None,
        input: Literal["q", "landmarks", "points"] | None = None,
        layout: str | None = None,
        side: Literal["right", "left"] | None = None,
        hand_length: float | None = None,
        lengths: dict[str, Any] | None = None,
        contact_gap: float | None = None,
        human_points: str | None = None,
        robot_points: str | None = None,
        mount: Literal["floating", "fixed"] | None = None,
        preset: str | None = None,
        options: dict[str, Any] | None = None,
        mapping: dict[str, Any] | None = None,
        teleoperation: dict[str, Any] | None = None,
        ik: dict[str, Any] | None = None,
        robot_q: npt.ArrayLike | None = None,
        robot_wrist: Pose | npt.ArrayLike | None = None,
        restore: bool | None = None,
        is_released: bool | None = None,
        max_dt: float | None = None,
        time_from: Literal["server", "client"] | None = None,
        watchdog: float | None = None,
        return_after: float | None = None,
        return_speed: float | None = None,
        resume: Literal["follow", "clutch"] | None = None,
        has_detail: bool | None = None,
        is_shared: bool | None = None,
    ) -> Opened:
        """Open a session: one human hand that leads one robot hand.

        An argument that is None is left to the server; `handmap serve --schema` lists its defaults.

        Args:
            robot: Name of a robot hand on the server.
            name: Public name of the session and its stream.
            input: What the samples hold.
            layout: Layout of the numbers that samples have in place of landmarks, such as webxr25.
            side: The human hand.
            hand_length: From wrist crease to middle fingertip [m].
            lengths: The measured hand: `bases` (5, 3) and `segments` (5, 3) [m], and `rolls` (5,)
                [rad].
            contact_gap: Distance of thumb and finger landmarks where the skin touches [m]; with
                `lengths`, the arguments of a person's file (`Person.session_fields`).
            human_points: Set of reference points on the human hand.
            robot_points: Set of reference points on the robot hand.
            mount: The robot's wrist.
            preset: What the mapping is for. If omitted, `teleoperation` if the robot's fingers
                have partners, else `object`.
            options: Options of the preset's method.
            mapping: Former name of `options`; without `preset`, for the preset `paper`.
            teleoperation: Former name of `options` for the preset `teleoperation`.
            ik: Fields of `IkOptions`; others are the preset's.
            robot_q: Joint angles where the robot is now [rad], shape (n,).
            robot_wrist: Pose of its wrist: (4, 4), seven numbers, or a `Pose`.
            restore: Continue where the last session of this name, of this owner, left the robot.
            is_released: Start released, so that the robot holds until `clutch`.
            max_dt: Longest time that one command may account for [s].
            time_from: Clock for the speed limits.
            watchdog: Time without a sample after which the robot holds [s].
            return_after: Time of a hold after which the robot returns to rest [s].
            return_speed: Share of the speed limits that it returns at.
            resume: What happens after a hold: follow the human, or take a new reference.
            has_detail: Whether commands carry every stage of the mapping.
            is_shared: Whether others may release, clutch, configure and clear the session.

        Returns:
            The session, also kept as `opened`.

        Raises:
            ServiceError: If the server refuses; a session that was open before stays open.
            ServiceTimeoutError: If no answer arrives in time.
        """
        arguments = dict(locals())
        del arguments["self"]
        request = {"type": "open", "session": secrets.token_urlsafe(24)} | _given(**arguments)
        return self._call(request, Opened)

    def step(
        self,
        *,
        q: npt.ArrayLike | None = None,
        wrist: Pose | npt.ArrayLike | None = None,
        landmarks: npt.ArrayLike | None = None,
        points: npt.ArrayLike | None = None,
        values: npt.ArrayLike | None = None,
        time: float | None = None,
        valid: bool | None = None,
        confidence: float | None = None,
    ) -> Command:
        """Map one sample and wait for its command.

        Args:
            q: Joint angles of the human hand [rad], in the order of `opened.human_joint_names`.
            wrist: Pose of the human's wrist: (4, 4), seven numbers x y z qx qy qz qw, or a `Pose`.
                With landmarks it may be omitted.
            landmarks: 21 landmarks in MediaPipe's order [m], shape (21, 3).
            points: Reference points [m], in the order of `opened.human_point_names`, shape (n, 3).
            values: Numbers of the session's layout, in its own axes and unit.
            time: Time stamp [s]; the monotonic clock of this machine if omitted.
            valid: False if the tracker did not see the hand; landmarks may then be omitted.
            confidence: The tracker's own confidence, from 0 to 1; 0 counts as not seen.

        Raises:
            ServiceError: If the server refuses the sample.
            ServiceTimeoutError: If no answer arrives in time.
            ValueError: If `wrist` is not a pose.
        """
        human = _given(
            q=q,
            wrist=wrist,
            landmarks=landmarks,
            points=points,
            values=None if values is None else np.ravel(values),
            valid=valid,
            confidence=confidence,
        )
        sample = self._sample("step", time, human)
        return self._call(sample, Command)

    def send(
        self,
        *,
        q: npt.ArrayLike | None = None,
        wrist: Pose | npt.ArrayLike | None = None,
        landmarks: npt.ArrayLike | None = None,
        points: npt.ArrayLike | None = None,
        values: npt.ArrayLike | None = None,
        time: float | None = None,
        valid: bool | None = None,
        confidence: float | None = None,
    ) -> None:
        """Send a sample as in `step`, without waiting for its command.

        Read the command with `latest`. If several samples wait, the server maps the newest.

        Raises:
            RuntimeError: If no session is open.
            ServiceError: If the server refused an earlier sample.
            ServiceTimeoutError: If a lost session cannot be reopened in time.
            ValueError: If `wrist` is not a pose.
        """
        human = _given(
            q=q,
            wrist=wrist,
            landmarks=landmarks,
            points=points,
            values=None if values is None else np.ravel(values),
            valid=valid,
            confidence=confidence,
        )
        sample = self._sample("sample", time, human)
        self._check_open()
        answer = self._receive(self._socket("samples"), 0.0)
        if answer is not None and self._must_reopen_before_sample(self._read(answer, "samples")):
            self._reopen(clock.monotonic() + self.timeout)
        self._socket("samples").send(_ENCODE(self._numbered(sample)), zmq.NOBLOCK)

    def latest(self, timeout: float = 0.0) -> Command | None:
        """Return the newest command of the stream.

        Args:
            timeout: Longest time to wait for one [s].

        Returns:
            None if no command has arrived since the last call, nor arrives in time.

        Raises:
            RuntimeError: If this client neither opened nor watches a session.
            ServiceError: If the server could not use a streamed sample.
        """
        self._check_stream()
        payload = self._receive(self._socket("stream"), clock.monotonic() + timeout)
        if payload is None:
            return None
        return self._accept_streamed(self._read(payload, "stream"))

    def watch(self, name: str) -> State:
        """Watch another client's session; `latest` returns its commands.

        If the session is shared, `release`, `clutch` and `configure` act on it.

        Raises:
            RuntimeError: If this client has a session of its own.
            ServiceError: If there is no such session.
            ServiceTimeoutError: If no answer arrives in time.
        """
        self._check_watch()
        request, deadline = {"type": "status", "name": name}, clock.monotonic() + self.timeout
        state = self._accept_watched(name, self._exchange(request, State, deadline))
        self._socket("stream")
        return state

    def clutch(self) -> None:
        """Engage, or engage again: the next sample is the reference.

        The robot continues from where it is. With the presets `teleoperation` and `object`, its
        fingers then go to the human's posture.
        """
        self._call({"type": "clutch"}, Done)

    def release(self) -> None:
        """Disengage: the robot holds its posture until `clutch`."""
        self._call({"type": "release"}, Done)

    def stop(self, name: str | None = None, *, reason: str = "") -> None:
        """Stop the robot: it brakes and holds, whatever comes, until `clear`.

        Args:
            name: Public name of a session; the client's own or the watched one if omitted, and all
                sessions of the server if the client has none.
            reason: Reason for the server's log.
        """
        self._call(_stop_request(name, reason), Done)

    def clear(self, stop: int) -> None:
        """Clear an emergency stop on purpose; the robot is then released, and `clutch` engages it.

        Args:
            stop: Its number, `status().stop`.
        """
        self._call({"type": "clear", "stop": stop}, Done)

    def reset(
        self,
        *,
        robot_q: npt.ArrayLike | None = None,
        robot_wrist: Pose | npt.ArrayLike | None = None,
    ) -> None:
        """Start again, with the next sample as the reference.

        Without arguments, the robot goes to rest within its speed limits.

        Args:
            robot_q: Joint angles where the robot is now [rad], shape (n,).
            robot_wrist: Pose of its wrist: (4, 4), seven numbers, or a `Pose`.
        """
        self._call({"type": "reset"} | _given(robot_q=robot_q, robot_wrist=robot_wrist), Done)

    def configure(
        self,
        *,
        preset: str | None = None,
        options: dict[str, Any] | None = None,
        mapping: dict[str, Any] | None = None,
        teleoperation: dict[str, Any] | None = None,
        ik: dict[str, Any] | None = None,
        has_detail: bool | None = None,
    ) -> None:
        """Change options; options that are not named, and the reference, stay as they are.

        Args:
            preset: Another preset; options that are not named are then the preset's own.
            options: Options of the preset's method.
            mapping: Former name of `options`.
            teleoperation: Former name of `options`.
            ik: Fields of `IkOptions`.
            has_detail: Whether commands carry every stage of the mapping.
        """
        changes = _given(
            preset=preset,
            options=options,
            mapping=mapping,
            teleoperation=teleoperation,
            ik=ik,
            has_detail=has_detail,
        )
        self._call({"type": "configure"} | changes, Done)

    def status(self) -> State:
        """Return the state of the session; of the server if no session is open."""
        return self._call({"type": "status"}, State)

    def close(self) -> None:
        """End the session if the server can be reached, and close the sockets."""
        try:
            if self.opened is not None:
                with suppress(ServiceError, ServiceTimeoutError):
                    self._exchange({"type": "close"}, Done, clock.monotonic() + self.timeout)
        finally:
            self._forget()
            self._sockets.close()

    def _call(self, request: Request, kind: type[R]) -> R:
        return self._exchange(request, kind, clock.monotonic() + self.timeout)

    def _exchange(self, request: Request, kind: type[R], deadline: float) -> R:
        """Send a request; if the server has lost the session, reopen it and send it again."""
        reply = self._ask(numbered := self._numbered(request), deadline)
        if self._speaks_older(reply):
            reply = self._ask(numbered := self._numbered(request), deadline)
        if self._is_lost(request, reply):
            self._reopen(deadline)
            reply = self._ask(numbered := self._numbered(request), deadline)
        accepted = self._accept(numbered, reply, kind)
        if isinstance(accepted, Opened):
            self._socket("stream")  # subscribe before the first command
        return accepted

    def _reopen(self, deadline: float) -> None:
        """Open the lost session again, where its robot is."""
        if (payload := self._receive(self._socket("stream"), 0.0)) is not None:
            self._read(payload, "stream")
        last = self._last_command
        self._exchange(self._reopen_request(), Opened, deadline)
        self._last_command, self.reopened = last, self.reopened + 1

    def _ask(self, request: Request, deadline: float) -> Reply:
        """Send a request and wait for its answer, each attempt on a new connection."""
        payload = _ENCODE(request)
        for until in self._attempt_ends(deadline):
            socket = self._socket("requests")
            if self._is_ready(socket, zmq.POLLOUT, until):
                socket.send(payload, zmq.NOBLOCK)
                while (answer := self._receive(socket, until)) is not None:
                    reply = self._read(answer, "requests")
                    if _answers(reply, request):
                        return reply
            self._sockets.drop("requests")
        raise self._timeout_error(request)

    def _socket(self, use: Use) -> zmq.Socket[bytes]:
        return self._sockets.get(use, self._endpoint(use))

    def _receive(self, socket: zmq.Socket[bytes], until: float) -> bytes | None:
        """Return a message; None if none arrives in time."""
        if self._is_ready(socket, zmq.POLLIN, until):
            return socket.recv(zmq.NOBLOCK)
        return None

    def _is_ready(self, socket: zmq.Socket[bytes], event: int, until: float) -> bool:
        """Return whether the event comes in time."""
        poller = zmq.Poller()
        poller.register(socket, event)
        return bool(poller.poll(_milliseconds(until)))


class AsyncClient(_Core):
    """Client for asyncio: `Client` with coroutines.

    Calls of several tasks take turns. Arguments, attributes and errors are those of `Client`.
    """

    def __init__(
        self,
        address: str = ADDRESS,
        *,
        timeout: float = 2.0,
        attempts: int = 2,
        keys: KeyFiles | None = None,
    ) -> None:
        super().__init__(address, timeout=timeout, attempts=attempts, keys=keys)
        self._sockets = _Sockets[zmq.asyncio.Socket](zmq.asyncio.Context.instance, self._keys)
        # Calls of several tasks take turns. One task may wait for the stream meanwhile.
        self._turn, self._stream_turn = asyncio.Lock(), asyncio.Lock()

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def open(
        self,
        robot: str,
        *,
        name: str | None = None,
        input: Literal["q", "landmarks", "points"] | None = None,
        layout: str | None = None,
        side: Literal["right", "left"] | None = None,
        hand_length: float | None = None,
        lengths: dict[str, Any] | None = None,
        contact_gap: float | None = None,
        human_points: str | None = None,
        robot_points: str | None = None,
        mount: Literal["floating", "fixed"] | None = None,
        preset: str | None = None,
        options: dict[str, Any] | None = None,
        mapping: dict[str, Any] | None = None,
        teleoperation: dict[str, Any] | None = None,
        ik: dict[str, Any] | None = None,
        robot_q: npt.ArrayLike | None = None,
        robot_wrist: Pose | npt.ArrayLike | None = None,
        restore: bool | None = None,
        is_released: bool | None = None,
        max_dt: float | None = None,
        time_from: Literal["server", "client"] | None = None,
        watchdog: float | None = None,
        return_after: float | None = None,
        return_speed: float | None = None,
        resume: Literal["follow", "clutch"] | None = None,
        has_detail: bool | None = None,
        is_shared: bool | None = None,
    ) -> Opened:
        """Open a session: one human hand that leads one robot hand; see `Client.open`."""
        arguments = dict(locals())
        del arguments["self"]
        request = {"type": "open", "session": secrets.token_urlsafe(24)} | _given(**arguments)
        return await self._call(request, Opened)

    async def step(
        self,
        *,
        q: npt.ArrayLike | None = None,
        wrist: Pose | npt.ArrayLike | None = None,
        landmarks: npt.ArrayLike | None = None,
        points: npt.ArrayLike | None = None,
        values: npt.ArrayLike | None = None,
        time: float | None = None,
        valid: bool | None = None,
        confidence: float | None = None,
    ) -> Command:
        """Map one sample and wait for its command; see `Client.step`."""
        human = _given(
            q=q,
            wrist=wrist,
            landmarks=landmarks,
            points=points,
            values=None if values is None else np.ravel(values),
            valid=valid,
            confidence=confidence,
        )
        sample = self._sample("step", time, human)
        return await self._call(sample, Command)

    async def send(
        self,
        *,
        q: npt.ArrayLike | None = None,
        wrist: Pose | npt.ArrayLike | None = None,
        landmarks: npt.ArrayLike | None = None,
        points: npt.ArrayLike | None = None,
        values: npt.ArrayLike | None = None,
        time: float | None = None,
        valid: bool | None = None,
        confidence: float | None = None,
    ) -> None:
        """Send a sample as in `step`, without waiting for its command; see `Client.send`."""
        human = _given(
            q=q,
            wrist=wrist,
            landmarks=landmarks,
            points=points,
            values=None if values is None else np.ravel(values),
            valid=valid,
            confidence=confidence,
        )
        sample = self._sample("sample", time, human)
        async with self._turn:
            self._check_open()
            answer = await self._receive(self._socket("samples"), 0.0)
            if answer is not None and self._must_reopen_before_sample(
                self._read(answer, "samples")
            ):
                await self._reopen(clock.monotonic() + self.timeout)
            await self._socket("samples").send(_ENCODE(self._numbered(sample)), zmq.NOBLOCK)

    async def latest(self, timeout: float = 0.0) -> Command | None:
        """Return the newest command of the stream; see `Client.latest`."""
        self._check_stream()
        until = clock.monotonic() + timeout
        async with self._stream_turn:
            # Another task may replace the stream by opening a session, or end it by closing.
            while self._stream_port:
                payload = await self._receive(self._socket("stream"), until)
                if payload is not None:
                    return self._accept_streamed(self._read(payload, "stream"))
                if clock.monotonic() >= until:
                    break
            return None

    async def watch(self, name: str) -> State:
        """Watch another client's session; see `Client.watch`."""
        async with self._turn:
            self._check_watch()
            request, deadline = {"type": "status", "name": name}, clock.monotonic() + self.timeout
            state = self._accept_watched(name, await self._exchange(request, State, deadline))
            self._socket("stream")
            return state

    async def clutch(self) -> None:
        """Engage, or engage again; see `Client.clutch`."""
        await self._call({"type": "clutch"}, Done)

    async def release(self) -> None:
        """Disengage; see `Client.release`."""
        await self._call({"type": "release"}, Done)

    async def stop(self, name: str | None = None, *, reason: str = "") -> None:
        """Stop the robot; see `Client.stop`."""
        await self._call(_stop_request(name, reason), Done)

    async def clear(self, stop: int) -> None:
        """Clear an emergency stop; see `Client.clear`."""
        await self._call({"type": "clear", "stop": stop}, Done)

    async def reset(
        self,
        *,
        robot_q: npt.ArrayLike | None = None,
        robot_wrist: Pose | npt.ArrayLike | None = None,
    ) -> None:
        """Start again, with the next sample as the reference; see `Client.reset`."""
        await self._call({"type": "reset"} | _given(robot_q=robot_q, robot_wrist=robot_wrist), Done)

    async def configure(
        self,
        *,
        preset: str | None = None,
        options: dict[str, Any] | None = None,
        mapping: dict[str, Any] | None = None,
        teleoperation: dict[str, Any] | None = None,
        ik: dict[str, Any] | None = None,
        has_detail: bool | None = None,
    ) -> None:
        """Change options; see `Client.configure`."""
        changes = _given(
            preset=preset,
            options=options,
            mapping=mapping,
            teleoperation=teleoperation,
            ik=ik,
            has_detail=has_detail,
        )
        await self._call({"type": "configure"} | changes, Done)

    async def status(self) -> State:
        """Return the state of the session or the server; see `Client.status`."""
        return await self._call({"type": "status"}, State)

    async def close(self) -> None:
        """End the session and close the sockets; see `Client.close`."""
        async with self._turn:
            try:
                if self.opened is not None:
                    with suppress(ServiceError, ServiceTimeoutError):
                        await self._exchange(
                            {"type": "close"}, Done, clock.monotonic() + self.timeout
                        )
            finally:
                self._forget()
                self._sockets.close()

    async def _call(self, request: Request, kind: type[R]) -> R:
        async with self._turn:
            return await self._exchange(request, kind, clock.monotonic() + self.timeout)

    async def _exchange(self, request: Request, kind: type[R], deadline: float) -> R:
        """Send a request; if the server has lost the session, reopen it and send it again."""
        reply = await self._ask(numbered := self._numbered(request), deadline)
        if self._speaks_older(reply):
            reply = await self._ask(numbered := self._numbered(request), deadline)
        if self._is_lost(request, reply):
            await self._reopen(deadline)
            reply = await self._ask(numbered := self._numbered(request), deadline)
        accepted = self._accept(numbered, reply, kind)
        if isinstance(accepted, Opened):
            self._socket("stream")  # subscribe before the first command
        return accepted

    async def _reopen(self, deadline: float) -> None:
        """Open the lost session again, where its robot is."""
        if (payload := await self._receive(self._socket("stream"), 0.0)) is not None:
            self._read(payload, "stream")
        last = self._last_command
        await self._exchange(self._reopen_request(), Opened, deadline)
        self._last_command, self.reopened = last, self.reopened + 1

    async def _ask(self, request: Request, deadline: float) -> Reply:
        """Send a request and wait for its answer, each attempt on a new connection."""
        payload = _ENCODE(request)
        for until in self._attempt_ends(deadline):
            socket = self._socket("requests")
            if await self._is_ready(socket, zmq.POLLOUT, until):
                await socket.send(payload, zmq.NOBLOCK)
                while (answer := await self._receive(socket, until)) is not None:
                    reply = self._read(answer, "requests")
                    if _answers(reply, request):
                        return reply
            self._sockets.drop("requests")
        raise self._timeout_error(request)

    def _socket(self, use: Use) -> zmq.asyncio.Socket:
        return self._sockets.get(use, self._endpoint(use))

    async def _receive(self, socket: zmq.asyncio.Socket, until: float) -> bytes | None:
        """Return a message; None if none arrives in time, or if the socket is closed."""
        while await self._is_ready(socket, zmq.POLLIN, until):
            # Another task may take the message between the event and this call.
            with suppress(zmq.Again):
                return await socket.recv(zmq.NOBLOCK)
        return None

    async def _is_ready(self, socket: zmq.asyncio.Socket, event: int, until: float) -> bool:
        """Return whether the event comes in time; False if another task closes the socket."""
        if int(socket.EVENTS) & event:
            return True
        poller = zmq.asyncio.Poller()
        poller.register(socket, event)
        # Closing the socket cancels this future. `wait` keeps that apart from a cancelled task.
        polled = asyncio.ensure_future(poller.poll(_milliseconds(until)))
        try:
            await asyncio.wait([polled])
            return not (polled.cancelled() or socket.closed) and bool(polled.result())
        finally:
            polled.cancel()
