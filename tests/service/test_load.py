"""Load: measured with a clock of the test, sessions refused and shed by it, and said to clients."""

from __future__ import annotations

import asyncio
import io
import json
import logging
import selectors
import socket
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from patience import wait_until
from service_desk import Desk, sample_of, secret_of
from service_tools import (
    PERIOD,
    Sampler,
    code_of,
    connected,
    human_q,
    in_loop,
    opening,
    serving,
    streamed,
)

from handmap_qp.apps.service.load import LATE, WINDOW, LoadMeter, TimedSelector
from handmap_qp.apps.service.logs import JsonLines, log
from handmap_qp.apps.service.sessions import Caller
from handmap_qp.client import ServiceError
from handmap_qp.client.messages import PROTOCOL, Open, Status, Stop
from handmap_qp.errors import RefusedError


class Bench:
    """A meter, with a clock and an event loop of the test."""

    def __init__(self, limit: float = 0.9) -> None:
        self.now = self.waited = 0.0
        self.meter = LoadMeter(limit, lambda: self.now)
        self.meter.waited = lambda: self.waited

    def window(
        self,
        names: Sequence[str],
        load: float,
        *,
        wait: float = 0.0,
        replaced: int = 0,
    ) -> frozenset[str]:
        """Pass a window in which each session that is served takes an equal share."""
        served = [name for name in names if name not in self.meter.shed]
        for name in served:
            self.meter.note(name, wait, load * WINDOW / len(served))
        for _ in range(replaced):
            self.meter.note_replaced()
        self.now += WINDOW
        self.waited += (1.0 - load) * WINDOW
        assert self.now >= self.meter.ends
        self.meter.update(self.now, names)
        return self.meter.shed


NAMES = [f"session-{i}" for i in range(16)]


@given(st.floats(0.0, 1.0))
def test_the_load_is_the_time_in_which_the_loop_does_not_wait(load: float) -> None:
    here = Bench()
    here.window(NAMES[:4], load)
    last = here.meter.last
    assert last.load == pytest.approx(load)
    assert last.rate == pytest.approx(4 / WINDOW)
    assert sum(last.shares.values()) == pytest.approx(load)


def test_a_selector_adds_up_the_time_that_it_waits() -> None:
    times = iter([1.0, 1.25, 5.0, 5.5])
    one, other = socket.socketpair()
    with one, other, TimedSelector(lambda: next(times)) as selector:
        selector.register(one, selectors.EVENT_READ)
        assert selector.select(0.0) == []
        other.send(b"x")
        assert len(selector.select(0.0)) == 1
        assert selector.waited == pytest.approx(0.75)


def test_a_session_is_refused_where_it_would_exceed_the_limit() -> None:
    here = Bench(0.9)
    here.window(NAMES[:8], 0.78)
    # Each takes a tenth of it.
    here.meter.check_room(8, 0, [])
    with pytest.raises(
        RefusedError, match=r"78%.* 8 sessions.* 8 samples a second"
    ) as said:
        here.meter.check_room(8, 1, [])
    assert said.value.code == "busy"


def test_a_session_is_expected_to_take_what_those_of_its_robot_take() -> None:
    here = Bench(0.9)
    here.meter.note("slow", 0.0, 0.35 * WINDOW)
    here.meter.note("quick", 0.0, 0.05 * WINDOW)
    here.now += WINDOW
    here.waited += 0.4 * WINDOW
    here.meter.update(here.now, ["slow", "quick"])
    # Messages take a third of the load, which is shared in proportion.
    here.meter.check_room(2, 0, ["quick"])
    with pytest.raises(RefusedError):
        here.meter.check_room(2, 0, ["slow"])


@pytest.mark.parametrize("limit", [0.9, 1.0])
def test_the_first_session_is_never_refused(limit: float) -> None:
    here = Bench(limit)
    here.window(NAMES[:1], 1.0)
    here.meter.check_room(0, 0, [])
    if limit == 1.0:
        here.meter.check_room(1, 0, [])


