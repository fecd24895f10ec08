"""The open sessions of a server: open, find and end them."""

from __future__ import annotations

import asyncio
import math
import secrets
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from logging import INFO
from typing import Any, TypeVar

from handmap_qp.apps.service.decoding import encode_reply
from handmap_qp.apps.service.logs import AuditLog, report
from handmap_qp.apps.service.metrics import Metrics
from handmap_qp.apps.service.opening import Calibration, HandCache, Hands, prepare_hands
from handmap_qp.apps.service.rate_limit import Bucket
from handmap_qp.apps.service.session import Session
from handmap_qp.apps.service.settings import Settings
from handmap_qp.apps.service.states import LEASE, Caller, refusal
from handmap_qp.apps.service.store import PostureStore, Record
from handmap_qp.client.messages import Error, Open
from handmap_qp.errors import RefusedError

_SHORTEST_SECRET = 16
_REMEMBERED = 1024

_T = TypeVar("_T")
Publish = Callable[[str, bytes], None]
"""Takes a session's name and a message of its stream (msgpack)."""


@dataclass(slots=True, eq=False)
class Entry:
    """A session with its last request and answer.

    The answer is sent again if the same request arrives again.

    Attributes:
        session: The session.
        seq: Number of the request.
        payload: The request as received.
        answer: Its encoded answer.
    """

    session: Session
    seq: int
    payload: bytes
    answer: bytes = b""


