"""Messages between a server and its worker processes, over a pair of sockets.

A message is its length in four bytes, and msgpack. They arrive in the order in which they were
sent. If one end closes, the other one learns it.
"""

import asyncio
from collections.abc import Callable
from typing import Generic, TypeVar

import msgspec
from msgspec import Struct

_HEAD = 4
MOST_UNSENT = 2**23
"""Bytes that a process may leave unread before its channel is closed."""


class Start(Struct, array_like=True, tag=True, frozen=True):
    """To a worker, first: its settings.

    Attributes:
        settings: The settings, pickled.
        level: Lowest level to log.
        number: Number of the worker, for the log.
        stream_port: Port of the stream, as `opened` reports it.
    """

    settings: bytes
    level: str
    number: int
    stream_port: int


class Ask(Struct, array_like=True, tag=True, frozen=True):
    """To a worker: a request of a client.

    Attributes:
        token: Number of the request, which its answer has too.
        peer: Number of the client's connection.
        address: Address of the client.
        key: Name of its key; empty without keys.
        payload: The request as received.
    """

    token: int
    peer: int
    address: str
    key: str
    payload: bytes


class Learn(Struct, array_like=True, tag=True, frozen=True):
    """To a worker: what is known of a name that a client is about to open.

    Attributes:
        name: The name.
        record: Its `Record` (msgpack); empty if there is none.
        heard: When its owner was heard, if others must not have it yet [s, monotonic]; else None.
    """

    name: str
    record: bytes
    heard: float | None


class Finish(Struct, array_like=True, tag=True, frozen=True):
    """To a worker: close all sessions and end."""


class Ready(Struct, array_like=True, tag=True, frozen=True):
    """From a worker: it serves."""


class Answered(Struct, array_like=True, tag=True, frozen=True):
    """From a worker: the answer to a request."""

    token: int
    payload: bytes


class Published(Struct, array_like=True, tag=True, frozen=True):
    """From a worker: a message of a session's stream."""

    name: str
    payload: bytes


class Noted(Struct, array_like=True, tag=True, frozen=True):
    """From a worker: where a session is, before its command leaves (`Record`, msgpack)."""

    record: bytes


class Began(Struct, array_like=True, tag=True, frozen=True):
    """From a worker: a session was opened.

    Attributes:
        secret: Its secret.
        name: Its name.
        account: Whose share it uses.
    """

    secret: str
    name: str
    account: str


class Ended(Struct, array_like=True, tag=True, frozen=True):
    """From a worker: the session of a secret has ended."""

    secret: str


class Report(Struct, array_like=True, tag=True, frozen=True):
    """From a worker, several times a second: its counters, and what it does.

    Attributes:
        counts: Counts of what happened.
        refusals: Counts of refused messages by code.
        steps: Counts of step times, by the buckets of `Metrics`.
        step_seconds: Sum of the step times [s].
        load: Share of the last second in which it worked; 0 if it had no sample.
        rate: Samples mapped per second.
        wait: Mean time that samples waited [s].
        lag: Longest delay of its event loop [s].
        busy: Longest CPU time between two turns of it [s].
        resident: Resident memory [bytes].
        shed: Names of the sessions whose samples are refused.
        unmeasured: Sessions that had no sample in the last second.
    """

    counts: dict[str, int]
    refusals: dict[str, int]
    steps: tuple[int, ...]
    step_seconds: float
    load: float
    rate: float
    wait: float
    lag: float
    busy: float
    resident: float
    shed: tuple[str, ...]
    unmeasured: int


ToWorker = Start | Ask | Learn | Finish
FromWorker = Ready | Answered | Published | Noted | Began | Ended | Report
M = TypeVar("M")
_encode = msgspec.msgpack.Encoder().encode


class Channel(asyncio.Protocol, Generic[M]):
    """One end of a channel, as an asyncio protocol.

    Args:
        decode: Reads a message of the other end.
        receive: Called with each message.
        lost: Called when the other end is gone.
    """

    def __init__(
        self,
        decode: Callable[[bytes], M],
        receive: Callable[[M], None],
        lost: Callable[[], None],
    ) -> None:
        self._decode = decode
        self._receive = receive
        self._lost = lost
        self._data = bytearray()
        self._unsent = bytearray()
        self._transport: asyncio.WriteTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport."""
        assert isinstance(transport, asyncio.WriteTransport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Pass on each message that is whole."""
        buffer = self._data
        buffer += data
        at = 0
        while len(buffer) >= at + _HEAD:
            end = at + _HEAD + int.from_bytes(buffer[at : at + _HEAD], "big")
            if len(buffer) < end:
                break
            message = self._decode(bytes(buffer[at + _HEAD : end]))
            at = end
            self._receive(message)
        del buffer[:at]

    def connection_lost(self, exc: Exception | None) -> None:
        """Say that the other end is gone."""
        self._transport = None
        self._lost()

    def send(self, message: ToWorker | FromWorker) -> None:
        """Send a message; one to an end that is gone is dropped."""
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        if not self._unsent:
            # A call of the system for all messages of a turn.
            asyncio.get_running_loop().call_soon(self._flush)
        payload = _encode(message)
        self._unsent += len(payload).to_bytes(_HEAD, "big")
        self._unsent += payload

    def close(self) -> None:
        """Send what was written, and close."""
        if self._transport is not None:
            self._flush()
            self._transport.close()

    def _flush(self) -> None:
        """Write the messages of this turn of the event loop."""
        data = bytes(self._unsent)
        self._unsent.clear()
        transport = self._transport
        if not data or transport is None or transport.is_closing():
            return
        transport.write(data)
        if transport.get_write_buffer_size() > MOST_UNSENT:
            # The other process does not read any more.
            transport.abort()
