"""The open sessions of a server: open, find and end them."""

import asyncio
import hashlib
import hmac
import itertools
import math
import secrets
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from logging import INFO
from typing import NamedTuple

import msgspec

from handmap_qp.client.messages import Error, Open
from handmap_qp.errors import RefusedError
from handmap_qp.hands import Names, Values
from .logs import AuditLog, Metrics, report
from .opening import HandCache, prepare_hands
from .safety import Bucket, refuse_if
from .session import Session
from .settings import Settings
from .store import PostureStore

LEASE = 2.0
"""Time after a request of its owner in which nobody else may have a session [s]."""
_SHORTEST_SECRET = 16
_REMEMBERED = 1024

Publish = Callable[[str, bytes], None]
"""Takes a session's name and a message of its stream (msgpack)."""


class Caller(NamedTuple):
    """A client: its address, and the name of its key, empty without keys."""

    address: str = "unknown"
    key: str = ""

    def __str__(self) -> str:
        return f"{self.key}@{self.address}" if self.key else self.address

    def owner(self, secret: str) -> str:
        """Return who owns a session of this client: a digest of its key, or else of the secret."""
        proof = self.key or secret
        digest = hashlib.sha256(proof.encode(errors="surrogatepass")).hexdigest()
        return f"{'key' if self.key else 'secret'}:{digest}"


UNKNOWN = Caller()
"""A client of which nothing is known."""


def refusal(owner: str, client: str, *, is_attended: bool, is_rival: bool) -> str:
    """Return why a client may not continue a session: `busy`, `denied`, or empty if it may.

    Args:
        owner: Owner of the session; empty if its record is older than owners.
        client: Owner that the session would have.
        is_attended: Whether the owner's lease runs.
        is_rival: Whether the session runs under another secret than the client's.
    """
    is_owner = hmac.compare_digest(owner, client)
    if owner.startswith("key:") and not is_owner:
        return "denied"
    return "busy" if is_attended and (is_rival or not is_owner) else ""


