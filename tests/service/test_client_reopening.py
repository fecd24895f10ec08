"""Reopened sessions: the robot's driver sees no jump without a new epoch."""

from __future__ import annotations

import asyncio
import itertools
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from patience import PATIENCE, wait_until
from service_tools import (
    LOCAL,
    address_of,
    assert_no_jump,
    client_of,
    code_of,
    connected,
    heard,
    human_q,
    in_loop,
    lose_sessions,
    send_until_reopened,
    serving,
    skip,
)

from handmap_qp.apps.service.server import Server
from handmap_qp.apps.service.sessions import LEASE
from handmap_qp.client import AsyncClient, Client, Command, ServiceError
from handmap_qp.client.messages import Error

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

WRIST = np.eye(4)
# Longer than the idle time of sessions [s].
LONG = 100.0


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as running:
        yield running


@contextmanager
def driver_of(server: Server, name: str) -> Iterator[Client]:
    """Watch the session as a robot's driver in a client of its own."""
    with client_of(server) as driver:
        driver.watch(name)
        yield driver


def lead_away(tracker: Client, driver: Client) -> Command:
    """Send samples without answers until the robot has moved.

    Returns:
        The last command.
    """
    assert tracker.opened is not None
    start, stamps = tracker.opened.q, itertools.count()

    def go_on() -> Command | None:
        stamp = float(next(stamps))
        tracker.send(q=human_q(min(0.1 * stamp, 1.5)), wrist=WRIST, time=stamp)
        command = heard(driver, stamp)
        return command if np.abs(np.subtract(command.q, start)).max() > 0.1 else None

    return wait_until(go_on)


def test_a_tracker_that_only_sends_is_reopened_where_its_robot_is(
    server: Server,
) -> None:
    with connected(server, name="lab") as tracker, driver_of(server, "lab") as driver:
        before = lead_away(tracker, driver)
        lose_sessions(server)
        send_until_reopened(tracker, q=human_q(2.0), wrist=WRIST, time=1e3)
        after = heard(driver, 1e3)
        assert (tracker.reopened, after.epoch) == (1, before.epoch)
        assert_no_jump(tracker, before, after)


@pytest.mark.parametrize("remembers", [False, True])
def test_a_restarted_server_continues_or_changes_the_epoch(
    free_port: int, tmp_path: Path, remembers: bool
) -> None:
    choices: dict[str, Any] = {"port": free_port} | (
        {"state": tmp_path / "state"} if remembers else {}
    )
    tracker = Client(f"tcp://127.0.0.1:{free_port}", timeout=PATIENCE)
    with serving(LOCAL, **choices):
        tracker.open("three_finger", name="lab")
        before = lead_away(tracker, tracker)
    with serving(LOCAL, **choices), tracker:
        after = tracker.step(q=human_q(2.0), wrist=WRIST)
        assert (after.epoch == before.epoch) == remembers
        assert (after.name, tracker.reopened) == ("lab", 1)
        assert_no_jump(tracker, before, after)


def test_sessions_keep_the_names_that_the_server_gave_them(free_port: int) -> None:
    left, right = (
        Client(f"tcp://127.0.0.1:{free_port}", timeout=PATIENCE) for _ in range(2)
    )
    with serving(LOCAL, port=free_port):
        names = [client.open("three_finger").name for client in (left, right)]
        for client in (left, right):
            client.step(q=human_q(), wrist=WRIST)
    with serving(LOCAL, port=free_port), left, right:
        found = {
            client: client.step(q=human_q(), wrist=WRIST).name
            for client in (right, left)
        }
    assert [found[left], found[right]] == names


@pytest.mark.parametrize("by", ["its client", "another"])
def test_a_robot_that_was_let_go_is_not_taken_hold_of_again(
    server: Server, by: str
) -> None:
    with (
        connected(server, name="lab", is_shared=True) as tracker,
        client_of(server) as other,
    ):
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


