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

import zmq

from .listening import Client, Connection, Listener
from .logs import Metrics
from .safety import Bucket
from .zmtp import GREETING, OLDER, head_size, is_older

_RATE = 1024.0
"""Credit that a connection gets without a message, for heartbeats and topics [bytes/s]."""
_STARVED = 1.0
"""Time without credit after which a connection ends [s]."""
_BUFFER = 4096
"""Bytes that wait for a client before the gate stops reading from the socket."""
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
    while len(data) < GREETING:
        data += yield 0
    if is_older(data):
        raise ValueError(OLDER)
    at = GREETING
    while True:
        count = 0
        while at < len(data):
            size = head_size(data[at])
            if at + size > len(data):
                break
            at += size + int.from_bytes(data[at + 1 : at + size], "big")
            count += 1
        rest = data[at:]
        at = max(0, at - len(data))
        data = rest + (yield count)


class ConnectionGate(Listener):
    """Listens in front of a socket: an asynchronous context manager that returns the port.

    Args:
        socket: The socket, which then admits connections of this process only.
        name: As of `Listener`.
        host: Likewise.
        port: Likewise.
        most: Likewise.
        credit: Bytes that a connection may send before the service has read a message.
        metrics: As of `Listener`.
        evicts: Likewise.

    Attributes:
        inner: Name of the socket, which others do not know.
        credit: As given.
    """

    def __init__(
        self,
        socket: zmq.Socket,
        name: str,
        host: str,
        port: int,
        most: int,
        credit: float,
        metrics: Metrics,
        *,
        evicts: bool = False,
    ) -> None:
        def make() -> _Client:
            return _Client(self)

        super().__init__(make, name, host, port, most, metrics, evicts=evicts)
        self.credit = credit
        self.inner = f"handmap-{secrets.token_hex(16)}"
        socket.setsockopt(zmq.IPC_FILTER_PID, os.getpid())
        socket.bind(f"ipc://@{self.inner}")
        # Connections by the name of the gate's end, and by the identity that the socket gave them.
        self._named: dict[bytes, _Client] = {}
        self._known: dict[bytes, _Client] = {}

    def note_name(self, client: "_Client") -> None:
        """Note the name of a connection's end."""
        self._named[client.name] = client

    def release(self, client: Client, reason: str) -> None:
        """Count a connection out; if the gate ended it, count and log the reason."""
        super().release(client, reason)
        self._known.pop(client.identity, None)
        if isinstance(client, _Client):
            self._named.pop(client.name, None)

    def find(self, message: Sequence[zmq.Frame]) -> "_Client | None":
        """Return the connection of a message from a ROUTER socket; None if it has ended."""
        identity = message[0].bytes
        if not (client := self._known.get(identity)):
            # The socket's descriptor of a connection shows the name of the gate's end.
            with suppress(OSError, KeyError):
                descriptor = int(message[-1].get(zmq.SRCFD))
                with socket.fromfd(
                    descriptor, socket.AF_UNIX, socket.SOCK_STREAM
                ) as end:
                    name = end.getpeername()
                client = self._named[name]
                client.identity = identity
                self._known[identity] = client
        return client


class _Inner(Connection):
    """The end of a connection at the gate's own socket.

    Args:
        client: The connection.
    """

    def __init__(self, client: "_Client") -> None:
        super().__init__(_BUFFER)
        self._client = client

    def receive(self, data: bytes) -> None:
        """Pass on to the client what the socket sends; see `_Client.pause_writing`."""
        self._client.writer.write(data)

    def end(self, reason: str = "") -> None:
        """End the connection, if by the gate with the reason."""
        self._client.end(reason)


class _Client(Client):
    """A client's connection; a ROUTER knows its identity, the socket its name.

    Args:
        gate: The gate.
    """

    def __init__(self, gate: ConnectionGate) -> None:
        super().__init__(gate)
        self.name = b""
        self._gate = gate
        self._credit = Bucket(_RATE, gate.credit)
        self._frames = count_frames()
        next(self._frames)
        self._early = b""
        self._inner: _Inner | None = None
        self._is_slow = False
        self._opening: asyncio.Task[None] | None = None
        self._starving: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """Connect to the socket."""
        self.writer.set_write_buffer_limits(high=_BUFFER)
        self._opening = asyncio.create_task(self._open())

    async def _open(self) -> None:
        """Connect to the socket, and pass on what has arrived meanwhile."""
        loop = asyncio.get_running_loop()
        with socket.socket(socket.AF_UNIX) as end:
            try:
                end.setblocking(False)
                # The system chooses a unique name.
                end.bind("")
                self.name = end.getsockname()
                self._gate.note_name(self)
                await loop.sock_connect(end, f"\0{self._gate.inner}")
                _, inner = await loop.create_unix_connection(
                    lambda: _Inner(self), sock=end.dup()
                )
            except OSError:
                self.end()
                return
        self._inner = inner
        if self._is_slow:
            inner.writer.pause_reading()
        self.writer.resume_reading()
        if early := self._early:
            self._early = b""
            self.receive(early)

    def receive(self, data: bytes) -> None:
        """Pass on to the socket what the client has credit for."""
        if self._inner is None:
            self._early = data
            self.writer.pause_reading()
            return
        try:
            cost = len(data) + _FRAME * self._frames.send(data)
        except ValueError as error:
            self.end(str(error))
            return
        self._inner.writer.write(data)
        if self._credit.charge(cost) <= 0.0 and self._starving is None:
            self.writer.pause_reading()
            loop = asyncio.get_running_loop()
            reason = "a client sent more than its messages need"
            self._starving = loop.call_later(_STARVED, self.end, reason)

    def pause_writing(self) -> None:
        """Read no more from the socket than the client reads."""
        self._is_slow = True
        if self._inner is not None:
            self._inner.writer.pause_reading()

    def resume_writing(self) -> None:
        """Read from the socket again."""
        self._is_slow = False
        if self._inner is not None:
            self._inner.writer.resume_reading()

    def refund(self, cost: float) -> str:
        """Give credit back; return the address of the client."""
        self.heard = time.monotonic()
        if self._credit.charge(-cost) > 0.0 and self._starving is not None:
            self._starving.cancel()
            self._starving = None
            self.writer.resume_reading()
        return self.address

    def end(self, reason: str = "") -> None:
        """Count the connection out and end it, if by the gate with the reason."""
        super().end(reason)
        if self._starving is not None:
            self._starving.cancel()
        if self._opening is not None:
            self._opening.cancel()
        if self._inner is not None:
            self._inner.writer.abort()
