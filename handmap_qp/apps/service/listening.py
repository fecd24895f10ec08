"""A port on which clients connect: how many may, and who gives way to others.

`connection_gate` passes their bytes on to a socket of ZeroMQ, `direct` reads their messages itself.
"""

import asyncio
import socket
import time
from collections.abc import Callable
from logging import WARNING

from handmap_qp.apps.refusals import naming
from .fairness import crowded_accounts
from .logs import Metrics, Throttle

AT_ONCE = 2048
"""Bytes of a client that are read in one turn of the event loop."""
_ACCEPTED = 8
"""Connections accepted in one turn of the event loop."""


class Connection(asyncio.BufferedProtocol):
    """A connection, which passes on at once what it reads.

    As a protocol, without streams: a task that reads would run in a later turn of the event loop,
    once for each direction of each message.

    Args:
        size: Bytes read in one turn.

    Attributes:
        writer: The transport.
    """

    writer: asyncio.Transport

    def __init__(self, size: int) -> None:
        self._buffer = memoryview(bytearray(size))

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport."""
        assert isinstance(transport, asyncio.Transport)
        self.writer = transport

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return where to put what is read."""
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        """Pass on what was read."""
        self.receive(bytes(self._buffer[:nbytes]))

    def receive(self, data: bytes) -> None:
        """Pass bytes on."""
        raise NotImplementedError

    def end(self, reason: str = "") -> None:
        """End the connection, if by the server with the reason."""
        raise NotImplementedError

    def eof_received(self) -> None:
        """End the connection: what the other side has not read is lost."""
        self.end()

    def connection_lost(self, exc: Exception | None) -> None:
        """End the connection."""
        self.end()


class Client(Connection):
    """A client's connection.

    Args:
        listener: The port that it is on.

    Attributes:
        address: Address of the client.
        identity: What it is known by once it has sent a message; empty before.
        heard: Time of its last message, at first of its beginning [s].
    """

    address: str

    def __init__(self, listener: "Listener") -> None:
        super().__init__(AT_ONCE)
        self.identity = b""
        self.heard = time.monotonic()
        self._listener = listener

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Count the connection in."""
        super().connection_made(transport)
        # The peer may have gone already.
        self.address, *_ = self.writer.get_extra_info("peername") or ("unknown",)
        self._listener.admit(self)
        if not self.writer.is_closing():
            self.begin()

    def begin(self) -> None:
        """Begin to serve the client, which is admitted."""
        raise NotImplementedError

    def end(self, reason: str = "") -> None:
        """Count the connection out and end it, if by the server with the reason."""
        self._listener.release(self, reason)
        self.writer.abort()


class Listener:
    """Listens on a port: an asynchronous context manager that returns it.

    Args:
        make: Makes the protocol of a connection.
        name: Name of the port, for counters and log.
        host: Address to listen on.
        port: Port; 0 lets the system choose.
        most: Connections at once.
        metrics: Counters.
        evicts: Whether a connection beyond `most` may end one of its own address: one without a
            message, or else the one that was silent for longest. Otherwise it is refused, unless
            another address has more connections, which then gives one up.

    Attributes:
        clients: The connections.
    """

    def __init__(
        self,
        make: Callable[[], Client],
        name: str,
        host: str,
        port: int,
        most: int,
        metrics: Metrics,
        *,
        evicts: bool = False,
    ) -> None:
        self._make = make
        self._name = name
        self._host = host
        self._port = port
        self._most = most
        self._metrics = metrics
        self._evicts = evicts
        self.clients: set[Client] = set()
        self._refusals = Throttle()

    async def __aenter__(self) -> int:
        advice = "give a free port at an IP address of this machine"
        with naming(f"{self._host}:{self._port}", advice=advice):
            self._server = await asyncio.get_running_loop().create_server(
                self._make, self._host, self._port, backlog=_ACCEPTED
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

    def admit(self, client: Client) -> None:
        """Count a connection in, and end one if there are too many.

        It is one of the address that has most, so that nobody shuts out other addresses.
        """
        if len(self.clients) >= self._most:
            crowded = crowded_accounts(
                (each.address for each in self.clients), client.address
            )
            rivals = [each for each in self.clients if each.address in crowded]
            is_refused = client.address in crowded and not self._evicts
            least = min(rivals, key=lambda each: (bool(each.identity), each.heard))
            (client if is_refused else least).end("too many connections")
        if not client.writer.is_closing():
            self.clients.add(client)

    def release(self, client: Client, reason: str) -> None:
        """Count a connection out; if the server ended it, count and log the reason."""
        self.clients.discard(client)
        if reason:
            self._metrics.refusals[self._name] += 1
            self._refusals.report(WARNING, "ended", port=self._name, reason=reason)
