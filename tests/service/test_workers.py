"""Worker processes behind one address: sessions, stops, streams, and what a lost worker leaves."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from patience import PATIENCE, wait_until
from service_tools import (
    WEB,
    address_of,
    client_of,
    code_of,
    human_q,
    in_loop,
    opening,
    serving,
)
from websockets.sync.client import connect

from handmap_qp.apps.service.channel import (
    Answered,
    Began,
    Channel,
    FromWorker,
    Noted,
    Published,
    Ready,
    Report,
)
from handmap_qp.apps.service.logs import AuditLog, Metrics
from handmap_qp.apps.service.pool import WorkerPool
from handmap_qp.apps.service.server import Server
from handmap_qp.apps.service.settings import Settings
from handmap_qp.apps.service.store import PostureStore
from handmap_qp.client import Client, ServiceError
from handmap_qp.client.messages import PROTOCOL, Request, Status

# Processes and sockets: not for the fast suite.
pytestmark = pytest.mark.slow

WRIST = np.eye(4)
ALL: dict[str, Any] = {"workers": 2, "max_load": 1.0}
"""Settings of a server that refuses nobody, however busy the machine of the tests is."""


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving(**ALL, **WEB, sessions=6) as running:
        yield running


@pytest.fixture
def clients(server: Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Client]]:
    """Four clients with sessions `lab-0` to `lab-3`, two in each worker."""
    # Loads are those of a machine that may do anything else.
    fewest = property(lambda worker: (0.0, len(worker.sessions)))
    monkeypatch.setattr("handmap_qp.apps.service.pool._Worker.use", fewest)
    made = [client_of(server) for _ in range(4)]
    for i, client in enumerate(made):
        client.open("three_finger", preset="paper", name=f"lab-{i}", is_shared=i == 1)
    yield made
    for client in made:
        with client_of(server) as operator:
            if stop := client.status().stop:
                client.clear(stop)
            operator.status()
        client.close()


def pool_of(server: Server) -> WorkerPool:
    assert isinstance(server.backend, WorkerPool)
    return server.backend


def homes(server: Server) -> dict[str, int]:
    """Return the process that has each session, by name."""
    pool = pool_of(server)
    pids = pool.pids
    found = in_loop(server, lambda: {n: w.number for w, n, _ in pool._open.values()})
    return {name: pids[number] for name, number in found.items()}


def test_each_session_is_in_one_worker_and_all_workers_have_some(
    server: Server, clients: list[Client]
) -> None:
    for i in range(3):
        for client in clients:
            command = client.step(q=human_q(0.1 * i), wrist=WRIST, time=float(i))
            assert command.time == float(i)
    assert sorted(homes(server)) == [f"lab-{i}" for i in range(4)]
    assert {*homes(server).values()} == {*pool_of(server).pids}
    heard = clients[2].latest(PATIENCE)
    assert heard is not None
    assert heard.name == "lab-2"


def test_status_counts_and_metrics_are_those_of_all_workers(
    server: Server, clients: list[Client]
) -> None:
    before = clients[0].status().counts.get("steps", 0)
    with client_of(server) as watcher:
        total = watcher.status().counts.get("steps", 0)
        for client in clients:
            client.step(q=human_q(), wrist=WRIST)
        state = watcher.status()
        assert state.names == tuple(f"lab-{i}" for i in range(4))
        assert state.counts["steps"] == total + 4
        assert "three_finger" in state.robots
    assert clients[0].status().counts["steps"] == before + 1
    # Workers report several times a second.
    wait_until(lambda: f"handmap_steps_total {total + 4}.0" in server.metrics.render())
    metrics = server.metrics.render()
    assert "\nhandmap_workers 2.0\n" in metrics
    assert "\nhandmap_sessions 4.0\n" in metrics
    assert server.health()["status"] == "ok"
    assert server.health()["sessions"] == 4


def test_a_stop_reaches_every_worker_and_one_session_by_its_name(
    server: Server, clients: list[Client]
) -> None:
    with client_of(server) as operator:
        operator.stop("lab-3", reason="test")
        modes = [client.status().mode for client in clients]
        assert [mode == "stopped" for mode in modes] == [False, False, False, True]
        operator.stop()
        assert [client.status().mode for client in clients] == ["stopped"] * 4


def test_others_watch_and_steer_a_session_whichever_worker_has_it(
    server: Server, clients: list[Client]
) -> None:
    for i, client in enumerate(clients):
        with client_of(server) as watcher:
            watcher.watch(f"lab-{i}")
            client.step(q=human_q(), wrist=WRIST, time=7.0 + i)
            heard = wait_until(lambda watcher=watcher: watcher.latest(0.1))
            assert heard.name == f"lab-{i}"
            if i == 1:
                watcher.disengage()
                assert client.status().is_released
            else:
                with pytest.raises(ServiceError, match="is_shared"):
                    watcher.disengage()
    no_session = pytest.raises(ServiceError, match="no session 'none'")
    with client_of(server) as watcher, no_session:
        watcher.watch("none")


def test_a_browser_reads_the_stream_of_any_session(
    server: Server, clients: list[Client]
) -> None:
    with connect(f"ws://127.0.0.1:{server.ports['web']}") as socket:
        head = {"protocol": PROTOCOL, "seq": 1}
        for name in ("lab-0", "lab-1", "none"):
            socket.send(json.dumps({"type": "subscribe", "name": name} | head))
        answers = [json.loads(socket.recv(PATIENCE)) for _ in range(3)]
        assert [answer.get("code", "") for answer in answers] == ["", "", "invalid"]
        seen = set()
        for client in clients[:3]:
            client.step(q=human_q(), wrist=WRIST)
        while len(seen) < 2:
            seen.add(json.loads(socket.recv(PATIENCE))["name"])
        assert seen == {"lab-0", "lab-1"}


def test_limits_count_all_workers(server: Server, clients: list[Client]) -> None:
    extra = [client_of(server) for _ in range(3)]
    try:
        for client in extra[:2]:
            client.open("three_finger", preset="paper")
        with pytest.raises(ServiceError, match="all 6 sessions") as refused:
            extra[2].open("three_finger", preset="paper")
        assert code_of(refused)[0] == "busy"
        # Names and secrets are unique over all workers.
        for name in ("lab-0", "lab-1"):
            with pytest.raises(ServiceError, match="exists"):
                extra[2].open("three_finger", preset="paper", name=name)
    finally:
        for client in extra:
            client.close()


def test_a_message_that_no_worker_can_read_is_answered(server: Server) -> None:
    with connect(f"ws://127.0.0.1:{server.ports['web']}") as socket:
        for message in (
            "{",
            "[1]",
            '{"type": "step"}',
            '{"type": "stop", "seq": "x"}',
            '{"type": "open", "seq": 3, "protocol": 2, "robot": 5}',
            '{"type": "subscribe", "seq": 3, "protocol": 2}',
        ):
            socket.send(message)
            answer = json.loads(socket.recv(PATIENCE))
            assert (answer["type"], answer["code"]) == ("error", "invalid")


def test_a_worker_that_dies_ends_its_sessions_alone_and_they_resume(
    server: Server, clients: list[Client]
) -> None:
    pool = pool_of(server)
    before = [client.step(q=human_q(0.3), wrist=WRIST) for client in clients]
    with client_of(server) as operator:
        operator.stop("lab-0")
        stop = clients[0].status().stop
        victim = homes(server)["lab-0"]
        lost = {name for name, pid in homes(server).items() if pid == victim}
        kept = {name for name, pid in homes(server).items() if pid != victim}
        assert kept
        os.kill(victim, signal.SIGKILL)
        wait_until(lambda: not pool.is_alive)
        assert server.health()["status"] == "stopped"
        assert {*operator.status().names} <= {f"lab-{i}" for i in range(4)}
    for i, client in enumerate(clients):
        command = client.step(q=human_q(0.3), wrist=WRIST)
        assert client.reopened == (f"lab-{i}" in lost)
        # The robot goes on where it was, in the same epoch, and stays stopped.
        assert command.epoch == before[i].epoch
        if i == 0 or f"lab-{i}" in lost:
            np.testing.assert_allclose(command.q, before[i].q, atol=0.2)
    assert clients[0].status().stop == stop
    assert clients[0].status().mode == "stopped"
    wait_until(lambda: pool.is_alive)
    assert victim not in pool.pids
    assert server.metrics.counts["workers_lost"] == 1
    assert server.health()["status"] == "ok"


def test_a_stop_holds_for_a_session_that_was_lost_and_is_not_back_yet(
    server: Server, clients: list[Client]
) -> None:
    pool = pool_of(server)
    for client in clients:
        client.step(q=human_q(), wrist=WRIST)
    wait_until(lambda: pool.is_alive)
    victims = homes(server)
    os.kill(victims["lab-1"], signal.SIGKILL)
    wait_until(lambda: "lab-1" not in pool.names)
    with client_of(server) as operator:
        operator.stop("lab-1")
        operator.stop()
    for client in clients:
        assert client.step(q=human_q(), wrist=WRIST).status == "stopped"
    wait_until(lambda: pool.is_alive)


def test_a_stream_says_that_its_worker_has_ended(server: Server) -> None:
    pool = pool_of(server)
    wait_until(lambda: pool.is_alive)
    with client_of(server) as client:
        client.open("three_finger", preset="paper", name="told")
        heard: list[tuple[str, dict[str, Any]]] = []
        note = lambda name, payload: heard.append(  # noqa: E731
            (name, msgspec.msgpack.decode(payload))
        )
        in_loop(server, lambda: pool.publish.append(note))
        os.kill(homes(server)["told"], signal.SIGKILL)
        wait_until(lambda: heard)
        in_loop(server, lambda: pool.publish.remove(note))
    (name, error), *_ = heard
    assert (name, error["type"], error["code"]) == ("told", "error", "no_session")
    assert "worker process of this session ended" in error["message"]
    wait_until(lambda: pool.is_alive)


def test_sessions_are_restored_from_a_file_by_any_worker(tmp_path: Path) -> None:
    file = tmp_path / "state"
    with serving(**ALL, state=file) as first, client_of(first) as client:
        client.open("three_finger", preset="paper", name="lab")
        for i in range(5):
            last = client.step(q=human_q(0.1 * i), wrist=WRIST)
        client.stop()
        with client_of(first) as other:
            other.open("three_finger", preset="paper", name="other")
    with serving(**ALL, state=file) as second, client_of(second) as client:

        def restored() -> bool:
            # Its owner was another one, whose lease must run out.
            try:
                client.open("three_finger", preset="paper", name="lab", restore=True)
            except ServiceError as error:
                if error.error.code != "busy":
                    raise
                return False
            return True

        wait_until(restored)
        assert client.status().mode == "stopped"
        np.testing.assert_allclose(client.status().q, last.q, atol=0.2)


def run_serve() -> tuple[subprocess.Popen[str], dict[str, Any]]:
    """Start `handmap serve --workers 2` in a process group of its own."""
    choices = "port=0, stream_port=0, health_port=-1, workers=2, log_level='error'"
    code = f"from handmap_qp.apps.service.cli import Serve\nServe({choices}).run()"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    return process, json.loads(process.stdout.readline())


def is_running(pid: int) -> bool:
    """Return whether a process runs; one that waits for its parent does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="ascii")
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state.rpartition(")")[2].split()[0] != "Z"


