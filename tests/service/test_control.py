"""Control of a session by its owner: every sequence of up to eight events of two clients.

Where sessions are shared, or there is a supervisor, sequences have up to five events: leases are
the same there, and a stop that others clear needs three.

The service itself is driven, from `Dispatcher.receive` on, with a clock of the test. Sequences that
lead to equal states are continued once, and so are those that do after the clients changed places.
"""

from __future__ import annotations

import asyncio
import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from copy import deepcopy
from types import SimpleNamespace
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from marks import full
from service_tools import CACHE, Sampler, human_q, opening, run_now

from handmap_qp.apps.service import sessions
from handmap_qp.apps.service.dispatch import Dispatcher
from handmap_qp.apps.service.logs import Metrics
from handmap_qp.apps.service.opening import prepare_hands
from handmap_qp.apps.service.session import Session
from handmap_qp.apps.service.sessions import LEASE, Caller, refusal
from handmap_qp.apps.service.settings import Settings
from handmap_qp.apps.service.store import PostureStore, Record
from handmap_qp.client.messages import (
    PROTOCOL,
    Clear,
    Close,
    Clutch,
    Open,
    Release,
    Request,
    Status,
    Stop,
)

# Thousands of sessions.
pytestmark = pytest.mark.slow

WAIT = 0.6 * LEASE
"""Longer than the watchdog's time; two of them are longer than the lease [s]."""
CLIENTS = ("a", "b")
EVENTS = (
    *itertools.product(
        CLIENTS,
        (
            "open",
            "restore",
            "sample",
            "status",
            "stop",
            "clear",
            "clutch",
            "release",
            "close",
        ),
    ),
    ("-", "wait"),
    ("-", "restart"),
)
Event = tuple[str, str]
Path = tuple[Event, ...]
Search = Callable[["Setting"], Counter[str]]


class Setting(NamedTuple):
    """What is the same in all sequences of a search, and how many events they have."""

    depth: int = 8
    has_keys: bool = False
    is_shared: bool = False
    has_supervisor: bool = False