@dataclass(eq=False)
class Sessions:
    """The open sessions.

    Attributes:
        settings: Limits of what clients may do.
        cache: The hands that clients may open.
        metrics: Counters.
        store: Records of former sessions; in memory if omitted.
        audit: Record of who did what; none if omitted.
        clock: Monotonic clock [s].
        by_secret: Sessions by their secrets.
        publish: Callbacks that receive the messages of all streams.
    """

    settings: Settings
    cache: HandCache
    metrics: Metrics
    store: PostureStore = field(default_factory=lambda: PostureStore(None))
    audit: AuditLog = field(default_factory=AuditLog)
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        """Begin without sessions."""
        self.by_secret: dict[str, Session] = {}
        self.publish: list[Publish] = []
        # Single worker, so that opening sessions cannot starve running ones.
        self._executor = ThreadPoolExecutor(1, "handmap-open")
        self._opens = Bucket(self.settings.opens, self.settings.sessions, self.clock)
        # Names of the sessions that are being opened, by their secrets.
        self._opening: dict[str, str] = {}
        self._ended: dict[str, str] = {}
        # After a restart, owners are on their way back.
        self._last_heard = dict.fromkeys(self.store.records, self.clock())
        self._numbers = itertools.count(1)

    @property
    def names(self) -> Names:
        """Public names of the open sessions."""
        return tuple(session.name for session in self.by_secret.values())

    def find(self, secret: str) -> Session:
        """Return the session of a secret, and renew its lease.

        Raises:
            RefusedError: `no_session` if there is none, `taken` if another client took it over.
        """
        if session := self.by_secret.get(secret):
            session.last_request = self.clock()
            return session
        refuse_if(
            self._ended.get(secret) == "taken",
            "another client took this session over",
            "session",
            "taken",
        )
        raise RefusedError("no_session", "no such session; open one", field="session")

    def named(self, name: str) -> Session:
        """Return the open session of a public name.

        Raises:
            RefusedError: If there is none.
        """
        if not (session := self._find_named(name)):
            raise RefusedError("invalid", f"no session {name!r}", field="name")
        return session

    async def open(self, request: Open, by: Caller) -> Session:
        """Open a session.

        Args:
            request: The request.
            by: The client.

        Raises:
            RefusedError: With the field at fault, or `busy`, `rate`, `denied`.
        """
        self._check(request, by)
        # Else a name that is unique also over restarts, because others may watch it.
        name = request.name or f"session-{next(self._numbers)}-{secrets.token_hex(3)}"
        self._opening[request.session] = name
        try:
            defer = self._executor.submit
            work = defer(prepare_hands, request, self.cache, defer=defer)
            hands = await asyncio.wrap_future(work)
            robot = hands.mapper.robot
            # The client of the former session may have returned meanwhile.
            self._check_owner(request, by)
            running = self._find_named(name)
            former = None
            if request.restore:
                if running:
                    self.store.note(running.record)
                former = self.store.find(name, robot.name, len(robot.joint_names))
                refuse_if(
                    former is None and request.robot_q is None,
                    f"no record of a session {name!r}: give the robot's joint angles in robot_q",
                    "restore",
                )
            now = self.clock()
            session = Session(
                request,
                hands,
                name,
                now,
                former=former,
                owner=by.owner(request.session),
                motion=running.motion if running else None,
                waited=running.since_command(now) if running else 0.0,
            )
        finally:
            del self._opening[request.session]
        # A stop also outlives a session that is not restored.
        if (last := self.store.records.get(name)) and last.stop:
            session.stop(last.stop)
        if running:
            self.end(running, "a client restored this session", by, "taken")
        self._last_heard.pop(name, None)
        self.by_secret[request.session] = session
        self.note(session)
        self.metrics.counts["opened"] += 1
        event: Values = {
            "session": name,
            "robot": robot.name,
            "restored": former is not None,
        }
        self.audit.note("opened", by, **event)
        report(INFO, "opened", input=request.input, **event)
        return session

    def note(self, session: Session) -> None:
        """Note where a session is, if that is to outlive the server.

        Without a file, it is noted when the session ends.
        """
        if self.store.is_persistent:
            self.store.note(session.record)

    def end(
        self,
        session: Session,
        reason: str,
        by: Caller | str = "server",
        code: str = "no_session",
    ) -> None:
        """Close a session.

        Args:
            session: The session.
            reason: The reason for stream and log.
            by: Who ends it, for the audit log.
            code: Error code for clients that go on using it.
        """
        secret = session.request.session
        del self.by_secret[secret]
        self.store.note(session.record)
        self._ended[secret] = code
        if len(self._ended) > _REMEMBERED:
            del self._ended[next(iter(self._ended))]
        self.send(
            session.name, msgspec.msgpack.encode(Error(code=code, message=reason))
        )
        event: Values = {"session": session.name, "reason": reason}
        self.audit.note("closed", by, **event)
        report(INFO, "closed", **event, counts=session.counts)

    def send(self, name: str, payload: bytes) -> None:
        """Publish a message in the stream of a session."""
        for publish in self.publish:
            publish(name, payload)

    def close(self) -> None:
        """Close all sessions."""
        for session in list(self.by_secret.values()):
            self.end(session, "the server stops")
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _check(self, request: Open, by: Caller) -> None:
        """Refuse requests that can be refused before hands are loaded."""
        name = request.name
        last = self._find_named(name)
        held = self.by_secret.get(request.session)
        most = self.settings.sessions
        is_another = held is not None and not (
            held is last and request.restore and request.seq > held.seq
        )
        is_replacing = last is not None and request.restore
        count = len(self.by_secret) + len(self._opening) - is_replacing
        refuse_if(
            len(request.session) < _SHORTEST_SECRET,
            f"expected at least {_SHORTEST_SECRET} random characters",
            "session",
        )
        refuse_if(
            is_another,
            "a session with this secret exists: choose another one",
            "session",
        )
        refuse_if(count >= most, f"all {most} sessions are taken", code="busy")
        refuse_if(
            request.time_from == "client" and not self.settings.simulated_time,
            "the server uses its own clock (see handmap serve --simulated-time)",
            "time_from",
            "denied",
        )
        refuse_if(
            name in self._opening.values(),
            f"session {name!r} is being opened",
            "name",
            "busy",
        )
        refuse_if(
            request.session in self._opening,
            "a session with this secret is being opened",
            code="busy",
        )
        refuse_if(
            last and not request.restore,
            f"session {name!r} exists: restore=true takes it over",
            "name",
        )
        refuse_if(
            request.restore and name is None,
            "missing: restore needs the name of the session",
            "name",
        )
        refuse_if(
            not self._opens.take(),
            f"more than {self.settings.opens:g} sessions opened a second: try again later",
            code="rate",
        )
        self._check_owner(request, by)

    def _find_named(self, name: str | None) -> Session | None:
        """Return the open session of a name, if there is one."""
        return next(
            (each for each in self.by_secret.values() if each.name == name), None
        )

    def _check_owner(self, request: Open, by: Caller) -> None:
        """Refuse a name to a client that must not have it, or must not yet."""
        name = request.name or ""
        running = self._find_named(name)
        held = running or self.store.records.get(name)
        heard = (
            running.last_request if running else self._last_heard.get(name, -math.inf)
        )
        is_attended = self.clock() - heard <= LEASE
        # Without `restore`, a name is free after the lease.
        if not held or not (request.restore or is_attended):
            return
        is_rival = running is not None and request.session not in self.by_secret
        client = by.owner(request.session)
        code = refusal(held.owner, client, is_attended=is_attended, is_rival=is_rival)
        busy = f"is in use until {LEASE:g} s after its owner's last request"
        reason = busy if code == "busy" else "belongs to another key"
        refuse_if(code, f"session {name!r} {reason}", "name", code)