def test_a_refused_sample_is_reported_at_the_next_one(server: Server) -> None:
    with (
        client_of(server) as nobody,
        pytest.raises(RuntimeError, match="open a session"),
    ):
        nobody.send(q=human_q(), wrist=WRIST)

    def refused() -> int:
        return in_loop(server, lambda: server.metrics.refusals["invalid"])

    with connected(server) as tracker:
        before = refused()
        tracker.send(q=np.full(20, np.nan), wrist=WRIST)
        wait_until(lambda: refused() > before)
        # The answer may not have arrived yet.
        with pytest.raises(ServiceError, match=r"q\[0\]"):
            wait_until(lambda: tracker.send(q=human_q(), wrist=WRIST))
        tracker.send(q=human_q(), wrist=WRIST, time=1e3)
        heard(tracker, 1e3)


def test_one_task_waits_for_commands_while_another_sends(server: Server) -> None:
    async def main() -> Command | None:
        async with AsyncClient(address_of(server), timeout=PATIENCE) as client:
            await client.open("three_finger")
            driving = asyncio.ensure_future(client.latest(PATIENCE))
            # The task waits now. Without samples there are no commands, so a common lock would be a
            # deadlock.
            await asyncio.sleep(0.0)
            while not driving.done():
                await client.send(q=human_q(), wrist=WRIST)
                await asyncio.sleep(0.01)
            return driving.result()

    assert asyncio.run(main()) is not None


def test_an_idle_session_comes_back_where_it_was(server: Server) -> None:
    with connected(server, name="lab") as tracker:
        before = [tracker.step(q=human_q(0.2 * i), wrist=WRIST) for i in range(10)][-1]
        skip(server, LONG)
        after = tracker.step(q=human_q(2.0), wrist=WRIST)
        assert (tracker.reopened, after.epoch) == (1, before.epoch)
        assert_no_jump(tracker, before, after)


def test_a_tracker_that_only_sends_and_was_idle_keeps_name_and_posture(
    server: Server,
) -> None:
    with client_of(server) as tracker:
        name = tracker.open("three_finger").name
        with driver_of(server, name) as driver:
            before = lead_away(tracker, driver)
            # The last message of the stream then says that the session was closed.
            skip(server, LONG)
            send_until_reopened(tracker, q=human_q(2.0), wrist=WRIST, time=1e3)
            after = heard(driver, 1e3)
        assert (tracker.reopened, after.name, after.epoch) == (1, name, before.epoch)
        assert_no_jump(tracker, before, after)


def test_a_reset_takes_hold_again_for_good(server: Server) -> None:
    with connected(server, name="lab", is_released=True) as tracker:
        assert tracker.step(q=human_q(), wrist=WRIST).status == "released"
        tracker.reset()
        assert tracker.step(q=human_q(), wrist=WRIST).status != "released"
        lose_sessions(server)
        assert tracker.step(q=human_q(), wrist=WRIST).status != "released"


def test_a_release_that_only_the_watchdog_told_of_outlives_the_server(
    free_port: int,
) -> None:
    tracker, other = (
        Client(f"tcp://127.0.0.1:{free_port}", timeout=PATIENCE) for _ in range(2)
    )
    with serving(LOCAL, port=free_port), other:
        tracker.open("three_finger", name="lab", is_shared=True)
        before = tracker.step(q=human_q(), wrist=WRIST)
        other.watch("lab")
        other.release()
        wait_until(
            lambda: (
                (command := tracker.latest(0.1)) is not None
                and "released" in command.flags
            )
        )
    with serving(LOCAL, port=free_port), tracker:
        after = tracker.step(q=human_q(2.0), wrist=WRIST)
        assert (tracker.reopened, after.status, after.q) == (1, "released", before.q)


def test_a_session_that_is_lost_twice_keeps_the_last_posture(server: Server) -> None:
    with connected(server, name="lab", watchdog=10.0) as tracker:
        # Empty the stream, so that the client must remember the command.
        last = wait_until(
            lambda: (
                tracker.step(q=human_q(), wrist=WRIST) and tracker.latest(timeout=0.1)
            )
        )
        for reopened in (1, 2):
            # As by a restart without --state.
            in_loop(server, server.dispatcher.sessions.by_secret.clear)
            assert tracker.status().q == pytest.approx(last.q, abs=1e-9)
            assert tracker.reopened == reopened
        request = tracker._open_request
        assert request["robot_q"] == pytest.approx(last.q, abs=1e-9)
        assert request["robot_wrist"] == last.wrist


