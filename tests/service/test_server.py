"""The server on its ZeroMQ sockets: answers, caps, streams, restarts; all on loopback."""

from __future__ import annotations

import json
import logging
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq
from patience import PATIENCE, wait_until
from service_tools import (
    HERE,
    SECRET,
    Sampler,
    address_of,
    bare_connection,
    client_of,
    code_of,
    connected,
    heard,
    human_q,
    opening,
    serving,
    skip,
)

from handmap_qp.apps.service.logs import JsonLines, logs_on_stderr, report
from handmap_qp.apps.service.server import Server
from handmap_qp.apps.service.sessions import LEASE
from handmap_qp.apps.service.settings import Settings
from handmap_qp.client import ServiceError
from handmap_qp.client.messages import PROTOCOL, Request, Status
from handmap_qp.errors import InvalidInputError, InvalidOptionsError

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

WRIST = np.eye(4)


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as running:
        yield running


def ask(
    server: Server, *payloads: bytes, kind: int = zmq.DEALER
) -> list[dict[str, Any]]:
    """Send payloads unchanged; return their answers."""
    with zmq.Context() as context, context.socket(kind) as socket:
        socket.linger, socket.rcvtimeo = 0, int(1e3 * PATIENCE)
        socket.connect(address_of(server))
        answers = []
        for payload in payloads:
            socket.send(payload)
            answers.append(msgspec.msgpack.decode(socket.recv()))
        return answers


def encoded(request: Request) -> bytes:
    return msgspec.msgpack.encode(request)


def test_a_step_names_joints_as_the_urdf_does_and_bears_its_number(
    server: Server,
) -> None:
    with connected(server) as client:
        command = client.step(q=human_q(), wrist=WRIST, time=12.5)
        assert command.joint_names[0] == "f1_proximal"
        assert len(command.q) == len(command.joint_names)
        assert (command.seq, command.time) == (2, 12.5)


def test_sessions_are_independent(server: Server) -> None:
    with (
        connected(server, name="a") as first,
        connected(server, name="b", robot="allegro_right") as second,
    ):
        first.step(q=human_q(), wrist=WRIST)
        before = first.step(q=human_q(), wrist=WRIST).q
        for i in range(5):
            second.step(q=human_q(0.2 * i), wrist=WRIST)
        assert np.allclose(first.step(q=human_q(), wrist=WRIST).q, before, atol=1e-6)
        assert set(first.status().names) == {"a"}
        assert len(second.step(q=human_q(), wrist=WRIST).q) == 16


def test_a_session_goes_on_after_bad_input(server: Server) -> None:
    with connected(server) as client:
        client.step(q=human_q(), wrist=WRIST)
        with pytest.raises(ServiceError) as raised:
            client.step(q=human_q()[:5], wrist=WRIST)
        assert code_of(raised) == ("invalid", "q")
        assert client.step(q=human_q(), wrist=WRIST).status == "converged"
        assert client.status().counts["refused"] == 1


def test_the_same_request_twice_is_carried_out_once(server: Server) -> None:
    step = encoded(Sampler()())
    answers = ask(
        server,
        encoded(opening()),
        step,
        step,
        encoded(Status(protocol=PROTOCOL, seq=3, session=SECRET)),
    )
    assert answers[1] == answers[2]
    assert answers[3]["counts"]["steps"] == 1
    # Another request with an old number is not a repetition.
    assert ask(server, encoded(Sampler()(q=human_q(1.0))))[0]["code"] == "stale"


def test_a_req_socket_will_do(server: Server) -> None:
    (answer,) = ask(server, encoded(Status(protocol=PROTOCOL, seq=1)), kind=zmq.REQ)
    assert answer["type"] == "state"
    assert "three_finger" in answer["robots"]


@pytest.mark.parametrize(
    "payload",
    [b"", b"\xc1", b"GET / HTTP/1.1\r\n\r\n", b"\x80", b"\x93\x01\x02"],
    ids=repr,
)
def test_garbage_is_answered_with_an_error(server: Server, payload: bytes) -> None:
    (answer,) = ask(server, payload)
    assert (answer["type"], answer["code"]) == ("error", "invalid")


def test_a_guessed_session_is_refused(server: Server) -> None:
    (answer,) = ask(
        server,
        encoded(msgspec.structs.replace(Sampler()(), session="somebody-elses-one")),
    )
    assert answer["code"] == "no_session"


def test_secrets_have_to_be_long(server: Server) -> None:
    (answer,) = ask(
        server, encoded(msgspec.structs.replace(opening(), session="short"))
    )
    assert (answer["code"], answer["field"]) == ("invalid", "session")


def test_the_newest_sample_wins(server: Server) -> None:
    with connected(server) as client:
        for i in range(200):
            client.send(q=human_q(), wrist=WRIST, time=float(i))
        assert heard(client, 199.0).seq == 201


