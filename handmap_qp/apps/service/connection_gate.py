"""The ports of requests and stream, in front of ZeroMQ's sockets.

libzmq stores without a bound what a peer sends: the topics of a PUB socket, and the parts of a
message up to its last one. While a ROUTER socket reads one peer's message, it reads no other's.

So clients connect to a gate, which passes bytes between them and the socket. A connection has a
credit of bytes, and each frame costs what libzmq stores for it too. The service gives the credit of
a message back once it has read the whole message. The gate passes nothing on without credit, and
ends a connection that gets none in time. libzmq then forgets what it has stored. Only lengths of
frames are read, so encrypted connections pass too.

If a client does not read, the gate does not read either, and the PUB socket keeps the newest
message for it.
"""

import asyncio
import os
import secrets
import socket
import time
from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from logging import WARNING

import zmq

from handmap_qp.apps.refusals import naming
from .fairness import crowded_accounts
from .logs import Metrics, Throttle
from .safety import Bucket

_RATE = 1024.0
"""Credit that a connection gets without a message, for heartbeats and topics [bytes/s]."""
_STARVED = 1.0
"""Time without credit after which a connection ends [s]."""
_ACCEPTED = 8
"""Connections accepted in one turn of the event loop."""
_AT_ONCE = 2048
"""Bytes of a client that the gate passes on at once."""
_BUFFER = 4096
"""Bytes that wait for a client before the gate stops reading from the socket."""
_GREETING = 64
_LONG = 0x02
"""ZMTP 3: bytes of the greeting; flag of a frame whose length has eight bytes."""
_FRAME = 64
"""What libzmq stores for a frame beside its content [bytes]."""


def cost_of(frame: zmq.Frame) -> int:
    """Return the credit that a frame gives back: its cost, with the 40 bytes of encryption."""
    return len(frame) + 2 * _FRAME


def count_frames() -> Generator[int, bytes, None]:
    """Count the frames of ZMTP 3 that begin in each piece of the bytes of a peer.

    Raises:
        ValueError: If the peer speaks an older protocol.
    """
    data = b""
    while len(data) < _GREETING:
        data += yield 0
    if data[0] != 0xFF or not data[9] & 1 or data[10] < 3:
        raise ValueError("a client speaks an older protocol than ZMTP 3")
    at = _GREETING
    while True:
        count = 0
        while at < len(data):
            size = 9 if data[at] & _LONG else 2
            if at + size > len(data):
                break
            at += size + int.from_bytes(data[at + 1 : at + size], "big")
            count += 1
        rest = data[at:]
        at = max(0, at - len(data))
        data = rest + (yield count)


