"""What one owner may take from the others: sessions, names, openings, room in the log."""

from __future__ import annotations

import asyncio
import json
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
import zmq
from marks import crossed
from service_tools import CACHE, Sampler, opening, streamed

from handmap_qp.apps.service import sessions as sessions_module
from handmap_qp.apps.service.connection_gate import ConnectionGate
from handmap_qp.apps.service.dispatch import Dispatcher
from handmap_qp.apps.service.fairness import (
    AccountBuckets,
    FairWorker,
    has_share,
    largest_account,
)
from handmap_qp.apps.service.logs import AuditLog, Metrics
from handmap_qp.apps.service.opening import prepare_hands
from handmap_qp.apps.service.session import Session
from handmap_qp.apps.service.sessions import LEASE, Caller, Sessions
from handmap_qp.apps.service.settings import MOST_SESSIONS, Settings
from handmap_qp.apps.service.store import MOST_NAMES, MOST_RECORDS, PostureStore, Record
from handmap_qp.client.messages import (
    PROTOCOL,
    Clear,
    Configure,
    Release,
    Request,
    Status,
    Stop,
)

ALICE = Caller("10.0.0.1", "alice")
BOB = Caller("10.0.0.2", "bob")
SUPERVISOR = Caller("10.0.0.3", "supervisor")
HEADSET = Caller("web@10.0.0.4")
PROGRAM = Caller("127.0.0.1")


class Service:
    """A service without sockets and threads, with a clock of the test.

    All sessions share one mapper, because none of them moves far.

    Args:
        file: File of the records; in memory if omitted.
        **caps: Settings.
    """

    def __init__(self, file: Path | None = None, **caps: Any) -> None:
        self.now = 0.0
        self.seq = 0
        self.store = PostureStore(file)
        weakref.finalize(self, self.store.close)
        self.sessions = Sessions(
            Settings(supervisor=("supervisor",), **caps),
            CACHE,
            Metrics(),
            store=self.store,
            clock=lambda: self.now,
        )
        self.dispatcher = Dispatcher(self.sessions)

    def open(self, by: Caller, name: str | None, **choices: Any) -> Session:
        """Open a session with a secret of its own, unless one is given."""
        self.seq += 1
        # Enough for the largest rate of the tests.
        self.now += 1e-6
        secret = choices.pop("secret", f"secret-of-the-tests-{self.seq}")
        request = msgspec.structs.replace(
            opening(name=name, **choices), session=secret, seq=self.seq
        )
        return asyncio.run(self.sessions.open(request, by))

    def refusal(self, by: Caller, name: str | None = None, **choices: Any) -> str:
        """Return the code that refuses an opening; empty if it is not refused."""
        try:
            self.open(by, name, **choices)
        except sessions_module.RefusedError as error:
            return error.code
        return ""

    def fill(self, by: Caller) -> int:
        """Open sessions until one is refused; return their number."""
        count = 0
        while (code := self.refusal(by)) == "":
            count += 1
        assert code == "busy"
        return count

    def end(self, session: Session) -> None:
        self.sessions.end(session, "closed by its client")

    def ask(self, by: Caller, kind: type[Request], **fields: Any) -> dict[str, Any]:
        """Send a request; return its answer."""
        self.seq += 1
        request = kind(protocol=PROTOCOL, seq=self.seq, **fields)
        answers: list[bytes] = []
        payload = msgspec.msgpack.encode(request)
        self.dispatcher.receive(payload, by, answers.append, by=by)
        return msgspec.msgpack.decode(answers[0])

    def restart(self, file: Path) -> Service:
        """End the server, and start another one with its file."""
        self.sessions.close()
        self.store.close()
        return Service(file)