class Sessions:
    """The open sessions.

    Args:
        settings: Limits of what clients may do.
        cache: The hands that clients may open.
        metrics: Counters.
        store: Records of former sessions.
        clock: Monotonic clock [s].
        audit: Record of who did what.

    Attributes:
        entries: Sessions by their secrets.
        publish: Callbacks that receive the messages of all streams.
        is_preparing: Whether the opening thread loads a hand, which it does not stop on request.
    """

    def __init__(
        self,
        settings: Settings,
        cache: HandCache,
        metrics: Metrics,
        store: PostureStore,
        clock: Callable[[], float],
        audit: AuditLog,
    ) -> None:
        self.entries: dict[str, Entry] = {}
        self.publish: list[Publish] = []
        self.is_preparing = False
        self._audit = audit
        self._settings, self._cache, self._metrics = settings, cache, metrics
        self._store, self._clock = store, clock
        # Single worker, so that opening sessions cannot starve running ones.
        self._executor = ThreadPoolExecutor(1, "handmap-open")
        self._opens = Bucket(settings.opens, clock(), burst=settings.sessions)
        self._names_opening: set[str] = set()
        self._ended: OrderedDict[str, str] = OrderedDict()
        # After a restart, owners are on their way back.
        self._last_heard = dict.fromkeys(store.records, clock())
        self._last_name = 0

    @property
    def names(self) -> tuple[str, ...]:
        """Public names of the open sessions."""
        return tuple(entry.session.name for entry in self.entries.values())

    def find(self, secret: str) -> Entry:
        """Return the session of a secret, and renew its lease.

        Raises:
            RefusedError: `no_session` if there is none, `taken` if another client took it over.
        """
        entry = self.entries.get(secret)
        if entry is not None:
            entry.session.last_request = self._clock()
            return entry
        if self._ended.get(secret) == "taken":
            raise RefusedError(
                "taken", "another client took this session over", field="session"
            )
        raise RefusedError("no_session", "no such session; open one", field="session")

    def named(self, name: str) -> Session:
        """Return the open session of a public name.

        Raises:
            RefusedError: If there is none.
        """
        session = self._find_named(name)
        if session is None:
            raise _invalid("name", f"no session {name!r}")
        return session

    async def open(self, request: Open, payload: bytes, by: Caller) -> Session:
        """Open a session.

        Args:
            request: The request.
            payload: The request as received.
            by: The client.

        Raises:
            RefusedError: With the field at fault, or `busy`, `rate`, `denied`.
        """
        self._check(request, by)
        name = request.name or self._new_name()
        self._names_opening.add(name)
        try:
            work = self._submit(lambda: self._prepare(request))
            hands, calibration = await asyncio.wrap_future(work)
            robot = hands.mapper.robot
            # The client of the former session may have returned meanwhile.
            self._check_owner(request, by)
            former = self._former(request, name, robot.name, len(robot.joint_names))
            running = None if former is None else self._find_named(name)
            session = Session(
                request,
                hands,
                name,
                self._clock(),
                calibration=calibration,
                former=former,
                owner=by.owner(request.session),
                motion=None if running is None else running.motion,
            )
        finally:
            self._names_opening.discard(name)
        # A stop also outlives a session that is not restored.
        if (last := self._store.records.get(name)) is not None and last.stop:
            session.stop(last.stop)
        for secret, entry in list(self.entries.items()):
            if entry.session.name == name:
                self.end(secret, "taken", "a client restored this session", by=by)
        self._last_heard.pop(name, None)
        self.entries[request.session] = Entry(session, request.seq, payload)
        self.note(session)
        self._metrics.counts["opened"] += 1
        event: dict[str, Any] = {
            "session": name,
            "robot": robot.name,
            "restored": former is not None,
        }
        self._audit.note("opened", by, **event)
        report(INFO, "opened", input=request.input, **event)
        return session

    def note(self, session: Session) -> None:
        """Note where a session is, if that is to outlive the server.

        Without a file, it is noted when the session ends.
        """
        if self._store.is_persistent:
            self._store.note(session.record)

    def end(
        self, secret: str, code: str, reason: str, *, by: Caller | str = "server"
    ) -> None:
        """Close a session.

        Args:
            secret: Secret of the session.
            code: Error code for clients that go on using it.
            reason: The reason for stream and log.
            by: Who ends it, for the audit log.
        """
        session = self.entries.pop(secret).session
        self._store.note(session.record)
        self._ended[secret] = code
        if len(self._ended) > _REMEMBERED:
            self._ended.popitem(last=False)
        self.send(session.name, encode_reply(Error(code=code, message=reason)))
        self._audit.note("closed", by, session=session.name, reason=reason)
        report(
            INFO,
            "closed",
            session=session.name,
            reason=reason,
            counts=dict(session.counts),
        )

    def send(self, name: str, payload: bytes) -> None:
        """Publish a message in the stream of a session."""
        for publish in self.publish:
            publish(name, payload)

    def close(self) -> None:
        """Close all sessions."""
        for secret in list(self.entries):
            self.end(secret, "no_session", "the server stops")
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _prepare(self, request: Open) -> tuple[Hands, Calibration | None]:
        """Load the hands of a session, and what measures the human hand if that is needed."""
        hands = prepare_hands(request, self._cache)
        if not hands.needs_measuring:
            return hands, None
        return hands, Calibration(request, self._cache, self._submit)

    def _submit(self, work: Callable[[], _T]) -> Future[_T]:
        """Run work in the opening thread."""

        def run() -> _T:
            self.is_preparing = True
            try:
                return work()
            finally:
                self.is_preparing = False

        return self._executor.submit(run)

    def _check(self, request: Open, by: Caller) -> None:
        """Refuse requests that can be refused before hands are loaded."""
        if len(request.session) < _SHORTEST_SECRET:
            raise _invalid(
                "session", f"expected at least {_SHORTEST_SECRET} random characters"
            )
        last = self._find_named(request.name)
        held = self.entries.get(request.session)
        is_newer = held is not None and request.seq > held.seq
        if held is not None and not (
            request.restore and held.session is last and is_newer
        ):
            raise _invalid(
                "session", "a session with this secret exists: choose another one"
            )
        is_replacing = last is not None and request.restore
        if (
            len(self.entries) + len(self._names_opening) - is_replacing
            >= self._settings.sessions
        ):
            raise RefusedError(
                "busy", f"all {self._settings.sessions} sessions are taken"
            )
        if not self._opens.take(self._clock()):
            message = f"more than {self._settings.opens:g} sessions opened a second"
            raise RefusedError("rate", f"{message}: try again later")
        if request.time_from == "client" and not self._settings.simulated_time:
            message = (
                "the server uses its own clock (see handmap serve --simulated-time)"
            )
            raise RefusedError("denied", message, field="time_from")
        self._check_name(request, last, by)

    def _check_name(self, request: Open, last: Session | None, by: Caller) -> None:
        """Refuse a name that is in use, or that the client must not have."""
        if request.name in self._names_opening:
            raise RefusedError(
                "busy", f"session {request.name!r} is being opened", field="name"
            )
        if last is not None and not request.restore:
            raise _invalid(
                "name", f"session {request.name!r} exists: restore=true takes it over"
            )
        self._check_owner(request, by)
        if request.restore and request.name is None:
            raise _invalid("name", "missing: restore needs the name of the session")

    def _find_named(self, name: str | None) -> Session | None:
        """Return the open session of a name, if there is one."""
        return next(
            (
                entry.session
                for entry in self.entries.values()
                if entry.session.name == name
            ),
            None,
        )

    def _check_owner(self, request: Open, by: Caller) -> None:
        """Refuse a name to a client that must not have it, or must not yet."""
        name, running = request.name or "", self._find_named(request.name)
        held = running or self._store.records.get(name)
        heard = (
            running.last_request if running else self._last_heard.get(name, -math.inf)
        )
        is_attended = self._clock() - heard <= LEASE
        # Without `restore`, a name is free after the lease.
        if held is None or not (request.restore or is_attended):
            return
        is_rival = running is not None and request.session not in self.entries
        client = by.owner(request.session)
        if code := refusal(
            held.owner, client, is_attended=is_attended, is_rival=is_rival
        ):
            reasons = {
                "busy": f"is in use until {LEASE:g} s after its owner's last request"
            }
            reason = reasons.get(code, "belongs to another key")
            raise RefusedError(code, f"session {name!r} {reason}", field="name")

    def _former(
        self, request: Open, name: str, robot: str, joints: int
    ) -> Record | None:
        """Return the record of the former session of this name, if the request asks for it."""
        if not request.restore:
            return None
        running = self._find_named(name)
        if running is not None:
            self._store.note(running.record)
        found = self._store.find(name, robot, joints)
        if found is None and request.robot_q is None:
            message = f"no record of a session {name!r}: give the robot's joint angles in robot_q"
            raise _invalid("restore", message)
        return found

    def _new_name(self) -> str:
        """Return a name that is unique also over restarts, because others may watch it."""
        self._last_name += 1
        return f"session-{self._last_name}-{secrets.token_hex(3)}"


def _invalid(field: str, message: str) -> RefusedError:
    return RefusedError("invalid", message, field=field)
