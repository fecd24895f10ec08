"""From a message to its answer: decoding, rate limits, repeated requests, and the sessions.

It has no sockets. A transport passes every message to `receive` with a callback for the answer, and
receives the messages of all streams through `sessions.publish`.
"""

import asyncio
import math
import re
from collections.abc import Callable, Hashable, Iterator
from functools import lru_cache
from importlib.metadata import version
from logging import ERROR, WARNING
from typing import Annotated, Any, Protocol, TypeGuard

import msgspec
from msgspec import structs

from handmap_core.client import messages
from handmap_core.client.messages import (
    HAPTICS_END,
    LARGEST,
    NAME,
    AnyReply,
    AnyRequest,
    Clear,
    Close,
    Command,
    Configure,
    Disengage,
    Done,
    Engage,
    Error,
    Measured,
    Named,
    Open,
    Pose,
    Request,
    Reset,
    Sample,
    State,
    Status,
    Step,
    Stop,
    Subscribe,
    Touch,
)
from handmap_core.errors import RefusedError
from handmap_qp.hands import Names
from .fairness import AccountBuckets
from .haptics import haptics_of, stream_of
from .load import LoadMeter
from .logs import Throttle, report
from .refused import Refusals
from .safety import BURST, Bucket, refuse_if
from .session import Session
from .sessions import UNKNOWN, Caller, Publish, Sessions
from .work import Schedule, WorkQueue, in_next_turn

Answer = Callable[[bytes], None]
"""Callback of a transport that sends an answer; it must not block."""
Subscriber = Callable[[str], None]
"""Callback of a transport that subscribes a connection to the stream of a session's name."""
Send = Callable[[AnyReply], None]
_QUAT_TOLERANCE = 1e-2
_STOP_PROTOCOL = 2
_MOST_PEERS = 1024
_ERRORS_PER_SECOND = 10.0
_SHARE = 0.5
"""Share of all changes of options that one client may make."""


class _Head(msgspec.Struct):
    """The fields that identify a request, which may be invalid elsewhere."""

    protocol: Any = None
    seq: Any = 0

    @property
    def number(self) -> int:
        """The number of the request; 0 if it is not one."""
        return self.seq if type(self.seq) is int and 0 <= self.seq <= 2**53 else 0


class _Peek(msgspec.Struct):
    """The fields of a sample that are read if its session is shed."""

    type: str = ""
    seq: Annotated[int, msgspec.Meta(ge=1, le=2**53)] = 1
    session: str = ""
    measured_q: Any = None


_SAMPLES = ("step", "sample")
NO_VALUE = b"\xc1"
"""The byte that begins no value in msgpack."""
# Invalid UTF-8 and excessive nesting raise errors other than msgspec's.
_UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
_decode = msgspec.msgpack.Decoder(AnyRequest).decode
_decode_peek = msgspec.msgpack.Decoder(_Peek).decode
_decode_head = msgspec.msgpack.Decoder(_Head).decode
encode_reply = msgspec.msgpack.Encoder().encode


def decode_request(payload: bytes) -> AnyRequest | Error:
    """Read and check one request.

    Args:
        payload: The message as received (msgpack).

    Returns:
        The request; or the error to answer with, which has the field at fault, and the number of
        the request if it can be read.
    """
    try:
        request = _decode(payload)
    except msgspec.ValidationError as error:
        return _invalid(payload, error)
    except _UNREADABLE as error:
        return _unreadable(payload, error)
    if request.protocol not in messages.PROTOCOLS:
        return _wrong_protocol(request.seq, request.protocol, messages.PROTOCOLS)
    if request.protocol < _STOP_PROTOCOL and isinstance(request, Stop | Clear):
        return _wrong_protocol(request.seq, request.protocol, (_STOP_PROTOCOL,))
    if _has_pose(request):
        for place, message in _wrong_poses(request):
            return Error(seq=request.seq, code="invalid", message=message, field=place)
    return request


def _invalid(payload: bytes, error: msgspec.ValidationError) -> Error:
    """Return what is wrong with a message that is no request.

    Its protocol comes first, because other versions may have other fields.
    """
    try:
        head = _decode_head(payload)
    except msgspec.ValidationError:
        # It is not a map.
        head = _Head()
    except _UNREADABLE as broken:
        # It breaks off behind what is invalid.
        return _unreadable(payload, broken)
    if type(head.protocol) is int and head.protocol not in messages.PROTOCOLS:
        return _wrong_protocol(head.number, head.protocol, messages.PROTOCOLS)
    message, path = _explain(error)
    return Error(seq=head.number, code="invalid", message=message, field=path)