def test_the_stream_reports_an_unusable_sample(server: Server) -> None:
    with connected(server) as client:

        def send_a_bad_one() -> None:
            client.send(q=human_q()[:3], wrist=WRIST)
            client.latest(0.1)

        # Repeat it, because the subscription may not have arrived yet.
        with pytest.raises(ServiceError) as raised:
            wait_until(send_a_bad_one)
        assert code_of(raised) == ("invalid", "q")


def test_the_stream_has_the_commands_of_the_watchdog(server: Server) -> None:
    with connected(server, watchdog=0.05) as client:
        client.step(q=human_q(), wrist=WRIST)
        wait_until(
            lambda: (command := client.latest(0.1)) and "watchdog" in command.flags
        )


def test_release_clutch_reset_close(server: Server) -> None:
    with connected(server) as client:
        client.step(q=human_q(), wrist=WRIST)
        client.release()
        assert client.step(q=human_q(1.0), wrist=WRIST).status == "released"
        client.clutch()
        assert client.step(q=human_q(1.0), wrist=WRIST).status != "released"
        client.reset()
        client.reset(robot_q=np.zeros(8), robot_wrist=WRIST)
        assert client.status().q == (0.0,) * 8
        client.close()
        with pytest.raises(ServiceError) as raised:
            client.step(q=human_q(), wrist=WRIST)
        assert code_of(raised) == ("no_session", "session")


def test_restore_takes_a_session_over_where_it_is(server: Server) -> None:
    with (
        connected(server, name="mine", watchdog=10.0) as first,
        client_of(server) as second,
    ):
        last = [first.step(q=human_q(0.2 * i), wrist=WRIST) for i in range(10)][-1]
        with pytest.raises(ServiceError) as raised:
            second.open("three_finger", name="mine")
        assert code_of(raised) == ("invalid", "name")
        with pytest.raises(ServiceError) as raised:
            second.open("three_finger", name="mine", restore=True)
        assert code_of(raised) == ("busy", "name")
        # Its client is silent from now on.
        skip(server, 11.0)
        opened = second.open("three_finger", name="mine", restore=True)
        assert opened.q == last.q
        with pytest.raises(ServiceError) as taken:
            first.step(q=human_q(), wrist=WRIST)
        assert code_of(taken)[0] == "taken"


def test_a_session_whose_client_gave_up_waiting_is_taken_over_after_its_lease(
    server: Server,
) -> None:
    with (
        connected(server, name="mine", is_released=True, robot_q=np.zeros(8)),
        client_of(server) as again,
    ):
        with pytest.raises(ServiceError, match="busy"):
            again.open("three_finger", name="mine", restore=True)
        skip(server, 2.0 * LEASE)
        assert again.open("three_finger", name="mine", restore=True).q == (0.0,) * 8
        assert again.step(q=human_q(), wrist=WRIST).status == "released"


def test_restore_needs_something_to_restore(server: Server) -> None:
    with client_of(server) as client:
        with pytest.raises(ServiceError) as raised:
            client.open("three_finger", name="new", restore=True)
        assert code_of(raised) == ("invalid", "restore")
        assert (
            client.open("three_finger", name="new", restore=True, robot_q=np.zeros(8)).q
            == (0.0,) * 8
        )


@pytest.mark.parametrize("wants_restore", [True, False])
def test_a_restarted_server_restores_on_request_only(
    tmp_path: Path, wants_restore: bool
) -> None:
    with (
        serving(state=tmp_path / "state") as before,
        connected(before, name="mine") as client,
    ):
        last = [client.step(q=human_q(0.2 * i), wrist=WRIST) for i in range(10)][-1]
    with serving(state=tmp_path / "state") as after, client_of(after) as client:
        # The owner may be on its way back.
        with pytest.raises(ServiceError, match="busy"):
            client.open("three_finger", name="mine", restore=wants_restore)
        skip(after, 2.0 * LEASE)
        opened = client.open("three_finger", name="mine", restore=wants_restore)
        assert (opened.q == last.q) == wants_restore


def test_a_takeover_needs_no_room_of_its_own() -> None:
    # Lift the cap on openings per second, which is not tested here.
    with (
        serving(sessions=1, opens=1e6) as server,
        connected(server, name="mine"),
        client_of(server) as second,
    ):
        skip(server, 2.0 * LEASE)
        second.open("three_finger", name="mine", restore=True, robot_q=np.zeros(8))


def test_sessions_are_capped() -> None:
    with (
        serving(sessions=2) as server,
        connected(server),
        connected(server),
        client_of(server) as third,
    ):
        with pytest.raises(ServiceError) as raised:
            third.open("three_finger")
        assert code_of(raised)[0] == "busy"


def test_a_client_above_the_rate_limit_gets_an_error() -> None:
    # One message now, and the next one after a quarter of an hour.
    with serving(rate=1e-3) as server, client_of(server) as client:
        client.status()
        with pytest.raises(ServiceError) as raised:
            client.status()
        assert code_of(raised)[0] == "rate"


