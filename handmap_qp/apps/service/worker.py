"""A worker process of `handmap serve --workers`: it maps the sessions that the server gives it.

    python -m handmap_qp.apps.service.worker FD

It has no sockets but its channel to the server, at the file descriptor FD. If the server is gone,
it ends.
"""

import asyncio
import os
import pickle
import signal
import socket
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from logging import ERROR

import msgspec

from handmap_qp.apps.service.channel import (
    Answered,
    Ask,
    Began,
    Channel,
    Ended,
    Finish,
    Learn,
    Noted,
    Published,
    Ready,
    Report,
    Start,
    ToWorker,
)
from handmap_qp.apps.service.dispatch import Dispatcher
from handmap_qp.apps.service.load import TimedSelector
from handmap_qp.apps.service.logs import (
    AuditLog,
    Metrics,
    Throttle,
    logs_on_stderr,
    resident_bytes,
)
from handmap_qp.apps.service.opening import HandCache
from handmap_qp.apps.service.process import import_early, keep_objects, run_timed
from handmap_qp.apps.service.session import Session
from handmap_qp.apps.service.sessions import Caller, Sessions
from handmap_qp.apps.service.settings import Settings
from handmap_qp.apps.service.store import PostureStore, Record
from handmap_qp.apps.service.watchdogs import Watchdogs
from handmap_qp.apps.service.work import in_next_turn

_REPORT = 0.25
"""Time between reports to the server [s]."""
_UNLIMITED = 1e9


class WorkerStore(PostureStore):
    """Records of a worker's sessions, which the server keeps.

    Args:
        tell: Sends a record to the server.
    """

    def __init__(self, tell: Callable[[Record], None]) -> None:
        super().__init__(None)
        # The server must know where a session is if the worker ends.
        self.is_persistent = True
        self._tell = tell

    def note(self, record: Record) -> None:
        """Keep a record, and send it to the server."""
        super().note(record)
        self._tell(record)

    def learn(self, name: str, record: Record | None) -> None:
        """Take over what the server has of a name."""
        if record is None:
            self._forget(name)
        else:
            self._keep(record, name)


class Worker:
    """Answers the requests that the server passes on.

    Args:
        start: What the server says first.
        send: Sends a message to the server.
    """

    def __init__(
        self, start: Start, send: Callable[..., None], selector: TimedSelector
    ) -> None:
        settings: Settings = pickle.loads(start.settings)
        self._send = send
        self._audit = AuditLog(settings.audit)
        self._store = WorkerStore(
            lambda record: send(Noted(msgspec.msgpack.encode(record)))
        )
        self._metrics = Metrics()
        # The server limits the rates of connections.
        self._sessions = Sessions(
            replace(settings, rate=_UNLIMITED),
            HandCache(settings.hand),
            self._metrics,
            self._store,
            self._audit,
        )
        self._sessions.load.waited = lambda: selector.waited
        self._sessions.publish.append(
            lambda name, payload: send(Published(name, payload))
        )
        self._sessions.listeners.append(self._tell_session)
        self._dispatcher = Dispatcher(self._sessions)
        self._dispatcher.stream_port = start.stream_port
        self._dispatcher.schedule = in_next_turn
        self._watchdogs = Watchdogs(self._dispatcher.tick)
        self._bugs = Throttle()
        self.finished = asyncio.Event()

    def receive(self, message: ToWorker) -> None:
        """Carry out a message of the server."""
        match message:
            case Ask():
                try:
                    self._dispatcher.receive(
                        message.payload,
                        message.peer,
                        partial(self._answer, message.token),
                        by=Caller(message.address, message.key),
                    )
                except Exception as error:
                    self._bugs.report(ERROR, "failed", failure=error)
            case Learn():
                record = message.record
                self._store.learn(
                    message.name,
                    msgspec.msgpack.decode(record, type=Record) if record else None,
                )
                if message.heard is not None:
                    self._sessions.hear(message.name, message.heard)
            case Finish():
                self.finished.set()

    async def run(self) -> None:
        """Serve until the server says `Finish`, or is gone."""
        tasks = [
            asyncio.create_task(self._watchdogs.run()),
            asyncio.create_task(self._report()),
        ]
        self._send(Ready())
        await self.finished.wait()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._dispatcher.close()
        self._send(self._numbers())
        self._audit.close()

    def _answer(self, token: int, payload: bytes) -> None:
        self._send(Answered(token, payload))

    def _tell_session(self, session: Session, is_open: bool) -> None:
        """Tell the server that a session was opened, or has ended."""
        secret = session.request.session
        if is_open:
            self._send(Began(secret, session.name, session.account))
        else:
            self._send(Ended(secret))

    async def _report(self) -> None:
        while True:
            self._send(self._numbers())
            await asyncio.sleep(_REPORT)

    def _numbers(self) -> Report:
        load = self._sessions.load
        shares = load.last.shares
        numbers = self._metrics.numbers
        return Report(
            dict(numbers.counts),
            dict(numbers.refusals),
            tuple(numbers.steps),
            numbers.step_seconds,
            # To load what the first session needs is no load of sessions.
            load.last.load if shares else 0.0,
            load.last.rate,
            load.last.wait,
            self._watchdogs.lag,
            self._watchdogs.busy,
            resident_bytes(),
            tuple(load.shed),
            sum(name not in shares for name in self._sessions.names),
        )


async def _serve(end: socket.socket, selector: TimedSelector) -> None:
    """Serve at a channel until it ends."""
    started: asyncio.Future[Start] = asyncio.get_running_loop().create_future()
    worker: Worker | None = None
    gone = asyncio.Event()

    def receive(message: ToWorker) -> None:
        if isinstance(message, Start):
            started.set_result(message)
        elif worker is not None:
            worker.receive(message)

    def lost() -> None:
        gone.set()
        if worker is not None:
            worker.finished.set()
        elif not started.done():
            started.cancel()

    decode = msgspec.msgpack.Decoder(ToWorker).decode
    channel = Channel[ToWorker](decode, receive, lost)
    # Until it has said `Ready`, the server says nothing but `Start`.
    await asyncio.get_running_loop().create_unix_connection(lambda: channel, sock=end)
    start = await started
    with logs_on_stderr(start.level, worker=start.number):
        import_early()
        worker = Worker(start, channel.send, selector)
        keep_objects()
        if gone.is_set():
            return
        await worker.run()
        channel.close()
        # What was sent last is on its way until the channel is closed.
        await gone.wait()


def main() -> None:
    """Serve at the channel of the command line."""
    # A signal to the whole group is the server's, which then says `Finish`.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    run_timed(partial(_serve, socket.socket(fileno=int(sys.argv[1]))))
    # Python would wait for a thread that loads a hand.
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