@pytest.mark.parametrize("how", ["ctrl-c", "kill"])
def test_no_worker_outlives_its_server(how: str) -> None:
    process, ready = run_serve()
    try:
        assert len(ready["workers"]) == 2
        assert all(map(is_running, ready["workers"]))
        with Client(
            f"tcp://127.0.0.1:{ready['ports']['requests']}", timeout=PATIENCE
        ) as c:
            c.open("three_finger", preset="paper")
        if how == "ctrl-c":
            # A terminal sends it to the whole group.
            os.killpg(process.pid, signal.SIGINT)
            assert process.wait(PATIENCE) == 0
        else:
            process.kill()
            process.wait(PATIENCE)
        wait_until(lambda: not any(map(is_running, ready["workers"])))
    finally:
        process.kill()
        process.communicate()


@given(st.lists(st.binary(max_size=300), max_size=20), st.data())
def test_a_channel_passes_messages_on_however_its_bytes_arrive(
    payloads: list[bytes], data: st.DataObject
) -> None:
    sent = [
        Answered(i, each) if i % 2 else Published(str(i), each)
        for i, each in enumerate(payloads)
    ]
    encoded = [msgspec.msgpack.encode(each) for each in sent]
    stream = b"".join(len(e).to_bytes(4, "big") + e for e in encoded)
    received: list[FromWorker] = []
    decode = msgspec.msgpack.Decoder(FromWorker).decode
    channel = Channel[FromWorker](decode, received.append, lambda: None)
    at = 0
    while at < len(stream):
        size = data.draw(st.integers(1, 64))
        channel.data_received(stream[at : at + size])
        at += size
    assert received == sent
    # A message to an end that is gone is dropped.
    channel.send(Noted(b""))


