"""The port of the stream, in front of ZeroMQ's PUB socket.

A PUB socket stores every topic that a reader sends, without a bound, and reads them in the thread
that publishes: a flood of long topics takes gigabytes, and delays all sessions. So readers connect
to this gate, which passes bytes between them and the PUB socket, and ends a connection that sends
more than subscriptions need. The PUB socket then forgets its topics. Bytes are not interpreted, so
encrypted connections pass too.

The gate keeps no messages: if a reader does not read, the gate does not read either, and the PUB
socket keeps the newest message for it.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from logging import WARNING

from handmap_qp.errors import InvalidInputError
from handmap_qp.service.caps import Bucket
from handmap_qp.service.logs import Throttle
from handmap_qp.service.metrics import Metrics

_RATE, _BURST = 1024.0, 12288.0
"""Bytes per second from a reader, and at once: some hundred subscriptions."""
_CONNECTIONS_PER_SECOND = 50.0
_BUFFER = 4096
"""Bytes that wait for a reader before the gate stops reading from the PUB socket."""


class StreamGate:
    """Listens for readers of the stream: an asynchronous context manager that returns the port.

    Args:
        host: Address to listen on.
        port: Port; 0 lets the system choose.
        most: Connections at once.
        metrics: Counters.

    Attributes:
        inner: Address for the PUB socket, which others on this machine cannot guess.
    """

    def __init__(self, host: str, port: int, most: int, metrics: Metrics) -> None:
        self._host, self._port, self._most, self._metrics = host, port, most, metrics
        self._name = f"handmap-{secrets.token_hex(16)}"
        self.inner = f"ipc://@{self._name}"
        self._readers: set[_Reader] = set()
        self._accepted = Bucket(_CONNECTIONS_PER_SECOND, time.monotonic(), 2.0 * most)
        self._refusals = Throttle()

    async def __aenter__(self) -> int:
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(self._accept, self._host, self._port)
        except OSError as error:
            address = f"{self._host}:{self._port}"
            problem = str(error.strerror or error)
            raise InvalidInputError(argument=address, problem=problem) from error
        return self._server.sockets[0].getsockname()[1]

    async def __aexit__(self, *_: object) -> None:
        # The last messages of sessions that end are still on their way.
        await asyncio.sleep(0.05)
        self._server.close()
        for reader in list(self._readers):
            reader.end()

    def _accept(self) -> asyncio.Protocol:
        return _Reader(self)

    def admits(self, reader: _Reader) -> bool:
        """Count a connection; return whether there is room for it."""
        is_admitted = len(self._readers) < self._most and self._accepted.take(time.monotonic())
        if is_admitted:
            self._readers.add(reader)
        else:
            self.refuse("too many readers of the stream")
        return is_admitted

    def release(self, reader: _Reader) -> None:
        """Count a connection out, however it ended."""
        self._readers.discard(reader)

    def refuse(self, reason: str) -> None:
        """Count a connection that is ended."""
        self._metrics.refusals["stream"] += 1
        self._refusals.report(WARNING, "refused_reader", reason=reason)

    async def connect(self, reader: _Reader) -> None:
        """Connect a reader to the PUB socket."""
        loop = asyncio.get_running_loop()
        try:
            await loop.create_unix_connection(lambda: _Publisher(reader), f"\0{self._name}")
        except OSError:
            reader.end()


class _Reader(asyncio.Protocol):
    """The connection of one reader."""

    def __init__(self, gate: StreamGate) -> None:
        self._gate = gate
        self._bytes = Bucket(_RATE, time.monotonic(), _BURST)
        self._transport: asyncio.Transport | None = None
        self._publisher: asyncio.Transport | None = None
        self._waiting = bytearray()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        if not self._gate.admits(self):
            transport.abort()
            return
        transport.set_write_buffer_limits(high=_BUFFER)
        self._connecting = asyncio.get_running_loop().create_task(self._gate.connect(self))

    def data_received(self, data: bytes) -> None:
        if not self._bytes.take(time.monotonic(), len(data)):
            self._gate.refuse("a reader sent more than subscriptions")
            self.end()
        elif self._publisher is None:
            self._waiting += data
        else:
            self._publisher.write(data)

    def pause_writing(self) -> None:
        if self._publisher is not None:
            self._publisher.pause_reading()

    def resume_writing(self) -> None:
        if self._publisher is not None and not self._publisher.is_closing():
            self._publisher.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        self.end()

    def attach(self, publisher: asyncio.Transport) -> None:
        """Take the connection to the PUB socket, and pass on what has arrived before."""
        self._publisher = publisher
        if self._transport is None or self._transport.is_closing():
            publisher.abort()
        elif self._waiting:
            publisher.write(bytes(self._waiting))
            self._waiting.clear()

    def write(self, data: bytes) -> None:
        """Pass on what the PUB socket sent."""
        if self._transport is not None:
            self._transport.write(data)

    def end(self) -> None:
        """End both connections."""
        self._gate.release(self)
        for transport in (self._transport, self._publisher):
            if transport is not None:
                transport.abort()


class _Publisher(asyncio.Protocol):
    """The connection to the PUB socket for one reader."""

    def __init__(self, reader: _Reader) -> None:
        self._reader = reader

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._reader.attach(transport)

    def data_received(self, data: bytes) -> None:
        self._reader.write(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._reader.end()