def test_a_load_that_is_not_measured_refuses_nobody() -> None:
    here = Bench()
    here.meter.waited = None
    assert here.window(NAMES, 1.0, wait=1.0) == frozenset()
    assert here.window(NAMES, 1.0, wait=1.0) == frozenset()
    here.meter.check_room(16, 0, [])


def test_the_sessions_opened_last_are_shed_and_the_first_is_kept() -> None:
    here = Bench()
    assert here.window(NAMES, 1.0, wait=2.0 * LATE) == frozenset()
    assert here.window(NAMES, 1.0, wait=2.0 * LATE) == {*NAMES[14:]}
    for _ in range(60):
        before = here.meter.shed
        shed = here.window(NAMES, 1.0, wait=2.0 * LATE)
        assert before <= shed == {*NAMES[len(NAMES) - len(shed) :]}
    assert shed == {*NAMES[1:]}


def test_as_many_are_shed_at_once_as_samples_were_replaced() -> None:
    here = Bench()
    here.window(NAMES, 1.0, wait=1.0, replaced=48)
    # Of four samples, one is mapped.
    assert here.window(NAMES, 1.0, wait=1.0, replaced=48) == {*NAMES[4:]}


@pytest.mark.parametrize(("load", "wait"), [(1.0, 0.5 * LATE), (0.8, 10.0 * LATE)])
def test_a_full_load_without_delay_and_a_delay_without_load_shed_nobody(
    load: float, wait: float
) -> None:
    here = Bench()
    for _ in range(10):
        assert here.window(NAMES, load, wait=wait) == frozenset()


def test_sessions_come_back_in_their_order_while_there_is_room() -> None:
    here = Bench()
    for _ in range(2):
        here.window(NAMES[:8], 1.0, wait=1.0, replaced=8)
    assert here.meter.shed == {*NAMES[4:8]}
    seen = []
    for _ in range(40):
        # Each session takes 0.15.
        served = 8 - len(here.meter.shed)
        seen.append(len(here.window(NAMES[:8], 0.15 * served)))
    assert here.meter.shed == {*NAMES[6:8]}
    assert seen == sorted(seen, reverse=True)
    # A session that ends makes room; one that is gone is not remembered.
    left = [name for name in NAMES[:8] if name not in (NAMES[0], NAMES[7])]
    for _ in range(2):
        here.window(left, 0.75)
    assert here.meter.shed == frozenset()


def served(desk: Desk, *names: str) -> dict[str, Sampler]:
    """Open sessions at a desk; return what makes their samples."""
    made = {}
    for name in names:
        request = msgspec.structs.replace(opening(name=name), session=secret_of(name))
        asyncio.run(desk.sessions.open(request, Caller()))
        made[name] = Sampler()
    return made


def overloaded(desk: Desk) -> dict[str, Sampler]:
    """Open two sessions, and shed the second."""
    samplers = served(desk, "first", "second")
    desk.sessions.load.waited = lambda: 0.0
    for _ in range(2):
        for name, sampler in samplers.items():
            assert desk.take(sample_of(name, sampler, desk.now))[0]["type"] == "command"
            desk.sessions.load.note(name, 1.0, 0.5)
        desk.wait(WINDOW)
    assert desk.sessions.load.shed == {"second"}
    return samplers