class Quiet:
    """A pool without processes, with a clock of the test."""

    def __init__(self) -> None:
        self.now = 0.0
        self.metrics = Metrics()
        settings = Settings(workers=2, max_load=0.9)
        store, audit = PostureStore(None), AuditLog()
        self.pool = WorkerPool(settings, store, self.metrics, audit, lambda: self.now)
        self.interrupted: list[int] = []

    def serve(self) -> None:
        """Let the workers say that they are ready."""
        for worker in self.pool._workers:
            number = worker.number
            vars(worker)["interrupt"] = lambda n=number: self.interrupted.append(n)
            self.pool.receive_from(worker, Ready())

    def ask(self, request: Request) -> list[dict[str, Any]]:
        """Send a request; return the answers of the pool itself."""
        answers: list[bytes] = []
        payload = msgspec.msgpack.encode(request)
        self.pool.receive(payload, "one", answers.append)
        return [msgspec.msgpack.decode(answer) for answer in answers]


def test_a_pool_without_workers_that_serve_is_busy() -> None:
    here = Quiet()
    for request in (opening(), Status(protocol=PROTOCOL, seq=1)):
        (answer,) = here.ask(request)
        assert answer["code"] == "busy"
    here.serve()
    assert here.ask(opening()) == []


def test_a_worker_that_says_nothing_is_killed() -> None:
    here = Quiet()
    here.serve()
    first, other = here.pool._workers
    numbers = Report({}, {}, (0,) * 9, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, (), 0)
    for _ in range(3):
        here.now += 6.0
        here.pool.receive_from(other, numbers)
        here.pool.tick()
    assert here.interrupted == [first.number]


