"""`Server`: the mapping service on its ZeroMQ sockets.

    ROUTER  requests, each answered; samples, not answered, of which the newest counts
    PUB     the stream: commands of every session under its name

A reader needs one SUB socket for each session, because PUB keeps the newest message only. Off
loopback, both sockets use CURVE and admit only the clients whose public keys are in the folder of
keys. libzmq then reads the requests (`connection_gate`); without keys the server does (`direct`).
The server also starts WebSocket and HTTP.
"""

import asyncio
import contextlib
import json
import resource
import signal
from collections.abc import Callable, Sequence
from functools import partial
from logging import ERROR, INFO

import zmq
import zmq.asyncio
from zmq.auth.asyncio import AsyncioAuthenticator
from zmq.utils.monitor import recv_monitor_message

from handmap_core.client.messages import TOPIC_END
from handmap_core.errors import InvalidOptionsError, expect
from handmap_qp.apps.refusals import naming
from handmap_qp.hands import Values
from .connection_gate import ConnectionGate, cost_of
from .direct import NO_HANDSHAKE, DirectClient, DirectPort
from .dispatch import Dispatcher
from .keys import ClientKeys, read_server_keys, read_token
from .listening import Listener
from .load import TimedSelector
from .logs import AuditLog, Metrics, Throttle, logs_on_stderr, report
from .opening import HandCache
from .pages import serve_metrics
from .pool import WorkerPool
from .process import import_early, keep_objects, run_timed
from .sessions import Caller, Sessions
from .settings import Settings
from .store import PostureStore
from .watchdogs import Watchdogs
from .websocket import WebSocketTransport
from .work import in_next_turn

_BATCH = 128
"""Parts of messages read before other tasks get their turn; a message has two or three."""
_MOST_PARTS = 3
_MOST_WAITING = 200
"""High-water mark of received messages, above which a client has to wait."""
_CONNECTIONS_PER_SESSION = 4
_TOPICS = 12288.0
"""Length of the topics of a reader of the stream: some hundred subscriptions [bytes]."""
_ENVELOPE = 4096.0
"""What the largest message and its handshake take beside the message [bytes]."""
_MOST_UNREAD = 500
"""High-water mark of replies, above which a slow client loses the others."""
_FAILURES = (
    zmq.Event.HANDSHAKE_FAILED_NO_DETAIL,
    zmq.Event.HANDSHAKE_FAILED_PROTOCOL,
    zmq.Event.HANDSHAKE_FAILED_AUTH,
)
# Why a handshake failed, as far as libzmq reports it, by event or value.
_REASONS = {
    zmq.Event.HANDSHAKE_FAILED_AUTH: "the client's key is not among the keys in clients/",
    zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC: "the client's server.key is another server's",
}
# Idle connections must not use up the descriptors that clients need.
_MOST_FILES = 65536


