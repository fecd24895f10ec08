"""The port of requests without keys: ZMTP as libzmq speaks it, and what floods may take."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import chain, repeat

import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from msgspec.msgpack import decode, encode
from patience import PATIENCE, wait_until
from service_tools import address_of, client_of, connected, human_q, serving

from handmap_qp.apps.service import direct
from handmap_qp.apps.service.server import Server
from handmap_qp.apps.service.zmtp import (
    GREETING,
    HELLO,
    Peer,
    PeerError,
    frame,
    message,
)
from handmap_qp.client.messages import PROTOCOL

STATUS = encode({"type": "status", "protocol": PROTOCOL, "seq": 1})
LONGEST = 70_000
_COMMAND = 4


def hello(kind: bytes = b"DEALER") -> bytes:
    """Return what a client sends first."""
    properties = b"\x0bSocket-Type" + len(kind).to_bytes(4, "big") + kind
    return HELLO[:GREETING] + frame(b"\x05READY" + properties, _COMMAND)


def greeted(send: Callable[[bytes], None] = lambda data: None) -> Peer:
    """Return a peer after its handshake."""
    peer = Peer(LONGEST, 2, send)
    data = hello(b"DEALER")
    peer.receive(data)
    assert peer.next_message() is None
    assert peer.is_ready
    return peer


def raw_client(server: Server) -> socket.socket:
    """Return a connection after its handshake."""
    raw = socket.create_connection(("127.0.0.1", server.ports["requests"]))
    raw.settimeout(PATIENCE)
    raw.sendall(hello())
    return raw


@contextmanager
def zmq_client(server: Server, kind: int) -> Iterator[zmq.Socket]:
    """Yield a socket of libzmq that is connected."""
    with zmq.Context() as context, context.socket(kind) as bare:
        bare.linger = 0
        bare.rcvtimeo = int(1e3 * PATIENCE)
        bare.connect(address_of(server))
        yield bare


@given(
    payloads=st.lists(st.tuples(st.integers(0, LONGEST), st.booleans()), max_size=12),
    cuts=st.lists(st.integers(1, 5000), min_size=1),
)
def test_messages_are_read_wherever_their_bytes_are_cut(
    payloads: list[tuple[int, bool]], cuts: list[int]
) -> None:
    sent = [(bytes([i]) * size, is_req) for i, (size, is_req) in enumerate(payloads)]
    data = hello()
    for payload, is_req in sent:
        data += message(payload, has_envelope=is_req)
    peer = Peer(LONGEST, 2, lambda data: None)
    found: list[list[bytes]] = []
    at = 0
    for cut in chain.from_iterable(repeat(cuts)):
        peer.receive(data[at : at + cut])
        while (parts := peer.next_message()) is not None:
            found.append(parts)
        if (at := at + cut) >= len(data):
            break
    assert found == [[b""] * is_req + [payload] for payload, is_req in sent]


@pytest.mark.parametrize("context", [b"", b"0123456789abcdef"])
def test_a_ping_is_answered_with_its_context(context: bytes) -> None:
    sent: list[bytes] = []
    peer = greeted(sent.append)
    peer.receive(frame(b"\x04PING\x00\x00" + context, _COMMAND))
    assert peer.next_message() is None
    assert sent == [frame(b"\x04PONG" + context, _COMMAND)]


def test_commands_beyond_a_rate_end_a_peer_and_are_not_answered() -> None:
    sent: list[bytes] = []
    peer = greeted(sent.append)
    peer.receive(frame(b"\x04PING\x00\x00", _COMMAND) * 1000)
    with pytest.raises(PeerError, match="too many commands"):
        peer.next_message()
    assert len(sent) <= 50


@pytest.mark.parametrize(
    ("data", "is_handshake"),
    [
        (b"\x01\x00" * 40, False),
        (HELLO.replace(b"NULL", b"CURV"), True),
        (hello(b"SUB"), True),
        (HELLO[:GREETING] + frame(b"early"), True),
        (HELLO[:GREETING] + frame(b"\x05ERROR", _COMMAND), True),
        (
            HELLO[:GREETING]
            + frame(b"\x05READY\x0bSocket-Type\xff\xff\xff\xff", _COMMAND),
            True,
        ),
        (HELLO[:GREETING] + frame(b"\x05READY\xff", _COMMAND), True),
        (hello() + b"\x02" + (LONGEST + 1).to_bytes(8, "big"), False),
        (hello() + b"\x06" + (2**62).to_bytes(8, "big"), False),
        (hello() + frame(b"", 1) * 3, False),
    ],
)
def test_a_peer_that_breaks_the_protocol_is_refused(
    data: bytes, is_handshake: bool
) -> None:
    peer = Peer(LONGEST, 2, lambda data: None)
    peer.receive(data)
    with pytest.raises(PeerError) as caught:
        peer.next_message()
    assert caught.value.is_handshake == is_handshake


@given(st.binary(max_size=300))
def test_whatever_arrives_is_a_message_or_a_refusal(data: bytes) -> None:
    for before in (b"", HELLO[:GREETING], hello()):
        peer = Peer(LONGEST, 2, lambda data: None)
        peer.receive(before + data)
        try:
            while peer.next_message() is not None:
                pass
        except PeerError:
            pass


@pytest.mark.slow
@pytest.mark.parametrize("kind", [zmq.DEALER, zmq.REQ, zmq.ROUTER])
def test_sockets_of_libzmq_are_answered(kind: int) -> None:
    with serving() as server, zmq_client(server, kind) as bare:
        if kind == zmq.ROUTER:
            # It learns the identity of the server, which is empty, from nothing that it is sent.
            wait_until(lambda: any(server.requests.clients))
            return
        for _ in range(3):
            bare.send(STATUS)
            assert decode(bare.recv())["type"] == "state"
        assert not server.metrics.refusals


@pytest.mark.slow
@pytest.mark.parametrize("kind", [zmq.SUB, zmq.PUSH, zmq.PAIR])
def test_other_sockets_are_refused(kind: int) -> None:
    with serving() as server, zmq_client(server, kind):
        wait_until(lambda: server.metrics.refusals["handshake"], "they are admitted")


@pytest.mark.slow
def test_a_silent_client_is_asked_and_then_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(direct, "_HEARTBEAT", 0.0)
    monkeypatch.setattr(direct, "_LONGEST_SILENCE", 3.0)
    with serving() as server, zmq_client(server, zmq.DEALER) as alive:
        alive.send(STATUS)
        alive.recv()
        (kept,) = server.requests.clients
        with raw_client(server) as silent:
            # It gets pings, to which libzmq answers and this one does not.
            wait_until(lambda: not silent.recv(4096), "a silent client is kept")
        assert kept in server.requests.clients


@pytest.mark.slow
def test_a_client_that_reads_nothing_loses_answers_and_disturbs_no_other() -> None:
    with (
        serving(rate=1e9) as server,
        client_of(server) as other,
        raw_client(server) as flood,
    ):
        flood.settimeout(0.1)

        unsent = bytearray()

        def dropped() -> int:
            if not unsent:
                unsent.extend(frame(STATUS) * 200)
            # The server may be behind.
            with suppress(TimeoutError):
                sent = flood.send(bytes(unsent))
                del unsent[:sent]
            return server.metrics.counts["dropped"]

        wait_until(dropped, "nothing is dropped")
        assert other.status().mode == "serving"
        unsent = [
            each.writer.get_write_buffer_size() for each in server.requests.clients
        ]
        assert max(unsent) < 2 * direct._MOST_UNREAD


@pytest.mark.slow
def test_a_client_that_floods_pings_is_cut_off() -> None:
    pings = frame(b"\x04PING\x00\x00" + b"0123456789abcdef", _COMMAND) * 2000
    with serving(rate=1e9) as server, raw_client(server) as flood:
        wait_until(lambda: any(server.requests.clients))

        def is_cut_off() -> bool:
            with suppress(ConnectionError):
                flood.sendall(pings)
            return not any(server.requests.clients)

        wait_until(is_cut_off, "it goes on")


@pytest.mark.slow
def test_a_handshake_that_is_sent_byte_by_byte_takes_no_longer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(direct, "_HANDSHAKE", 0.5)
    with (
        serving() as server,
        socket.create_connection(("127.0.0.1", server.ports["requests"])) as slow,
    ):

        def is_refused() -> int:
            with suppress(ConnectionError):
                slow.send(b"\xff")
            return server.metrics.refusals["handshake"]

        wait_until(is_refused, "it goes on")


@pytest.mark.slow
def test_a_turn_handles_a_bounded_number_of_messages_and_a_stop_passes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    turns: list[int] = [0]
    begin = direct.DirectPort._go_on
    handle = direct.DirectClient.handle_next

    def next_turn(port: direct.DirectPort) -> None:
        turns.append(0)
        begin(port)

    def counted(client: direct.DirectClient) -> bool:
        is_one = handle(client)
        turns[-1] += is_one
        return is_one

    monkeypatch.setattr(direct.DirectPort, "_go_on", next_turn)
    monkeypatch.setattr(direct.DirectClient, "handle_next", counted)
    with (
        serving() as server,
        connected(server, name="lab") as client,
        client_of(server) as operator,
        raw_client(server) as flood,
    ):
        client.step(q=human_q(), wrist=np.eye(4))
        for _ in range(20):
            flood.sendall(frame(b"") * 5000)
        operator.stop("lab")
        assert client.status().mode == "stopped"
        wait_until(lambda: sum(turns) >= 100_000, "messages are lost")
    assert max(turns) <= direct._BATCH