def test_a_sample_of_a_session_that_is_shed_is_answered_busy_and_its_robot_holds() -> (
    None
):
    here = Desk()
    samplers = overloaded(here)
    for _ in range(40):
        here.wait(PERIOD)
        answers = {
            n: here.take(sample_of(n, s, here.now))[0] for n, s in samplers.items()
        }
        assert answers["first"]["type"] == "command"
        assert answers["second"]["code"] == "busy"
        assert "100% of the time, for 2 sessions" in answers["second"]["message"]
    assert here.sessions.named("second").mode == "hold"
    assert here.sessions.named("first").mode == "following"
    # The stream may keep the command of the watchdog only.
    held = [each for each in here.published if "watchdog" in each.get("flags", ())]
    assert {each["name"] for each in held if "busy" in each["flags"]} == {"second"}
    # One that is streamed is answered in the stream.
    before = len(here.published)

    async def stream() -> None:
        here.take(streamed(sample_of("second", samplers["second"], here.now)))
        await asyncio.sleep(0.0)

    asyncio.run(stream())
    assert here.published[before]["code"] == "busy"
    # Everything but samples is carried out.
    (done,) = here.take(Stop(protocol=PROTOCOL, seq=1, name="second"))
    assert done["type"] == "done"
    assert here.sessions.named("second").mode == "stopped"
    here.sessions.close()


def test_status_metrics_and_log_say_whom_a_server_serves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    text = io.StringIO()
    handler = logging.StreamHandler(text)
    handler.setFormatter(JsonLines())
    monkeypatch.setattr(log, "handlers", [handler])
    monkeypatch.setattr(log, "level", logging.INFO)
    here = Desk()
    overloaded(here)
    (state,) = here.take(Status(protocol=PROTOCOL, seq=1))
    assert (state["load"], state["busy"]) == (1.0, ["second"])
    assert state["samples_per_second"] > 0.0
    (state,) = here.take(Status(protocol=PROTOCOL, seq=2, name="second"))
    assert state["busy"] == ["second"]
    assert "\nhandmap_shed_sessions 1.0\n" in here.metrics.render()
    assert "\nhandmap_load 1.0\n" in here.metrics.render()
    events = [json.loads(line) for line in text.getvalue().splitlines()]
    (line,) = [each for each in events if each["event"] == "overload"]
    assert line["shed"] == ["second"]
    here.sessions.close()


def open_now(desk: Desk, request: Open) -> str:
    """Open a session; return the code of the refusal, or nothing."""
    try:
        asyncio.run(desk.sessions.open(request, Caller()))
    except RefusedError as error:
        return error.code
    return ""


def test_a_server_that_is_full_opens_no_session_but_gives_back_its_own() -> None:
    here = Desk()
    samplers = served(here, "first", "second")
    here.sessions.load.waited = lambda: 0.3 * here.now
    for name, sampler in samplers.items():
        here.take(sample_of(name, sampler, here.now))
        here.sessions.load.note(name, 0.0, 0.3)
    here.wait(WINDOW)
    another = msgspec.structs.replace(opening(name="third"), session="x" * 20)
    assert open_now(here, another) == "busy"
    # A client that comes back takes no more than it had.
    again = msgspec.structs.replace(
        opening(name="second", restore=True), session=secret_of("second"), seq=99
    )
    assert open_now(here, again) == ""
    here.sessions.end(here.sessions.named("first"), "test")
    here.sessions.load.waited = lambda: here.now
    here.wait(WINDOW)
    assert open_now(here, another) == ""
    here.sessions.close()


@pytest.mark.slow
def test_a_client_is_told_that_its_samples_are_not_served() -> None:
    q, wrist = human_q(), np.eye(4)
    with serving() as server, connected(server, name="lab", watchdog=0.05) as client:
        client.step(q=q, wrist=wrist)
        load = server.dispatcher.sessions.load
        in_loop(server, lambda: vars(load).update(shed=frozenset({"lab"})))
        with pytest.raises(ServiceError) as refused:
            client.step(q=q, wrist=wrist)
        assert code_of(refused)[0] == "busy"
        assert client.status().busy == ("lab",)

        def told() -> bool:
            """Stream a sample; return whether the stream says why the robot holds."""
            client.send(q=q, wrist=wrist)
            try:
                command = client.latest(0.1)
            except ServiceError as error:
                return error.error.code == "busy"
            return command is not None and "busy" in command.flags

        wait_until(told)
        client.stop()
        assert client.status().mode == "stopped"
        in_loop(server, lambda: vars(load).update(shed=frozenset()))
        assert client.step(q=q, wrist=wrist).status == "stopped"
