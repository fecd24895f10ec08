"""Dispatch without sockets: time, simultaneous messages and failures. The test sets the clock."""

from __future__ import annotations

import asyncio
import io
import json
import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from service_desk import Desk
from service_tools import (
    CACHE,
    PERIOD,
    SECRET,
    Sampler,
    human_q,
    make_session,
    opening,
    streamed,
)

from handmap_qp.apps.service.dispatch import decode_request
from handmap_qp.apps.service.logs import JsonLines, log
from handmap_qp.apps.service.session import Session
from handmap_qp.apps.service.sessions import LEASE, Caller
from handmap_qp.apps.service.store import PostureStore, Record
from handmap_qp.apps.service.websocket import _from_json
from handmap_qp.client.messages import (
    PROTOCOL,
    Command,
    Error,
    Measured,
    Status,
)


@contextmanager
def desk(caps: dict[str, Any], **choices: Any) -> Iterator[Desk]:
    """Make a dispatcher with an open session named `lab`."""
    made = Desk(**caps)
    asyncio.run(made.sessions.open(opening(name="lab", **choices), Caller()))
    yield made
    made.sessions.close()


def test_of_samples_that_come_together_the_newest_is_mapped() -> None:
    sample = Sampler()

    async def burst(here: Desk) -> None:
        for i in range(20):
            assert here.take(streamed(sample(float(i)))) == []
        # They are mapped after all waiting messages have been read.
        await asyncio.sleep(0.0)

    with desk({}) as here:
        asyncio.run(burst(here))
        assert [command["time"] for command in here.published] == [19.0]
        assert here.sessions.named("lab").counts == {"steps": 1}
        assert here.metrics.counts["replaced"] == 19


def test_the_next_look_is_when_a_watchdog_may_act() -> None:
    with desk({}, watchdog=0.25, max_dt=0.04) as here:
        # Before the first sample, a robot that was led before may have to brake.
        assert here.dispatcher.tick() <= 0.0
        sample = Sampler()
        here.take(sample())
        # The next sample may be two periods late before the robot brakes.
        assert here.dispatcher.tick() == pytest.approx(0.08)
        here.now += 0.077
        published = len(here.published)
        assert here.dispatcher.tick() == pytest.approx(0.003)
        assert len(here.published) == published
        here.now += 1.0
        assert here.dispatcher.tick() < 0.0
        assert here.published[-1]["status"] == "hold"
        here.take(sample(1.0))
        assert here.dispatcher.tick() == pytest.approx(0.08)
        # A second session that is not led is looked at as often as it needs.
        other = make_session()
        request = msgspec.structs.replace(other.request, session="x" * 20)
        other.request = request
        here.sessions.by_secret[request.session] = other
        assert here.dispatcher.tick() <= 0.0


def test_without_a_session_nothing_is_due() -> None:
    here = Desk()
    assert here.dispatcher.tick() == np.inf
    here.sessions.close()


@pytest.mark.parametrize("error", [None, 0.2])
def test_a_robot_that_may_be_lost_is_looked_at_in_time(error: float | None) -> None:
    with desk({}, watchdog=5.0, max_dt=1.0, following_error=error) as here:
        sample = Sampler()
        here.take(sample())
        (session,) = here.sessions.by_secret.values()
        q = session.posture[0]
        told = Measured(
            protocol=PROTOCOL, seq=99, session=SECRET, measured_q=tuple(q.tolist())
        )
        here.take(told)
        # Measurements that stay away for 150 ms are a loss where errors count.
        assert here.dispatcher.tick() == pytest.approx(0.15 if error else 2.0)


def test_rates_are_capped_for_each_connection_and_recover() -> None:
    sample = Sampler()

    def flood(peer: str) -> list[str]:
        return [
            answer["type"] for _ in range(100) for answer in here.take(sample(), peer)
        ]

    with desk({"rate": 40.0}) as here:
        # A burst of a quarter of a second, and one error for the rest.
        assert flood("one") == ["command"] * 10 + ["error"]
        assert flood("other") == ["command"] * 10 + ["error"]
        here.wait(0.2)
        assert flood("one") == ["command"] * 8 + ["error"]
        assert here.metrics.refusals == {"rate": 2 * 90 + 92}


def test_a_session_that_is_not_heard_of_is_closed_also_while_others_look_on() -> None:
    def look() -> str:
        (answer,) = here.take(Status(protocol=PROTOCOL, seq=1, name="lab"))
        return answer["type"]

    with desk({"idle": 0.32}) as here:
        seen = []
        for _ in range(10):
            here.wait(0.05)
            seen.append(look())
        assert seen == ["state"] * 6 + ["error"] * 4
        assert [(message["type"], message["code"]) for message in here.published] == [
            ("error", "no_session")
        ]


