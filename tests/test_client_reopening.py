"""What a robot's driver sees when a server loses a session and its client opens it anew: no jump that it is not told of."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from service_tools import LOCAL, address_of, connected, human_q, serving

from handmap_qp.client import AsyncClient, Client, Command, ServiceError
from handmap_qp.service.caps import Caps
from handmap_qp.service.server import Server

WRIST = np.eye(4)
PERIOD = 1.0 / 60.0


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as running:
        yield running


def lose_sessions(server: Server) -> None:
    """As a server does with those that it has not heard of for long."""
    server.dispatcher.sessions.entries.clear()


@contextmanager
def driver_of(server: Server, name: str) -> Iterator[Callable[[], list[Command]]]:
    """A robot's driver in a client of its own, and the commands that it hears."""
    with Client(address_of(server), timeout=2.0) as driver:
        driver.watch(name)

        def heard() -> list[Command]:
            commands = []
            while (command := driver.latest(0.1)) is not None:
                commands.append(command)
                if len(commands) > 3:
                    break
            return commands

        yield heard


def stream(tracker: Client, start: int, count: int = 20) -> None:
    """Samples without answers, as a tracker sends that leaves commands to the robot's driver."""
    for i in range(count):
        tracker.send(q=human_q(0.1 * (start + i)), wrist=WRIST)
        time.sleep(PERIOD)


def test_a_tracker_that_only_sends_is_opened_anew_where_its_robot_is(server: Server) -> None:
    with connected(server, name="lab") as tracker, driver_of(server, "lab") as heard:
        stream(tracker, 0)
        before = heard()[-1]
        lose_sessions(server)
        stream(tracker, 20, 5)
        after = heard()[-1]
        assert tracker.reopened == 1
        assert before.epoch == after.epoch
        session = server.dispatcher.sessions.named("lab")
    # At most what the new session's few commands may account for.
    limits = session.robot.velocity_limits * session.request.max_dt * session.counts["steps"]
    assert (np.abs(np.subtract(after.q, before.q)) <= limits + 1e-9).all()
    assert np.abs(np.subtract(before.q, session.robot.rest)).max() > 0.1


@pytest.mark.parametrize("remembers", [False, True])
def test_a_restarted_server_goes_on_or_says_that_it_does_not_know(free_port: int, tmp_path: Path, remembers: bool) -> None:
    choices: dict[str, Any] = {"port": free_port} | ({"state": tmp_path / "state"} if remembers else {})
    with Client(f"tcp://127.0.0.1:{free_port}", timeout=1.0) as tracker:
        with serving(LOCAL, **choices):
            tracker.open("three_finger", name="lab")
            stream(tracker, 0)
            before = tracker.latest(1.0)
        with serving(LOCAL, **choices):
            after = tracker.step(q=human_q(2.0), wrist=WRIST)
    assert before is not None
    assert (after.epoch == before.epoch) == remembers
    assert (after.name, tracker.reopened) == ("lab", 1)
    assert np.abs(np.subtract(after.q, before.q)).max() < 0.2


def test_sessions_keep_the_names_that_the_server_gave_them(free_port: int) -> None:
    address = f"tcp://127.0.0.1:{free_port}"
    with Client(address, timeout=1.0) as left, Client(address, timeout=1.0) as right:
        with serving(LOCAL, port=free_port):
            names = [client.open("three_finger").name for client in (left, right)]
            for client in (left, right):
                client.step(q=human_q(), wrist=WRIST)
        with serving(LOCAL, port=free_port):
            found = {client: client.step(q=human_q(), wrist=WRIST).name for client in (right, left)}
    assert [found[left], found[right]] == names