class Server:
    """The service.

    Args:
        settings: Addresses, limits and files.

    Raises:
        InvalidInputError: If a file cannot be used, or a setting.
        InvalidOptionsError: With the setting at fault.

    Attributes:
        backend: Answers messages.
        metrics: Counters.
        ports: The ports in use by name, once started.
        requests: The port of requests, once started.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings = settings.checked()
        keys = settings.keys
        files = (keys / "clients").glob("*.key") if keys else ()
        for name in set(settings.supervisor).difference(file.stem for file in files):
            raise InvalidOptionsError(
                option="supervisor", expected="the name of a client in keys", value=name
            )
        self.metrics = Metrics()
        self.ports: dict[str, int] = {}
        self._closing = contextlib.AsyncExitStack()
        cache = HandCache(settings.hand)
        file = settings.web_token_file
        self._token = read_token(file) if file else None
        self._audit = AuditLog(settings.audit)
        self._closing.callback(self._audit.close)
        # Acquire the file lock last, after everything that can fail.
        store = self._closing.enter_context(PostureStore(settings.state))
        self.backend: Dispatcher | WorkerPool
        if settings.workers:
            self.backend = WorkerPool(settings, store, self.metrics, self._audit)
        else:
            sessions = Sessions(settings, cache, self.metrics, store, self._audit)
            self.backend = Dispatcher(sessions)
        self._clients = None
        self._keys = None
        self._tasks = []
        self._bugs = Throttle()
        # The encrypted port; None without keys.
        self._router: zmq.Socket | None = None
        self._gate: ConnectionGate | None = None
        self._is_draining = False
        self._parts: list[zmq.Frame] = []
        self._cost = 0
        self._watchdogs = Watchdogs(self._tick)
        self.metrics.gauges["lag_seconds"] = lambda: self.lag
        self.metrics.gauges["busy_seconds"] = lambda: self.busy

    @property
    def dispatcher(self) -> Dispatcher:
        """What answers messages in this process.

        Raises:
            InvalidOptionsError: If workers answer them.
        """
        if isinstance(self.backend, Dispatcher):
            return self.backend
        raise InvalidOptionsError(
            option="workers", expected="0", value=self.settings.workers
        )

    @property
    def lag(self) -> float:
        """Longest delay of an event loop, of this process or a worker [s]."""
        is_alone = isinstance(self.backend, Dispatcher)
        return max(self._watchdogs.lag, 0.0 if is_alone else self.backend.lag)

    @property
    def busy(self) -> float:
        """Longest CPU time between two turns of an event loop, of any of them [s]."""
        is_alone = isinstance(self.backend, Dispatcher)
        return max(self._watchdogs.busy, 0.0 if is_alone else self.backend.busy)

    async def start(self) -> None:
        """Listen on all transports.

        Raises:
            InvalidInputError: If an address or file cannot be used.
        """
        settings = self.settings
        context = zmq.asyncio.Context()
        self._closing.callback(context.term)
        if settings.keys:
            self._keys = read_server_keys(settings.keys)
            # Admit only clients whose public keys are in the folder at their handshake.
            folder = settings.keys / "clients"
            self._clients = ClientKeys(folder)
            expect(
                self._clients.read(),
                str(folder),
                "a client's key (*.key)",
                got="none",
                advice="handmap keys FOLDER --client NAME makes one",
            )
            authenticator = AsyncioAuthenticator(context)
            authenticator.start()
            self._closing.callback(authenticator.stop)
            authenticator.configure_curve_callback(
                "*", credentials_provider=self._clients
            )
        # Plain sockets polled by FD: a Future per message costs a third of a step.
        plain = zmq.Context.shadow(context.underlying)
        self._stream = self._socket(plain, zmq.PUB)
        host = "127.0.0.1" if settings.host == "localhost" else settings.host
        most = _CONNECTIONS_PER_SESSION * settings.sessions
        self.requests = self._request_port(plain, host, most)
        gate = "stream", host, settings.stream_port, most, _TOPICS, self.metrics
        stream = ConnectionGate(self._stream, *gate)
        self._readers = stream.clients
        self.ports["requests"] = await self._closing.enter_async_context(self.requests)
        port = await self._closing.enter_async_context(stream)
        self.ports["stream"] = self.backend.stream_port = port
        self.backend.publish.append(self._publish)
        self._closing.push_async_callback(self.backend.close)
        if isinstance(self.backend, WorkerPool):
            await self.backend.start()
        else:
            self.backend.schedule = in_next_turn
        if settings.web:
            transport = WebSocketTransport(settings, self._token, self.backend)
            self.ports["web"] = await self._closing.enter_async_context(transport)
        if settings.health_port >= 0:
            with naming("health_port", str(settings.health_port)):
                health = await serve_metrics(
                    settings.health_port, self.metrics, self.health
                )
            self._closing.callback(health.close)
            self.ports["health"] = next(iter(health.sockets)).getsockname()[1]
        self._loop = asyncio.get_running_loop()
        if self._router is not None:
            self._loop.add_reader(self._router.FD, self._drain)
            self._closing.callback(self._loop.remove_reader, self._router.FD)
        watches = [
            _report_handshakes(context, socket, self.metrics)
            for socket in (self._router, self._stream)
            if socket is not None
        ]
        self._tasks = [
            asyncio.create_task(work) for work in (self._watchdogs.run(), *watches)
        ]
        self._audit.note("started", "server", ports=self.ports)
        report(
            INFO,
            "ready",
            host=settings.host,
            ports=self.ports,
            curve=settings.keys is not None,
        )

    async def stop(self) -> None:
        """Close all sessions and transports."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._closing.aclose()
        if self._tasks:
            report(INFO, "stopped")

    def health(self) -> Values:
        """Return the result of the health check."""
        is_alive = self._tasks and not any(task.done() for task in self._tasks)
        if isinstance(self.backend, WorkerPool):
            is_alive = is_alive and self.backend.is_alive
        return {
            "status": "ok" if is_alive else "stopped",
            "sessions": len(self.backend.names),
            "lag_seconds": self.lag,
        }

    def _socket(self, context: zmq.Context, kind: int) -> zmq.Socket:
        socket = context.socket(kind)
        # Linger [ms]: send queued messages when the server stops.
        self._closing.callback(socket.close, 100)
        socket.maxmsgsize = self.settings.message_size
        # Times are in milliseconds.
        socket.handshake_ivl = 5000
        socket.heartbeat_ivl = 2000
        socket.heartbeat_timeout = 6000
        socket.rcvhwm = _MOST_WAITING
        socket.sndhwm = _MOST_UNREAD
        # ROUTER reports replies that it cannot queue, so that they are counted. PUB keeps the
        # newest message per reader, whatever its topic.
        socket.setsockopt(zmq.CONFLATE if kind == zmq.PUB else zmq.ROUTER_MANDATORY, 1)
        if keys := self._keys:
            socket.curve_publickey, socket.curve_secretkey = keys
            socket.curve_server = True
        return socket

    def _request_port(self, context: zmq.Context, host: str, most: int) -> Listener:
        """Return the port of requests, which libzmq reads if it is encrypted.

        Args:
            context: Context of libzmq.
            host: Address to listen on.
            most: Connections at once.
        """
        settings = self.settings
        if not settings.keys:
            where = host, settings.port, most, settings.message_size, self.metrics
            return DirectPort(self._handle, *where)
        self._router = self._socket(context, zmq.ROUTER)
        credit = settings.message_size + _ENVELOPE
        gate = "requests", host, settings.port, most, credit, self.metrics
        self._gate = ConnectionGate(self._router, *gate, evicts=True)
        return self._gate

    def _handle(
        self, client: DirectClient, payload: bytes, answer: Callable[[bytes], None]
    ) -> None:
        """Handle one message of a client without a key."""
        try:
            self.backend.receive(payload, client.identity, answer, by=client.caller)
        except Exception as error:
            self._bugs.report(ERROR, "failed", failure=error)

    def _drain(self) -> None:
        """Read up to a batch of waiting parts; then a sample is mapped, and other tasks run."""
        router = self._router
        if router is None or router.closed:
            return
        self._is_draining = True
        try:
            for _ in range(_BATCH):
                # An exception where nothing waits takes several times as long as the question.
                if not (self._parts or _has_message(router)):
                    return
                frame = router.recv(zmq.NOBLOCK, copy=False)
                self._cost += cost_of(frame)
                # Keep one part too many of a message that has too many.
                if len(self._parts) <= _MOST_PARTS:
                    self._parts.append(frame)
                if not frame.more:
                    self._receive(self._parts, self._cost)
                    self._parts = []
                    self._cost = 0
            self._loop.call_soon(self._drain)
        except zmq.Again:
            pass
        finally:
            self._is_draining = False

    def _receive(self, parts: Sequence[zmq.Frame], cost: int) -> None:
        """Handle one message: the payload of a DEALER, or that of a REQ after an empty frame."""
        client = self._gate.find(parts) if self._gate else None
        *envelope, payload = (part.bytes for part in parts)
        if len(parts) > _MOST_PARTS or any(envelope[1:]):
            if client:
                client.end("a message has too many parts")
            return
        address = client.refund(cost) if client else ""
        keys = self._clients
        try:
            key = keys.name_of(str(parts[-1].get("User-Id"))) if keys else ""
            by = Caller(address, key)
            self.backend.receive(
                payload, envelope[0], partial(self._reply, envelope), by=by
            )
        except Exception as error:
            self._bugs.report(ERROR, "failed", failure=error)

    def _reply(self, envelope: list[bytes], payload: bytes) -> None:
        router = self._router
        assert router is not None
        try:
            router.send_multipart([*envelope, payload], zmq.NOBLOCK)
        except zmq.ZMQError:
            self.metrics.counts["dropped"] += 1
        # ZeroMQ's descriptor is edge-triggered, and sending may have consumed the edge.
        if not self._is_draining and not router.closed and _has_message(router):
            self._loop.call_soon(self._drain)

    def _publish(self, name: str, payload: bytes) -> None:
        # A call of a socket that is seldom used takes 40 us.
        if self._readers:
            with contextlib.suppress(zmq.Again):
                self._stream.send(name.encode() + TOPIC_END + payload, zmq.NOBLOCK)

    def _tick(self) -> float:
        """Read what a lost edge has left unread, and run the watchdogs."""
        self._drain()
        return self.backend.tick()