class World:
    """A service, two clients, and what an observer knows of them.

    Attributes:
        owner: The client that owns the running or last session; empty for none.
        is_stopped: Whether a stop is in force.
        seen: Counts of what happened.
    """

    def __init__(self, setting: Setting, loop: asyncio.AbstractEventLoop) -> None:
        self.setting, self._loop = setting, loop
        self.now, self.sample = 0.0, Sampler()
        self.store = PostureStore(None)
        # Records in memory that outlive a restart as those in a file do.
        self.store.is_persistent = True
        self.owner, self.is_stopped = "", False
        # Time of the owner's last request that the service accepted, or of a restart.
        self._heard, self._is_open, self._epoch = 0.0, False, 0
        self.seen: Counter[str] = Counter()
        self._start()

    def _start(self) -> None:
        supervisors = ("b",) if self.setting.has_supervisor else ()
        caps = Settings(rate=1e9, opens=1e9, idle=1e9, supervisor=supervisors)
        self.dispatcher = Dispatcher(
            sessions.Sessions(
                caps, CACHE, Metrics(), store=self.store, clock=self._clock
            )
        )
        inline: Any = SimpleNamespace(
            submit=lambda _, *work, **choices: run_now(*work, **choices)
        )
        self.dispatcher.sessions._worker = inline
        # No limit of rates, which a copy would share.
        vars(self.dispatcher)["_rates"] = self.dispatcher._new_rates

    def _clock(self) -> float:
        return self.now

    def fork(self) -> World:
        """Return a copy that goes on by itself. What does not change is shared."""
        there, session = self.dispatcher.sessions, self.session
        shared: list[Any] = [self._loop, CACHE, self.dispatcher.sessions.metrics]
        shared += there._worker, there.settings
        if session is not None:
            hands: Any = session._hands
            mapper = hands.mapper
            shared += hands.robot, hands.follower, hands.choice
            shared += mapper.human, mapper.robot, mapper.bound, mapper.source.joints
            shared += mapper.method, session._commanded._placed, session.request
        return deepcopy(self, {id(thing): thing for thing in shared})

    @property
    def session(self) -> Session | None:
        """The running session; there is at most one."""
        running = [*self.dispatcher.sessions.by_secret.values()]
        assert len(running) <= 1, "two sessions of one name"
        return running[0] if running else None

    def caller(self, client: str) -> Caller:
        return Caller("127.0.0.1", client if self.setting.has_keys else "")

    def send(self, client: str, request: Request) -> dict[str, Any]:
        """Send a request; return its answer."""
        answers: list[bytes] = []
        payload, who = msgspec.msgpack.encode(request), self.caller(client)

        async def ask() -> None:
            self.dispatcher.receive(payload, client, answers.append, by=who)
            while not answers:
                await asyncio.sleep(0.0)

        if isinstance(request, Open):
            self._loop.run_until_complete(ask())
        else:
            # All others are answered at once.
            self.dispatcher.receive(payload, client, answers.append, by=who)
        return msgspec.msgpack.decode(answers[0])

    def _request(self, client: str, kind: str, *, by_name: bool) -> Request:
        seq, secret = self.sample.seq + 1, f"the-secret-of-client-{client}"
        self.sample.seq = seq
        if kind in ("open", "restore"):
            request = opening(
                name="lab", restore=kind == "restore", is_shared=self.setting.is_shared
            )
            return msgspec.structs.replace(
                request,
                seq=seq,
                session=secret,
                robot_q=(0.0,) * 8 if by_name else None,
            )
        if kind == "sample":
            made = self.sample(self.now, human_q(0.7 * seq))
            return msgspec.structs.replace(made, session=secret)
        to: dict[str, Any] = {"protocol": PROTOCOL, "seq": seq}
        to |= {"name": "lab"} if by_name else {"session": secret}
        if kind == "clear":
            return Clear(stop=(self.session._stop if self.session else 0) or 1, **to)
        return {
            "status": Status, "stop": Stop, "clutch": Clutch, "release": Release, "close": Close
        }[kind](**to)  # fmt: skip

    def act(self, event: Event) -> None:
        """Let an event happen, and check what the observer saw of it."""
        client, kind = event
        before, posture = self.session, self._posture()
        number = self.store.records["lab"].stop if self.store.records else 0
        if kind == "wait":
            self.now += WAIT
            self.dispatcher.tick()
            answers = []
        elif kind == "restart":
            self._start()
            answers = []
        else:
            # Whoever has no session of its own tries by name.
            answers = [self.send(client, self._request(client, kind, by_name=False))]
            if answers[0]["type"] == "error" and kind in (
                "stop",
                "clear",
                "clutch",
                "release",
            ):
                answers.append(
                    self.send(client, self._request(client, kind, by_name=True))
                )
        is_done = any(answer["type"] != "error" for answer in answers)
        self._check_owner(client, kind, is_done=is_done)
        self._check_stop(client, kind, number, is_done=is_done and before is not None)
        after = self._posture()
        if (
            posture is not None
            and after is not None
            and kind not in ("open", "restore")
        ):
            has_moved = not np.array_equal(posture, after)
            self.seen["moved"] += has_moved
            is_led = kind == "sample" and client == self.owner and not self.is_stopped
            assert is_led or not has_moved, "motion without the owner"
        if self.session is not None:
            self.seen[self.session.mode] += 1

    def _posture(self) -> np.ndarray | None:
        return None if self.session is None else self.session.posture[0].copy()

    def _check_owner(self, client: str, kind: str, *, is_done: bool) -> None:
        """Assert that nobody else got hold of the session before the end of the lease."""
        is_over = self.now - self._heard > LEASE
        if kind in ("open", "restore") and is_done:
            assert self.session is not None
            is_new = client != self.owner
            if is_new and self.owner and self._is_open:
                self.seen["succeeded"] += 1
                assert is_over, "a second owner within the lease"
                assert not (self.setting.has_keys and kind == "restore"), "another key"
            if is_new and self.setting.has_keys and kind == "restore":
                assert not self.owner, "another key restored the session"
            is_continued = kind == "restore" and not is_new
            assert (self.session._epoch == self._epoch) == is_continued, "epoch"
            self.seen["returned"] += is_continued
            self.owner, self._is_open = client, True
            self._epoch, self._heard = self.session._epoch, self.now
        elif kind == "restart":
            self._heard = self.now
        elif kind == "close" and is_done:
            self._is_open = False
        elif kind in ("sample", "status") and is_done:
            assert client == self.owner, "a stranger led the robot"
        if (
            client == self.owner
            and self.session is not None
            and kind not in ("open", "restore")
        ):
            self._heard = self.now
        if self.session is not None:
            assert self.session.owner == self._owner_of(self.owner)

    def _check_stop(
        self, client: str, kind: str, number: int, *, is_done: bool
    ) -> None:
        """Assert that a stop is in force until somebody who may has cleared it."""
        if kind == "stop" and is_done:
            self.is_stopped = True
            self.seen["stopped"] += 1
        elif kind == "clear" and is_done:
            may = client == self.owner or self.setting.is_shared
            assert may or (self.setting.has_supervisor and client == "b"), (
                "cleared by a stranger"
            )
            self.is_stopped = False
            self.seen["cleared"] += 1
        if self.session is not None:
            assert (self.session.mode == "stopped") == self.is_stopped, (
                "a stop that does not stop"
            )
            if self.is_stopped and number:
                assert self.session._stop == number

    def state(self) -> tuple[Any, ...]:
        """Return all on which the future depends; ages beyond the lease are equal.

        Clients that may do the same can change places: of both states the first one is returned.
        """
        pair = CLIENTS
        both = [self._state_of(pair)] if self.setting.has_supervisor else [
            self._state_of(pair), self._state_of(pair[::-1])
        ]  # fmt: skip
        return min(both, key=repr)

    def _state_of(self, clients: tuple[str, ...]) -> tuple[Any, ...]:
        """Return the state, with clients called by their places."""
        there, running = self.dispatcher.sessions, self.session
        record = self.store.records.get("lab")
        secrets = [f"the-secret-of-client-{client}" for client in clients]
        owners = ["", *map(self._owner_of, clients)]

        def age(time: float) -> float:
            return min(round(self.now - time, 6), 1.01 * LEASE)

        return (
            tuple(
                (secret in there.by_secret, secret in there._taken)
                for secret in secrets
            ),
            running
            and (
                owners.index(running.owner),
                running._state,
                running._is_slewing,
                running._stop > 0,
                age(running.last_request),
                self.now > running._clock.last_sample,
            ),
            record
            and (owners.index(record.owner), record.stop > 0, record.is_released),
            tuple(sorted(age(time) for time in there._last_heard.values())),
            ("", *clients).index(self.owner),
            (self.is_stopped, age(self._heard), self._is_open),
        )

    def _owner_of(self, client: str) -> str:
        return self.caller(client).owner(f"the-secret-of-client-{client}")


