"""The open sessions of a server: open, find and end them."""

import asyncio
import hashlib
import hmac
import math
import secrets
import time
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, field
from functools import partial
from logging import INFO
from typing import NamedTuple

import msgspec

from handmap_core.client.messages import Error, Open
from handmap_core.errors import RefusedError
from handmap_qp.hands import Names, Values
from .fairness import AccountBuckets, FairWorker, has_share, largest_account
from .load import LoadMeter
from .logs import AuditLog, Metrics, report
from .opening import HandCache, prepare_hands
from .safety import refuse_if
from .session import Session
from .settings import Settings
from .store import MOST_NAMES, PostureStore, Record, names_account

LEASE = 2.0
"""Time after a request of its owner in which nobody else may have a session [s]."""
WEB = "web"
"""What the addresses of clients over WebSocket begin with."""
_SHORTEST_SECRET = 16
_REMEMBERED = 1024

Publish = Callable[[str, bytes], None]
"""Takes a session's name and a message of its stream (msgpack)."""
Listener = Callable[[Session, bool], None]
"""Takes a session, and whether it was opened; if not, it has ended."""


class Caller(NamedTuple):
    """A client: its address, and the name of its key, empty without keys."""

    address: str = "unknown"
    key: str = ""

    def __str__(self) -> str:
        return f"{self.key}@{self.address}" if self.key else self.address

    @property
    def account(self) -> str:
        """Whose share of the service the client uses: that of its key, or of its address."""
        return f"key:{self.key}" if self.key else f"address:{self.address}"

    @property
    def is_anonymous(self) -> bool:
        """Whether it has no key and speaks ZeroMQ, as programs of this machine may.

        Such clients cannot be told apart: they have one share, which is everything.
        """
        return not self.key and not self.address.startswith(WEB)

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


def check_share(
    accounts: Sequence[str], by: Caller, most: int, *, is_return: bool
) -> None:
    """Refuse a session beyond the limit of all, or beyond the share of the client.

    Args:
        accounts: Accounts of all sessions that are open, or being opened.
        by: The client.
        most: Number of sessions that may be open.
        is_return: Whether the client restores a session of its own. Newcomers must leave it room:
            it may have a half of all sessions, whatever is free.

    Raises:
        RefusedError: `busy`.
    """
    free = most - len(accounts)
    refuse_if(free <= 0, f"all {most} sessions are taken", code="busy")
    held = accounts.count(by.account)
    is_within = has_share(held, most - held if is_return else free)
    refuse_if(
        not (is_within or by.is_anonymous),
        f"this client has {held} of {most} sessions: the {free} left are for others",
        code="busy",
    )


def check_names(name: str | None, kept: Set[str]) -> None:
    """Refuse a new name to an owner all of whose names are kept.

    So stops, which are never forgotten, are bounded.

    Args:
        name: The name; None for one that the server makes.
        kept: Names of the owner that are open, or stopped.

    Raises:
        RefusedError: `busy`.
    """
    refuse_if(
        name not in kept and len(kept) >= MOST_NAMES,
        f"all {MOST_NAMES} names of this client are in use or stopped: clear a stop first",
        "name",
        "busy",
    )


