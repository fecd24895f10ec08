"""What both clients do: requests, answers, the stream, and reopening a lost session."""

import asyncio
import math
import re
import secrets
from collections import defaultdict
from collections.abc import Awaitable, Coroutine, Mapping
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any, Literal, TypedDict, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
import zmq
import zmq.auth

from . import messages
from .messages import (
    HAPTICS_END,
    HAPTICS_LIFE,
    PROTOCOL,
    PROTOCOLS,
    TOPIC_END,
    Done,
    Error,
    Haptics,
    Opened,
    Pose,
    Reply,
    Side,
)

ADDRESS = "tcp://127.0.0.1:5570"
"""Address of a server on this machine."""
KeyFiles = tuple[Path | str, Path | str]
"""Files of `handmap keys`: `NAME.key_secret` of the client, and `server.key`."""
Options = Mapping[str, object]
"""Options by name: numbers, names, flags and arrays."""
PoseLike = Pose | npt.ArrayLike
"""A pose: shape (4, 4), seven numbers x y z qx qy qz qw, or a `Pose`."""
Request = dict[str, Any]
Socket = zmq.Socket[Any]
R = TypeVar("R", bound=Reply)
T = TypeVar("T")
Use = Literal["requests", "samples", "stream", "haptics", "touches"]
Call = Coroutine[Any, Any, T]


class Command(messages.Command):
    """A command for the robot's driver; its `detail` is a dict, as the server sent it."""

    detail: dict[str, Any] | None = None  # ty: ignore[incompatible-attribute-override]


class State(messages.State):
    """The state of a session or of the server; its `about` is a dict, as the server sent it."""

    about: dict[str, Any] | None = None  # ty: ignore[incompatible-attribute-override]


class HandFields(TypedDict, total=False):
    """One hand of a sample of both hands: the fields of `messages.HandSample`.

    Attributes:
        landmarks: 21 landmarks [m]; may be omitted if `valid` is false.
        values: Numbers of the session's `layout`, in place of landmarks.
        wrist: The human's wrist; the landmarks of the palm give it if omitted.
        valid: Whether the tracker saw the hand. If not, this side of the robot holds.
        confidence: The tracker's own confidence; 0 counts as not seen.
    """

    landmarks: npt.ArrayLike
    values: npt.ArrayLike
    wrist: PoseLike
    valid: bool
    confidence: float


Hands = Mapping[Side, HandFields | Options] | Mapping[str, HandFields | Options]
"""One or both hands by side, `left` and `right`: `HandFields`, or the same in any mapping."""


class ServiceError(RuntimeError):
    """The server refused a request; `error` has the reason and the field at fault."""

    def __init__(self, error: Error) -> None:
        super().__init__(
            ": ".join(filter(None, (error.code, error.field, error.message)))
        )
        self.error = error


class ServiceTimeoutError(TimeoutError):
    """No answer arrived in time."""


def _plain(value: Any) -> Any:
    """Convert an array, scalar or sequence of numpy's to lists and numbers."""
    plain = np.asarray(value)
    if plain.dtype == object:
        raise ValueError(f"expected numbers, got {type(value).__name__}")
    return plain.tolist()


_ENCODE = msgspec.msgpack.Encoder(enc_hook=_plain).encode
_DECODE = msgspec.msgpack.Decoder(
    Opened | Command | State | Haptics | Done | Error
).decode
_ENGAGING = ("clutch", "release", "reset", "stop", "clear")


def request_fields(given: Mapping[str, Any]) -> Request:
    """Return the fields of a request that are not None, with poses in any form as `Pose`.

    Raises:
        TypeError: If one hand of `hands` has an unknown field.
        ValueError: If a pose cannot be used.
    """
    return {
        name: _field(name, value) for name, value in given.items() if value is not None
    }


def open_request(given: Mapping[str, Any]) -> Request:
    """Return the request that opens a session, with a new secret; errors of `request_fields`."""
    own = {"type": "open", "session": secrets.token_urlsafe(24)}
    if given.get("resume") == "engage":
        # Servers of earlier versions know the former name alone.
        own["resume"] = "clutch"
    return request_fields(given) | own