@dataclass(eq=False)
class ConnectionGate:
    """Listens in front of a socket: an asynchronous context manager that returns the port.

    Attributes:
        socket: The socket, which then admits connections of this process only.
        name: Name of the port, for counters and log.
        host: Address to listen on.
        port: Port; 0 lets the system choose.
        most: Connections at once.
        credit: Bytes that a connection may send before the service has read a message.
        metrics: Counters.
        evicts: Whether a connection beyond `most` may end one of its own address: one without a
            message, or else the one that was silent for longest. Otherwise it is refused, unless
            another address has more connections, which then gives one up.
        clients: The connections.
    """

    socket: zmq.Socket
    name: str
    host: str
    port: int
    most: int
    credit: float
    metrics: Metrics
    evicts: bool = False

    def __post_init__(self) -> None:
        """Put the gate in front of the socket, which gets a name that others do not know."""
        self.inner = f"handmap-{secrets.token_hex(16)}"
        self.socket.setsockopt(zmq.IPC_FILTER_PID, os.getpid())
        self.socket.bind(f"ipc://@{self.inner}")
        self.clients = set[_Client]()
        self._known = dict[bytes, _Client]()
        self._refusals = Throttle()

    async def __aenter__(self) -> int:
        advice = "give a free port at an IP address of this machine"
        with naming(f"{self.host}:{self.port}", advice=advice):
            self._server = await asyncio.start_server(
                lambda *streams: self.admit(_Client(self, *streams)),
                *(self.host, self.port),
                limit=_AT_ONCE,
                backlog=_ACCEPTED,
            )
        bound, *_ = self._server.sockets
        # asyncio accepts the whole backlog in one turn, so it is told of a shorter one.
        with socket.fromfd(bound.fileno(), bound.family, bound.type) as listening:
            listening.listen()
        return bound.getsockname()[1]

    async def __aexit__(self, *_: object) -> None:
        # The last messages of sessions that end are still on their way.
        await asyncio.sleep(0.05)
        self._server.close()
        for client in list(self.clients):
            client.end()

    def admit(self, client: "_Client") -> None:
        """Count a connection in, and end one if there are too many.

        It is one of the address that has most, so that nobody shuts out other addresses.
        """
        if len(self.clients) >= self.most:
            crowded = crowded_accounts(
                (each.address for each in self.clients), client.address
            )
            rivals = [each for each in self.clients if each.address in crowded]
            is_refused = client.address in crowded and not self.evicts
            least = min(rivals, key=lambda each: (bool(each.identity), each.heard))
            (client if is_refused else least).end("too many connections")
        if not client.writer.is_closing():
            self.clients.add(client)

    def release(self, client: "_Client", reason: str) -> None:
        """Count a connection out; if the gate ended it, count and log the reason."""
        self.clients.discard(client)
        self._known.pop(client.identity, None)
        if reason:
            self.metrics.refusals[self.name] += 1
            self._refusals.report(WARNING, "ended", port=self.name, reason=reason)

    def find(self, message: Sequence[zmq.Frame]) -> "_Client | None":
        """Return the connection of a message from a ROUTER socket; None if it has ended."""
        identity = message[0].bytes
        if not (client := self._known.get(identity)):
            # The socket's descriptor of a connection shows the name of the gate's end.
            with suppress(OSError, StopIteration):
                descriptor = int(message[-1].get(zmq.SRCFD))
                with socket.fromfd(
                    descriptor, socket.AF_UNIX, socket.SOCK_STREAM
                ) as end:
                    name = end.getpeername()
                client = next(each for each in self.clients if each.name == name)
                client.identity = identity
                self._known[identity] = client
        return client


@dataclass(eq=False)
class _Client:
    """A client's connection, `heard` [s]; a ROUTER knows its identity, the socket its name."""

    gate: ConnectionGate
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    name = identity = b""

    def __post_init__(self) -> None:
        # The peer may have gone already.
        self.address, *_ = self.writer.get_extra_info("peername") or ("unknown",)
        self.heard = time.monotonic()
        self._credit = Bucket(_RATE, self.gate.credit)
        self._has_credit = asyncio.Event()
        self._task = asyncio.create_task(self._serve())
        self._task.add_done_callback(lambda _: self.end())

    async def _serve(self) -> None:
        """Pass bytes on both ways until one side ends."""
        self.writer.transport.set_write_buffer_limits(high=_BUFFER)
        with socket.socket(socket.AF_UNIX) as end, suppress(OSError):
            end.setblocking(False)
            # The system chooses a unique name.
            end.bind("")
            self.name = end.getsockname()
            loop = asyncio.get_running_loop()
            await loop.sock_connect(end, f"\0{self.gate.inner}")
            reader, writer = await asyncio.open_unix_connection(sock=end, limit=_BUFFER)
            try:
                await asyncio.gather(self._send(writer), self._receive(reader))
            finally:
                writer.transport.abort()

    async def _send(self, writer: asyncio.StreamWriter) -> None:
        """Pass on to the socket what the client has credit for."""
        frames = count_frames()
        next(frames)
        while data := await self.reader.read(_AT_ONCE):
            try:
                cost = len(data) + _FRAME * frames.send(data)
            except ValueError as error:
                self.end(str(error))
                return
            writer.write(data)
            if self._credit.charge(cost) <= 0.0:
                self._has_credit.clear()
                try:
                    async with asyncio.timeout(_STARVED):
                        await self._has_credit.wait()
                except TimeoutError:
                    self.end("a client sent more than its messages need")
        self.end()

    async def _receive(self, reader: asyncio.StreamReader) -> None:
        """Pass on to the client what the socket sends, as fast as it reads."""
        while data := await reader.read(_BUFFER):
            self.writer.write(data)
            await self.writer.drain()
        self.end()

    def refund(self, cost: float) -> str:
        """Give credit back; return the address of the client."""
        self.heard = time.monotonic()
        if self._credit.charge(-cost) > 0.0:
            self._has_credit.set()
        return self.address

    def end(self, reason: str = "") -> None:
        """End the connection, if by the gate with the reason."""
        self.gate.release(self, reason)
        self.writer.transport.abort()
        self._task.cancel()