def _wrong_protocol(seq: int, got: int, expected: tuple[int, ...]) -> Error:
    """Return the refusal of a request of another version."""
    return Error(
        seq=seq,
        code="protocol",
        field="protocol",
        message=f"expected version {' or '.join(map(str, expected))}, got {got}",
        protocols=messages.PROTOCOLS,
    )


def _unreadable(payload: bytes, error: Exception) -> Error:
    """Return the refusal of a message that is not msgpack, or that its transport did not read."""
    why = _why_unreadable(payload) or error
    return Error(code="invalid", message=f"not a message: {why}"[:200])


def _why_unreadable(payload: bytes) -> str:
    """Return what a transport that could not read a message says behind `NO_VALUE`, or nothing."""
    if payload.startswith(NO_VALUE):
        return payload[1:].decode(errors="replace")
    return ""


def _explain(error: msgspec.ValidationError) -> tuple[str, str]:
    """Return what msgspec complains of, in words that help a client, and the path of the value.

    msgspec only has a text, such as "Expected `float`, got `str` - at `$.q[1]`".
    """
    # That of a key is "- at `key` in `$.hands`".
    message, *places = (
        str(error).replace(" - at `key` in `$", " - at `$").rsplit(" - at `$", 1)
    )
    path = "".join(places).rstrip("`").lstrip(".")
    if not path:
        path = "".join(re.findall(r"field `(\w+)`$", message))
    if "matching regex" in message:
        message = f"expected {NAME}"
    elif path == "name" and message.startswith("Object contains unknown field"):
        message = (
            "by a session's name you may only watch it, and steer it if it is shared; "
            "this request requires its secret"
        )
    return message, path


def _has_pose(request: AnyRequest) -> TypeGuard[Step | Open | Reset]:
    """Return whether a request has a pose; most samples have none."""
    if isinstance(request, Step):
        own = request.wrist or request.base or request.object_pose
        return own is not None or request.hands is not None
    return isinstance(request, Open | Reset)


def _wrong_poses(request: Step | Open | Reset) -> Iterator[tuple[str, str]]:
    """Yield field and message of poses that cannot be used; infinity and NaN cannot either."""
    for name, pose in _poses(request):
        if pose is None:
            continue
        norm = math.hypot(*pose.quat_xyzw)
        far = math.hypot(*pose.position)
        if not abs(norm - 1.0) <= _QUAT_TOLERANCE:
            yield f"{name}.quat_xyzw", f"expected a unit quaternion, got norm {norm:g}"
        if not far <= LARGEST:
            message = f"expected at most {LARGEST:g} m from the origin, got {far:g} m"
            yield f"{name}.position", message


def _poses(request: Step | Open | Reset) -> list[tuple[str, Pose | None]]:
    """Return the poses of a request, with the paths of their fields."""
    if not isinstance(request, Step):
        return [("robot_wrist", request.robot_wrist)]
    poses = [
        ("wrist", request.wrist),
        ("base", request.base),
        ("object_pose", request.object_pose),
    ]
    for side, hand in (request.hands or {}).items():
        poses.append((f"hands.{side}.wrist", hand.wrist))
    return poses


def connection_rates(rate: float, clock: Callable[[], float]) -> tuple[Bucket, Bucket]:
    """Return the limits of a connection: of its messages, and of the errors that say so.

    Args:
        rate: Messages per second.
        clock: Monotonic clock [s].
    """
    return Bucket(rate, clock=clock), Bucket(_ERRORS_PER_SECOND, 1.0, clock)


class Backend(Protocol):
    """What answers the messages of transports: a `Dispatcher`, or worker processes.

    Attributes:
        stream_port: Port of the stream, as `opened` reports it.
    """

    stream_port: int

    @property
    def publish(self) -> list[Publish]:
        """Callbacks that receive the messages of all streams."""
        ...

    @property
    def load(self) -> LoadMeter:
        """Load of the server's own process."""
        ...

    @property
    def names(self) -> Names:
        """Public names of the open sessions."""
        ...

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
        ...

    def tick(self) -> float:
        """Run the watchdogs; return the time until one may act next [s]."""
        ...

    async def close(self) -> None:
        """Close all sessions."""
        ...


