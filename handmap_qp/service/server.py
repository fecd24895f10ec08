"""`Server`: the mapping service on its sockets. ZeroMQ here.

WebSocket and HTTP are started from here.

    ROUTER  requests, each answered; and samples, not answered, of which the newest counts
    PUB     the stream: commands of every session under its name; a reader needs a SUB socket for
    each of its sessions

Off loopback, both speak CURVE and take only the clients whose public keys lie in the keys' folder.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from logging import ERROR, INFO, WARNING
from pathlib import Path
from typing import Any

import zmq
import zmq.asyncio
from zmq.auth.asyncio import AsyncioAuthenticator

from handmap_qp.addresses import check_port, is_loopback
from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.service.caps import Caps
from handmap_qp.service.dispatch import Dispatcher
from handmap_qp.service.hand_cache import HandCache
from handmap_qp.service.handshakes import report_handshakes
from handmap_qp.service.keys import ClientKeys, ServerKeys, read_server_keys
from handmap_qp.service.logs import Throttle, report
from handmap_qp.service.messages import TOPIC_END
from handmap_qp.service.metrics import Metrics, serve_metrics
from handmap_qp.service.store import PostureStore
from handmap_qp.service.websocket import WebSettings, WebSocketTransport

TICK = 0.005
"""Time between looks at the watchdogs [s]."""
_BATCH = 64
"""Messages taken before others get their turn."""
_MOST_WAITING = 200
"""Messages kept of a client that sends too fast, which then has to wait."""
_MOST_UNREAD = 500
"""Replies kept for a client that reads too slowly, which loses the others."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Where a server listens and what it takes.

    Attributes:
        host: Address to listen on; off loopback only with `keys`.
        port: Port of requests and samples; 0 lets the system choose, here and below.
        stream_port: Port of the stream.
        health_port: Port of `/metrics` and `/health`, always on loopback; None for neither.
        keys: Folder that `handmap keys` made; CURVE is spoken if given.
        web: The WebSocket door; None for none.
        state: File that keeps the postures last commanded; None for none.
        hands: Further robot hands: paths of `hand.yaml` files.
        caps: What clients are allowed.
    """

    host: str = "127.0.0.1"
    port: int = 5570
    stream_port: int = 5571
    health_port: int | None = 5573
    keys: Path | None = None
    web: WebSettings | None = None
    state: Path | None = None
    hands: tuple[Path, ...] = ()
    caps: Caps = field(default_factory=Caps)

    def __post_init__(self) -> None:
        """Refuse to be reached from elsewhere without keys.

        Raises:
            InvalidInputError: If there is no such port.
            InvalidOptionsError: Saying what is missing.
        """
        check_port("port", self.port)
        check_port("stream port", self.stream_port)
        if self.health_port is not None:
            check_port("health port", self.health_port)
        if not is_loopback(self.host) and self.keys is None:
            raise InvalidOptionsError(
                f"host {self.host}: others could move the robot; off loopback, give keys (handmap keys FOLDER makes them)"
            )


class Server:
    """The service.

    Args:
        settings: Where it listens and what it takes.

    Attributes:
        dispatcher: What answers messages.
        metrics: What it counts.
        ports: The ports in use by name, once started.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.metrics = Metrics()
        self.ports: dict[str, int] = {}
        self._closing = contextlib.AsyncExitStack()
        cache = HandCache(settings.hands)
        # Last of what may fail: from here on the file is taken.
        store = (
            None
            if settings.state is None
            else self._closing.enter_context(PostureStore(settings.state))
        )
        self.dispatcher = Dispatcher(settings.caps, cache, self.metrics, store=store)
        self._keys: ServerKeys | None = None
        self._tasks: list[asyncio.Task[None]] = []
        self._bugs = Throttle()
        self._is_draining = False
        self._lag = self._worst_lag = 0.0
        self.metrics.gauges["lag_seconds"] = lambda: max(self._lag, self._worst_lag)

    async def start(self) -> None:
        """Open all doors.

        Raises:
            InvalidInputError: If an address or file cannot be used.
        """
        settings, context = self.settings, zmq.asyncio.Context()
        self._closing.callback(context.term)
        if settings.keys is not None:
            self._keys = read_server_keys(settings.keys)
            self._authenticate(context, settings.keys / "clients")
        # Plain sockets, read as soon as their descriptor stirs: a future for each message would
        # cost as much as a third of a step.
        plain = zmq.Context.shadow(context.underlying)
        self._router, self._stream = self._socket(plain, zmq.ROUTER), self._socket(plain, zmq.PUB)
        self.ports["requests"] = _bind(self._router, settings.host, settings.port)
        self.ports["stream"] = self.dispatcher.stream_port = _bind(
            self._stream, settings.host, settings.stream_port
        )
        self.dispatcher.sessions.publish.append(self._publish)
        self._closing.push_async_callback(self.dispatcher.close)
        if settings.web is not None:
            door = WebSocketTransport(settings.web, self.dispatcher, settings.caps)
            self.ports["web"] = await self._closing.enter_async_context(door)
        if settings.health_port is not None:
            try:
                health = await serve_metrics(
                    "127.0.0.1", settings.health_port, self.metrics, self.health
                )
            except OSError as error:
                raise InvalidInputError(
                    f"health port {settings.health_port}: {error.strerror}"
                ) from error
            self._closing.callback(health.close)
            self.ports["health"] = health.sockets[0].getsockname()[1]
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._router.FD, self._drain)
        self._closing.callback(self._loop.remove_reader, self._router.FD)
        watches = [
            report_handshakes(context, socket, self.metrics)
            for socket in (self._router, self._stream)
        ]
        self._tasks = [asyncio.create_task(work) for work in (self._tick(), *watches)]
        report(INFO, "ready", host=settings.host, ports=self.ports, curve=settings.keys is not None)

    async def stop(self) -> None:
        """Close all sessions and doors."""
        was_ready = bool(self._tasks)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._closing.aclose()
        if was_ready:
            report(INFO, "stopped")

    def health(self) -> dict[str, Any]:
        """What the health check says."""
        is_alive = bool(self._tasks) and not any(task.done() for task in self._tasks)
        return {
            "status": "ok" if is_alive else "stopped",
            "sessions": len(self.dispatcher.sessions.entries),
            "lag_seconds": max(self._lag, self._worst_lag),
        }

    def _socket(self, context: zmq.Context, kind: int) -> zmq.Socket:
        socket = context.socket(kind)
        # What is on its way when the server ends gets a moment to leave.
        self._closing.callback(socket.close, 100)
        socket.setsockopt(zmq.MAXMSGSIZE, self.settings.caps.message_size)
        socket.setsockopt(zmq.HANDSHAKE_IVL, 5000)
        socket.setsockopt(zmq.HEARTBEAT_IVL, 2000)
        socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 6000)
        socket.setsockopt(zmq.RCVHWM, _MOST_WAITING)
        socket.setsockopt(zmq.SNDHWM, _MOST_UNREAD)
        socket.setsockopt(zmq.IPV6, ":" in self.settings.host)
        # ROUTER tells of replies that it cannot queue, so that they can be counted; PUB keeps the
        # newest for each reader's socket, whatever its topic.
        socket.setsockopt(zmq.CONFLATE if kind == zmq.PUB else zmq.ROUTER_MANDATORY, 1)
        if (keys := self._keys) is not None:
            socket.curve_publickey, socket.curve_secretkey, socket.curve_server = (
                keys.public,
                keys.secret,
                True,
            )
        return socket

    def _authenticate(self, context: zmq.asyncio.Context, folder: Path) -> None:
        """Let in only clients whose public keys lie in the folder when they knock."""
        clients = ClientKeys(folder)
        if not clients.read():
            raise InvalidInputError(
                f"{folder}: holds no client's key (*.key), so that nobody could come in"
            )
        authenticator = AsyncioAuthenticator(context)
        authenticator.start()
        self._closing.callback(authenticator.stop)
        authenticator.configure_curve_callback("*", credentials_provider=clients)

    def _drain(self) -> None:
        """Take what has come, up to a batch.

        Then samples that wait are mapped, and others get their turn.
        """
        if self._router.closed:
            return
        self._is_draining = True
        try:
            for _ in range(_BATCH):
                self._receive(self._router.recv_multipart(zmq.NOBLOCK))
            self._loop.call_soon(self._drain)
        except zmq.Again:
            pass
        finally:
            self._is_draining = False

    def _receive(self, frames: Sequence[bytes]) -> None:
        """One message: a DEALER's payload, or a REQ's after an empty frame."""
        *envelope, payload = frames
        if len(envelope) > 2 or (len(envelope) == 2 and envelope[1]):
            self.metrics.refusals["frames"] += 1
            return
        try:
            self.dispatcher.receive(payload, envelope[0], partial(self._reply, envelope))
        except Exception as error:
            self._bugs.report(ERROR, "failed", error=repr(error), failure=error)

    def _reply(self, envelope: list[bytes], payload: bytes) -> None:
        try:
            self._router.send_multipart([*envelope, payload], zmq.NOBLOCK)
        except zmq.ZMQError:
            self.metrics.counts["dropped"] += 1
        if not self._is_draining:
            # ZeroMQ's descriptor stirs once, and sending may have taken that for itself.
            self._loop.call_soon(self._drain)

    def _publish(self, name: str, payload: bytes) -> None:
        with contextlib.suppress(zmq.Again):
            self._stream.send(name.encode() + TOPIC_END + payload, zmq.NOBLOCK)

    async def _tick(self) -> None:
        """The watchdogs' clock; also measures how late the event loop is."""
        second = time.monotonic()
        while True:
            wanted = time.monotonic() + TICK
            await asyncio.sleep(TICK)
            now = time.monotonic()
            self._worst_lag = max(self._worst_lag, now - wanted)
            if now - second > 1.0:
                if self._worst_lag > 0.1:
                    report(WARNING, "late", seconds=round(self._worst_lag, 4))
                second, self._lag, self._worst_lag = now, self._worst_lag, 0.0
            try:
                self._drain()
                self.dispatcher.tick()
            except Exception as error:
                self._bugs.report(ERROR, "failed", error=repr(error), failure=error)


def _bind(socket: zmq.Socket, host: str, port: int) -> int:
    """Listen; the port in use."""
    host = "127.0.0.1" if host == "localhost" else host
    address = f"tcp://[{host}]" if ":" in host else f"tcp://{host}"
    try:
        socket.bind(f"{address}:{port or '*'}")
    except zmq.ZMQError as error:
        # ZeroMQ looks up no names where it listens.
        is_unknown = error.errno == errno.ENODEV
        reason = (
            "expected an IP address of this machine, or a network interface"
            if is_unknown
            else error.strerror
        )
        raise InvalidInputError(f"{address}:{port}: {reason}") from error
    return int(socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