@pytest.mark.parametrize("by", ["its client", "another"])
def test_a_robot_that_was_let_go_is_not_taken_hold_of_again(server: Server, by: str) -> None:
    with connected(server, name="lab", is_shared=True) as tracker, Client(address_of(server)) as other:
        tracker.step(q=human_q(), wrist=WRIST)
        other.watch("lab")
        (tracker if by == "its client" else other).release()
        before = tracker.step(q=human_q(), wrist=WRIST)
        lose_sessions(server)
        after = tracker.step(q=human_q(2.0), wrist=WRIST)
        assert (tracker.reopened, after.status, after.q) == (1, "released", before.q)
        tracker.clutch()
        assert tracker.step(q=human_q(2.0), wrist=WRIST).status != "released"


def test_a_session_that_begins_anew_has_another_epoch(server: Server) -> None:
    epochs = []
    for _ in range(2):
        with connected(server, name="lab") as tracker:
            epochs.append(tracker.step(q=human_q(), wrist=WRIST).epoch)
    assert epochs[0] < epochs[1]


def test_a_sample_that_cannot_be_sent_on_is_told_at_the_next(server: Server) -> None:
    with Client(address_of(server)) as nobody, pytest.raises(RuntimeError, match="open a session"):
        nobody.send(q=human_q(), wrist=WRIST)
    with connected(server) as tracker:
        tracker.send(q=np.full(20, np.nan), wrist=WRIST)
        time.sleep(0.2)
        with pytest.raises(ServiceError, match=r"q\[0\]"):
            tracker.send(q=human_q(), wrist=WRIST)
        tracker.send(q=human_q(), wrist=WRIST)
        assert tracker.latest(1.0) is not None


def test_one_task_waits_for_commands_while_another_sends(server: Server) -> None:
    async def main() -> tuple[float, set[str]]:
        async with AsyncClient(address_of(server), timeout=3.0) as client:
            await client.open("three_finger")
            found: set[str] = set()

            async def drive() -> None:
                while (command := await client.latest(1.0)) is not None and command.time < 29.0:
                    found.add(command.status)

            driving, started = asyncio.create_task(drive()), time.monotonic()
            for i in range(30):
                await client.send(q=human_q(0.01 * i), wrist=WRIST, time=float(i))
                await asyncio.sleep(0.002)
            elapsed = time.monotonic() - started
            await driving
            return elapsed, found

    elapsed, found = asyncio.run(main())
    # The wait for a command is up to a second.
    assert elapsed < 1.0
    assert "hold" not in found


def test_an_idle_session_comes_back_where_it_was() -> None:
    with serving(caps=Caps(idle=0.2)) as server, connected(server, name="lab") as tracker:
        last = [tracker.step(q=human_q(0.2 * i), wrist=WRIST) for i in range(10)][-1]
        time.sleep(0.4)
        after = tracker.step(q=human_q(2.0), wrist=WRIST)
        assert (tracker.reopened, after.epoch) == (1, last.epoch)
        assert np.abs(np.subtract(after.q, last.q)).max() < 0.2


def test_a_tracker_that_only_sends_and_was_idle_keeps_name_and_posture() -> None:
    with serving(caps=Caps(idle=0.4)) as server, Client(address_of(server), timeout=2.0) as tracker:
        name = tracker.open("three_finger").name
        with driver_of(server, name) as heard:
            stream(tracker, 0)
            before = heard()[-1]
            # The stream's last word is then that the session was closed.
            time.sleep(0.8)
            stream(tracker, 20, 3)
            after = heard()[-1]
    assert (tracker.reopened, after.name, after.epoch) == (1, name, before.epoch)
    assert np.abs(np.subtract(after.q, before.q)).max() < 0.4


def test_a_reset_takes_hold_again_for_good(server: Server) -> None:
    with connected(server, name="lab", is_released=True) as tracker:
        assert tracker.step(q=human_q(), wrist=WRIST).status == "released"
        tracker.reset()
        assert tracker.step(q=human_q(), wrist=WRIST).status != "released"
        lose_sessions(server)
        assert tracker.step(q=human_q(), wrist=WRIST).status != "released"