class _Opening(NamedTuple):
    """A session that is being opened: its name, its client's account, and its owner."""

    name: str
    account: str
    owner: str


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
        by_secret: Sessions by their secrets, in the order in which they were opened.
        load: How much of its time the server works, and whom it serves.
        publish: Callbacks that receive the messages of all streams.
        listeners: Callbacks that learn of each session that was opened, or has ended.
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
        self.listeners: list[Listener] = []
        self.load = LoadMeter(self.settings.max_load, lambda: self.clock())
        self._worker = FairWorker()
        self._opens = AccountBuckets(
            self.settings.opens, self.settings.sessions, self.clock
        )
        # By secret.
        self._opening: dict[str, _Opening] = {}
        # Accounts of clients whose sessions others took over, by secret; the oldest first.
        self._taken: dict[str, str] = {}
        # After a restart, owners are on their way back.
        self._last_heard = dict.fromkeys(self.store.records, self.clock())
        self._unnamed = 0  # sessions that were opened without a name

    @property
    def names(self) -> Names:
        """Public names of the open sessions."""
        return tuple(session.name for session in self.by_secret.values())

    def find(self, secret: str, by: Caller) -> Session:
        """Return the session of a secret, and renew its lease.

        Raises:
            RefusedError: `no_session` if there is none, `taken` if another client took it over,
                `denied` if the session is that of another key, which somebody got the secret of.
        """
        if session := self.by_secret.get(secret):
            if session.owner.startswith("key:") and session.account != by.account:
                message = "belongs to another key"
                raise RefusedError("denied", message, field="session")
            session.last_request = self.clock()
            return session
        if secret in self._taken:
            message = "another client took this session over"
            raise RefusedError("taken", message, field="session")
        raise RefusedError("no_session", "no such session; open one", field="session")

    def named(self, name: str) -> Session:
        """Return the open session of a public name.

        Raises:
            RefusedError: If there is none.
        """
        if not (session := self.find_named(name)):
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
        name = request.name or self._new_name()
        owner = by.owner(request.session)
        self._opening[request.session] = _Opening(name, by.account, owner)
        try:
            defer = partial(self._worker.submit, by.account)
            work = defer(prepare_hands, request, self.cache, defer=defer)
            hands = await asyncio.wrap_future(work)
            robot = hands.mapper.robot
            # The client of the former session may have returned meanwhile.
            self._check_owner(request, by)
            running = self.find_named(name)
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
                owner=owner,
                account=by.account,
                # Without a record, it is another robot's.
                motion=running.motion if running and former else None,
                waited=running.since_command(now) if running else 0.0,
                totals=self.metrics.counts,
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
        self._tell(session, is_open=True)
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
        if code == "taken":
            self._remember_taken(secret, session.account)
        self.send(
            session.name, msgspec.msgpack.encode(Error(code=code, message=reason))
        )
        self._tell(session, is_open=False)
        event: Values = {"session": session.name, "reason": reason}
        self.audit.note("closed", by, **event)
        report(INFO, "closed", **event, counts=session.counts)

    def send(self, name: str, payload: bytes) -> None:
        """Publish a message in the stream of a session."""
        for publish in self.publish:
            publish(name, payload)

    def hear(self, name: str, time: float) -> None:
        """Note when the owner of a name was heard, who is on its way back [s]."""
        self._last_heard[name] = time

    def _tell(self, session: Session, *, is_open: bool) -> None:
        """Tell the listeners that a session was opened, or has ended."""
        for listener in self.listeners:
            listener(session, is_open)

    def close(self) -> None:
        """Close all sessions."""
        for session in list(self.by_secret.values()):
            self.end(session, "the server stops")
        self._worker.close()

    def _remember_taken(self, secret: str, account: str) -> None:
        """Remember that another client took a session over, so that its former client learns it."""
        self._taken[secret] = account
        if len(self._taken) > _REMEMBERED:
            largest = largest_account(self._taken.values())
            oldest = next(s for s, each in self._taken.items() if each == largest)
            del self._taken[oldest]

    def _new_name(self) -> str:
        """Return a name that is unique also over restarts, because others may watch the session."""
        self._unnamed += 1
        return f"session-{self._unnamed}-{secrets.token_hex(3)}"

    def _check(self, request: Open, by: Caller) -> None:
        """Refuse requests that can be refused before hands are loaded."""
        name = request.name
        running = self.find_named(name)
        self._check_secret(request, running)
        refuse_if(
            request.time_from == "client" and not self.settings.simulated_time,
            "the server uses its own clock (see handmap serve --simulated-time)",
            "time_from",
            "denied",
        )
        refuse_if(
            name in (each.name for each in self._opening.values()),
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
            running and not request.restore,
            f"session {name!r} exists: restore=true takes it over",
            "name",
        )
        refuse_if(
            request.restore and name is None,
            "missing: restore needs the name of the session",
            "name",
        )
        is_return = request.restore and self._is_owner(request, by)
        replaced = running if request.restore else None
        self._check_room(by, request.robot, replaced, is_return=is_return)
        self._check_names(name, by.owner(request.session))
        refuse_if(
            not is_return and not self._opens.take(by.account),
            f"more than {self.settings.opens:g} sessions opened a second: try again later",
            code="rate",
        )
        self._check_owner(request, by)

    def _check_secret(self, request: Open, running: Session | None) -> None:
        """Refuse a secret that is too short, or in use for anything but this session."""
        secret = request.session
        refuse_if(
            len(secret) < _SHORTEST_SECRET,
            f"expected at least {_SHORTEST_SECRET} random characters",
            "session",
        )
        held = self.by_secret.get(secret)
        is_same = held is running and request.restore
        refuse_if(
            held and not (is_same and request.seq > held.seq),
            "a session with this secret exists: choose another one",
            "session",
        )

    def _check_load(self, robot: str) -> None:
        """Refuse a session that the server has no time for."""
        running = self.by_secret.values()
        waiting = sum(each.mode == "waiting" for each in running) + len(self._opening)
        # A name of a family is that of no robot; all sessions count then.
        alike = [each.name for each in running if each.robot.name == robot]
        self.load.check_room(len(running), waiting, alike)

    def _check_room(
        self, by: Caller, robot: str, replaced: Session | None, *, is_return: bool
    ) -> None:
        """Refuse a session beyond the limit of all, or beyond the share of the client.

        Args:
            by: The client.
            robot: Name of the robot that it wants.
            replaced: The running session that this one takes the place of.
            is_return: Whether the client restores a session of its own.
        """
        accounts = [each.account for each in self.by_secret.values()]
        accounts += [each.account for each in self._opening.values()]
        if replaced:
            accounts.remove(replaced.account)
        check_share(accounts, by, self.settings.sessions, is_return=is_return)
        if not (replaced or is_return):
            self._check_load(robot)

    def _check_names(self, name: str | None, owner: str) -> None:
        """Refuse a new name to an owner all of whose names are kept: open, or stopped."""
        account = names_account(owner)
        in_use = *self._opening.values(), *self.by_secret.values()
        kept = self.store.stopped(account)
        kept |= {each.name for each in in_use if names_account(each.owner) == account}
        check_names(name, kept)

    def _is_owner(self, request: Open, by: Caller) -> bool:
        """Return whether the named session, or its record, is the client's own."""
        held = self._held(request.name)
        return held is not None and held.owner == by.owner(request.session)

    def _held(self, name: str | None) -> Session | Record | None:
        """Return the open session of a name, or else its record."""
        return self.find_named(name) or self.store.records.get(name or "")

    def find_named(self, name: str | None) -> Session | None:
        """Return the open session of a name, if there is one."""
        return next(
            (each for each in self.by_secret.values() if each.name == name), None
        )

    def _check_owner(self, request: Open, by: Caller) -> None:
        """Refuse a name to a client that must not have it, or must not yet."""
        name = request.name or ""
        running = self.find_named(name)
        held = self._held(name)
        if not held:
            return
        heard = (
            running.last_request if running else self._last_heard.get(name, -math.inf)
        )
        is_attended = self.clock() - heard <= LEASE
        # Without `restore`, a name is free after the lease. Of a robot that is stopped it is not,
        # because its owner may clear the stop. Supervisors may clear every stop.
        record = self.store.records.get(name)
        is_stopped = bool(record and record.stop)
        is_stopped &= by.key not in self.settings.supervisor
        if not (request.restore or is_attended or is_stopped):
            return
        is_rival = running is not None and request.session not in self.by_secret
        client = by.owner(request.session)
        code = refusal(held.owner, client, is_attended=is_attended, is_rival=is_rival)
        busy = f"is in use until {LEASE:g} s after its owner's last request"
        reason = busy if code == "busy" else "belongs to another key"
        refuse_if(code, f"session {name!r} {reason}", "name", code)
