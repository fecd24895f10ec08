"""Transports: settings that keep a server from listening, and rejected connections."""

from __future__ import annotations

import gc
import json
import resource
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain, count, repeat
from pathlib import Path
from queue import Queue
from typing import Any

import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from marks import crossed
from msgspec.msgpack import decode, encode
from patience import PATIENCE, wait_until
from service_tools import (
    LOCAL,
    WEB,
    Sampler,
    address_of,
    bare_connection,
    client_of,
    connected,
    heard,
    human_q,
    serving,
    skip,
)
from zmq.auth import load_certificate

from handmap_qp import cli
from handmap_qp.apps.addresses import bare_host, service_address
from handmap_qp.apps.service import logs
from handmap_qp.apps.service import server as server_module
from handmap_qp.apps.service.cli import SCHEMAS
from handmap_qp.apps.service.connection_gate import _FRAME, cost_of, count_frames
from handmap_qp.apps.service.dispatch import decode_request
from handmap_qp.apps.service.keys import (
    ClientKeys,
    make_keys,
    read_server_keys,
    read_token,
)
from handmap_qp.apps.service.server import Server, run_server
from handmap_qp.apps.service.sessions import LEASE
from handmap_qp.client import Client
from handmap_qp.client.messages import PROTOCOL, Error
from handmap_qp.errors import InvalidInputError

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "service.md").read_text(
    encoding="utf-8"
)


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """Return a folder with keys of a server and of the client `a`."""
    make_keys(tmp_path, ["a"])
    return tmp_path