def test_a_session_that_is_heard_of_stays() -> None:
    sample = Sampler()
    with desk({"idle": 0.32}) as here:
        for _ in range(10):
            here.wait(0.3)
            assert here.take(sample())[0]["type"] == "command"


def test_a_robot_on_its_way_to_rest_gets_there_before_its_session_is_closed() -> None:
    sample, rest = Sampler(), CACHE.robot("three_finger", None, None).rest
    with desk({"idle": 0.2}, watchdog=0.05, return_after=0.3) as here:
        for i in range(10):
            here.now += PERIOD
            here.take(sample(i * PERIOD, human_q(0.2 * i)))
        (session,) = here.sessions.by_secret.values()
        assert not np.array_equal(session.posture[0], rest)
        while here.sessions.by_secret:
            here.wait(0.005)
            assert here.now < 60.0
        record = here.store.find("lab", "three_finger", 8)
    assert record is not None
    np.testing.assert_array_equal(record.q, rest)


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """Capture what `handmap serve` would write to stderr."""
    text = io.StringIO()
    handler = logging.StreamHandler(text)
    handler.setFormatter(JsonLines())
    monkeypatch.setattr(log, "handlers", [handler])
    monkeypatch.setattr(log, "level", logging.INFO)
    return text


def test_a_session_that_fails_leaves_the_others_their_watchdogs(
    logged: io.StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    def burst(now: float) -> Command | None:
        raise ZeroDivisionError(f"at {now}")

    here, sessions = Desk(), list[Session]()
    for secret in ("another-secret-of-the-tests", SECRET):
        sessions.append(make_session(watchdog=0.2))
        request = sessions[-1].request
        sessions[-1].request = msgspec.structs.replace(request, session=secret)
        sessions[-1].step(Sampler()(), 0.0)
        here.sessions.by_secret[secret] = sessions[-1]
    monkeypatch.setattr(sessions[0], "tick", burst)
    here.wait(0.3)
    assert sessions[1].mode == "hold"
    (line,) = [
        json.loads(text)
        for text in logged.getvalue().splitlines()
        if "ZeroDivisionError" in text
    ]
    assert (line["event"], line["level"]) == ("failed", "error")
    assert "in burst" in line["traceback"]
    here.sessions.close()


class RecordingStore(PostureStore):
    """A store that counts its records."""

    notes = 0

    def note(self, record: Record) -> None:
        self.notes += 1
        super().note(record)


@pytest.mark.parametrize("file", ["state", None])
def test_postures_are_noted_at_each_command_only_with_a_file(
    tmp_path: Path, file: str | None
) -> None:
    sample, secret = Sampler(), "another-secret-of-the-tests"
    with RecordingStore(tmp_path / file if file else None) as store:
        here = Desk(store)
        asyncio.run(here.sessions.open(opening(name="lab"), Caller()))
        last = [here.take(sample())[0] for _ in range(10)][-1]
        assert store.notes == (11 if file else 0)
        # The posture is known without a file too: at a takeover, and after the end.
        here.wait(2.0 * LEASE)
        again = msgspec.structs.replace(
            opening(name="lab", restore=True), session=secret
        )
        session = asyncio.run(here.sessions.open(again, Caller()))
        assert session.record.q == tuple(last["q"])
        here.sessions.end(session, "test")
        found = store.find("lab", "three_finger", 8)
        assert found is not None
        assert found.q == tuple(last["q"])
        here.sessions.close()


@pytest.mark.parametrize(
    ("message", "field", "said"),
    [
        (
            '{"type": "step", "seq": 1, "protocol": 2, "hands": {"middle": {}}}',
            "hands",
            "enum value 'middle'",
        ),
        ('{"type": "configure", "ik": {"": ', "", "data was truncated"),
        ('{"type": "status", "seq": NaN}', "", "JSON is malformed"),
        (
            '{"type": "stop", "seq": 1, "protocol": 1}',
            "protocol",
            "expected version 2, got 1",
        ),
        (
            '{"type": "status", "seq": 1, "protocol": 3}',
            "protocol",
            "version 1 or 2, got 3",
        ),
    ],
)
def test_an_answer_says_what_was_wrong(message: str, field: str, said: str) -> None:
    reply = decode_request(_from_json(message))
    assert isinstance(reply, Error)
    assert reply.field == field
    assert re.search(said, reply.message)
    assert "MessagePack" not in reply.message
