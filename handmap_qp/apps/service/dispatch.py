"""Dispatch of messages to sessions: decoding, rate limits, repeated requests, answers.

It has no sockets. A transport passes every message to `receive` with a callback for the answer, and
receives the messages of all streams through `sessions.publish`.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Hashable
from functools import partial
from importlib.metadata import version
from logging import ERROR, INFO
from typing import Any

import msgspec

from handmap_qp.apps.service.decoding import decode_request, encode_reply
from handmap_qp.apps.service.logs import AuditLog, Throttle
from handmap_qp.apps.service.metrics import Metrics
from handmap_qp.apps.service.opening import HandCache
from handmap_qp.apps.service.rate_limit import Bucket, RateLimit
from handmap_qp.apps.service.session import Session
from handmap_qp.apps.service.sessions import Sessions
from handmap_qp.apps.service.settings import Settings
from handmap_qp.apps.service.states import Caller
from handmap_qp.apps.service.store import PostureStore
from handmap_qp.client.messages import (
    AnyReply,
    AnyRequest,
    Clear,
    Close,
    Clutch,
    Command,
    Configure,
    Done,
    Error,
    Named,
    Open,
    Opened,
    Release,
    Reset,
    Sample,
    State,
    Status,
    Step,
    Stop,
    Subscribe,
)
from handmap_qp.errors import RefusedError

Answer = Callable[[bytes], None]
"""Callback of a transport that sends an answer; it must not block."""

_MOST_REPEATS = 8


class Dispatcher:
    """Answer messages.

    Args:
        settings: Limits of what clients may do.
        cache: The hands that clients may open.
        metrics: Counters.
        store: Record of the postures commanded; in memory if omitted.
        audit: Record of who did what; none if omitted.
        clock: Monotonic clock [s].

    Attributes:
        sessions: The open sessions.
        stream_port: Port of the stream, as `opened` reports it.
    """

    def __init__(
        self,
        settings: Settings,
        cache: HandCache,
        metrics: Metrics,
        *,
        store: PostureStore | None = None,
        audit: AuditLog | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        store = PostureStore(None) if store is None else store
        self._audit, self._who = audit or AuditLog(), Caller
        self.sessions = Sessions(settings, cache, metrics, store, clock, self._audit)
        self.stream_port = 0
        self._settings, self._cache, self._metrics, self._clock = (
            settings,
            cache,
            metrics,
            clock,
        )
        self._version = version("handmap-qp")
        self._started = clock()
        self._rates, self._configures = (
            RateLimit(settings.rate),
            Bucket(settings.configures, clock()),
        )
        self._pending: dict[str, tuple[Sample, Callable[[AnyReply], None]]] = {}
        self._opening: dict[str, tuple[bytes, list[Answer]]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._written = b""
        self._refusals, self._bugs = Throttle(), Throttle()
        metrics.gauges["sessions"] = lambda: len(self.sessions.entries)
        metrics.gauges["uptime_seconds"] = lambda: self._clock() - self._started

    def receive(
        self,
        payload: bytes,
        peer: Hashable,
        answer: Answer,
        *,
        is_json: bool = False,
        subscribe: Callable[[str], None] | None = None,
        who: Callable[[], Caller] = Caller,
    ) -> bool:
        """Handle one message; call it from the event loop.

        Args:
            payload: The message as received.
            peer: The connection that it came from.
            answer: Called with the answer, now or later. A streamed sample that can be read has no
                answer.
            is_json: Whether message and answer are JSON.
            subscribe: Subscribes the connection to a stream; None if the transport has no such
                streams.
            who: Returns who the client is.

        Returns:
            False if the rate limit rejected the message unread.
        """

        def send(reply: AnyReply) -> None:
            answer(encode_reply(reply, is_json=is_json))

        now, self._who = self._clock(), who
        self._metrics.counts["requests"] += 1
        if not self._rates.take(peer, now):
            self._metrics.refusals["rate"] += 1
            if self._rates.may_report(peer, now):
                send(Error(code="rate", message="too many messages"))
            return False
        request = decode_request(payload, is_json=is_json)
        if isinstance(request, Error):
            self._count(request)
            send(request)
        elif isinstance(request, Sample):
            self._receive_sample(request, send)
        elif isinstance(request, Open):
            self._receive_open(request, payload, answer, is_json)
        elif isinstance(request, Subscribe):
            send(self._attempt(request, lambda: self._subscribe(request, subscribe)))
        elif isinstance(request, Named) and request.name is not None:
            send(self._attempt(request, lambda: self._answer_anyone(request, now)))
        elif isinstance(request, Status | Stop) and not request.session:
            send(self._attempt(request, lambda: self._answer_all(request, now)))
        else:
            answer(self._answer_client(request, payload, now, is_json))
        return True

    def flush(self) -> None:
        """Map the newest streamed sample of each session since the last call."""
        pending, self._pending = self._pending, {}
        for sample, send in pending.values():
            try:
                entry = self.sessions.find(sample.session)
            except RefusedError as error:
                send(self._refusal(sample.seq, error))
                continue
            if sample.seq <= entry.seq:
                entry.session.counts["stale"] += 1
                continue
            entry.seq, entry.payload = sample.seq, b""
            reply = self._carry_out(entry.session, sample, self._clock())
            if isinstance(reply, Error):
                self.sessions.send(entry.session.name, encode_reply(reply))

    def tick(self) -> None:
        """Let time pass: run the watchdogs, and close idle sessions."""
        now = self._clock()
        for secret, entry in list(self.sessions.entries.items()):
            session = entry.session
            if (
                now - session.last_request > self._settings.idle
                and not session.will_move
            ):
                self.sessions.end(
                    secret, "no_session", "closed: its client was silent too long"
                )
                continue
            try:
                self._tick(session, now)
            except Exception as error:
                # The watchdogs of the other sessions must continue.
                self._bug(0, error)

    async def close(self) -> None:
        """Close all sessions."""
        for task in self._tasks:
            task.cancel()
        self.sessions.close()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _tick(self, session: Session, now: float) -> None:
        trips = session.counts["watchdog"]
        command = session.tick(now)
        self._metrics.counts["watchdog"] += session.counts["watchdog"] - trips
        if command is not None:
            self._send(session, command)

    def _receive_sample(self, sample: Sample, send: Callable[[AnyReply], None]) -> None:
        """Keep the newest sample of each session until all waiting messages have been read."""
        if not self._pending:
            asyncio.get_running_loop().call_soon(self.flush)
        elif sample.session in self._pending:
            self._metrics.counts["replaced"] += 1
        self._pending[sample.session] = sample, send

    def _answer_client(
        self, request: AnyRequest, payload: bytes, now: float, is_json: bool
    ) -> bytes:
        """Answer a session's client; repeat the last answer if the request is repeated."""
        try:
            entry = self.sessions.find(request.session)
            if request.seq == entry.seq and payload == entry.payload:
                return entry.answer
            if request.seq <= entry.seq:
                message = f"expected a number above {entry.seq}, got {request.seq}"
                raise RefusedError("stale", message, field="seq")
        except RefusedError as error:
            return encode_reply(self._refusal(request.seq, error), is_json=is_json)
        entry.seq, entry.payload = request.seq, payload
        reply = self._carry_out(entry.session, request, now)
        # The stream's command is encoded already.
        written = None if is_json or not isinstance(reply, Command) else self._written
        entry.answer = written or encode_reply(reply, is_json=is_json)
        return entry.answer

    def _answer_anyone(self, request: Named, now: float) -> AnyReply:
        """Answer a request about the server, or by a session's public name.

        Everyone may ask for the status, and stop robots; other requests need `is_shared`. The
        owner's key and supervisor may clear a stop too.

        Raises:
            RefusedError: If the client may not do that.
        """
        if request.session:
            raise RefusedError(
                "invalid", "give session or name, not both", field="name"
            )
        session = self.sessions.named(request.name or "")
        is_allowed = session.request.is_shared or isinstance(request, Status | Stop)
        if isinstance(request, Clear) and not is_allowed:
            by = self._who()
            is_allowed = (
                by.key in self._settings.supervisor or by.owner("") == session.owner
            )
        if not is_allowed:
            message = f"session {request.name!r} was not opened with is_shared: only its owner may"
            raise RefusedError("denied", message, field="name")
        return self._carry_out(session, request, now)

    def _answer_all(self, request: Status | Stop, now: float) -> AnyReply:
        """Answer a request about the server, or stop the robots of all sessions."""
        if isinstance(request, Status):
            return self._server_state(request.seq, now)
        self._audit.note("stop", self._who(), **_changes(request))
        for entry in list(self.sessions.entries.values()):
            self._carry_out(entry.session, request, now)
        return Done(seq=request.seq)

    def _attempt(
        self, request: AnyRequest | Named, work: Callable[[], AnyReply]
    ) -> AnyReply:
        """Return what `work` returns, or the error to answer with."""
        try:
            return work()
        except RefusedError as error:
            return self._refusal(request.seq, error)
        except Exception as error:
            return self._bug(request.seq, error)

    def _carry_out(
        self, session: Session, request: AnyRequest | Named, now: float
    ) -> AnyReply:
        """Carry out a request for a session."""
        if isinstance(request, Step):
            return self._attempt(request, lambda: self._step(session, request, now))
        if isinstance(request, Status):
            state = partial(
                session.state, request.seq, self._version, self.stream_port, now
            )
            return self._attempt(request, state)
        return self._attempt(request, lambda: self._control(session, request, now))

    def _step(self, session: Session, sample: Step, now: float) -> Command:
        command = session.step(sample, now)
        self._metrics.observe_step(self._clock() - now)
        self._send(session, command)
        return command

    def _control(
        self, session: Session, request: AnyRequest | Named, now: float
    ) -> Done:
        """Engage, disengage, change, stop, close a session, or start it again."""
        match request:
            case Close():
                reason = "closed by its client"
                self.sessions.end(request.session, "no_session", reason, by=self._who())
                return Done(seq=request.seq)
            case Configure():
                if not self._configures.take(now):
                    limit = f"more than {self._settings.configures:g} changes of options a second"
                    raise RefusedError("rate", f"{limit}: try again later")
                session.configure(request)
            case Reset():
                session.reset(request, now)
            case Clutch():
                session.clutch()
            case Release():
                session.release()
            case Clear():
                session.clear(request.stop)
            case Stop():
                session.stop()
                # The stream must not wait for the next tick.
                self._tick(session, now)
        event = type(request).__name__.lower()
        self._audit.note(event, self._who(), session=session.name, **_changes(request))
        # A release must outlive the server as well as a posture.
        self.sessions.note(session)
        return Done(seq=request.seq)

    def _receive_open(
        self, request: Open, payload: bytes, answer: Answer, is_json: bool
    ) -> None:
        """Open a session in a task; a repeated request gets the same answer."""
        entry = self.sessions.entries.get(request.session)
        if entry is not None and payload == entry.payload:
            answer(entry.answer)
            return
        first, waiting = self._opening.get(request.session, (b"", []))
        if payload == first and len(waiting) < _MOST_REPEATS:
            waiting.append(answer)
            return
        if first or len(self._opening) >= self._settings.sessions:
            refusal = self._refusal(
                request.seq, RefusedError("busy", "too many at once")
            )
            answer(encode_reply(refusal, is_json=is_json))
            return
        self._opening[request.session] = payload, [answer]
        opening = self._open(request, payload, is_json, self._who())
        task = asyncio.get_running_loop().create_task(opening)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _open(
        self, request: Open, payload: bytes, is_json: bool, by: Caller
    ) -> None:
        reply: AnyReply
        try:
            session = await self.sessions.open(request, payload, by)
            reply = session.opened(request.seq, self.stream_port)
        except RefusedError as error:
            reply = self._refusal(request.seq, error)
        except Exception as error:
            reply = self._bug(request.seq, error)
        encoded = encode_reply(reply, is_json=is_json)
        if isinstance(reply, Opened):
            self.sessions.entries[request.session].answer = encoded
        for answer in self._opening.pop(request.session)[1]:
            answer(encoded)

    def _send(self, session: Session, command: Command) -> None:
        """Note and publish a command."""
        self.sessions.note(session)
        self._written = encode_reply(command)
        self.sessions.send(session.name, self._written)

    def _subscribe(
        self, request: Subscribe, subscribe: Callable[[str], None] | None
    ) -> Done:
        if subscribe is None:
            message = "connect a SUB socket to the stream's port instead"
            raise RefusedError("invalid", message, field="type")
        self.sessions.named(request.name)
        subscribe(request.name)
        return Done(seq=request.seq)

    def _server_state(self, seq: int, now: float) -> State:
        return State(
            seq=seq,
            version=self._version,
            uptime=now - self._started,
            names=self.sessions.names,
            counts=dict(self._metrics.counts),
            robots=self._cache.robots,
            missing=self._cache.missing,
            stream_port=self.stream_port,
        )

    def _refusal(self, seq: int, error: RefusedError) -> Error:
        reply = Error(seq=seq, code=error.code, message=str(error), field=error.field)
        self._count(reply)
        return reply

    def _bug(self, seq: int, error: Exception) -> Error:
        """Log an unexpected exception, and tell the client that the request failed."""
        self._bugs.report(ERROR, "failed", error=repr(error), failure=error)
        message = "the server failed at this request; see its log"
        reply = Error(seq=seq, code="internal", message=message)
        self._count(reply)
        return reply

    def _count(self, error: Error) -> None:
        self._metrics.refusals[error.code] += 1
        evidence: dict[str, Any] = {
            "code": error.code,
            "field": error.field,
            "message": error.message,
        }
        self._refusals.report(INFO, "refused", **evidence)


def _changes(request: AnyRequest | Named) -> dict[str, Any]:
    """Return the fields of a request that the audit log keeps: those that were given."""
    left_out = {"type", "protocol", "seq", "session", "name"}
    given = msgspec.to_builtins(request)
    return {
        name: value for name, value in given.items() if name not in left_out and value
    }
