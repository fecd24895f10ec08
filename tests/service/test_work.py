"""The order of requests: stops overtake mappings, and what waits is bounded. No clock runs."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from service_desk import Desk, sample_of, secret_of
from service_tools import Sampler, opening, streamed

from handmap_qp.apps.service.sessions import Caller
from handmap_qp.apps.service.work import MOST_WAITING, WorkQueue
from handmap_qp.client.messages import (
    PROTOCOL,
    Clear,
    Disengage,
    Engage,
    Request,
    Status,
    Stop,
)
from handmap_qp.errors import RefusedError


class Loop:
    """An event loop in which the test makes the turns."""

    def __init__(self) -> None:
        self.due: list[Callable[[], None]] = []

    def schedule(self, call: Callable[[], None]) -> None:
        """Call in the next turn."""
        self.due.append(call)

    def turn(self) -> None:
        """Call what is due now."""
        due, self.due = self.due, []
        for call in due:
            call()

    def run(self) -> int:
        """Make turns until nothing is due; return their number."""
        turns = 0
        while self.due:
            self.turn()
            turns += 1
        return turns


class BusyDesk(Desk):
    """A dispatcher that reads all messages before it maps, with open sessions."""

    def __init__(self, *names: str) -> None:
        super().__init__(rate=1e6)
        self.loop = Loop()
        self.answers: list[tuple[str, int, str]] = []
        for name in names:
            request = msgspec.structs.replace(
                opening(name=name), session=secret_of(name)
            )
            asyncio.run(self.sessions.open(request, Caller()))
        self.dispatcher.schedule = self.loop.schedule

    def send(self, request: Request, note: str = "") -> None:
        """Send a request; note its answer when it comes."""

        def take(payload: bytes) -> None:
            reply: dict[str, Any] = msgspec.msgpack.decode(payload)
            said = reply.get("code") or reply.get("status") or reply["type"]
            self.answers.append((note, reply["seq"], said))

        self.dispatcher.receive(msgspec.msgpack.encode(request), "one", take)


def names_of(count: int) -> list[str]:
    return [f"session-{i}" for i in range(count)]


def test_a_stop_waits_for_no_mapping_of_twenty_busy_sessions() -> None:
    names = names_of(20)
    here, sampler = BusyDesk(*names), Sampler()
    for _ in range(3):
        for name in names:
            here.send(sample_of(name, sampler, here.now), name)
    assert here.answers == []
    here.send(Stop(protocol=PROTOCOL, seq=1, name=names[7]), "stop")
    # At once, without a turn of the loop; nor does its command in the stream wait.
    assert here.answers == [("stop", 1, "done")]
    assert here.published[-1]["status"] == "stopped"
    here.loop.run()
    said = {(note, what) for note, _, what in here.answers[1:]}
    assert {note for note, what in said if what == "stopped"} == {names[7]}
    assert len(here.answers) == 61
    here.sessions.close()


def test_messages_are_read_between_two_mappings() -> None:
    here, sampler = BusyDesk("one", "other"), Sampler()
    for name in ("one", "other"):
        here.send(sample_of(name, sampler, here.now), name)
    here.loop.turn()
    assert len(here.answers) == 1
    # A message that arrives during a mapping passes the sockets in some turns of the loop.
    here.loop.turn()
    here.loop.turn()
    assert len(here.answers) == 1
    here.send(Stop(protocol=PROTOCOL, seq=1), "all")
    assert here.answers[-1] == ("all", 1, "done")
    here.loop.run()
    assert here.answers[-1][2] == "stopped"
    here.sessions.close()


def test_sessions_take_turns_however_much_one_of_them_sends() -> None:
    here, sampler = BusyDesk("one", "other"), Sampler()
    for _ in range(5):
        here.send(sample_of("one", sampler, here.now), "one")
    here.send(sample_of("other", sampler, here.now), "other")
    here.loop.run()
    assert [note for note, *_ in here.answers].index("other") == 1
    here.sessions.close()


@pytest.mark.parametrize("kind", [Stop, Disengage])
def test_a_clients_own_stop_makes_its_waiting_samples_stale(
    kind: type[Stop] | type[Disengage],
) -> None:
    here, sampler = BusyDesk("one"), Sampler()
    here.send(sample_of("one", sampler, here.now), "sample")
    secret = secret_of("one")
    here.send(kind(protocol=PROTOCOL, seq=50, session=secret), "stop")
    here.loop.run()
    assert here.answers == [("stop", 50, "done"), ("sample", 2, "stale")]
    here.sessions.close()


def test_requests_of_a_client_keep_their_order_behind_its_samples() -> None:
    here, sampler = BusyDesk("one"), Sampler()
    here.send(sample_of("one", sampler, here.now), "sample")
    secret = secret_of("one")
    here.send(Engage(protocol=PROTOCOL, seq=50, session=secret), "engage")
    here.send(Status(protocol=PROTOCOL, seq=51, session=secret), "status")
    # Another client does not wait for them.
    here.send(Status(protocol=PROTOCOL, seq=1, name="one"), "watcher")
    here.loop.run()
    assert [note for note, *_ in here.answers] == [
        "watcher",
        "sample",
        "engage",
        "status",
    ]
    here.sessions.close()


def test_what_was_sent_before_a_stop_does_not_undo_it() -> None:
    here, sampler = BusyDesk("one"), Sampler()
    secret = secret_of("one")
    here.send(Stop(protocol=PROTOCOL, seq=3, session=secret), "stop")
    (session,) = here.sessions.by_secret.values()
    number = session.record.stop
    sampler.seq = 9
    here.send(sample_of("one", sampler, here.now), "sample")
    clearing = Clear(protocol=PROTOCOL, seq=50, session=secret, stop=number)
    here.send(clearing, "clear")
    here.send(Engage(protocol=PROTOCOL, seq=51, session=secret), "engage")
    # The clearing waits behind the sample; the second stop comes after it.
    here.send(Stop(protocol=PROTOCOL, seq=1, name="one"), "again")
    assert session.mode == "stopped"
    here.loop.run()
    assert session.mode == "stopped"
    assert [note for note, *_ in here.answers] == [
        "stop",
        "clear",
        "engage",
        "again",
        "sample",
    ]
    here.sessions.close()


def test_a_session_whose_requests_pile_up_is_answered_busy() -> None:
    here, sampler = BusyDesk("one", "other"), Sampler()
    for _ in range(MOST_WAITING + 3):
        here.send(sample_of("one", sampler, here.now), "one")
    assert [said for _, _, said in here.answers] == ["busy"] * 3
    here.send(sample_of("other", sampler, here.now), "other")
    here.loop.run()
    assert len(here.answers) == MOST_WAITING + 4
    assert ("other", sampler.seq, "converged") in here.answers
    here.sessions.close()


def test_of_streamed_samples_the_newest_is_mapped_in_the_turn_of_the_first() -> None:
    here, sampler = BusyDesk("one", "other"), Sampler()
    for i in range(3):
        for name in ("one", "other"):
            here.send(streamed(sample_of(name, sampler, float(i))))
    here.loop.run()
    assert [(each["name"], each["time"]) for each in here.published] == [
        ("one", 2.0),
        ("other", 2.0),
    ]
    assert here.metrics.counts["replaced"] == 4
    here.sessions.close()


@given(st.lists(st.tuples(st.integers(0, 4), st.booleans()), max_size=40))
def test_each_request_is_carried_out_once_in_the_order_of_its_session(
    requests: list[tuple[int, bool]],
) -> None:
    loop, done = Loop(), list[tuple[int, int]]()
    queue = WorkQueue(lambda: 0.0)
    for i, (key, is_mapping) in enumerate(requests):
        run = lambda key=key, i=i: done.append((key, i))  # noqa: E731
        queue.add(key, run, loop.schedule, is_mapping=is_mapping)
    assert len(queue) == len(requests)
    loop.run()
    assert len(queue) == 0
    for key in range(5):
        assert [i for each, i in done if each == key] == [
            i for i, (each, _) in enumerate(requests) if each == key
        ]


def test_a_full_queue_refuses_and_keeps_what_waits() -> None:
    loop, done = Loop(), list[int]()
    queue = WorkQueue(lambda: 0.0)
    for i in range(MOST_WAITING):
        queue.add("one", lambda i=i: done.append(i), loop.schedule, is_mapping=True)
    with pytest.raises(RefusedError, match="send fewer"):
        queue.add("one", lambda: None, loop.schedule, is_mapping=True)
    loop.run()
    assert done == [*range(MOST_WAITING)]


def test_a_flood_of_messages_leaves_half_of_the_time_to_the_samples() -> None:
    loop, now, mapped = Loop(), [0.0], list[float]()

    def run() -> None:
        now[0] += 0.0005
        mapped.append(now[0])

    queue = WorkQueue(lambda: now[0])
    for key in range(1000):
        queue.add(key, run, loop.schedule, is_mapping=True)
    while now[0] < 0.2:
        # Each turn reads for longer than ten mappings take.
        now[0] += 0.006
        loop.turn()
    assert 0.4 <= 0.0005 * len(mapped) / now[0] <= 0.5
    # Between two turns, none lasts longer than a stop may wait.
    gaps = np.diff(mapped)
    longest = np.diff(np.flatnonzero(gaps > 0.001)).max()
    assert longest * 0.0005 <= 0.0055