def _has_message(socket: zmq.Socket) -> bool:
    """Return whether a message waits in a socket."""
    return bool(int(socket.get(zmq.EVENTS)) & zmq.POLLIN)


async def _report_handshakes(
    context: zmq.asyncio.Context, socket: zmq.Socket, metrics: Metrics
) -> None:
    """Count and log failed handshakes until cancelled; libzmq reports them to a monitor only."""
    address = f"inproc://handshakes-{socket.FD}"
    failed = Throttle()
    with context.socket(zmq.PAIR) as events:
        # No high-water mark: libzmq's I/O thread, which serves all connections, would block.
        events.linger = events.rcvhwm = 0
        socket.monitor(address, sum(_FAILURES))
        try:
            events.connect(address)
            while True:
                event = await recv_monitor_message(events)
                metrics.refusals["handshake"] += 1
                known = _REASONS.get(event["event"]) or _REASONS.get(event["value"])
                failed.report(INFO, "handshake", reason=known or NO_HANDSHAKE)
        finally:
            socket.disable_monitor()


def run_server(settings: Settings, log_level: str = "info") -> None:
    """Serve until SIGINT or SIGTERM.

    Args:
        settings: Addresses, limits and files.
        log_level: Lowest level to log.

    Raises:
        InvalidInputError: If an address or file cannot be used.
    """
    _raise_file_limit()
    with logs_on_stderr(log_level):
        run_timed(partial(_serve, settings))


async def _serve(settings: Settings, selector: TimedSelector) -> None:
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    # Leases count from when the server is made.
    import_early()
    server = Server(settings)
    backend = server.backend
    backend.load.waited = lambda: selector.waited
    try:
        await server.start()
        keep_objects()
        settings = server.settings
        hosts = {"host": settings.host} | (
            {"web_host": settings.web_host} if settings.web else {}
        )
        ready: Values = {"ready": True, **hosts, "ports": server.ports}
        if isinstance(backend, WorkerPool):
            ready["workers"] = backend.pids
        print(json.dumps(ready), flush=True)
        await ended.wait()
    finally:
        await server.stop()


def _raise_file_limit() -> None:
    """Raise the limit of open files to the system's maximum, at most 65536."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    # RLIM_INFINITY is -1.
    wanted = min(hard, _MOST_FILES) if hard >= 0 else _MOST_FILES
    if 0 <= soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