@pytest.fixture
def explore(monkeypatch: pytest.MonkeyPatch) -> Iterator[Search]:
    """Return the search, which takes a setting and returns what it has seen."""
    # Sessions of a world follow one another, and each resets the mapper.
    hands = prepare_hands(opening(), CACHE)
    monkeypatch.setattr(sessions, "prepare_hands", lambda *_, **__: hands)
    monkeypatch.setattr(sessions, "report", lambda *_, **__: None)
    monkeypatch.setattr(
        "handmap_qp.apps.service.dispatch.Throttle.report", lambda *_, **__: None
    )
    monkeypatch.setattr("handmap_qp.apps.service.dispatch.version", lambda _: "0")
    numbers = itertools.count(1)
    monkeypatch.setattr(
        "handmap_qp.apps.service.session._new_epoch", lambda: next(numbers)
    )
    loop = asyncio.new_event_loop()

    def search(setting: Setting) -> Counter[str]:
        start = World(setting, loop)
        seen, known = Counter[str](), {start.state()}
        worlds: list[tuple[Path, World]] = [((), start)]
        for _ in range(setting.depth):
            longer: list[tuple[Path, World]] = []
            for path, world in worlds:
                state, here = world.state(), world.fork()
                for event in EVENTS:
                    try:
                        here.act(event)
                    except AssertionError as error:
                        raise AssertionError(f"{error}: {(*path, event)}") from error
                    seen += here.seen
                    here.seen.clear()
                    if (after := here.state()) != state:
                        if after not in known:
                            known.add(after)
                            # Sessions that are opened share one mapper, and copies do not.
                            longer.append(((*path, event), here.fork()))
                        here = world.fork()
            worlds = longer
        return seen + Counter(states=len(known), left=len(worlds))

    yield search
    loop.close()


SETTINGS = {
    "secrets": Setting(),
    "shared": Setting(depth=5, is_shared=True),
    "keys": Setting(has_keys=True),
    "supervisor": Setting(depth=5, has_keys=True, has_supervisor=True),
}