def sample_request(
    kind: Literal["step", "sample"], given: Mapping[str, Any]
) -> Request:
    """Return a sample, which happens now unless it says when; errors of `request_fields`."""
    return {"type": kind, "time": monotonic()} | request_fields(given)


def _hand_fields(side: str, given: Mapping[str, Any]) -> Request:
    if unknown := given.keys() - HandFields.__annotations__.keys():
        raise TypeError(f"hands: {side} has no field {sorted(unknown)[0]!r}")
    return request_fields(given)


def _field(name: str, value: Any) -> Any:
    if name == "hands":
        return {side: _hand_fields(side, hand) for side, hand in value.items()}
    if name == "values":
        return np.ravel(value)
    is_pose = name.endswith(("wrist", "base", "pose"))
    return Pose.of(value, name) if is_pose else value


class Calls:
    """Calls, written once for both clients; those of `Client` block and never suspend."""

    _context: type[zmq.Context[Any]] = zmq.Context

    def __init__(
        self,
        address: str = ADDRESS,
        *,
        timeout: float = 2.0,
        attempts: int = 2,
        keys: KeyFiles | None = None,
    ) -> None:
        if not re.fullmatch(r".*://.*:\d+", address):
            raise ValueError(f"expected an address such as {ADDRESS}, got {address!r}")
        self.address = address
        self.timeout = timeout
        self.attempts = attempts
        self.reopened = 0
        self._keys = None if keys is None else _load_keys(keys)
        self._seq = 0
        self._protocol = PROTOCOL
        self._sockets: dict[Use, Socket] = {}
        # Calls of several tasks take turns. One task may wait for the stream meanwhile.
        self._turns: dict[Use, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._forget()

    def _forget(self) -> None:
        """Forget the session."""
        self.opened: Opened | None = None
        self._last_command: messages.Command | None = None
        self._open_request: Request = {}  # as it must be repeated to reopen the session
        self._addressee: Request = {"session": ""}  # or the name of a watched session
        self._stream_of = ("", 0)  # name of the session, port of its stream
        self._felt_at = 0.0  # time of the last look at the haptics [s, monotonic]
        self._released_at = 0  # number of the last request that changed `is_released`

    async def _is_ready(self, socket: Socket, event: int, milliseconds: int) -> bool:
        """Return whether a socket's event comes in time."""
        return bool(socket.poll(milliseconds, event))

    async def _io(self, use: Use, payload: bytes | None, until: float) -> bytes | None:
        """Send a payload, or return a message if it is None, before a time [s, monotonic].

        None is too late; what was sent is an empty message.
        """
        socket = self._socket(use)
        event = zmq.POLLIN if payload is None else zmq.POLLOUT
        milliseconds = max(0, math.ceil(1e3 * (until - monotonic())))
        if not await self._is_ready(socket, event, milliseconds):
            return None
        # Another task may take the message between the event and the transfer.
        with suppress(zmq.Again):
            if payload is None:
                done = socket.recv(zmq.NOBLOCK)
            else:
                done = socket.send(payload, zmq.NOBLOCK)
            return (await done if isinstance(done, Awaitable) else done) or b""
        return None

    async def _do(self, kind: str, **fields: Any) -> None:
        await self._call({"type": kind, **fields}, Done)

    async def _send(self, sample: Request) -> None:
        if self.opened is None:
            raise RuntimeError("open a session first")
        # Only samples that could not be read, or that are of no session, are answered.
        error = await self._read("samples", 0.0)
        if isinstance(error, Error):
            if error.code != "no_session":
                raise ServiceError(error)
            await self._reopen(monotonic() + self.timeout)
        await self._io("samples", _ENCODE(self._numbered(sample)), 0.0)

    async def _tell(self, request: Request, use: Use = "samples") -> Error | None:
        """Send a request without waiting for its answer; return the refusal of an earlier one.

        A newer request for the same use may replace it before it is sent.
        """
        reply = await self._read(use, 0.0)
        await self._io(use, _ENCODE(self._numbered(request)), 0.0)
        return reply if isinstance(reply, Error) else None

    async def _touch(self, felt: Request) -> Error | None:
        return await self._tell(request_fields(felt | {"type": "touch"}), "touches")

    async def _latest(self, timeout: float) -> Command | None:
        if "stream" not in self._sockets:
            raise RuntimeError("open a session first, or watch one")
        until = monotonic() + timeout
        # Another task may replace the stream by opening a session, or end it by closing.
        while "stream" in self._sockets:
            reply = await self._read("stream", until)
            # Who watches has sent no sample.
            is_ours = self.opened and isinstance(reply, Error)
            if is_ours and reply.code not in ("no_session", "taken"):
                raise ServiceError(reply)
            if reply or monotonic() >= until:
                return reply if isinstance(reply, Command) else None
        return None

    async def _haptics(self, timeout: float) -> Haptics | None:
        if "stream" not in self._sockets:
            raise RuntimeError("open a session first, or watch one")
        if "haptics" not in self._sockets:
            # Only who asks for haptics receives them.
            name, port = self._stream_of
            self._connect_stream("haptics", name + HAPTICS_END, port)
        elif monotonic() - self._felt_at > HAPTICS_LIFE:
            # What waits may have arrived long ago.
            await self._read("haptics", 0.0)
        reply = await self._read("haptics", monotonic() + timeout)
        self._felt_at = monotonic()
        return reply if isinstance(reply, Haptics) else None

    async def _watch(self, name: str) -> State:
        if self.opened is not None:
            raise RuntimeError(
                "this client has a session of its own; watch with another one"
            )
        state = await self._call({"type": "status", "name": name}, State)
        self._addressee = {"name": name}
        self._subscribe(name, state.stream_port)
        return state

    async def _close(self) -> None:
        try:
            if self.opened is not None:
                with suppress(ServiceError, ServiceTimeoutError):
                    await self._do("close")
        finally:
            self._forget()
            for use in tuple(self._sockets):
                self._drop(use)

    async def _call(
        self, request: Request, kind: type[R], deadline: float | None = None
    ) -> R:
        """Send a request; if the server has lost the session, reopen it and send it again."""
        until = deadline or monotonic() + self.timeout
        reply = await self._ask(request, until)
        if self._speaks_older(reply):
            reply = await self._ask(request, until)
        is_lost = isinstance(reply, Error) and reply.code == "no_session"
        if is_lost and self.opened and request["type"] not in ("open", "close"):
            await self._reopen(until)
            reply = await self._ask(request, until)
        if isinstance(reply, Error):
            raise ServiceError(reply)
        if not isinstance(reply, kind):
            raise ServiceError(Error(code="protocol", message=f"unexpected {reply}"))
        self._note(request, reply)
        return reply

    async def _ask(self, request: Request, deadline: float) -> Reply:
        """Number a request, send it and wait for its answer, each attempt on a new connection."""
        request = self._numbered(request)
        payload = _ENCODE(request)
        for left in range(self.attempts, 0, -1):
            # Each attempt has an equal share of the time that is left.
            now = monotonic()
            until = now + (deadline - now) / left
            is_sent = await self._io("requests", payload, until) is not None
            while is_sent and (reply := await self._read("requests", until)):
                # An error with number 0 says that the server did not read the request. Other
                # numbers are of requests that timed out before.
                if reply.seq == request["seq"] or (
                    reply.seq == 0 and isinstance(reply, Error)
                ):
                    return reply
            self._drop("requests")
        raise ServiceTimeoutError(
            f"{self.address}: no answer to {request['type']!r} within {self.timeout:g} s"
        )

    async def _reopen(self, deadline: float) -> None:
        """Open the lost session again, where its robot is."""
        await self._read("stream", 0.0)
        opened = self.opened
        assert opened is not None
        last = self._last_command
        # `restore` lets the server use its own record if it has one; it knows the owner's secret.
        request = self._open_request | {"name": opened.name, "restore": True}
        request["robot_q"] = (last or opened).q
        if last is not None and opened.is_floating:
            request["robot_wrist"] = last.wrist
        await self._call(request, Opened, deadline)
        self._last_command = last
        self.reopened += 1

    def _numbered(self, request: Request) -> Request:
        """Add the next number and the session to a request."""
        self._seq += 1
        addressee = {} if request["type"] == "open" else self._addressee
        return addressee | request | {"protocol": self._protocol, "seq": self._seq}

    async def _read(self, use: Use, until: float) -> Reply | None:
        """Read a reply, as in `_io`, and remember the last command for `_reopen`."""
        payload = await self._io(use, None, until)
        if payload is None:
            return None
        if use in ("stream", "haptics"):
            payload = payload.split(TOPIC_END, 1)[1]
        reply = _DECODE(payload)
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
        theirs = reply.protocols or PROTOCOLS[:1]
        older = [v for v in PROTOCOLS if v in theirs and v < self._protocol]
        self._protocol = max(older, default=self._protocol)
        return bool(older)

    def _note(self, request: Request, reply: Reply) -> None:
        """Note what a request that was carried out means for the next reopening."""
        wanted = self._open_request
        kind = request["type"]
        if isinstance(reply, Opened):
            self._open_request = request
            self.opened = reply
            self._last_command = None
            self._released_at = reply.seq
            self._addressee = {"session": request["session"]}
            # Answers to samples before a reopening would reopen the session again.
            self._drop("samples")
            self._subscribe(reply.name, reply.stream_port)
        elif not wanted or "name" in request:
            return
        elif kind in _ENGAGING:
            wanted["is_released"] = kind not in ("clutch", "reset")
            self._released_at = reply.seq
        elif kind == "configure":
            self._open_request = messages.with_changes(wanted, request)

    def _subscribe(self, name: str, port: int) -> None:
        """Read the stream of a session from its next command on."""
        self._drop("stream")
        self._drop("haptics")
        self._stream_of = name, port
        self._connect_stream("stream", name, port)

    def _connect_stream(self, use: Use, topic: str, port: int) -> None:
        """Subscribe to what the server publishes under a topic."""
        host = self.address.rpartition(":")[0]
        stream = self._socket(use, zmq.SUB, f"{host}:{port}")
        stream.setsockopt(zmq.SUBSCRIBE, topic.encode() + TOPIC_END)

    def _socket(self, use: Use, kind: int = zmq.DEALER, address: str = "") -> Socket:
        """Return the socket for a use, connected when it is first needed."""
        if use in self._sockets:
            return self._sockets[use]
        socket = self._sockets[use] = self._context.instance().socket(kind)
        # A request waits until there is a connection; of samples and commands the newest counts.
        socket.setsockopt(zmq.IMMEDIATE if use == "requests" else zmq.CONFLATE, 1)
        socket.ipv6 = True
        socket.linger = 0
        # Times are in milliseconds. Heartbeats detect a connection that died without notice.
        socket.reconnect_ivl = 50
        socket.heartbeat_ivl = 1000
        socket.heartbeat_timeout = 3000
        if self._keys is not None:
            socket.curve_publickey, socket.curve_secretkey, socket.curve_serverkey = (
                self._keys
            )
        socket.connect(address or self.address)
        return socket

    def _drop(self, use: Use) -> None:
        if (socket := self._sockets.pop(use, None)) is not None:
            socket.close(linger=0)


def _load_keys(files: KeyFiles) -> tuple[bytes, bytes, bytes]:
    """Return this client's public and secret key, and the server's public key."""
    (public, secret), (server, _) = (zmq.auth.load_certificate(file) for file in files)
    if secret is None:
        raise ValueError(
            f"{files}: expected NAME.key_secret and server.key; the first holds no secret key"
        )
    return public, secret, server
