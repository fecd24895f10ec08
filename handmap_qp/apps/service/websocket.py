"""WebSocket transport of the same messages, for browsers and headsets.

Binary frames are msgpack, text frames JSON.

A page of any web site could reach a socket on loopback from the user's browser. So a page must come
from loopback or from a named origin, unless the server requires a token. Off loopback, a token and
TLS are required.
"""

import asyncio
import contextlib
import hmac
import http
import re
import ssl
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from logging import ERROR
from pathlib import Path
from time import monotonic
from typing import Any

import msgspec
from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CTRL_OPCODES, DATA_OPCODES, Frame, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import Event
from websockets.typing import Subprotocol

from handmap_core.errors import InvalidInputError
from handmap_qp.apps.refusals import naming
from .dispatch import NO_VALUE, Backend
from .fairness import crowded_accounts
from .haptics import session_of
from .logs import report, websocket_log
from .pages import page_response
from .safety import Bucket
from .sessions import WEB, Caller
from .settings import MOST_SESSIONS, Settings

SUBPROTOCOL = Subprotocol("handmap.v1")
"""Subprotocol that a browser offers besides `bearer.TOKEN`, because it cannot set headers."""
_LOOPBACK_ORIGIN = re.compile(r"https?://(localhost|127(\.\d{1,3}){3}|\[::1\])(:\d+)?")
_SEND_TIMEOUT = 5.0
_CLOSE_TIMEOUT = 1.0
_PENALTY = 0.02
_CONNECTIONS_PER_SESSION = 2
_MOST_FRAGMENTS = 64
_CONTROLS_PER_SECOND = 5.0
_CONTROLS = 50.0
"""Control frames of a connection, and how many at once; the server's own ping asks for one."""
_AT_ONCE = 2048
"""Bytes read from a connection in one turn of the event loop."""
_ACTIVE = 1.0
"""Time after a message in which a connection keeps its place before silent ones [s]."""


