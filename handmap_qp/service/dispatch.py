"""Dispatch of messages to sessions: decoding, rate limits, repeated requests, answers.

It has no sockets. A transport passes every message to `receive` with a callback for the answer, and
receives the messages of all streams through `sessions.publish`.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Hashable
from importlib.metadata import version
from logging import ERROR, INFO
from typing import Any

import msgspec

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
from handmap_qp.service.audit import AuditLog
from handmap_qp.service.caps import Bucket, Caps, RateLimit
from handmap_qp.service.decoding import decode_request, encode_reply
from handmap_qp.service.logs import Throttle
from handmap_qp.service.metrics import Metrics
from handmap_qp.service.opening import HandCache
from handmap_qp.service.session import Session
from handmap_qp.service.sessions import Sessions
from handmap_qp.service.states import Caller
from handmap_qp.service.store import PostureStore

Answer = Callable[[bytes], None]
"""Callback of a transport that sends an answer; it must not block."""

_MOST_REPEATS = 8


class Dispatcher:
    """Answer messages.

    Args:
        caps: Limits of what clients may do.
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
        caps: Caps,
        cache: HandCache,
        metrics: Metrics,
        *,
        store: PostureStore | None = None,
        audit: AuditLog | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store or PostureStore(None)
        self._audit, self._who = audit or AuditLog(), Caller
        self.sessions = Sessions(caps, cache, metrics, self._store, clock, self._audit)
        self.stream_port = 0
        self._caps, self._cache, self._metrics, self._clock = caps, cache, metrics, clock
        self._version = version("handmap-qp")
        self._started = clock()
        self._rates, self._configures = RateLimit(caps.rate), Bucket(caps.configures, clock())
        self._pending: dict[str, tuple[Sample, Answer, bool]] = {}
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
        now, self._who = self._clock(), who
        self._metrics.counts["requests"] += 1
        if not self._rates.take(peer, now):
            self._metrics.refusals["rate"] += 1
            if self._rates.may_report(peer, now):
                error = Error(code="rate", message="too many messages")
                answer(encode_reply(error, is_json=is_json))
            return False
        request = decode_request(payload, is_json=is_json)
        if isinstance(request, Error):
            self._count(request)
            answer(encode_reply(request, is_json=is_json))
        elif isinstance(request, Sample):
            self._receive_sample(request, answer, is_json)
        elif isinstance(request, Open):
            self._receive_open(request, payload, answer, is_json)
        elif isinstance(request, Subscribe):
            answer(encode_reply(self._subscribe(request, subscribe), is_json=is_json))
        else:
            answer(self._answer(request, payload, now, is_json))
        return True

    def flush(self) -> None:
        """Map the newest streamed sample of each session since the last call."""
        pending, self._pending = self._pending, {}
        for sample, answer, is_json in pending.values():
            try:
                entry = self.sessions.find(sample.session)
            except RefusedError as error:
                answer(encode_reply(self._refusal(sample.seq, error), is_json=is_json))
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
            if now - session.last_request > self._caps.idle and not session.will_move:
                self.sessions.end(secret, "no_session", "closed: its client was silent too long")
                continue
            try:
                trips = session.counts["watchdog"]
                command = session.tick(now)
                self._metrics.counts["watchdog"] += session.counts["watchdog"] - trips
                if command is not None:
                    self._send(session, command)
            except Exception as error:
                # The watchdogs of the other sessions must continue.
                self._bug(0, error)

    async def close(self) -> None:
        """Close all sessions."""
        for task in self._tasks:
            task.cancel()
        self.sessions.close()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _receive_sample(self, sample: Sample, answer: Answer, is_json: bool) -> None:
        """Keep the newest sample of each session until all waiting messages have been read."""
        if not self._pending:
            asyncio.get_running_loop().call_soon(self.flush)
        elif sample.session in self._pending:
            self._metrics.counts["replaced"] += 1
        self._pending[sample.session] = sample, answer, is_json

    def _answer(self, request: AnyRequest, payload: bytes, now: float, is_json: bool) -> bytes:
        """Answer a request that needs no waiting."""
        if isinstance(request, Named) and request.name is not None:
            reply = self._answer_anyone(request, request.name, now)
        elif isinstance(request, Stop) and not request.session:
            reply = self._stop_all(request, now)
        elif isinstance(request, Status) and not request.session:
            reply = self._server_state(request.seq, now)
        else:
            return self._answer_client(request, payload, now, is_json)
        return encode_reply(reply, is_json=is_json)

    def _answer_client(
        self, request: AnyRequest, payload: bytes, now: float, is_json: bool
    ) -> bytes:
        """Answer a session's client; repeat the last answer if the request is repeated."""
        try:
            entry = self.sessions.find(request.session)
        except RefusedError as error:
            return encode_reply(self._refusal(request.seq, error), is_json=is_json)
        if request.seq == entry.seq and payload == entry.payload:
            return entry.answer
        if request.seq <= entry.seq:
            stale = RefusedError(
                "stale", f"expected a number above {entry.seq}, got {request.seq}", field="seq"
            )
            return encode_reply(self._refusal(request.seq, stale), is_json=is_json)
        entry.seq, entry.payload = request.seq, payload
        reply = self._carry_out(entry.session, request, now)
        # The stream's command is encoded already.
        written = None if is_json or not isinstance(reply, Command) else self._written
        entry.answer = written or encode_reply(reply, is_json=is_json)
        return entry.answer

    def _answer_anyone(self, request: Named, name: str, now: float) -> AnyReply:
        """Answer a request by a session's public name.

        Everyone may ask for the status, and stop the robot; other requests need `is_shared`. The
        owner's key and supervisors may clear a stop too.
        """
        try:
            if request.session:
                raise RefusedError("invalid", "give session or name, not both", field="name")
            session = self.sessions.named(name)
            is_allowed = session.request.is_shared or isinstance(request, Status | Stop)
            if isinstance(request, Clear) and not is_allowed:
                by = self._who()
                is_allowed = by.key in self._caps.supervisors or by.owner("") == session.owner
            if not is_allowed:
                message = f"session {name!r} was not opened with is_shared: only its owner may"
                raise RefusedError("denied", message, field="name")
        except RefusedError as error:
            return self._refusal(request.seq, error)
        return self._carry_out(session, request, now)

    def _stop_all(self, request: Stop, now: float) -> AnyReply:
        """Stop the robots of all sessions."""
        self._audit.note("stop", self._who(), **_changes(request))
        for entry in list(self.sessions.entries.values()):
            self._carry_out(entry.session, request, now)
        return Done(seq=request.seq)

    def _carry_out(self, session: Session, request: AnyRequest | Named, now: float) -> AnyReply:
        try:
            if isinstance(request, Step):
                command = session.step(request, now)
                self._metrics.observe_step(self._clock() - now)
                self._send(session, command)
                return command
            if isinstance(request, Status):
                return session.state(request.seq, self._version, self.stream_port, now)
            if isinstance(request, Configure):
                if not self._configures.take(now):
                    limit = f"more than {self._caps.configures:g} changes of options a second"
                    raise RefusedError("rate", f"{limit}: try again later")
                session.configure(request)
            elif isinstance(request, Close):
                reason = "closed by its client"
                self.sessions.end(request.session, "no_session", reason, by=self._who())
            else:
                self._steer(session, request, now)
            if not isinstance(request, Close):
                event, changes = type(request).__name__.lower(), _changes(request)
                self._audit.note(event, self._who(), session=session.name, **changes)
            # A release must outlive the server as well as a posture.
            self._note(session)
            return Done(seq=request.seq)
        except RefusedError as error:
            return self._refusal(request.seq, error)
        except Exception as error:
            return self._bug(request.seq, error)

    def _steer(self, session: Session, request: AnyRequest | Named, now: float) -> None:
        """Engage, disengage, stop or start a session again."""
        if isinstance(request, Reset):
            session.reset(request, now)
        elif isinstance(request, Clutch):
            session.clutch()
        elif isinstance(request, Release):
            session.release()
        elif isinstance(request, Clear):
            session.clear(request.stop)
        else:
            session.stop()
            # The stream must not wait for the next tick.
            if (command := session.tick(now)) is not None:
                self._send(session, command)

    def _receive_open(self, request: Open, payload: bytes, answer: Answer, is_json: bool) -> None:
        """Open a session in a task; a repeated request gets the same answer."""
        entry = self.sessions.entries.get(request.session)
        if entry is not None and payload == entry.payload:
            answer(entry.answer)
            return
        waiting = self._opening.get(request.session)
        if waiting is not None and payload == waiting[0] and len(waiting[1]) < _MOST_REPEATS:
            waiting[1].append(answer)
            return
        if waiting is not None or len(self._opening) >= self._caps.sessions:
            answer(
                encode_reply(
                    self._refusal(request.seq, RefusedError("busy", "too many at once")),
                    is_json=is_json,
                )
            )
            return
        self._opening[request.session] = payload, [answer]
        opening = self._open(request, payload, is_json, self._who())
        task = asyncio.get_running_loop().create_task(opening)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _open(self, request: Open, payload: bytes, is_json: bool, by: Caller) -> None:
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
        self._note(session)
        self._written = encode_reply(command)
        self.sessions.send(session.name, self._written)

    def _note(self, session: Session) -> None:
        """Note where the session is, if that is to outlive the server.

        Without a file, `Sessions` notes it when the session ends.
        """
        if self._store.is_persistent:
            self._store.note(session.record)

    def _subscribe(self, request: Subscribe, subscribe: Callable[[str], None] | None) -> AnyReply:
        if subscribe is None:
            error = RefusedError(
                "invalid", "connect a SUB socket to the stream's port instead", field="type"
            )
            return self._refusal(request.seq, error)
        try:
            self.sessions.named(request.name)
        except RefusedError as error:
            return self._refusal(request.seq, error)
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
        reply = Error(
            seq=seq, code="internal", message="the server failed at this request; see its log"
        )
        self._count(reply)
        return reply

    def _count(self, error: Error) -> None:
        self._metrics.refusals[error.code] += 1
        self._refusals.report(
            INFO, "refused", code=error.code, field=error.field, message=error.message
        )


def _changes(request: AnyRequest | Named) -> dict[str, Any]:
    """Return the fields of a request that the audit log keeps: those that were given."""
    left_out = {"type", "protocol", "seq", "session", "name"}
    given = msgspec.to_builtins(request)
    return {name: value for name, value in given.items() if name not in left_out and value}
