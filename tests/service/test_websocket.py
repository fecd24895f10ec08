"""The WebSocket transport: the same messages, and its access rules."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import shutil
import socket
import ssl
import struct
import subprocess
import types
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from patience import PATIENCE, wait_until
from service_tools import (
    LOCAL,
    SECRET,
    WEB,
    Sampler,
    human_q,
    in_loop,
    opening,
    serving,
    streamed,
    token_file,
)
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.protocol import Protocol
from websockets.typing import Origin, Subprotocol

from handmap_qp.apps.service import websocket
from handmap_qp.apps.service.server import Server
from handmap_qp.apps.service.settings import MOST_SESSIONS, Settings
from handmap_qp.apps.service.websocket import WebSocketTransport
from handmap_qp.client.messages import PROTOCOL, Close, Status, Stop, Subscribe
from handmap_qp.errors import InvalidInputError, InvalidOptionsError

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

TOKEN = "a-token-of-the-tests"
HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
ENCODE: dict[bool, Callable[[Any], bytes | str]] = {
    False: msgspec.msgpack.encode,
    True: lambda message: msgspec.json.encode(message).decode(),
}


def run(
    work: Callable[[ClientConnection], Awaitable[None]], server: Server, **choices: Any
) -> None:
    """Connect, and run a coroutine with the connection."""

    async def main() -> None:
        scheme = "wss" if "ssl" in choices else "ws"
        async with (
            asyncio.timeout(PATIENCE),
            connect(
                f"{scheme}://127.0.0.1:{server.ports['web']}", **choices
            ) as connection,
        ):
            await work(connection)

    asyncio.run(main())


async def ask(
    connection: ClientConnection, message: Any, is_json: bool = False
) -> dict[str, Any]:
    await connection.send(ENCODE[is_json](message))
    answer = await connection.recv()
    assert isinstance(answer, str) == is_json
    return (
        json.loads(answer)
        if isinstance(answer, str)
        else msgspec.msgpack.decode(answer)
    )


async def nothing(_: ClientConnection) -> None:
    pass


@pytest.mark.parametrize("is_json", [False, True], ids=["msgpack", "json"])
def test_a_session_over_websocket(is_json: bool) -> None:
    async def work(connection: ClientConnection) -> None:
        opened = await ask(connection, opening(), is_json)
        assert opened["type"] == "opened"
        sample = Sampler()
        command = await ask(connection, sample(1.5), is_json)
        assert (command["type"], command["time"], command["status"]) == (
            "command",
            1.5,
            "converged",
        )
        refused = await ask(connection, sample(q=[0.0, 1.0]), is_json)
        assert (refused["code"], refused["field"]) == ("invalid", "q")
        closed = await ask(
            connection, Close(protocol=PROTOCOL, seq=9, session=SECRET), is_json
        )
        assert closed["type"] == "done"

    with serving(**WEB) as server:
        run(work, server)


@pytest.mark.parametrize("is_json", [False, True], ids=["msgpack", "json"])
def test_a_stream_over_websocket(is_json: bool) -> None:
    async def work(connection: ClientConnection) -> None:
        name = (await ask(connection, opening(), is_json))["name"]
        refused = await ask(
            connection, Subscribe(protocol=PROTOCOL, seq=2, name="nobody"), is_json
        )
        assert refused["field"] == "name"
        assert (
            await ask(
                connection, Subscribe(protocol=PROTOCOL, seq=2, name=name), is_json
            )
        )["type"] == "done"
        sample = Sampler()
        for i in range(50):
            await connection.send(
                ENCODE[is_json](streamed(sample(float(i), human_q(0.01 * i))))
            )
        while True:
            message = await connection.recv()
            command = (
                json.loads(message)
                if isinstance(message, str)
                else msgspec.msgpack.decode(message)
            )
            if command["time"] == 49.0:
                break

    with serving(**WEB) as server:
        run(work, server)


def test_garbage_is_answered_and_the_connection_stays() -> None:
    async def work(connection: ClientConnection) -> None:
        for message in (b"\xc1", "{", "[]", b""):
            await connection.send(message)
            assert b"invalid" in (await connection.recv(decode=False))
        assert (await ask(connection, Status(protocol=PROTOCOL, seq=1)))[
            "type"
        ] == "state"

    with serving(**WEB) as server:
        run(work, server)


def test_a_message_that_is_too_long_closes_its_connection() -> None:
    async def work(connection: ClientConnection) -> None:
        await connection.send(b"x" * 20_000)
        with pytest.raises(ConnectionClosed):
            await connection.recv()

    with serving(**WEB) as server:
        run(work, server)
        run(nothing, server)


def test_a_client_that_vanishes_leaves_the_robot_held() -> None:
    async def vanish(connection: ClientConnection) -> None:
        await ask(connection, opening(watchdog=0.05))
        await ask(connection, Sampler()())
        connection.transport.abort()

    async def look(connection: ClientConnection) -> None:
        for seq in itertools.count(50):
            state = await ask(
                connection, Status(protocol=PROTOCOL, seq=seq, session=SECRET)
            )
            if state["mode"] == "hold":
                break
            await asyncio.sleep(0.01)

    with serving(**WEB) as server:
        run(vanish, server)
        run(look, server)


@pytest.mark.parametrize(
    ("origin", "is_admitted"),
    [
        (None, True),
        ("http://localhost:8080", True),
        ("http://127.0.0.1", True),
        ("https://headset.example", True),
        ("https://evil.example", False),
        ("http://localhost.evil.example", False),
        ("null", False),
    ],
)
def test_pages_from_elsewhere_may_not_connect(
    origin: str | None, is_admitted: bool
) -> None:
    with serving(**WEB, web_origin=("https://headset.example",)) as server:
        if is_admitted:
            run(nothing, server, origin=None if origin is None else Origin(origin))
        else:
            with pytest.raises(InvalidStatus) as raised:
                run(nothing, server, origin=None if origin is None else Origin(origin))
            assert raised.value.response.status_code == 403


def test_a_token_is_asked_for(tmp_path: Path) -> None:
    with serving(**WEB, web_token_file=token_file(tmp_path, TOKEN)) as server:
        others = "Bearer something-else-altogether", "Bearer \u00fc"
        for headers in ({}, *({"Authorization": other} for other in others)):
            with pytest.raises(InvalidStatus) as raised:
                run(nothing, server, additional_headers=headers)
            assert raised.value.response.status_code == 401
        run(nothing, server, additional_headers={"Authorization": f"Bearer {TOKEN}"})
        # Browsers cannot set headers.
        run(
            nothing,
            server,
            subprotocols=[Subprotocol("handmap.v1"), Subprotocol(f"bearer.{TOKEN}")],
        )


def test_tls(tmp_path: Path) -> None:
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("needs the openssl command to make a certificate")
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    command = (
        f"{openssl} req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 "
        "-nodes -days 1 -subj /CN=localhost"
    )
    names = ["-addext", "subjectAltName=IP:127.0.0.1"]
    subprocess.run(
        [*command.split(), *names, "-keyout", str(key), "-out", str(certificate)],
        check=True,
        capture_output=True,
    )
    files = {"web_certificate": certificate, "web_key": key}
    with serving(**WEB, **files, web_token_file=token_file(tmp_path, TOKEN)) as server:
        trusting = ssl.create_default_context(cafile=str(certificate))
        run(
            nothing,
            server,
            ssl=trusting,
            additional_headers={"Authorization": f"Bearer {TOKEN}"},
        )
        with pytest.raises(ssl.SSLError):
            run(nothing, server, ssl=ssl.create_default_context())


def test_settings_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    certificate = {"web_certificate": tmp_path / "certificate.pem"}
    with pytest.raises(InvalidOptionsError, match="together"):
        Settings(**WEB, **certificate).checked()
    short = token_file(tmp_path, "short")
    with (
        pytest.raises(InvalidOptionsError, match="16"),
        serving(**WEB, web_token_file=short),
    ):
        pass
    missing = WEB | certificate | {"web_key": tmp_path / "key.pem"}
    with (
        pytest.raises(InvalidInputError, match="cannot be read"),
        serving(LOCAL, **missing),
    ):
        pass


def test_idle_connections_leave_a_place_for_the_stop() -> None:
    stop = Stop(protocol=PROTOCOL, seq=1)

    async def work(server: Server) -> None:
        address = f"ws://127.0.0.1:{server.ports['web']}"
        async with contextlib.AsyncExitStack() as stack, asyncio.timeout(PATIENCE):
            driver = await stack.enter_async_context(connect(address))
            name = (await ask(driver, opening()))["name"]
            await ask(driver, Subscribe(protocol=PROTOCOL, seq=2, name=name))
            idle = [
                await stack.enter_async_context(connect(address)) for _ in range(128)
            ]
            operator = await stack.enter_async_context(connect(address))
            assert (await ask(operator, stop))["type"] == "done"
            # The reader of a stream keeps its place before connections that do nothing.
            while (
                msgspec.msgpack.decode(await driver.recv(decode=False))["status"]
                != "stopped"
            ):
                pass
            await asyncio.gather(*(connection.wait_closed() for connection in idle[:2]))

    with serving(**WEB, sessions=64) as server:
        asyncio.run(work(server))


def test_a_connection_that_does_nothing_is_ended() -> None:
    has_read = False

    async def read_a_stream(reader: ClientConnection) -> None:
        name = (await ask(reader, opening()))["name"]
        await ask(reader, Subscribe(protocol=PROTOCOL, seq=2, name=name))

    async def work(reader: ClientConnection) -> None:
        nonlocal has_read
        # On a busy machine the server takes it to be idle before it reads a stream.
        with contextlib.suppress(ConnectionClosed):
            await read_a_stream(reader)
            has_read = True
        if has_read:
            await outlast_another(reader)

    async def outlast_another(reader: ClientConnection) -> None:
        # The session ends, but not the connection that reads its stream.
        while (
            msgspec.msgpack.decode(await reader.recv(decode=False))["type"] != "error"
        ):
            pass
        async with connect(f"ws://127.0.0.1:{server.ports['web']}") as idle:
            await idle.wait_closed()
        assert (await ask(reader, Status(protocol=PROTOCOL, seq=3)))["type"] == "state"

    with serving(**WEB, idle=1.0) as server:
        wait_until(lambda: run(work, server) or has_read)


_EMPTY = {
    "fragments": b"\x02\x80\x00\x00\x00\x00" + b"\x00\x80\x00\x00\x00\x00" * 200_000,
    "pings": b"\x89\x80\x00\x00\x00\x00" * 200_000,
    "pongs": b"\x8a\x80\x00\x00\x00\x00" * 200_000,
}


@pytest.mark.parametrize("kind", _EMPTY)
def test_a_flood_of_empty_frames_ends_its_connection(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    turns: list[int] = []
    receive = Protocol.receive_data

    def count(protocol: Protocol, data: bytes) -> None:
        turns.append(len(data))
        receive(protocol, data)

    monkeypatch.setattr(Protocol, "receive_data", count)
    with serving(**WEB) as server:
        with socket.create_connection(("127.0.0.1", server.ports["web"])) as raw:
            raw.settimeout(PATIENCE)
            raw.sendall(HANDSHAKE)
            assert b" 101 " in raw.recv(4096)
            with pytest.raises(ConnectionError):  # noqa: PT012
                raw.sendall(_EMPTY[kind])
                while raw.recv(4096):
                    pass
                raise ConnectionError
        run(nothing, server)
    assert max(turns) <= 2048
    # Of the megabyte that was sent; the other connection's handshake is in the sum.
    assert sum(turns) < 20_000


def test_fragments_and_pings_within_the_limits_are_taken() -> None:
    async def work(connection: ClientConnection) -> None:
        status = msgspec.msgpack.encode(Status(protocol=PROTOCOL, seq=1))
        for _ in range(100):
            await connection.send([status[i : i + 1] for i in range(len(status))])
            assert (
                msgspec.msgpack.decode(await connection.recv(decode=False))["type"]
                == "state"
            )
        for _ in range(40):
            await (await connection.ping())

    with serving(**WEB) as server:
        run(work, server)


def test_clients_that_vanish_with_answers_outstanding_leave_no_connection() -> None:
    status = msgspec.msgpack.encode(Status(protocol=PROTOCOL, seq=1))
    frame = bytes([0x82, 0x80 | len(status)]) + bytes(4) + status

    def ask_and_reset(port: int, count: int) -> None:
        with socket.create_connection(("127.0.0.1", port)) as raw:
            raw.sendall(HANDSHAKE)
            assert b" 101 " in raw.recv(4096)
            raw.sendall(count * frame)
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    def can_connect(server: Server) -> bool:
        try:
            run(nothing, server)
        except InvalidStatus:
            return False
        return True

    # Two connections are allowed, so two that are not released shut out all others.
    with serving(**WEB, sessions=1) as server:
        for count in range(1, 31):
            wait_until(lambda: can_connect(server))
            ask_and_reset(server.ports["web"], count)
        wait_until(lambda: can_connect(server))


def test_a_reader_that_is_slow_gets_the_newest_and_one_that_stops_is_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    count = 40

    async def work(connection: ClientConnection) -> None:
        name = (await ask(connection, opening()))["name"]
        await ask(connection, Subscribe(protocol=PROTOCOL, seq=2, name=name))

        def publish() -> None:
            # Far more than buffers hold, each in its own turn of the server.
            for i in range(count):
                message = msgspec.msgpack.encode((i, bytes(500_000)))
                in_loop(
                    server, lambda m=message: server.dispatcher.sessions.send(name, m)
                )

        await asyncio.to_thread(publish)
        found = [0]
        while found[-1] < count - 1:
            message: Any = await connection.recv()
            found.append(msgspec.msgpack.decode(message)[0])
        assert found == sorted(found)
        assert len(found) < count
        monkeypatch.setattr(websocket, "_SEND_TIMEOUT", 0.0)
        await asyncio.to_thread(publish)
        transport: Any = server.dispatcher.sessions.publish[-1]
        await asyncio.to_thread(
            wait_until,
            lambda: in_loop(server, lambda: not transport.__self__._connections),
        )

    with serving(**WEB) as server:
        run(work, server, max_queue=1)


def test_a_handshake_that_stays_away_does_not_hold_up_the_stop() -> None:
    with contextlib.ExitStack() as sockets, serving(**WEB) as server:
        for half in (b"", b"GET / HTTP/1.1\r\nHost:"):
            raw = socket.create_connection(("127.0.0.1", server.ports["web"]))
            sockets.enter_context(raw).sendall(half)
        run(nothing, server)


def test_streams_of_sessions_that_have_ended_are_forgotten_in_time() -> None:
    names = ["lab", *(f"session-{i}" for i in range(3 * MOST_SESSIONS))]
    backend: Any = types.SimpleNamespace(names=("lab", "other"))
    connection: Any = types.SimpleNamespace(streams={})
    transport = WebSocketTransport(Settings(), None, backend)
    for name in names:
        transport._subscribe(connection, bytes, name)
        assert len(connection.streams) <= MOST_SESSIONS
    assert {"lab", names[-1]} <= connection.streams.keys()
