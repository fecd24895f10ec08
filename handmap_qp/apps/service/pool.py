"""The sessions of a server in worker processes, behind its one address.

The server's process reads and answers the sockets, and maps nothing. Each session is in one worker,
which decides about it as a server of one process does: `dispatch` and `sessions` run there. Here is
what concerns all workers:

- which worker has a session, by its secret and by its name; a new one gets the worker that works
  least
- the rate of each connection, the number of sessions, the share of each client, its names
- the records of all sessions, so that stops and postures outlive a worker
- requests about all sessions: `status` of the server, and a stop of all

A worker that ends is started again. Its sessions end with the error `no_session`, so that clients
open them again where their robots are.
"""

import asyncio
import logging
import os
import pickle
import socket
import subprocess
import sys
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from logging import ERROR, INFO, WARNING

import msgspec
from msgspec import structs

from handmap_core.client.messages import (
    AnyReply,
    Done,
    Error,
    Open,
    State,
    Subscribe,
)
from handmap_core.errors import InvalidInputError, RefusedError
from handmap_qp.hands import Names
from .channel import (
    Answered,
    Ask,
    Began,
    Channel,
    Ended,
    Finish,
    FromWorker,
    Learn,
    Noted,
    Published,
    Ready,
    Report,
    Start,
)
from .dispatch import (
    Answer,
    Subscriber,
    connection_rates,
    decode_request,
    encode_reply,
)
from .haptics import stream_of
from .load import LoadMeter
from .logs import AuditLog, Metrics, Numbers, log, report, resident_bytes
from .refused import Refusals
from .safety import Bucket, refuse_if
from .sessions import UNKNOWN, Caller, Publish, check_names, check_share
from .settings import Settings
from .store import PostureStore, Record, names_account

_STARTING = 120.0
"""Time in which a worker must be ready [s]."""
_ENDING = 3.0
"""Time that workers have to end before they are killed [s]."""
_PAUSE = 1.0
"""Time after which a worker that ended is started again [s]."""
_MOST_PEERS = 1024
_MOST_SAMPLES = 4096
"""Streamed samples whose answer, an error, may still come."""
_REMEMBERED = 4096
"""Secrets of former sessions, whose worker can say what became of them."""
_FRESH = 0.1
"""Load expected of a session that has sent no sample of late."""
_HUNG = 10.0
"""Time without a report after which a worker is killed [s]."""
_GONE = "the worker process of this session ended: open it again with restore"


class _Route(msgspec.Struct):
    """The fields of a request that say where it belongs."""

    type: str = ""
    seq: int = 0
    session: str = ""
    name: str | None = None


_decode_route = msgspec.msgpack.Decoder(_Route).decode
_decode_reply = msgspec.msgpack.Decoder(AnyReply).decode
_decode_record = msgspec.msgpack.Decoder(Record).decode


@dataclass(eq=False, slots=True)
class _Waiting:
    """A request that waits for its answer: the worker, its number, and who takes the answer."""

    worker: "_Worker"
    seq: int
    answer: Answer