class Dispatcher:
    """Answer messages.

    Args:
        sessions: The open sessions.

    Attributes:
        sessions: As given.
        stream_port: Port of the stream, as `opened` reports it.
        schedule: Calls a function in a later turn of the event loop, so that all messages that have
            arrived are read before the next sample is mapped; None maps samples at once that are
            answered.
    """

    def __init__(self, sessions: Sessions) -> None:
        self.schedule: Schedule | None = None
        self.sessions = sessions
        self.stream_port = 0
        self._settings = sessions.settings
        self._metrics = sessions.metrics
        self._by = UNKNOWN
        self._started = sessions.clock()
        self._version = version("handmap-qp")
        configures = self._settings.configures
        self._configures = Bucket(configures, clock=sessions.clock)
        # One client may use up a half of them.
        self._configures_of = AccountBuckets(
            _SHARE * configures, _SHARE * BURST * configures, sessions.clock
        )
        # There is no common limit, because a few clients above the rate would shut out the others.
        self._rates = lru_cache(_MOST_PEERS)(self._new_rates)
        self._work = WorkQueue(lambda: sessions.clock())
        self._opening = {}
        # The last command of a stream, which mostly is an answer, too.
        self._published: tuple[Command | None, bytes] = (None, b"")
        self._refusals = Refusals(self._metrics)
        self._bugs = Throttle()
        self._metrics.gauges["sessions"] = lambda: len(self.sessions.by_secret)
        self._metrics.gauges["uptime_seconds"] = self._uptime
        load = sessions.load
        self._metrics.gauges["load"] = lambda: load.last.load
        self._metrics.gauges["samples_per_second"] = lambda: load.last.rate
        self._metrics.gauges["wait_seconds"] = lambda: load.last.wait
        self._metrics.gauges["shed_sessions"] = lambda: len(load.shed)

    @property
    def publish(self) -> list[Publish]:
        """Callbacks that receive the messages of all streams."""
        return self.sessions.publish

    @property
    def load(self) -> LoadMeter:
        """See `Sessions.load`."""
        return self.sessions.load

    @property
    def names(self) -> Names:
        """Public names of the open sessions, in the order of their opening."""
        return self.sessions.names

    def receive(
        self,
        payload: bytes,
        peer: Hashable,
        answer: Answer,
        *,
        subscribe: Subscriber | None = None,
        by: Caller = UNKNOWN,
    ) -> bool:
        """Handle one message; call it from the event loop.

        Args:
            payload: The message as received (msgpack).
            peer: The connection that it came from.
            answer: Called with the answer, now or later. A streamed sample that can be read has no
                answer.
            subscribe: Subscribes the connection to a stream; None if the transport has no such
                streams.
            by: The client.

        Returns:
            False if the rate limit rejected the message unread.
        """

        def send(reply: AnyReply) -> None:
            command, encoded = self._published
            answer(encoded if reply is command else encode_reply(reply))

        samples, errors = self._rates(peer)
        self._by = by
        self._metrics.counts["requests"] += 1
        if not samples.take():
            self._metrics.refusals["rate"] += 1
            if errors.take():
                send(Error(code="rate", message="too many messages"))
            return False
        if self.sessions.load.shed and self._refuse_unread(payload, send):
            return True
        request = decode_request(payload)
        if isinstance(request, Error):
            send(self._refusals.counted(request))
        else:
            self._carry_out(request, payload, send, subscribe)
        return True

    def _refuse_unread(self, payload: bytes, send: Send) -> bool:
        """Refuse a sample of a session that is shed, before it takes more time.

        Returns:
            Whether it was one. A sample with joints that are measured is read all the same.
        """
        try:
            peek = _decode_peek(payload)
        except _UNREADABLE:
            return False
        load = self.sessions.load
        session = self.sessions.by_secret.get(peek.session)
        if session is None or session.name not in load.shed:
            return False
        if peek.type not in _SAMPLES or peek.measured_q is not None:
            return False
        try:
            self.sessions.find(peek.session, self._by).counts["busy"] += 1
            load.refuse_sample(len(self.sessions.by_secret))
        except RefusedError as error:
            reply = self._failure(peek.seq, error)
        if peek.type == "step" or reply.code != "busy":
            send(reply)
        elif load.may_say(session.name):
            self.sessions.send(session.name, encode_reply(reply))
        return True

    def _carry_out(
        self,
        request: AnyRequest,
        payload: bytes,
        send: Send,
        subscribe: Subscriber | None,
    ) -> None:
        """Carry out a request, or let it wait for its turn."""
        match request:
            case Sample():
                self._receive_sample(request, send)
            case Step() if self.schedule is not None:
                self._wait(request, payload, send, self.schedule)
            case Touch():
                # It does not move the robot, so that its order does not matter.
                send(self._attempt(self._touch, request))
            case Stop() | Disengage():
                self._overtake(request)
                send(self._attempt(self._answer, request, payload))
            case Open():
                self._receive_open(request, payload, send)
            case Subscribe():
                send(self._attempt(self._subscribe, request, subscribe))
            case _ if self.schedule and self._work.is_waiting(request.session):
                # A client's own requests keep their order.
                self._wait(request, payload, send, self.schedule)
            case _:
                send(self._attempt(self._answer, request, payload))

    def _receive_sample(self, sample: Sample, send: Send) -> None:
        """Let a streamed sample wait for its turn, of each session the newest."""
        by = self._by

        def run() -> None:
            reply = self._attempt(self._for_stream, sample, by)
            if isinstance(reply, Error):
                send(reply)

        schedule = self.schedule or in_next_turn
        if self._work.put((by, sample.session), run, schedule):
            self._metrics.counts["replaced"] += 1
            self.sessions.load.note_replaced()

    def _wait(
        self, request: AnyRequest, payload: bytes, send: Send, schedule: Schedule
    ) -> None:
        """Let a request wait for its turn, which is answered then."""
        by = self._by

        def run() -> None:
            self._by = by
            send(self._attempt(self._answer, request, payload))

        is_mapping = isinstance(request, Step)
        try:
            self._work.add(request.session, run, schedule, is_mapping=is_mapping)
        except RefusedError as error:
            send(self._failure(request.seq, error))

    def _overtake(self, request: Stop | Disengage) -> None:
        """Let a request that stops a robot overtake the samples that wait.

        A sample of the same client that has a lower number is then `stale`.
        """
        by = self._by
        if request.session:
            self._work.overtake(request.session)
        elif request.name is None:
            self._work.overtake_all()
        elif session := self.sessions.find_named(request.name):
            self._work.overtake(session.request.session)
        # What was carried out may be of other clients.
        self._by = by

    def tick(self) -> float:
        """Run the watchdogs and close idle sessions.

        Returns:
            Time until a watchdog may act next if no request comes [s]; not above 0 for at once.
        """
        now = self.sessions.clock()
        if now >= self.sessions.load.ends:
            self._measure_load(now)
        due = math.inf
        for session in list(self.sessions.by_secret.values()):
            is_idle = now - session.last_request > self._settings.idle
            if is_idle and not session.will_move:
                self.sessions.end(session, "closed: its client was silent too long")
                continue
            try:
                self._tick(session, now)
            except Exception as error:
                # The watchdogs of the other sessions must continue.
                self._failure(0, error)
            due = min(due, session.due)
        return due - now

    async def close(self) -> None:
        """Close all sessions."""
        tasks = [*self._opening.values()]
        for task in tasks:
            task.cancel()
        self.sessions.close()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _new_rates(self, _peer: Hashable) -> tuple[Bucket, Bucket]:
        """Return the limits of a connection: of its messages, and of the errors that say so."""
        return connection_rates(self._settings.rate, self.sessions.clock)

    def _measure_load(self, now: float) -> None:
        """End a window of the load, and say whose samples are refused from now on."""
        load = self.sessions.load
        before = load.shed
        load.update(now, self.sessions.names)
        if load.shed == before:
            return
        report(
            WARNING,
            "overload" if load.shed - before else "served_again",
            shed=sorted(load.shed),
            load=round(load.last.load, 3),
            samples_per_second=round(load.last.rate),
            wait_seconds=round(load.last.wait, 4),
        )

    def _uptime(self) -> float:
        return self.sessions.clock() - self._started

    def _tick(self, session: Session, now: float) -> None:
        if command := session.tick(now):
            if session.name in self.sessions.load.shed:
                # A stream keeps the newest message, so the error may be lost behind this one.
                command = structs.replace(command, flags=(*command.flags, "busy"))
            self._send(session, command)

    def _for_stream(self, sample: Sample, by: Caller) -> None:
        """Map a streamed sample; its command, or why there is none, is in the stream."""
        session = self.sessions.find(sample.session, by)
        if sample.seq <= session.seq:
            session.counts["stale"] += 1
        else:
            session.seq = sample.seq
            session.payload = b""
            reply = self._attempt(self._act, sample, session)
            if isinstance(reply, Error):
                self.sessions.send(session.name, encode_reply(reply))

    def _subscribe(self, request: Subscribe, subscribe: Subscriber | None) -> None:
        """Subscribe a connection to the stream of a session, as everyone may."""
        self.sessions.named(request.name)
        if not subscribe:
            raise RefusedError(
                "invalid",
                "connect a SUB socket to the stream's port instead",
                field="type",
            )
        subscribe(stream_of(request))

    def _answer(self, request: AnyRequest, payload: bytes) -> AnyReply | None:
        """Answer a request at once; repeat the last answer if a session's client repeats itself."""
        if isinstance(request, Named) and request.name is not None:
            return self._by_name(request)
        if not request.session and isinstance(request, Status | Stop):
            return self._for_all(request)
        session = self.sessions.find(request.session, self._by)
        if request.seq == session.seq and payload == session.payload:
            return session.answer
        if request.seq <= session.seq:
            message = f"expected a number above {session.seq}, got {request.seq}"
            raise RefusedError("stale", message, field="seq")
        session.seq = request.seq
        session.payload = payload
        session.answer = self._attempt(self._act, request, session)
        return session.answer

    def _by_name(self, request: Named) -> AnyReply | None:
        """Answer a request by a session's public name.

        Everyone may ask and stop, owner and supervisor may clear, and tell joints; all else needs
        `is_shared`.
        """
        session = self.sessions.named(request.name or "")
        by = self._by
        refuse_if(request.session, "give session or name, not both", "name")
        may_clear = by.key in self._settings.supervisor or by.owner("") == session.owner
        free = Status | Stop | Clear | Measured | Touch if may_clear else Status | Stop
        is_alien = not (session.request.is_shared or isinstance(request, free))
        message = f"session {request.name!r} was not opened with is_shared: only its owner may"
        refuse_if(is_alien, message, "name", "denied")
        return self._act(request, session)

    def _for_all(self, request: Status | Stop) -> AnyReply | None:
        """Answer a request about the server, or stop the robots of all sessions."""
        if isinstance(request, Status):
            cache = self.sessions.cache
            load = self.sessions.load
            return State(
                seq=request.seq,
                version=self._version,
                uptime=self._uptime(),
                names=self.sessions.names,
                counts=dict(self._metrics.counts),
                robots=cache.robots,
                missing=cache.missing,
                two_handed=cache.two_handed,
                stream_port=self.stream_port,
                load=_known(load.last.load),
                samples_per_second=load.last.rate,
                busy=tuple(sorted(load.shed)),
            )
        self.sessions.audit.note("stop", self._by, **_changes(request))
        for session in list(self.sessions.by_secret.values()):
            self._attempt(self._act, request, session)
        return None

    def _attempt(
        self, work: Callable[..., AnyReply | None], request: Request, *values: Any
    ) -> AnyReply:
        """Return what `work` answers, `Done` if nothing, or the error to answer with."""
        try:
            return work(request, *values) or Done(seq=request.seq)
        except Exception as error:
            return self._failure(request.seq, error)

    def _act(self, request: Request, session: Session) -> AnyReply | None:
        """Carry out a request for a session."""
        now = self.sessions.clock()
        match request:
            case Step():
                if self.sessions.load.shed:
                    self._check_load(request, session, now)
                command = session.step(request, now)
                self._metrics.counts["steps"] += 1
                took = self.sessions.clock() - now
                self._metrics.note_step(took)
                self.sessions.load.note(session.name, self._work.waited, took)
                self._send(session, command)
                return command
            case Status():
                state = session.state(request.seq, self._version, self.stream_port, now)
                return self._with_load(state, session.name)
            case Close():
                self.sessions.end(session, "closed by its client", self._by)
                return None
            case Measured():
                session.measure(request, now)
                return None
            case Touch():
                self._feel(request, session)
                return None
        self._change(request, session, now)
        event = type(request).__name__.lower()
        self.sessions.audit.note(
            event, self._by, session=session.name, **_changes(request)
        )
        # A release must outlive the server as well as a posture.
        self.sessions.note(session)
        return None

    def _with_load(self, state: State, name: str) -> State:
        """Return the state of a session with what it takes of the server."""
        load = self.sessions.load
        busy = (name,) if name in load.shed else ()
        share = load.last.shares.get(name, 0.0)
        return structs.replace(state, load=share, busy=busy)

    def _check_load(self, sample: Step, session: Session, now: float) -> None:
        """Refuse a sample of a session that the server has no time for."""
        load = self.sessions.load
        if session.name not in load.shed:
            return
        # Joints that are measured are noted all the same, so that the robot does not count as lost.
        session.measure(sample, now)
        session.counts["busy"] += 1
        load.refuse_sample(len(self.sessions.by_secret))

    def _change(self, request: Request, session: Session, now: float) -> None:
        """Carry out a request that the audit log keeps."""
        match request:
            case Configure():
                self._limit_configures()
                session.configure(request)
            case Reset():
                session.reset(request, now)
            case Engage():
                session.clutch()
            case Disengage():
                session.release()
            case Clear():
                session.clear(request.stop)
            case Stop():
                session.stop()
                # The stream must not wait for the next tick.
                self._tick(session, now)

    def _limit_configures(self) -> None:
        """Refuse a change of options beyond the rate of all, or beyond the client's share."""
        by = self._by
        is_due = by.is_anonymous or self._configures_of.take(by.account)
        is_due = is_due and self._configures.take()
        limit = f"more than {self._settings.configures:g} changes of options a second"
        refuse_if(not is_due, f"{limit}: try again later", code="rate")

    def _receive_open(self, request: Open, payload: bytes, send: Send) -> None:
        """Open a session in a task; a repeated request gets the same answer."""
        session = self.sessions.by_secret.get(request.session)
        if session and payload == session.payload:
            send(session.answer)
            return
        if not (task := self._opening.get(payload)):
            opening = self._open(request, payload, self._by)
            task = asyncio.create_task(opening)
            self._opening[payload] = task
        task.add_done_callback(lambda done: done.cancelled() or send(done.result()))

    async def _open(self, request: Open, payload: bytes, by: Caller) -> AnyReply:
        """Open a session; return the answer."""
        try:
            session = await self.sessions.open(request, by)
            session.payload = payload
            session.answer = session.opened(request.seq, self.stream_port)
            return session.answer
        except Exception as error:
            return self._failure(request.seq, error)
        finally:
            del self._opening[payload]

    def _send(self, session: Session, command: Command) -> None:
        """Note and publish a command."""
        self.sessions.note(session)
        encoded = encode_reply(command)
        self._published = command, encoded
        self.sessions.send(session.name, encoded)

    def _touch(self, request: Touch) -> AnyReply | None:
        """Pass on what fingers feel; numbers of samples do not become stale by it."""
        if request.name is not None:
            return self._by_name(request)
        self._feel(request, self.sessions.find(request.session, self._by))
        return None

    def _feel(self, request: Touch, session: Session) -> None:
        """Pass on what fingers feel to who subscribed to it."""
        haptics = haptics_of(request, session.name, session.robot)
        self.sessions.send(session.name + HAPTICS_END, encode_reply(haptics))

    def _failure(self, seq: int, error: Exception) -> Error:
        """Return the error to answer with; log an unexpected one."""
        if not isinstance(error, RefusedError):
            self._bugs.report(ERROR, "failed", failure=error)
            message = "the server failed at this request; see its log"
            error = RefusedError("internal", message)
        return self._refusals.answer(seq, error)


def _known(load: float) -> float | None:
    """Return a load; None if it is not measured."""
    return None if math.isnan(load) else load


def _changes(request: Request) -> dict[str, Any]:
    """Return the fields of a request that the audit log keeps: those that were given."""
    left_out = {"type", "protocol", "seq", "session", "name"}
    given = msgspec.to_builtins(request).items()
    return {name: value for name, value in given if name not in left_out and value}