def test_a_command_of_an_earlier_sample_does_not_undo_a_release(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    with connected(server, name="lab") as tracker:

        def read(command: Command) -> None:
            async def stream(*_: Any) -> bytes:
                return b"lab\0" + msgspec.msgpack.encode(command)

            with monkeypatch.context() as patch:
                patch.setattr(tracker, "_io", stream)
                assert tracker.latest() == command

        earlier = tracker.step(q=human_q(), wrist=WRIST)
        tracker.release()
        # The stream may deliver the earlier command after the answer to the release.
        read(earlier)
        assert tracker._open_request["is_released"]
        after = msgspec.structs.replace(earlier, seq=earlier.seq + 2)
        read(after)
        assert not tracker._open_request["is_released"]


def test_nobody_takes_a_session_whose_client_is_heard_from(server: Server) -> None:
    with (
        connected(server, name="lab", input="landmarks") as tracker,
        client_of(server) as button,
        client_of(server) as thief,
    ):
        wants: dict[str, Any] = {"name": "lab", "preset": "paper", "restore": True}

        def is_busy() -> bool:
            with pytest.raises(ServiceError) as raised:
                thief.open("three_finger", **wants)
            return code_of(raised) == ("busy", "name")

        # The hand is lost, then the robot is stopped; the client only asks for the status.
        for heartbeat in (
            lambda: tracker.step(valid=False),
            lambda: button.stop("lab") or tracker.status(),
            tracker.status,
        ):
            skip(server, 0.9 * LEASE)
            heartbeat()
            assert is_busy()
            skip(server, 0.9 * LEASE)
            assert is_busy()
            heartbeat()
        stop, before = tracker.status().stop, tracker.latest(PATIENCE)
        # Silent for longer than the lease: a new owner, a new epoch, and still stopped.
        skip(server, 1.1 * LEASE)
        thief.open("three_finger", **wants)
        after = wait_until(lambda: thief.latest(0.1))
        assert before is not None
        assert thief.status().stop == stop
        assert after.epoch > before.epoch


def test_a_stop_outlives_a_session_that_is_not_restored(server: Server) -> None:
    with connected(server, name="lab") as tracker:
        tracker.step(q=human_q(), wrist=WRIST)
        tracker.stop()
        number = tracker.status().stop
    with connected(server, name="lab") as again:
        assert again.status().stop == number
        again.clear(number)
    with connected(server, name="lab") as third:
        assert not third.status().stop


def test_a_client_restores_its_running_session_with_its_secret(server: Server) -> None:
    with connected(server, name="lab") as tracker:
        before = tracker.step(q=human_q(), wrist=WRIST)
        payload = tracker._open_request
        assert payload["session"] == tracker._addressee["session"]
        tracker._run(tracker._reopen(clock.monotonic() + PATIENCE))
        after = tracker.step(q=human_q(), wrist=WRIST)
        assert (after.epoch, tracker.reopened) == (before.epoch, 1)
        # Neither a repetition with an older number nor another name is its session.
        for number, request in ((0, payload), (10**6, payload | {"name": "other"})):
            tracker._seq = number
            steps = tracker._ask(request, clock.monotonic() + PATIENCE)
            reply = tracker._run(steps)
            assert isinstance(reply, Error)
            assert (reply.code, reply.field) == ("invalid", "session")


def test_records_do_not_hold_secrets(tmp_path: Path) -> None:
    with (
        serving(state=tmp_path / "state") as server,
        connected(server, name="lab") as client,
    ):
        secret = client._addressee["session"]
        written = b"".join(file.read_bytes() for file in tmp_path.iterdir())
        assert secret.encode() not in written
        assert b"secret:" in written