def test_a_message_that_is_too_long_costs_the_connection_and_nothing_else(
    server: Server,
) -> None:
    with bare_connection(server) as (socket, next_event):
        socket.send(b"x" * 20_000)
        wait_until(lambda: next_event() == zmq.EVENT_DISCONNECTED)
        assert not socket.poll(0)
    assert ask(server, encoded(Status(protocol=PROTOCOL, seq=1)))[0]["type"] == "state"


def test_idle_sessions_are_closed(server: Server) -> None:
    with connected(server) as client:
        skip(server, 100.0)
        assert ask(server, encoded(Status(protocol=PROTOCOL, seq=1)))[0]["names"] == []
        assert client.step(q=human_q(), wrist=WRIST).status == "converged"
        assert client.reopened == 1


def test_simulated_time_needs_leave(server: Server) -> None:
    with client_of(server) as client, pytest.raises(ServiceError) as raised:
        client.open("three_finger", time_from="client")
    assert code_of(raised) == ("denied", "time_from")
    with (
        serving(simulated_time=True) as other,
        connected(other, time_from="client") as client,
    ):
        client.step(q=human_q(), wrist=WRIST, time=0.0)
        assert client.step(q=human_q(), wrist=WRIST, time=0.02).dt == pytest.approx(
            0.02
        )


@pytest.mark.parametrize("port", [-2, -1, 65536, 10**9, 10**30])
@pytest.mark.parametrize("name", ["port", "stream_port", "health_port", "web_port"])
def test_a_number_that_is_no_port_is_refused(name: str, port: int) -> None:
    if (name, port) == ("health_port", -1):
        pytest.skip("stands for none")
    choice: dict[str, Any] = {name: port, "web": True}
    message = f"^{name}: expected 0 to 65535, got {port}$"
    with pytest.raises(InvalidInputError, match=message) as raised:
        Settings(**choice).checked()
    assert (raised.value.argument, raised.value.value) == (name, port)


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "192.168.1.2", "::", "example.org", "127.0.0.1.example.org"]
)
def test_off_loopback_keys_are_needed(host: str) -> None:
    with pytest.raises(InvalidOptionsError, match="keys"):
        Settings(host=host).checked()
    with pytest.raises(InvalidOptionsError, match="token"):
        Settings(web=True, web_host=host, web_token_file=Path("token")).checked()


def test_metrics_and_health_are_told_on_loopback() -> None:
    with serving(health_port=0) as server, connected(server) as client:
        for _ in range(3):
            client.step(q=human_q(), wrist=WRIST)
        base = f"http://127.0.0.1:{server.ports['health']}"
        health = json.loads(
            urllib.request.urlopen(f"{base}/health", timeout=PATIENCE).read()
        )
        assert (health["status"], health["sessions"]) == ("ok", 1)
        text = (
            urllib.request.urlopen(f"{base}/metrics", timeout=PATIENCE).read().decode()
        )
        assert "handmap_steps_total 3" in text
        assert "handmap_step_seconds_count 3" in text
        for request in (
            f"{base}/other",
            urllib.request.Request(f"{base}/metrics", headers={"Host": "evil.example"}),
        ):
            with pytest.raises(urllib.error.HTTPError) as raised:
                urllib.request.urlopen(request, timeout=PATIENCE)
            assert raised.value.code in (404, 421)
            raised.value.close()


def test_a_taken_port_is_said(server: Server) -> None:
    with (
        pytest.raises(InvalidInputError, match="in use"),
        serving(port=server.ports["requests"]),
    ):
        pass


def test_only_what_was_ready_has_stopped(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[str] = []
    monkeypatch.setattr(
        "handmap_qp.apps.service.server.report",
        lambda level, event, **data: events.append(event),
    )
    for taken in ("port", "stream_port", "health_port"):
        choice: dict[str, Any] = {taken: server.ports["requests"]}
        with pytest.raises(InvalidInputError, match="in use"), serving(**choice):
            pass
    assert not {"ready", "stopped"} & set(events)
    with serving():
        pass
    # On a busy machine the server may also log that it is late.
    assert [event for event in events if event != "late"] == ["ready", "stopped"]


def test_logs_are_json_lines() -> None:
    record = logging.LogRecord("x", logging.INFO, "", 0, "refused", None, None)
    record.data = {"field": 'a"\n', "wrist": HERE}
    line = JsonLines().format(record)
    assert "\n" not in line
    assert json.loads(line)["field"] == 'a"\n'


def test_logs_are_on_stderr_only_while_a_server_runs(
    capsys: pytest.CaptureFixture[str],
) -> None:
    # Each test has another stderr, as `pytest` captures it, and closes it at its end.
    for event in ("first", "second"):
        with logs_on_stderr("info"):
            report(logging.INFO, event)
        report(logging.INFO, "after")
        assert json.loads(capsys.readouterr().err)["event"] == event