class _Worker:
    """A worker process, as the server has it.

    Args:
        number: Its number, from 0.
        pool: The pool.

    Attributes:
        number: As given.
        last: What it reported last; None before the first report.
        reported: When that was [s].
        fresh: Sessions opened there since then.
        sessions: Names of its sessions by their secrets, in the order of their opening.
        ready: Set as long as it serves.
    """

    def __init__(self, number: int, pool: "WorkerPool") -> None:
        self.number = number
        self.last: Report | None = None
        self.reported = 0.0
        self.fresh = 0
        self.sessions: dict[str, str] = {}
        self.ready = asyncio.Event()
        self._pool = pool
        self._channel: Channel[FromWorker] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._gone = asyncio.Event()

    @property
    def use(self) -> tuple[float, int]:
        """How much it works, and how many sessions it has: the least gets the next one."""
        load, unmeasured = 0.0, self.fresh
        if self.last:
            load = self.last.load
            unmeasured += self.last.unmeasured
        return load + _FRESH * unmeasured, len(self.sessions)

    @property
    def pid(self) -> int:
        """Number of the process; 0 if it does not run."""
        return self._process.pid if self._process else 0

    async def start(self, message: Start) -> None:
        """Start the process, and wait until it serves.

        Raises:
            InvalidInputError: If it ends, or does not serve in time.
        """
        ours, theirs = socket.socketpair()
        self._gone.clear()
        with theirs:
            command = "-P", "-m", "handmap_qp.apps.service.worker"
            self._process = subprocess.Popen(
                [sys.executable, *command, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                env=_environment(),
                pass_fds=(theirs.fileno(),),
            )
        decode = msgspec.msgpack.Decoder(FromWorker).decode
        self._channel = Channel[FromWorker](
            decode, partial(self._pool.receive_from, self), self._lost
        )
        await asyncio.get_running_loop().create_unix_connection(
            lambda: self._checked_channel, sock=ours
        )
        self.send(message)
        waits = [self.ready.wait(), self._gone.wait()]
        tasks = [asyncio.create_task(wait) for wait in waits]
        try:
            await asyncio.wait(
                tasks, timeout=_STARTING, return_when=asyncio.FIRST_COMPLETED
            )
        finally:
            for task in tasks:
                task.cancel()
        if not self.ready.is_set():
            self.kill()
            failure = f"worker {self.number} did not start; see the log"
            raise InvalidInputError(failure, argument="--workers")

    @property
    def _checked_channel(self) -> Channel[FromWorker]:
        assert self._channel is not None
        return self._channel

    def send(self, message: Start | Ask | Learn | Finish) -> None:
        """Send a message; one to a process that has ended is dropped."""
        if self._channel is not None:
            self._channel.send(message)

    def interrupt(self) -> None:
        """End the process at once; the pool learns it by its channel."""
        if self._process is not None:
            self._process.kill()

    async def end(self) -> None:
        """Let the process close its sessions and end; kill it if it does not."""
        if self._process is None:
            return
        self.send(Finish())
        try:
            async with asyncio.timeout(_ENDING):
                await self._gone.wait()
        except TimeoutError:
            report(WARNING, "worker_killed", worker=self.number)
        self.kill()

    def kill(self) -> int:
        """Make sure that the process has ended; return its exit code."""
        if self._channel is not None:
            self._channel.close()
        if self._process is None:
            return 0
        try:
            # A process whose channel is closed has nothing left to do.
            return self._process.wait(0.5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

    def _lost(self) -> None:
        self._gone.set()
        self._pool.lose(self)


class WorkerPool:
    """Answers messages by worker processes, as `Dispatcher` does by itself.

    Args:
        settings: Limits of what clients may do, and the number of workers.
        store: Records of all sessions.
        metrics: Counters of all workers, and of the server.
        audit: Record of who did what.
        clock: Monotonic clock of all processes [s].

    Attributes:
        stream_port: Port of the stream, as `opened` reports it.
        publish: Callbacks that receive the messages of all streams.
        load: Load of the server's own process.
    """

    def __init__(
        self,
        settings: Settings,
        store: PostureStore,
        metrics: Metrics,
        audit: AuditLog,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.stream_port = 0
        self.publish: list[Publish] = []
        self.load = LoadMeter(settings.max_load, clock)
        self._settings = settings
        self._store = store
        self._metrics = metrics
        self._audit = audit
        self._clock = clock
        self._started = clock()
        self._workers = [_Worker(number, self) for number in range(settings.workers)]
        # Open sessions by secret, in the order of their opening: worker, name and account.
        self._open: dict[str, tuple[_Worker, str, str]] = {}
        self._names: dict[str, str] = {}
        # Sessions that are being opened, by secret and by name.
        self._opening: dict[str, tuple[_Worker, str | None, str]] = {}
        self._former: OrderedDict[str, _Worker] = OrderedDict()
        # When owners were heard who are on their way back, by the names of their sessions.
        self._heard = dict.fromkeys(store.records, clock())
        # When sessions were lost with their workers, by name.
        self._lost: dict[str, float] = {}
        self._waiting: dict[int, _Waiting] = {}
        self._samples: OrderedDict[int, _Waiting] = OrderedDict()
        self._tokens = 0
        self._peers = lru_cache(_MOST_PEERS)(self._new_peer)
        self._peer_count = 0
        self._refusals = Refusals(metrics)
        self._restarts: set[asyncio.Task[None]] = set()
        self._is_closing = False
        # Numbers of processes that have ended.
        self._past = Numbers()
        self._add_gauges()

    @property
    def names(self) -> Names:
        """Public names of the open sessions, in the order of their opening."""
        return tuple(name for _, name, _ in self._open.values())

    @property
    def is_alive(self) -> bool:
        """Whether all workers serve."""
        return all(worker.ready.is_set() for worker in self._workers)

    @property
    def pids(self) -> tuple[int, ...]:
        """Numbers of the worker processes."""
        return tuple(worker.pid for worker in self._workers)

    async def start(self) -> None:
        """Start all workers.

        Raises:
            InvalidInputError: If one does not start.
        """
        starts = (worker.start(self._start_of(worker)) for worker in self._workers)
        await asyncio.gather(*starts)

    async def close(self) -> None:
        """Close all sessions, and end all workers."""
        self._is_closing = True
        for task in [*self._restarts]:
            task.cancel()
        await asyncio.gather(*self._restarts, return_exceptions=True)
        await asyncio.gather(*(worker.end() for worker in self._workers))

    def tick(self) -> float:
        """Kill workers that hang; the watchdogs of sessions run in the workers.

        Returns:
            Time until this must be called again [s].
        """
        now = self._clock()
        if now >= self.load.ends:
            self.load.update(now, ())
        for worker in self._workers:
            if worker.ready.is_set() and now - worker.reported > _HUNG:
                report(ERROR, "worker_hangs", worker=worker.number, seconds=_HUNG)
                worker.reported = now
                worker.interrupt()
        return 1.0

    def receive(
        self,
        payload: bytes,
        peer: Hashable,
        answer: Answer,
        *,
        subscribe: Subscriber | None = None,
        by: Caller = UNKNOWN,
    ) -> bool:
        """Handle one message; see `Dispatcher.receive`."""

        def send(reply: AnyReply) -> None:
            answer(encode_reply(reply))

        number, samples, errors = self._peers(peer)
        if not samples.take():
            self._metrics.refusals["rate"] += 1
            if errors.take():
                send(Error(code="rate", message="too many messages"))
            return False
        route = _route_of(payload)
        try:
            match route.type:
                case "open":
                    self._receive_open(payload, number, answer, by)
                case "subscribe":
                    send(self._subscribe(payload, subscribe))
                case "status" | "stop" if not route.session and route.name is None:
                    self._ask_all(route, payload, number, answer, by)
                case "stop" if route.name in self._returning() and not route.session:
                    send(self._stop_lost(payload, [route.name], by))
                case _:
                    worker = self._find(route)
                    self._ask(worker, payload, number, route, answer, by)
        except RefusedError as error:
            send(self._refusals.answer(route.seq, error))
        return True

    def receive_from(self, worker: _Worker, message: FromWorker) -> None:
        """Carry out a message of a worker."""
        match message:
            case Answered(token, payload):
                waiting = self._waiting.pop(token, None)
                waiting = waiting or self._samples.pop(token, None)
                if waiting:
                    waiting.answer(payload)
            case Published(name, payload):
                self._send(name, payload)
            case Noted(record):
                self._store.note(_decode_record(record))
            case Began(secret, name, account):
                worker.fresh += 1
                worker.sessions[secret] = name
                self._open[secret] = worker, name, account
                self._names[name] = secret
                self._heard.pop(name, None)
                self._lost.pop(name, None)
            case Ended(secret):
                self._forget(secret)
            case Ready():
                worker.reported = self._clock()
                worker.ready.set()
            case Report():
                worker.reported = self._clock()
                worker.last = message
                worker.fresh = 0

    def lose(self, worker: _Worker) -> None:
        """End the sessions of a worker that has ended, and start it again."""
        was_ready = worker.ready.is_set()
        worker.ready.clear()
        names = list(worker.sessions.values())
        for secret, name in list(worker.sessions.items()):
            self._forget(secret)
            # Its owner is on its way back.
            self._heard[name] = self._lost[name] = self._clock()
        if worker.last:
            self._past = self._past.plus(_numbers_of(worker.last))
            worker.last = None
        lost = Error(code="no_session", message=_GONE)
        if not self._is_closing:
            for name in names:
                self._audit.note("closed", "server", session=name, reason=_GONE)
                self._send(name, encode_reply(lost))
            self._metrics.counts["workers_lost"] += 1
        for table in (self._waiting, self._samples):
            for token, waiting in list(table.items()):
                if waiting.worker is worker:
                    del table[token]
                    waiting.answer(encode_reply(structs.replace(lost, seq=waiting.seq)))
        if was_ready and not self._is_closing:
            task = asyncio.create_task(self._start_again(worker, names))
            self._restarts.add(task)
            task.add_done_callback(self._restarts.discard)

    async def _start_again(self, worker: _Worker, names: list[str]) -> None:
        """Start a worker until it serves."""
        code = await asyncio.to_thread(worker.kill)
        report(
            ERROR, "worker_ended", worker=worker.number, code=code, sessions_lost=names
        )
        while True:
            await asyncio.sleep(_PAUSE)
            try:
                await worker.start(self._start_of(worker))
            except (OSError, InvalidInputError) as error:
                report(ERROR, "worker_failed", worker=worker.number, failure=error)
            else:
                report(INFO, "worker_started", worker=worker.number)
                return

    def _start_of(self, worker: _Worker) -> Start:
        """Return what a worker is told first."""
        level = logging.getLevelName(log.level) if log.level else "WARNING"
        settings = pickle.dumps(self._settings)
        return Start(settings, level, worker.number, self.stream_port)

    def _find(self, route: _Route) -> _Worker:
        """Return the worker that knows a session, or else any."""
        secret = route.session
        if not secret and route.name is not None:
            secret = self._names.get(route.name, "")
        if secret in self._open:
            return self._open[secret][0]
        if secret in self._opening:
            return self._opening[secret][0]
        former = self._former.get(secret)
        return former if former and former.ready.is_set() else self._least()

    def _least(self) -> _Worker:
        """Return the worker that works least.

        Raises:
            RefusedError: `busy` if none serves.
        """
        ready = [worker for worker in self._workers if worker.ready.is_set()]
        refuse_if(not ready, "no worker serves: try again later", code="busy")
        return min(ready, key=lambda worker: worker.use)

    def _ask(
        self,
        worker: _Worker,
        payload: bytes,
        peer: int,
        route: _Route,
        answer: Answer,
        by: Caller,
    ) -> None:
        """Pass a request on to a worker."""
        self._tokens += 1
        waiting = _Waiting(worker, route.seq, answer)
        if route.type == "sample":
            self._samples[self._tokens] = waiting
            if len(self._samples) > _MOST_SAMPLES:
                self._samples.popitem(last=False)
        else:
            self._waiting[self._tokens] = waiting
        worker.send(Ask(self._tokens, peer, by.address, by.key, payload))

    def _ask_all(
        self, route: _Route, payload: bytes, peer: int, answer: Answer, by: Caller
    ) -> None:
        """Pass a request on to all workers; answer when all have answered."""
        workers = [worker for worker in self._workers if worker.ready.is_set()]
        refuse_if(not workers, "no worker serves: try again later", code="busy")
        answers: list[bytes] = []

        def collect(payload: bytes) -> None:
            answers.append(payload)
            if len(answers) == len(workers):
                answer(encode_reply(self._merged([*map(_decode_reply, answers)])))

        if route.type == "stop":
            self._stop_lost(payload, self._returning(), by)
        for worker in workers:
            self._ask(worker, payload, peer, route, collect, by)

    def _returning(self) -> list[str]:
        """Return the names of sessions that were lost with a worker, and are not closed yet."""
        latest = self._clock() - self._settings.idle
        return [name for name, lost in self._lost.items() if lost >= latest]

    def _stop_lost(self, payload: bytes, names: Sequence[str], by: Caller) -> AnyReply:
        """Note a stop of sessions that were lost, whose clients are about to open them again."""
        request = decode_request(payload)
        if isinstance(request, Error):
            return self._refusals.counted(request)
        for name in names:
            record = self._store.records.get(name)
            if record is not None and not record.stop:
                self._store.note(structs.replace(record, stop=time.time_ns() // 1000))
                self._audit.note("stop", by, session=name)
            for worker, opening, _ in self._opening.values():
                if opening == name:
                    self._teach(worker, name)
        return Done(seq=request.seq)

    def _merged(self, replies: list[AnyReply]) -> AnyReply:
        """Return the answer of all workers: an error if there is one, or all states as one."""
        for reply in replies:
            # One that has ended stops no robot: its sessions have ended, too.
            if isinstance(reply, Error) and reply.code != "no_session":
                return reply
        states = [reply for reply in replies if isinstance(reply, State)]
        if not states:
            done = [reply for reply in replies if isinstance(reply, Done)]
            return done[0] if done else replies[0]
        return structs.replace(
            states[0],
            uptime=self._clock() - self._started,
            names=self.names,
            counts=dict(self._counts(states)),
            load=self._load_of([each.load for each in states if each.load is not None]),
            samples_per_second=sum(state.samples_per_second for state in states),
            busy=tuple(sorted(name for state in states for name in state.busy)),
        )

    def _load_of(self, workers: list[float]) -> float:
        """Return the load of all workers together, or of the server's own process if it is more."""
        mean = sum(workers) / len(workers) if workers else 0.0
        own = self.load.last.load
        # NaN, if that is not measured, is not above the mean.
        return own if own > mean else mean

    def _counts(self, states: list[State]) -> Counter[str]:
        """Return the counts of all states, of processes that have ended, and of the server."""
        total = self._past.counts + self._metrics.counts
        for state in states:
            total.update(state.counts)
        return total

    def _subscribe(self, payload: bytes, subscribe: Subscriber | None) -> AnyReply:
        """Subscribe a connection to the stream of a session."""
        request = decode_request(payload)
        if not isinstance(request, Subscribe):
            assert isinstance(request, Error)
            return request
        is_known = request.name in self._names
        refuse_if(not is_known, f"no session {request.name!r}", "name")
        message = "connect a SUB socket to the stream's port instead"
        if subscribe is None:
            raise RefusedError("invalid", message, field="type")
        subscribe(stream_of(request))
        return Done(seq=request.seq)

    def _receive_open(
        self, payload: bytes, peer: int, answer: Answer, by: Caller
    ) -> None:
        """Let a worker open a session."""
        request = decode_request(payload)
        if not isinstance(request, Open):
            assert isinstance(request, Error)
            answer(encode_reply(self._refusals.counted(request)))
            return
        route = _Route("open", request.seq, request.session, request.name)
        worker = self._placed(request)
        if worker is None:
            self._check(request, by)
            worker = self._least()
            if name := request.name:
                self._teach(worker, name)
        secret = request.session
        if secret in self._opening:
            # A repetition, or another one with the same secret: the worker knows.
            self._ask(worker, payload, peer, route, answer, by)
            return
        self._opening[secret] = worker, request.name, by.account

        def done(payload: bytes) -> None:
            del self._opening[secret]
            answer(payload)

        self._ask(worker, payload, peer, route, done, by)

    def _placed(self, request: Open) -> _Worker | None:
        """Return the worker that has to do with a secret or name; None if there is none."""
        if held := self._open.get(request.session):
            return held[0]
        if request.session in self._opening:
            return self._opening[request.session][0]
        if request.name in self._names:
            return self._open[self._names[request.name]][0]
        for worker, name, _ in self._opening.values():
            if name is not None and name == request.name:
                return worker
        return None

    def _check(self, request: Open, by: Caller) -> None:
        """Refuse a session that no worker may open: beyond the limits of all of them together."""
        accounts = [account for _, _, account in self._open.values()]
        accounts += [account for _, _, account in self._opening.values()]
        owner = by.owner(request.session)
        record = self._store.records.get(request.name or "")
        is_return = request.restore and record is not None and record.owner == owner
        own = self.load.last.load
        # All messages pass this process, however many workers there are.
        refuse_if(
            own > self.load.limit and not is_return,
            f"the server works {own:.0%} of the time to pass on the messages of "
            f"{len(self._open)} sessions",
            code="busy",
        )
        check_share(accounts, by, self._settings.sessions, is_return=is_return)
        kept = self._store.stopped(names_account(owner))
        kept |= {name for name in self.names if self._owns(name, owner)}
        check_names(request.name, kept)

    def _owns(self, name: str, owner: str) -> bool:
        """Return whether an open session counts among the names of an owner."""
        record = self._store.records.get(name)
        return record is not None and record.account == names_account(owner)

    def _teach(self, worker: _Worker, name: str) -> None:
        """Tell a worker what is known of a name that it is to open."""
        record = self._store.records.get(name)
        encoded = msgspec.msgpack.encode(record) if record else b""
        worker.send(Learn(name, encoded, self._heard.get(name)))

    def _forget(self, secret: str) -> None:
        """Forget an open session; its worker still knows what became of it."""
        if held := self._open.pop(secret, None):
            worker, name, _ = held
            worker.sessions.pop(secret, None)
            if self._names.get(name) == secret:
                del self._names[name]
            self._former[secret] = worker
            if len(self._former) > _REMEMBERED:
                self._former.popitem(last=False)

    def _send(self, name: str, payload: bytes) -> None:
        """Publish a message in the stream of a session."""
        for publish in self.publish:
            publish(name, payload)

    def _new_peer(self, _peer: Hashable) -> tuple[int, Bucket, Bucket]:
        """Return the number of a connection, and its limits."""
        self._peer_count += 1
        return self._peer_count, *connection_rates(self._settings.rate, self._clock)

    def _reports(self) -> Iterator[Report]:
        """Yield the last reports of all workers."""
        return (worker.last for worker in self._workers if worker.last)

    def _numbers(self) -> Numbers:
        """Return the counters of all workers, also of those that have ended."""
        total = self._past
        for each in self._reports():
            total = total.plus(_numbers_of(each))
        return total

    def _add_gauges(self) -> None:
        """Let the metrics be those of all workers."""
        gauges = self._metrics.gauges
        self._metrics.others = self._numbers
        gauges["sessions"] = lambda: len(self._open)
        gauges["uptime_seconds"] = lambda: self._clock() - self._started
        gauges["load"] = lambda: self._load_of([e.load for e in self._reports()])
        gauges["samples_per_second"] = lambda: sum(e.rate for e in self._reports())
        gauges["wait_seconds"] = lambda: max(
            (e.wait for e in self._reports()), default=0.0
        )
        gauges["shed_sessions"] = lambda: sum(len(e.shed) for e in self._reports())
        gauges["workers"] = lambda: sum(each.ready.is_set() for each in self._workers)
        gauges["resident_bytes"] = lambda: (
            resident_bytes() + sum(each.resident for each in self._reports())
        )

    @property
    def lag(self) -> float:
        """Longest delay of the event loop of a worker [s]."""
        return max((each.lag for each in self._reports()), default=0.0)

    @property
    def busy(self) -> float:
        """Longest CPU time of a worker between two turns of its event loop [s]."""
        return max((each.busy for each in self._reports()), default=0.0)


def _environment() -> dict[str, str]:
    """Return the environment of a worker: modules are found as here, and one core is used."""
    one = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return one | os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}


def _route_of(payload: bytes) -> _Route:
    """Return where a request belongs; nowhere, if it cannot be read: any worker says why."""
    try:
        return _decode_route(payload)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return _Route()


def _numbers_of(last: Report) -> Numbers:
    """Return the counters of a report."""
    counts, refusals = Counter(last.counts), Counter(last.refusals)
    return Numbers(counts, refusals, last.steps, last.step_seconds)
