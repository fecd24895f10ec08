"""The port of requests without keys, whose messages the event loop reads itself (`zmtp`).

Messages of one turn of the event loop are bounded, so that a flood leaves time to the samples: a
connection that has more is not read until they are handled, and connections take turns.
"""

import asyncio
import itertools
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from logging import INFO

from .listening import Client, Listener
from .logs import Metrics, Throttle
from .sessions import Caller
from .zmtp import HELLO, PING, Peer, PeerError, message

_BATCH = 64
"""Messages handled in one turn of the event loop."""
_PARTS = 2
"""Parts of a message: its payload, and an empty one before it from a REQ."""
_HANDSHAKE = 5.0
"""Longest time of a handshake [s]."""
_HEARTBEAT = 2.0
"""Time between the questions whether a peer is still there [s]."""
_LONGEST_SILENCE = 8.0
"""Time without a byte after which a peer is gone [s]."""
_MOST_UNREAD = 2**18
"""Bytes that a client may leave unread, above which it loses further answers."""
NO_HANDSHAKE = (
    "only one of client and server uses keys, or the client does not speak ZeroMQ"
)
"""Why a handshake failed, if nothing else is known."""

Receive = Callable[["DirectClient", bytes, Callable[[bytes], None]], None]
"""Takes a message of a client, and what answers it."""


class DirectClient(Client):
    """A client whose messages the server reads itself.

    Args:
        port: The port that it is on.

    Attributes:
        caller: The client, as sessions know it.
    """

    caller: Caller

    def __init__(self, port: "DirectPort") -> None:
        super().__init__(port)
        self._port = port
        self._peer = Peer(port.longest, _PARTS, self._write)
        self._asked = self._active = self.heard

    def begin(self) -> None:
        """Greet the client."""
        self.caller = Caller(self.address)
        self._write(HELLO)

    def receive(self, data: bytes) -> None:
        """Handle the messages that have arrived."""
        self._active = time.monotonic()
        self._peer.receive(data)
        self._port.serve(self)

    def handle_next(self) -> bool:
        """Handle one message; return False if none is whole, or the connection has ended."""
        if self.writer.is_closing():
            return False
        try:
            parts = self._peer.next_message()
        except PeerError as error:
            self.end("" if error.is_handshake else str(error))
            return False
        if parts is None:
            return False
        *envelope, payload = parts
        if any(envelope):
            self.end("a message has too many parts")
            return False
        self.heard = self._active
        self.identity = self.identity or self._port.new_identity()
        answer = partial(self._answer, bool(envelope))
        self._port.handle(self, payload, answer)
        return True

    def check(self, now: float) -> None:
        """Ask a silent client whether it is still there; end one that is not."""
        is_ready = self._peer.is_ready
        # Before its first message, that is when it connected.
        silent = now - (self._active if is_ready else self.heard)
        if silent > (_LONGEST_SILENCE if is_ready else _HANDSHAKE):
            self.end()
        elif is_ready and now - self._asked >= _HEARTBEAT:
            self._asked = now
            self._write(PING)

    def end(self, reason: str = "") -> None:
        """Count the connection out and end it, if by the server with the reason."""
        is_new = not self.writer.is_closing()
        super().end(reason)
        if is_new and not (reason or self._peer.is_ready):
            self._port.note_failed_handshake()

    def _answer(self, has_envelope: bool, payload: bytes) -> None:
        """Send an answer, unless the client does not read."""
        if self.writer.is_closing() or self._is_behind:
            self._port.note_dropped()
        else:
            self.writer.write(message(payload, has_envelope=has_envelope))

    def _write(self, data: bytes) -> None:
        """Send what is no answer, unless the client does not read."""
        if not self._is_behind:
            self.writer.write(data)

    @property
    def _is_behind(self) -> bool:
        return self.writer.get_write_buffer_size() > _MOST_UNREAD


class DirectPort(Listener):
    """Listens for requests: an asynchronous context manager that returns the port.

    Args:
        handle: Takes each message; it must not raise.
        host: As of `Listener`.
        port: Likewise.
        most: Likewise.
        longest: Bytes of a message.
        metrics: As of `Listener`.

    Attributes:
        handle: As given.
        longest: As given.
    """

    def __init__(
        self,
        handle: Receive,
        host: str,
        port: int,
        most: int,
        longest: int,
        metrics: Metrics,
    ) -> None:
        super().__init__(
            self._make_client, "requests", host, port, most, metrics, evicts=True
        )
        self.handle = handle
        self.longest = longest
        self._numbers = itertools.count(1)
        self._left = _BATCH
        # Those that have more messages, in the order of their turns.
        self._waiting: deque[DirectClient] = deque()
        self._is_counting = False
        self._failed = Throttle()

    async def __aenter__(self) -> int:
        port = await super().__aenter__()
        self._loop = asyncio.get_running_loop()
        self._watching = asyncio.create_task(self._watch())
        return port

    async def __aexit__(self, *_: object) -> None:
        await super().__aexit__()
        self._watching.cancel()
        await asyncio.gather(self._watching, return_exceptions=True)

    def new_identity(self) -> bytes:
        """Return what a client is known by."""
        return str(next(self._numbers)).encode()

    def serve(self, client: DirectClient) -> None:
        """Handle what has arrived from a client, as far as this turn of the event loop goes."""
        if not self._is_counting:
            self._is_counting = True
            self._loop.call_soon(self._go_on)
        while self._left > 0:
            if not client.handle_next():
                return
            self._left -= 1
        client.writer.pause_reading()
        self._waiting.append(client)

    def note_dropped(self) -> None:
        """Count an answer that its client loses."""
        self._metrics.counts["dropped"] += 1

    def note_failed_handshake(self) -> None:
        """Count and log a connection that ended before its handshake was over."""
        self._metrics.refusals["handshake"] += 1
        self._failed.report(INFO, "handshake", reason=NO_HANDSHAKE)

    def _make_client(self) -> DirectClient:
        return DirectClient(self)

    def _go_on(self) -> None:
        """Begin a turn: those that wait are first, one message each."""
        self._left = _BATCH
        self._is_counting = bool(self._waiting)
        if self._waiting:
            self._loop.call_soon(self._go_on)
        while self._left > 0 and self._waiting:
            client = self._waiting.popleft()
            if client.handle_next():
                self._left -= 1
                self._waiting.append(client)
            else:
                client.writer.resume_reading()

    async def _watch(self) -> None:
        """Look after silent clients until cancelled."""
        while True:
            await asyncio.sleep(1.0)
            now = time.monotonic()
            for client in [*self.clients]:
                if isinstance(client, DirectClient):
                    client.check(now)