def test_a_session_goes_to_the_worker_that_works_least() -> None:
    here = Quiet()
    here.serve()
    first, other = here.pool._workers
    loads = {first: 0.5, other: 0.35}
    chosen = []
    for i in range(4):
        for worker, load in loads.items():
            numbers = (0.0, load, 0.0, 0.0, 0.0, 0.0, 0.0, (), 0)
            if i in (0, 3):
                here.pool.receive_from(worker, Report({}, {}, (0,) * 9, *numbers))
        least = here.pool._least()
        chosen.append(least)
        here.pool.receive_from(least, Began(f"secret-{i}" * 3, f"name-{i}", "one"))
    # What was opened since the last report counts, too.
    assert chosen == [other, other, first, other]


def test_a_server_that_has_no_time_to_pass_messages_on_opens_nothing() -> None:
    here = Quiet()
    here.serve()
    here.pool.load.waited = lambda: 0.05 * here.now
    here.now += 1.0
    here.pool.tick()
    (answer,) = here.ask(opening())
    assert answer["code"] == "busy"
    assert "95%" in answer["message"]
    assert "\nhandmap_load 0.95" in here.metrics.render()


def test_addresses_are_those_of_one_server(server: Server) -> None:
    assert address_of(server).endswith(str(server.ports["requests"]))
    with pytest.raises(Exception, match="workers"):
        _ = server.dispatcher