@dataclass(eq=False)
class WebSocketTransport:
    """The listening WebSocket: an asynchronous context manager that returns the port in use.

    Attributes:
        settings: Address and access rules.
        token: Token that clients must present; None for none.
        backend: Answers messages.
    """

    settings: Settings
    token: str | None
    backend: Backend

    async def __aenter__(self) -> int:
        self._connections = set[_Connection]()
        settings = self.settings
        tls = None
        if settings.web_certificate and settings.web_key:
            tls = _read_tls(settings.web_certificate, settings.web_key)
        with naming(f"web {settings.web_host}:{settings.web_port}"):
            self._server = await serve(
                self._handle,
                settings.web_host,
                settings.web_port,
                ssl=tls,
                process_request=self._check,
                # A client need not offer it.
                select_subprotocol=lambda _, offered: (
                    SUBPROTOCOL if SUBPROTOCOL in offered else None
                ),
                create_connection=_Connection,
                logger=websocket_log,
                compression=None,
                max_size=settings.message_size,
                max_queue=16,
                open_timeout=5.0,
                close_timeout=0.5 * _CLOSE_TIMEOUT,
            )
        self.backend.publish.append(self._publish)
        return next(iter(self._server.sockets)).getsockname()[1]

    async def __aexit__(self, *_: object) -> None:
        self.backend.publish.remove(self._publish)
        self._server.close()
        # Handshakes under way would hold it up for their own timeout.
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._server.wait_closed(), _CLOSE_TIMEOUT)

    def _check(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return None to accept a handshake, else what rejects it, or the page for headsets."""
        if page := page_response(request):
            return page
        headers = request.headers
        if self.token:
            # As a header, or among its subprotocols.
            offered = ",".join(headers.get_all("Sec-WebSocket-Protocol")).split(",")
            offered += headers.get_all("Authorization")
            given = [
                each.strip().removeprefix("bearer.").removeprefix("Bearer ")
                for each in offered
            ]
            token = self.token.encode()
            is_admitted = any(
                hmac.compare_digest(v.encode(errors="replace"), token) for v in given
            )
            refusal = http.HTTPStatus.UNAUTHORIZED, "token missing or wrong\n"
        else:
            is_admitted = all(
                _LOOPBACK_ORIGIN.fullmatch(origin) or origin in self.settings.web_origin
                for origin in headers.get_all("Origin")
            )
            refusal = (
                http.HTTPStatus.FORBIDDEN,
                "pages of this origin may not connect\n",
            )
        return None if is_admitted else connection.respond(*refusal)

    async def _handle(self, connection: Any) -> None:
        """Serve one connection, and release it however it ends."""
        if len(self._connections) >= _CONNECTIONS_PER_SESSION * self.settings.sessions:
            # The new client may come to stop a robot. The address that has most connections gives
            # one up, so that nobody shuts out other addresses.
            crowded = crowded_accounts(
                map(_address_of, self._connections), _address_of(connection)
            )
            rivals = (e for e in self._connections if _address_of(e) in crowded)
            least = min(rivals, key=_Connection.use)
            least.transport.abort()
            self._connections.discard(least)
        self._connections.add(connection)
        try:
            await self._read(connection)
        except Exception as failure:
            report(ERROR, "failed", failure=failure)
        finally:
            # What still arrives while it closes is no message.
            connection.receive = None
            self._connections.discard(connection)

    async def _read(self, connection: "_Connection") -> None:
        """Serve a connection until it closes or is silent for too long.

        It passes on nearly all messages itself; those that must wait are passed on here.
        """
        by = Caller(_address_of(connection))
        connection.receive = receive = partial(self._receive, connection, by)
        with contextlib.suppress(ConnectionClosed):
            while True:
                # A connection that reads a stream may be silent.
                idle = self.settings.idle - (monotonic() - connection.heard)
                try:
                    async with asyncio.timeout(None if connection.streams else idle):
                        message = await connection.recv()
                except TimeoutError:
                    if connection.streams or connection.is_heard(self.settings.idle):
                        continue
                    return
                # Slow clients over the rate limit.
                await asyncio.sleep(connection.slowed_until - monotonic())
                connection.waiting -= 1
                receive(message)
                # Stop reading from clients that do not read.
                await connection.drain()

    def _receive(
        self, connection: "_Connection", by: Caller, message: str | bytes
    ) -> None:
        """Handle one message."""
        connection.heard = monotonic()
        form: _Form = bytes
        if isinstance(message, str):
            form = _as_json
            message = _from_json(message)
        is_taken = self.backend.receive(
            message,
            ("web", connection.id),
            partial(connection.answer, form),
            subscribe=partial(self._subscribe, connection, form),
            by=by,
        )
        if not is_taken:
            connection.slowed_until = connection.heard + _PENALTY

    def _subscribe(self, connection: "_Connection", form: "_Form", name: str) -> None:
        if len(connection.streams) >= MOST_SESSIONS:
            # Forget ended sessions: they could return under their names, but there is no end.
            names = {*self.backend.names}
            for stream in tuple(connection.streams):
                if session_of(stream) not in names:
                    del connection.streams[stream]
        connection.streams[name] = form

    def _publish(self, name: str, payload: bytes) -> None:
        for connection in self._connections:
            connection.offer(name, payload)


_Form = Callable[[bytes], bytes | str]
"""Turns a message into the form of a client's frames: msgpack or JSON."""


class _Connection(ServerConnection, asyncio.BufferedProtocol):
    """A connection, which sends answers at once, and the newest of each stream when it can.

    It reads little in a turn, and bounds empty fragments and control frames: the library does not.
    It ends if its client accepts nothing for too long.

    It passes on a message as soon as it is read: a task that waits for it would run in a later turn
    of the event loop. Only a message in fragments, and those of a client that does not read or is
    over the rate limit, wait in the library's queue for such a task.
    """

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # Handles a message; None before the connection is admitted.
        self.receive: Callable[[str | bytes], None] | None = None
        # Messages in the library's queue, and the time until which all must wait there [s].
        self.waiting = 0
        self.slowed_until = 0.0
        self.streams: dict[str, _Form] = {}
        self._newest: dict[str, bytes | str] = {}
        # Time of its last message, at first of its beginning [s].
        self.heard = self._begun = monotonic()
        self._fragments = 0
        self._controls = Bucket(_CONTROLS_PER_SECOND, _CONTROLS)
        super().connection_made(transport)

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return where to put what is read; a view, of which asyncio takes parts over TLS."""
        self._buffer = memoryview(bytearray(_AT_ONCE))
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        """Pass on what was read."""
        self.data_received(bytes(self._buffer[:nbytes]))

    def process_event(self, event: Event) -> None:
        is_control = isinstance(event, Frame) and event.opcode in CTRL_OPCODES
        if isinstance(event, Frame) and not is_control:
            self._fragments = 0 if event.fin else self._fragments + 1
        if self._fragments >= _MOST_FRAGMENTS or (
            is_control and not self._controls.take()
        ):
            self.transport.abort()
        elif not self._handle_at_once(event):
            super().process_event(event)

    def _handle_at_once(self, event: Event) -> bool:
        """Handle a frame that is a message; return False for what the library must look at."""
        if not isinstance(event, Frame) or event.opcode not in DATA_OPCODES:
            return False
        is_whole = event.fin and event.opcode is not Opcode.CONT
        is_next = not (self.waiting or self.paused or monotonic() < self.slowed_until)
        if self.receive is None or not (is_whole and is_next):
            self.waiting += event.fin
            return False
        message: str | bytes = bytes(event.data)
        if event.opcode is Opcode.TEXT:
            try:
                message = bytes(event.data).decode()
            except UnicodeDecodeError:
                # The library ends the connection, and says why.
                self.waiting += 1
                return False
        try:
            self.receive(message)
        except Exception as failure:
            report(ERROR, "failed", failure=failure)
            self.transport.abort()
        return True

    def is_heard(self, time: float) -> bool:
        """Return whether there was a message in the last so many seconds."""
        return monotonic() - self.heard < time

    def use(self) -> tuple[bool, bool, float]:
        """Return the rank of the connection: active ones are highest, then readers of streams."""
        is_active = self.heard > self._begun and self.is_heard(_ACTIVE)
        return is_active, bool(self.streams), self.heard

    def answer(self, form: _Form, payload: bytes) -> None:
        # At once: a task that sends would take a turn of the event loop.
        broadcast((self,), form(payload))

    def offer(self, name: str, payload: bytes) -> None:
        if name in self.streams:
            self._newest[name] = self.streams[name](payload)
            self._send_newest()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._ending = self.loop.call_later(_SEND_TIMEOUT, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._ending.cancel()
        self._send_newest()

    def _send_newest(self) -> None:
        while self._newest and not self.paused:
            broadcast((self,), self._newest.pop(next(iter(self._newest))))


def _address_of(connection: ServerConnection) -> str:
    """Return the address of a client over WebSocket, as `Caller` has it."""
    # The peer may have gone already.
    address = connection.remote_address
    return f"{WEB}@{address[0]}" if address else WEB


def _read_tls(certificate: Path, key: Path) -> ssl.SSLContext:
    """Read the certificate and its key, which must be such."""
    for file in (certificate, key):
        with naming(file, "cannot be read"):
            file.read_bytes()
    tls = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        # An empty passphrase: otherwise OpenSSL would prompt for one.
        tls.load_cert_chain(certificate, key, password="")
    except ssl.SSLError as error:
        raise InvalidInputError(
            "expected a PEM certificate and its key, without passphrase",
            argument=f"{certificate}, {key}",
            advice=(error.reason or "").replace("_", " ").lower(),
        ) from error
    return tls


def _from_json(message: str) -> bytes:
    """Return a message as msgpack; what is not JSON becomes the reason, behind `NO_VALUE`."""
    try:
        return msgspec.msgpack.encode(msgspec.json.decode(message))
    except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError) as error:
        return NO_VALUE + str(error).encode()


def _as_json(payload: bytes) -> str:
    return msgspec.json.encode(msgspec.msgpack.decode(payload)).decode()