@pytest.fixture(autouse=True)
def shared_hands(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prepare the hands once."""
    hands = prepare_hands(opening(), CACHE)
    monkeypatch.setattr(sessions_module, "prepare_hands", lambda *_, **__: hands)
    monkeypatch.setattr(sessions_module, "report", lambda *_, **__: None)


def record(name: str, owner: str = "", stop: int = 0) -> Record:
    return Record(name, "hand", (0.1,), None, 7, stop=stop, owner=owner)


# Emergency stops


@pytest.mark.parametrize(
    ("has_file", "stranger"), crossed([True, False], [BOB, HEADSET, ALICE], every=2)
)
def test_a_stop_outlives_any_number_of_other_sessions(
    tmp_path: Path, has_file: bool, stranger: Caller
) -> None:
    file = tmp_path / "state" if has_file else None
    service = Service(file, opens=1e9)
    lab = service.open(ALICE, "lab")
    service.ask(BOB, Stop, name="lab")
    number = lab.record.stop
    assert number
    service.end(lab)
    for i in range(2 * MOST_NAMES):
        service.end(service.open(stranger, f"session-{i}"))
    if file:
        service = service.restart(file)
    service.now += 2.0 * LEASE
    again = service.open(ALICE, "lab", restore=True)
    assert (again.mode, again.record.stop) == ("stopped", number)


@pytest.mark.parametrize("has_file", [True, False])
def test_one_key_does_not_evict_the_names_of_another(
    tmp_path: Path, has_file: bool
) -> None:
    service = Service(tmp_path / "state" if has_file else None, opens=1e9)
    epoch = service.open(ALICE, "lab").record.epoch
    service.end(service.sessions.named("lab"))
    for i in range(2 * MOST_NAMES):
        service.end(service.open(BOB, f"session-{i}"))
    service.now += 2.0 * LEASE
    assert service.open(ALICE, "lab", restore=True).record.epoch == epoch
    assert "session-0" not in service.store.records
    assert f"session-{2 * MOST_NAMES - 1}" in service.store.records


def test_stops_are_bounded_by_refusing_new_names() -> None:
    service = Service(opens=1e9)
    for i in range(MOST_NAMES):
        session = service.open(BOB, f"session-{i}")
        session.stop()
        service.end(session)
    assert service.refusal(BOB, "one-more") == "busy"
    with pytest.raises(sessions_module.RefusedError, match="clear a stop"):
        service.open(BOB, "one-more")
    # Others have names of their own; and a name that is counted already may be opened.
    assert service.refusal(ALICE, "lab") == ""
    service.now += 2.0 * LEASE
    first = service.open(BOB, "session-0", restore=True)
    assert first.mode == "stopped"
    first.clear(first.record.stop)
    service.end(first)
    assert service.refusal(BOB, "one-more") == ""
    assert len(service.store.records) == MOST_NAMES


def test_names_that_are_open_count_before_they_are_stopped() -> None:
    service = Service(opens=1e9, sessions=MOST_SESSIONS)
    open_sessions = [service.open(BOB, f"open-{i}") for i in range(MOST_NAMES // 4)]
    for i in range(MOST_NAMES - len(open_sessions)):
        session = service.open(BOB, f"stopped-{i}")
        session.stop()
        service.end(session)
    assert service.refusal(BOB, "one-more") == "busy"
    for session in open_sessions:
        session.stop()
        service.end(session)
    stopped = [each for each in service.store.records.values() if each.stop]
    assert len(stopped) == MOST_NAMES


@pytest.mark.parametrize("restore", [True, False])
def test_another_key_cannot_open_a_stopped_name_to_clear_it(restore: bool) -> None:
    service = Service()
    session = service.open(ALICE, "lab")
    session.stop()
    number = session.record.stop
    service.end(session)
    service.now += 10.0 * LEASE
    assert service.refusal(BOB, "lab", restore=restore) == "denied"
    # Its owner may, and so may a supervisor, who may clear every stop.
    assert service.open(ALICE, "lab", restore=True).record.stop == number
    service.end(service.sessions.named("lab"))
    service.now += 10.0 * LEASE
    taken = service.open(SUPERVISOR, "lab")
    assert taken.mode == "stopped"
    answer = service.ask(SUPERVISOR, Clear, session=taken.request.session, stop=number)
    assert answer["type"] == "done"
    service.end(taken)
    service.now += 10.0 * LEASE
    assert service.refusal(BOB, "lab") == ""


def test_a_file_of_an_earlier_version_keeps_its_stops(tmp_path: Path) -> None:
    file = tmp_path / "state"
    with PostureStore(file) as store:
        assert store._database
        # Records that are older than owners, some of them also older than stops.
        for i in range(MOST_NAMES):
            fields: dict[str, Any] = {"name": f"old-{i}", "robot": "hand", "q": (0.1,)}
            fields |= {"wrist": None}
            fields |= {"epoch": 7} | ({"stop": 5} if i < 3 else {})
            row = f"old-{i}", msgspec.msgpack.encode(fields)
            store._database.execute("INSERT INTO postures VALUES (?, ?)", row)
    with PostureStore(file) as store:
        assert len(store.records) == MOST_NAMES
        for i in range(MOST_RECORDS):
            store.note(record(f"new-{i}", owner=""))
    with PostureStore(file) as store:
        assert [name for name in store.records if name.startswith("old")] == [
            "old-0", "old-1", "old-2"
        ]  # fmt: skip
        assert all(store.records[f"old-{i}"].stop == 5 for i in range(3))


@pytest.mark.parametrize("restore", [True, False])
def test_a_record_that_cannot_be_read_counts_as_stopped(
    tmp_path: Path, restore: bool
) -> None:
    file = tmp_path / "state"
    service = Service(file)
    service.open(ALICE, "lab")
    service.sessions.close()
    assert service.store._database
    service.store._database.execute("UPDATE postures SET record = x'c1'")
    service.store.close()
    service = Service(file)
    service.now += 2.0 * LEASE
    # Where its robot is must be said, as for a name without a record.
    robot_q = {"robot_q": (0.0,) * 8}
    session = service.open(ALICE, "lab", restore=restore, **robot_q)
    assert session.mode == "stopped"
    session.clear(session.record.stop)
    assert service.restart(file).store.records["lab"].stop == 0


def test_the_file_is_bounded_also_for_many_owners(tmp_path: Path) -> None:
    file = tmp_path / "state"

    def size() -> int:
        return sum(each.stat().st_size for each in tmp_path.iterdir())

    with PostureStore(file) as store:
        reserved = size()
        store.note(record("rare", owner="key:rare"))
        for i in range(2 * MOST_RECORDS):
            store.note(record(f"session-{i}", owner=f"key:{i % 20}"))
        assert len(store.records) == MOST_RECORDS
        # The account with the most names gives way.
        assert "rare" in store.records
        assert size() <= reserved
    with PostureStore(file) as store:
        assert len(store.records) == MOST_RECORDS


def test_a_secret_does_not_open_the_session_of_a_key_to_another_key() -> None:
    service = Service()
    session = service.open(ALICE, "lab")
    secret = session.request.session
    heard = session.last_request
    service.now += 1.0
    for stranger in (BOB, HEADSET, PROGRAM, SUPERVISOR):
        answer = service.ask(stranger, Release, session=secret)
        assert (answer["code"], answer["field"]) == ("denied", "session")
    assert session.mode == "waiting"
    # It does not renew the lease either.
    assert session.last_request == heard
    assert service.ask(ALICE, Release, session=secret)["type"] == "done"


def test_a_streamed_sample_of_another_key_replaces_none_of_the_owner() -> None:
    service = Service()
    secret = service.open(ALICE, "lab").request.session
    sample = streamed(Sampler()(1.0))
    mine = msgspec.structs.replace(sample, session=secret, seq=99)
    alien = msgspec.structs.replace(mine, seq=100)

    async def send() -> list[bytes]:
        refusals: list[bytes] = []
        for by, each in ((ALICE, mine), (BOB, alien)):
            payload = msgspec.msgpack.encode(each)
            service.dispatcher.receive(payload, by, refusals.append, by=by)
        await asyncio.sleep(0.0)
        return refusals

    (refusal,) = asyncio.run(send())
    assert msgspec.msgpack.decode(refusal)["code"] == "denied"
    session = service.sessions.named("lab")
    assert (session.counts["steps"], session.seq) == (1, 99)


# Sessions and openings


def test_one_key_cannot_take_all_sessions() -> None:
    service = Service(opens=1e9)
    most = service.sessions.settings.sessions
    assert service.fill(ALICE) == most // 2
    assert service.fill(BOB) == most // 4
    assert service.refusal(SUPERVISOR) == ""
    assert service.fill(HEADSET) > 1
    assert len(service.sessions.by_secret) < most


def test_programs_of_this_machine_are_one_owner_and_may_take_all_sessions() -> None:
    service = Service(opens=1e9, sessions=8)
    assert service.fill(PROGRAM) == 8


def test_a_flood_of_openings_leaves_the_restores_of_others_alone() -> None:
    service = Service(sessions=64)
    names = [f"lab-{i}" for i in range(29)]
    for name in names:
        service.end(service.open(ALICE, name))
    service.now += 2.0 * LEASE
    refusals = []
    for name in names:
        for _ in range(20):
            service.refusal(BOB)
        refusals.append(service.refusal(ALICE, name, restore=True))
    assert refusals == [""] * len(names)


def test_an_owner_that_floods_may_still_restore_its_own_names() -> None:
    service = Service(opens=1e-6, sessions=8)
    session = service.open(ALICE, "lab", secret="the-same-secret-again")
    while service.refusal(ALICE, "other", robot="none") != "rate":
        service.sessions.by_secret.pop("none", None)
        for other in [*service.sessions.by_secret.values()]:
            if other is not session:
                service.end(other)
    service.now += 2.0 * LEASE
    again = service.open(ALICE, "lab", restore=True)
    assert again.record.epoch == session.record.epoch
    # The restore of a name that is another's, or nobody's, takes a token.
    assert service.refusal(ALICE, "unknown", restore=True) == "rate"
    assert service.refusal(ALICE, "new") == "rate"


def test_an_opening_waits_for_one_of_each_other_owner_at_most() -> None:
    order: list[str] = []
    worker = FairWorker()
    first: Future[None] = Future()
    blocked = worker.submit("blocker", first.result)
    pending = [worker.submit("flood", order.append, "flood") for _ in range(20)]
    pending += [worker.submit("lab", order.append, "lab") for _ in range(2)]
    pending.append(worker.submit("other", order.append, "other"))
    first.set_result(None)
    for each in (blocked, *pending):
        each.result(60.0)
    assert order[:6] == ["flood", "lab", "other", "flood", "lab", "flood"]
    worker.close()


def test_a_worker_hands_errors_on_and_cancels_what_waits() -> None:
    worker = FairWorker()

    def fail() -> None:
        raise ZeroDivisionError

    failed = worker.submit("lab", fail)
    with pytest.raises(ZeroDivisionError):
        failed.result(60.0)
    gate: Future[None] = Future()
    started: Future[None]
    running = worker.submit("lab", gate.result)
    waiting = worker.submit("lab", fail)
    cancelled = worker.submit("lab", fail)
    cancelled.cancel()
    gate.set_result(None)
    running.result(60.0)
    with pytest.raises(ZeroDivisionError):
        waiting.result(60.0)
    gate, started = Future(), Future()
    running = worker.submit("lab", lambda: (started.set_result(None), gate.result()))
    started.result(60.0)
    waiting = worker.submit("lab", fail)
    worker.close()
    assert waiting.cancelled()
    gate.set_result(None)
    running.result(60.0)


def test_rates_are_those_of_each_account_and_few_are_remembered() -> None:
    now = 0.0
    buckets = AccountBuckets(rate=1.0, burst=3.0, clock=lambda: now)
    assert [buckets.take("a") for _ in range(5)] == [True] * 3 + [False] * 2
    assert buckets.take("b")
    now += 1.0
    assert [buckets.take("a") for _ in range(2)] == [True, False]
    for i in range(3000):
        buckets.take(str(i))
    assert len(buckets) <= 1024


def test_changes_of_options_by_one_key_leave_others_theirs() -> None:
    service = Service(configures=8.0)
    for by, name in ((ALICE, "lab"), (BOB, "other")):
        service.open(by, name, is_shared=True)
    service.now += 10.0

    def configure(by: Caller, name: str) -> str:
        answer = service.ask(by, Configure, name=name, has_detail=True)
        return answer.get("code", "done")

    flood = [configure(BOB, "other") for _ in range(100)]
    assert flood.count("done") == 1
    assert flood.count("rate") == 99
    assert configure(ALICE, "lab") == "done"


def test_who_was_taken_over_is_remembered_whatever_others_do() -> None:
    service = Service(opens=1e9)
    first = service.open(ALICE, "lab")
    service.now += 2.0 * LEASE
    service.open(ALICE, "lab", restore=True)
    secret = first.request.session

    def code() -> str:
        return service.ask(ALICE, Status, session=secret)["code"]

    assert code() == "taken"
    service.open(BOB, "other")
    for _ in range(1100):
        service.now += 2.0 * LEASE
        service.open(BOB, "other", restore=True)
    assert code() == "taken"
    assert len(service.sessions._taken) <= 1024


def test_a_flood_in_the_audit_log_hides_nobody_else(tmp_path: Path) -> None:
    file = tmp_path / "audit.jsonl"
    audit = AuditLog(file)
    for _ in range(2000):
        audit.note("release", BOB, session="other")
    audit.note("clear", ALICE, session="lab")
    audit.close()
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    assert len(lines) < 1000
    assert lines[-1]["event"] == "clear"


def test_the_share_of_one_is_a_half_of_what_is_left() -> None:
    assert [has_share(held, 10 - held) for held in range(6)] == [True] * 5 + [False]
    assert has_share(0, 1)
    assert not has_share(0, 0)
    assert largest_account(["a", "b", "b", "a", "c", "b"]) == "b"


def test_accounts_are_keys_or_else_addresses() -> None:
    assert Caller("10.0.0.1", "alice").account == Caller("10.0.0.9", "alice").account
    assert Caller("10.0.0.1").account != Caller("10.0.0.2").account
    # A key that has the name of an address is another account.
    assert Caller("here", "there").account != Caller("there").account


# Connections


class Connection:
    """A connection as the gate sees it, without a socket."""

    def __init__(self, address: str, heard: float, identity: bytes = b"") -> None:
        self.address = address
        self.heard = heard
        self.identity = identity
        self.reason = ""
        self.writer = SimpleNamespace(is_closing=lambda: bool(self.reason))


@pytest.fixture
def gate() -> Iterator[Callable[..., ConnectionGate]]:
    """Return a function that makes a gate for six connections."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as socket:
        yield partial(
            ConnectionGate, socket, "requests", "127.0.0.1", 0, 6, 1e4, Metrics()
        )


def admit(gate: ConnectionGate, *connections: Connection) -> None:
    """Admit connections; those that the gate ends leave it, as `_Client.end` does."""
    for connection in connections:

        def end(reason: str, ended: Connection = connection) -> None:
            ended.reason = reason
            gate.clients.discard(cast(Any, ended))

        vars(connection)["end"] = end
        gate.admit(cast(Any, connection))


@pytest.mark.parametrize("evicts", [True, False])
def test_a_flood_of_connections_takes_no_place_of_another_address(
    gate: Callable[..., ConnectionGate], evicts: bool
) -> None:
    here = gate(evicts=evicts)
    button = Connection("10.0.0.1", 0.0, b"silent for longest")
    flood = [Connection("10.0.0.2", 1.0 + i) for i in range(20)]
    admit(here, button, *flood)
    assert not button.reason
    assert len(here.clients) == 6
    # A newcomer of another address takes the place of one of the flood.
    driver = Connection("10.0.0.3", 30.0)
    admit(here, driver, *[Connection("10.0.0.2", 40.0 + i) for i in range(20)])
    assert not driver.reason
    assert not button.reason
    assert len(here.clients) == 6


@pytest.mark.parametrize("evicts", [True, False])
def test_of_one_address_the_connection_of_least_use_gives_way(
    gate: Callable[..., ConnectionGate], evicts: bool
) -> None:
    here = gate(evicts=evicts)
    mine = [Connection("10.0.0.1", float(i), b"known") for i in range(5)]
    mine.append(Connection("10.0.0.1", 9.0))
    admit(here, *mine)
    last = Connection("10.0.0.1", 10.0)
    admit(here, last)
    assert [bool(each.reason) for each in mine] == [False] * 5 + [evicts]
    assert bool(last.reason) != evicts


@pytest.mark.parametrize("evicts", [True, False])
def test_where_each_address_has_one_connection_a_newcomer_is_one_more(
    gate: Callable[..., ConnectionGate], evicts: bool
) -> None:
    here = gate(evicts=evicts)
    others = [Connection(f"10.0.0.{i}", float(i), b"known") for i in range(6)]
    admit(here, *others)
    last = Connection("10.0.0.9", 9.0)
    admit(here, last)
    assert [bool(each.reason) for each in others] == [evicts] + [False] * 5
    assert bool(last.reason) != evicts