def complaint(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    """Return the error of the command line for these words."""
    assert cli.main([str(word) for word in words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"garbage",
        b'    public-key = "a"\n    secret-key = "b"\n',
        bytes(range(256)),
    ],
    ids=repr,
)
def test_a_file_that_is_no_key_is_to_be_deleted_first(
    tmp_path: Path, text: bytes
) -> None:
    make_keys(tmp_path, ["a"])
    (tmp_path / "server.key_secret").write_bytes(text)
    with pytest.raises(
        InvalidInputError,
        match=r"server.key_secret: expected a server's secret key, got something else: delete it",
    ):
        read_server_keys(tmp_path)
    (tmp_path / "server.key_secret").unlink()
    with pytest.raises(
        InvalidInputError, match=f"does not exist: handmap keys {tmp_path} makes it"
    ):
        read_server_keys(tmp_path)
    make_keys(tmp_path, [])
    assert len(read_server_keys(tmp_path)[1]) == 40


def test_a_client_that_was_shut_out_is_admitted_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["keys", str(tmp_path), "--client", "a"]
    assert cli.main(words) == 0
    keys, a = ClientKeys(tmp_path / "clients"), load_certificate(tmp_path / "a.key")[0]
    (tmp_path / "clients" / "a.key").unlink()
    assert not keys.callback("*", a)
    capsys.readouterr()
    assert cli.main(words) == 0
    assert (
        capsys.readouterr().out
        == f"wrote {tmp_path}/clients/a.key, which admits a again\n"
    )
    assert keys.callback("*", a)
    assert cli.main(words) == 0
    assert capsys.readouterr().out == "wrote nothing: all keys exist\n"


def test_names_of_clients_are_checked_before_anything_is_written(
    tmp_path: Path,
) -> None:
    with pytest.raises(InvalidInputError, match=r"'\.\./bad'"):
        make_keys(tmp_path / "keys", ["good", "../bad"])
    assert not (tmp_path / "keys").exists()


def test_a_file_in_place_of_the_folder_of_keys_is_named(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    for use in (read_server_keys, lambda folder: make_keys(folder, ["a"])):
        with pytest.raises(InvalidInputError, match="file: expected a folder of keys"):
            use(file)


def test_a_token_is_for_its_owner_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "token"
    file.write_text("a-token-of-the-tests\n", encoding="utf-8")
    file.chmod(0o640)
    assert "token: others can read it: chmod 600" in complaint(
        capsys, "serve", "--web", "--web-token-file", file
    )
    file.chmod(0o600)
    assert read_token(file) == "a-token-of-the-tests"
    file.write_bytes(b"\xff\xfe")
    assert "token-file: expected a token of 16" in complaint(
        capsys, "serve", "--web", "--web-token-file", file
    )


def test_a_refused_key_is_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logged: list[tuple[str, object]] = []
    monkeypatch.setattr(
        logs, "report", lambda level, event, **data: logged.append((event, data["key"]))
    )
    make_keys(tmp_path, ["a", "b"])
    (tmp_path / "clients" / "b.key").unlink()
    a, b = (load_certificate(tmp_path / f"{name}.key")[0] for name in "ab")
    keys = ClientKeys(tmp_path / "clients")
    # Only the first of several refusals is logged.
    for key in (a, b, b):
        keys.callback("*", key)
    assert logged == [("refused_key", b.decode())]


@pytest.mark.parametrize(
    "host", ["127.0.0.1:5570", "tcp://127.0.0.1", "[::1]:5570", "localhost:5570", ""]
)
def test_a_host_with_more_than_a_host_is_refused_as_such(
    capsys: pytest.CaptureFixture[str], host: str
) -> None:
    expected = f"expected a host alone, such as 127.0.0.1 or ::1, and its port apart, got {host!r}"
    assert complaint(capsys, "serve", "--host", host) == f"handmap: --host: {expected}"
    assert (
        complaint(capsys, "serve", "--web", "--web-host", host)
        == f"handmap: --web-host: {expected}"
    )


def test_brackets_round_a_host_are_taken_off() -> None:
    hosts = ("[::1]", "::1", "127.0.0.1", "localhost", "fe80::1%eth0", "eth0", "*")
    assert [bare_host("host", host) for host in hosts] == ["::1", *hosts[1:]]


def test_a_host_that_cannot_be_listened_on_is_reported(tmp_path: Path) -> None:
    make_keys(tmp_path, ["a"])
    message = "^nosuch.invalid:0: .*: give a free port at an IP address of this machine"
    with (
        pytest.raises(InvalidInputError, match=message),
        serving(host="nosuch.invalid", keys=tmp_path),
    ):
        pass


@pytest.mark.parametrize(
    "web", [{}, {**WEB, "web_host": "localhost"}], ids=["zeromq", "web"]
)
def test_the_ready_line_tells_where_websocket_is(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    web: dict[str, Any],
) -> None:
    # Stop the server as soon as it is ready.
    monkeypatch.setattr(gc, "freeze", lambda: signal.raise_signal(signal.SIGTERM))
    run_server(replace(LOCAL, **web), "error")
    ready = json.loads(capsys.readouterr().out)
    assert ready["host"] == "127.0.0.1"
    assert ready.get("web_host") == web.get("web_host")


@pytest.mark.parametrize("wrong", ["certificate", "key"])
def test_files_of_tls_that_cannot_be_used_are_named(tmp_path: Path, wrong: str) -> None:
    files = {name: tmp_path / f"{name}.pem" for name in ("certificate", "key")}
    for file in files.values():
        file.touch()
    settings = WEB | {"web_certificate": files["certificate"], "web_key": files["key"]}
    message = f"^{files['certificate']}, {files['key']}: expected a PEM certificate and its key"
    with pytest.raises(InvalidInputError, match=message), serving(LOCAL, **settings):
        pass
    files[wrong].unlink()
    message = f"^{files[wrong]}: cannot be read: No such file or directory$"
    with pytest.raises(InvalidInputError, match=message), serving(LOCAL, **settings):
        pass


def test_the_server_may_open_as_many_files_as_the_system_allows(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    monkeypatch.setattr(gc, "freeze", lambda: signal.raise_signal(signal.SIGTERM))
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(256, before[1]), before[1]))
        run_server(LOCAL, "error")
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (
            min(before[1], 65536),
            before[1],
        )
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert "ready" in capsys.readouterr().out


class Events:
    """Events of the log, from any thread."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._events: Queue[tuple[str, dict[str, Any]]] = Queue()
        monkeypatch.setattr(
            logs, "report", lambda level, event, **data: self._events.put((event, data))
        )

    def wait(self, event: str) -> dict[str, Any]:
        """Return the data of the next event of this name."""
        while True:
            name, data = self._events.get(timeout=PATIENCE)
            if name == event:
                return data


@pytest.mark.parametrize(
    ("key", "server_key", "reason"),
    [
        (None, None, "only one of client and server uses keys"),
        ("others", "keys", "not among the keys"),
        ("keys", "others", "another server's"),
    ],
)
def test_a_failed_handshake_is_logged_and_counted(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    key: str | None,
    server_key: str | None,
    reason: str,
) -> None:
    for folder in ("keys", "others"):
        make_keys(tmp_path / folder, ["client"])
    events = Events(monkeypatch)
    with serving(keys=tmp_path / "keys") as server:
        with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
            if key is not None:
                socket.curve_publickey, socket.curve_secretkey = load_certificate(
                    tmp_path / key / "client.key_secret"
                )
                socket.curve_serverkey, _ = load_certificate(
                    tmp_path / str(server_key) / "server.key"
                )
            socket.connect(address_of(server))
            assert reason in events.wait("handshake")["reason"]
        assert 'handmap_refusals_total{code="handshake"}' in server.metrics.render()
        assert server.health()["status"] == "ok"


@pytest.mark.parametrize("time", [1e308, -2e15, float("inf"), float("nan")])
def test_the_limit_of_time_stamps_is_named(time: float) -> None:
    answer = decode_request(encode(Sampler()(time)))
    assert isinstance(answer, Error)
    assert answer.field == "time"
    assert "1000000000000000.0" in answer.message


def test_what_a_name_may_be_is_said_in_words() -> None:
    answer = decode_request(
        encode({"type": "status", "protocol": PROTOCOL, "seq": 1, "name": "a/b"})
    )
    assert isinstance(answer, Error)
    assert (answer.field, answer.message) == (
        "name",
        "expected 1 to 64 of A-Z a-z 0-9 _ . -",
    )


@pytest.mark.parametrize("kind", ["step", "sample", "reset", "close"])
def test_a_request_by_name_that_needs_the_secret_says_so(kind: str) -> None:
    answer = decode_request(
        encode({"type": kind, "name": "lab", "protocol": PROTOCOL, "seq": 1})
    )
    assert isinstance(answer, Error)
    assert answer.field == "name"
    assert "you may only watch" in answer.message


def test_the_documentation_explains_tokens_and_the_length_of_messages(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        cli.main(["serve", "--help"])
    assert f"at most {LOCAL.message_size} bytes" in SCHEMAS["schema"].read_text(
        encoding="utf-8"
    )
    for text in (
        SCHEMAS["schema"].read_text(encoding="utf-8"),
        PAGE,
        capsys.readouterr().out,
    ):
        words = " ".join(text.replace("│", " ").split())
        assert "Authorization: Bearer TOKEN" in words
        assert '["handmap.v1", "bearer.TOKEN"]' in words


def test_a_tracker_that_crashed_opens_with_the_words_of_its_first_start() -> None:
    choices: dict[str, Any] = {
        "name": "lab",
        "restore": True,
        "robot_q": np.zeros(8),
    }
    assert 'name="lab", restore=True, robot_q=' in PAGE
    with (
        serving() as server,
        Client(address_of(server), timeout=PATIENCE) as crashed,
        Client(address_of(server)) as again,
    ):
        assert crashed.open("three_finger", **choices).q == (0.0,) * 8
        last = [crashed.step(q=human_q(0.2 * i), wrist=np.eye(4)) for i in range(5)][-1]
        # The client is silent from now on.
        skip(server, 2.0 * LEASE)
        assert again.open("three_finger", **choices).q == last.q != (0.0,) * 8


def test_a_flood_of_topics_ends_its_connection_and_disturbs_no_other() -> None:
    with (
        serving() as server,
        connected(server, name="lab") as client,
        client_of(server) as listener,
        zmq.Context() as context,
    ):
        listener.watch("lab")
        flood = context.socket(zmq.XSUB)
        # No bound on what waits: XSUB drops subscriptions beyond it.
        flood.linger = flood.sndhwm = 0
        flood.connect(f"tcp://127.0.0.1:{server.ports['stream']}")
        try:
            for i in range(200):
                flood.send(b"\x01" + bytes([i]) * 900)
            wait_until(lambda: server.metrics.refusals["stream"], "the flood goes on")
        finally:
            flood.close()
        client.step(q=human_q(), wrist=np.eye(4), time=5.0)
        assert heard(listener, 5.0).time == 5.0


def test_readers_are_capped_and_counted_out() -> None:
    with serving(sessions=1) as server, ExitStack() as sockets:
        address = ("127.0.0.1", server.ports["stream"])
        readers = [
            sockets.enter_context(socket.create_connection(address)) for _ in range(4)
        ]
        assert all(reader.recv(1) for reader in readers)
        with socket.create_connection(address) as another:
            assert not _reads(another)
        readers[0].close()

        def has_room() -> bool:
            with socket.create_connection(address) as again:
                return _reads(again)

        assert wait_until(has_room)


def _reads(connection: socket.socket) -> bool:
    """Return whether the server greets a connection rather than ending it."""
    try:
        return bool(connection.recv(1))
    except ConnectionError:
        return False


def _has_ended(connection: socket.socket) -> bool:
    """Return whether the server has ended a connection, without waiting."""
    try:
        return not connection.recv(64, socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


@pytest.mark.parametrize("size", [0, 1, 255, 256, 70_000])
def test_a_frame_gives_back_what_it_costs_with_its_header_and_encryption(
    size: int,
) -> None:
    # ZMTP 3: a header of 2 or 9 bytes; of CURVE, a command's name, a nonce, flags and a code.
    header, curve = (9 if size > 200 else 2), 8 + 8 + 1 + 16
    assert cost_of(zmq.Frame(bytes(size))) >= size + header + curve + _FRAME


@pytest.mark.parametrize(
    ("has_keys", "message"),
    crossed([False, True], [(3, 0), (5000, 0), (10**5, 0), (10**4, 10**4)], every=2),
)
def test_a_message_of_many_parts_ends_its_connection_and_delays_no_stop(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    has_keys: bool,
    message: tuple[int, int],
) -> None:
    number, size = message
    keys = None
    if has_keys:
        make_keys(tmp_path, ["a"])
        keys = (tmp_path / "a.key_secret", tmp_path / "server.key")
    parts = count()
    monkeypatch.setattr(
        server_module, "cost_of", lambda frame: (next(parts), cost_of(frame))[1]
    )
    with (
        serving(keys=tmp_path if has_keys else None) as server,
        client_of(server, keys=keys) as client,
        client_of(server, keys=keys) as operator,
        bare_connection(server, keys) as (flood, next_event),
    ):
        client.open("three_finger", name="lab", watchdog=0.05)
        client.step(q=human_q(), wrist=np.eye(4))
        flood.send_multipart([bytes(size)] * number)
        wait_until(lambda: client.status().mode == "hold", "the watchdog waits")
        operator.stop("lab")
        wait_until(lambda: next_event() == zmq.EVENT_DISCONNECTED)
        wait_until(lambda: server.metrics.refusals["requests"], "the flood goes on")
        assert client.status().mode == "stopped"
        # A part is read when its message is complete, so none of the long ones was.
        assert next(parts) < 1000


def test_a_turn_reads_a_bounded_number_of_parts(
    keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    turns: list[int] = []
    monkeypatch.setattr(
        server_module,
        "cost_of",
        lambda frame: (turns.append(turns.pop() + 1), cost_of(frame))[1],
    )
    drain = Server._drain
    monkeypatch.setattr(
        Server, "_drain", lambda server: (turns.append(0), drain(server))[1]
    )
    with (
        serving(keys=keys) as server,
        zmq.Context() as context,
        context.socket(zmq.DEALER) as bare,
    ):
        assert server._gate is not None
        bare.rcvtimeo = int(1e3 * PATIENCE)
        bare.curve_publickey, bare.curve_secretkey = load_certificate(
            keys / "a.key_secret"
        )
        bare.curve_serverkey = load_certificate(keys / "server.key")[0]
        # This process may pass by the gate.
        bare.connect(f"ipc://@{server._gate.inner}")
        bare.send_multipart([b""] * 5000)
        bare.send(encode({"type": "status", "protocol": PROTOCOL, "seq": 1}))
        assert decode(bare.recv())["type"] == "state"
    assert sum(turns) >= 5000
    assert max(turns) <= 128


def test_messages_within_the_limits_are_all_answered() -> None:
    request = {"type": "status", "protocol": PROTOCOL, "seq": 1, "session": ""}
    with serving(rate=1e7) as server, bare_connection(server) as (bare, _):
        bare.rcvtimeo, bare.rcvhwm = int(1e3 * PATIENCE), 0
        status, longest = encode(request), bytes(server.settings.message_size)
        for payload in (status, longest, status):
            for _ in range(500):
                bare.send_multipart([b"", payload])
            assert all(bare.recv_multipart()[1] for _ in range(500))
        assert not server.metrics.refusals["requests"]


@given(
    contents=st.lists(st.integers(0, 70_000), max_size=20),
    cuts=st.lists(st.integers(1, 5000), min_size=1),
    flags=st.sampled_from([0, 1, 4]),
)
def test_frames_are_counted_wherever_their_bytes_are_cut(
    contents: list[int], cuts: list[int], flags: int
) -> None:
    data = b"\xff" + bytes(8) + b"\x7f\x03" + bytes(53)
    for size in contents:
        is_long = size > 255 or size % 2 == 1
        length = size.to_bytes(8 if is_long else 1, "big")
        data += bytes([flags | 2 * is_long]) + length + b"\xff" * size
    frames, found, at = count_frames(), 0, 0
    next(frames)
    for cut in chain.from_iterable(repeat(cuts)):
        found += frames.send(data[at : at + cut])
        if (at := at + cut) >= len(data):
            break
    assert found == len(contents)


@pytest.mark.parametrize(
    "greeting",
    [
        b"\x01\x00" * 40,
        b"\xff" + bytes(80),
        b"\xff" + bytes(8) + b"\x7f\x01\x05" + bytes(70),
    ],
    ids=["1.0", "1.0 with eight bytes of length", "2.0"],
)
def test_an_older_protocol_is_refused(greeting: bytes) -> None:
    with (
        serving() as server,
        socket.create_connection(("127.0.0.1", server.ports["requests"])) as raw,
    ):
        raw.sendall(greeting)
        wait_until(lambda: _has_ended(raw))
        assert server.metrics.refusals["requests"] == 1


def test_silent_connections_leave_a_place_for_the_stop() -> None:
    with (
        serving(sessions=1) as server,
        connected(server, name="lab") as client,
        ExitStack() as sockets,
    ):
        client.step(q=human_q(), wrist=np.eye(4))
        (served,) = (each for each in server.requests.clients if each.identity)
        for _ in range(20):
            _, next_event = sockets.enter_context(bare_connection(server))
            while next_event() != zmq.EVENT_HANDSHAKE_SUCCEEDED:
                pass
        # A client that has sent something keeps its connection before those that have not.
        assert served in server.requests.clients
        with client_of(server) as operator:
            operator.stop("lab")
        assert client.status().mode == "stopped"
        assert client.reopened == 0


def test_other_processes_cannot_pass_by_the_gate(keys: Path) -> None:
    code = (
        "import socket, sys\n"
        "with socket.socket(socket.AF_UNIX) as raw:\n"
        "    raw.connect(chr(0) + sys.argv[1])\n"
        "    print(len(raw.recv(1)))"
    )
    with serving(keys=keys) as server:
        assert server._gate is not None
        command = [sys.executable, "-c", code, server._gate.inner]
        assert subprocess.check_output(command, timeout=PATIENCE) == b"0\n"


@pytest.mark.parametrize(
    ("host", "address"),
    [
        ("::1", "tcp://::1:5570"),
        ("[::1]", "tcp://[::1]:5570"),
        ("[::1]:99", "tcp://[::1]:99"),
        ("127.0.0.1:99", "tcp://127.0.0.1:99"),
    ],
)
def test_a_service_may_be_at_an_address_of_ipv6(host: str, address: str) -> None:
    assert service_address("to", host) == address