# With keys the suite runs up to five events: leases are those of `secrets`.
@pytest.mark.parametrize(
    "name", ["secrets", full("shared"), full("keys"), "supervisor"]
)
def test_every_sequence_has_one_owner_no_stray_motion_and_stops(
    explore: Search, name: str
) -> None:
    seen = explore(SETTINGS[name])
    # The search came by what it is about.
    modes = ("waiting", "following", "released", "hold", "stopped")
    for event in (*modes, "moved", "returned", "succeeded", "cleared"):
        assert seen[event] > 0, event
    assert seen["states"] > (130 if SETTINGS[name].depth == 8 else 70)


def _forgets_leases(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        sessions, "refusal", lambda *owners, is_attended, is_rival: refusal(
            *owners, is_attended=False, is_rival=is_rival
        )
    )  # fmt: skip


def _renews_no_lease(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(self: sessions.Sessions, secret: str, by: Caller) -> Session:
        session = self.by_secret.get(secret)
        heard = 0.0 if session is None else session.last_request
        found = whole(self, secret, by)
        found.last_request = heard
        return found

    whole = sessions.Sessions.find
    monkeypatch.setattr(sessions.Sessions, "find", find)


def _lets_keys_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        sessions, "refusal", lambda owner, client, **lease: refusal(
            owner.replace("key:", "any:"), client, **lease
        )
    )  # fmt: skip


def _keeps_epochs(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(*args: Any, former: Record | None, owner: str, **choices: Any) -> Session:
        if former is not None:
            former = msgspec.structs.replace(former, owner=owner)
        return Session(*args, former=former, owner=owner, **choices)

    monkeypatch.setattr(sessions, "Session", make)


def _forgets_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    stop = Session.stop
    monkeypatch.setattr(
        Session, "stop", lambda self, number=0: None if number else stop(self)
    )  # fmt: skip


def _lets_all_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(**choices: Any) -> Settings:
        choices["supervisor"] = CLIENTS
        return whole(**choices)

    whole = Settings
    monkeypatch.setattr(f"{__name__}.Settings", make)


@pytest.mark.parametrize(
    ("fault", "name", "complaint"),
    [
        (_forgets_leases, "secrets", "a second owner within the lease"),
        (_renews_no_lease, "secrets", "a second owner within the lease"),
        (_lets_keys_in, "keys", "another key"),
        (_keeps_epochs, "secrets", "epoch"),
        (_forgets_stops, "secrets", "a stop that does not stop"),
        (_lets_all_clear, "keys", "cleared by a stranger"),
    ],
)
def test_the_search_notices_faults(
    explore: Search,
    monkeypatch: pytest.MonkeyPatch,
    fault: Callable[[pytest.MonkeyPatch], None],
    name: str,
    complaint: str,
) -> None:
    fault(monkeypatch)
    with pytest.raises(AssertionError, match=complaint):
        explore(SETTINGS[name])


@pytest.mark.parametrize("is_attended", [False, True])
@pytest.mark.parametrize("is_rival", [False, True])
def test_who_may_continue_a_session(is_attended: bool, is_rival: bool) -> None:
    alice, bob = Caller("here", "alice"), Caller("there", "bob")
    page, other = Caller("here"), "another-secret-of-the-tests"
    keyed, plain = alice.owner("a secret"), page.owner("a secret")

    def may(owner: str, client: str) -> str:
        return refusal(owner, client, is_attended=is_attended, is_rival=is_rival)

    # A key is the same owner with any secret, from any address.
    assert keyed == Caller("there", "alice").owner(other)
    assert may(keyed, alice.owner(other)) == (
        "busy" if is_attended and is_rival else ""
    )
    assert may(keyed, bob.owner("a secret")) == may(keyed, plain) == "denied"
    # Without keys the secret counts. Others wait for the end of the lease, with a key too.
    assert may(plain, Caller("there").owner("a secret")) == (
        "busy" if is_attended and is_rival else ""
    )
    for stranger in (page.owner(other), bob.owner("a secret"), page.owner("")):
        assert (
            may(plain, stranger) == may("", stranger) == ("busy" if is_attended else "")
        )


def test_owners_are_digests_that_do_not_collide() -> None:
    secret = "a-secret-of-the-tests"
    owners = {
        Caller("here", key).owner(secret)
        for key in ("", secret, "key:", "secret:", "\udcff")
    }
    assert len(owners) == 5
    assert not any(secret in owner for owner in owners)
