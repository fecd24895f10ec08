"""What the fingers of a robot feel: what is refused, and its way to who asked for it."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterator
from time import monotonic, sleep
from typing import Any

import numpy as np
import pytest
from msgspec import json, msgpack
from patience import wait_until
from service_tools import WEB, client_of, connected, human_q, serving
from websockets import Subprotocol
from websockets.asyncio.client import connect

from handmap_qp import load_hand
from handmap_qp.apps.service.dispatch import decode_request
from handmap_qp.apps.service.haptics import finger_names
from handmap_qp.apps.service.server import Server
from handmap_qp.client import Client, Error
from handmap_qp.client.messages import HAPTICS_LIFE, PROTOCOL, Haptics, Touch

WRIST = np.eye(4)
FORCES = {"thumb": 1.5, "index": 0.0}


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving(**WEB) as running:
        yield running


def felt(driver: Client, reader: Client, **values: dict[str, float]) -> Haptics:
    """Say what fingers feel until it arrives: a subscription takes some time."""

    def arrives() -> Haptics | None:
        driver.touch(forces=values.get("forces"), efforts=values.get("efforts"))
        return reader.haptics(0.05)

    return wait_until(arrives, "no haptics arrive")


def refusal(driver: Client, **values: dict[str, float]) -> Error:
    """Return why the server refuses what is said."""
    return wait_until(
        lambda: driver.touch(
            forces=values.get("forces"), efforts=values.get("efforts")
        ),
        "nothing is refused",
    )


def test_haptics_come_to_who_asked_for_them(server: Server) -> None:
    with (
        connected(server, name="felt", is_shared=True) as owner,
        client_of(server) as driver,
    ):
        driver.watch("felt")
        # Neither commands nor the numbers of the owner's requests are disturbed.
        owner.step(q=human_q(), wrist=WRIST)
        got = felt(driver, owner, forces=FORCES)
        assert (got.name, got.forces, got.efforts) == ("felt", FORCES, {})
        got = felt(owner, driver, efforts={"middle": 0.25})
        assert got.efforts == {"middle": 0.25}
        assert owner.step(q=human_q(0.1), wrist=WRIST).q


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"forces": {"tail": 1.0}}, "forces.tail"),
        ({"efforts": {"tail": 0.5}}, "efforts.tail"),
        ({}, "forces"),
    ],
)
def test_what_the_robot_cannot_feel_is_refused(
    server: Server, values: dict[str, dict[str, float]], field: str
) -> None:
    with connected(server, name="wrong") as owner, client_of(server) as reader:
        reader.watch("wrong")
        felt(owner, reader, forces=FORCES)
        before = owner.status()
        error = refusal(owner, **values)
        assert (error.code, error.field) == ("invalid", field)
        if values:
            assert ", ".join(finger_names(load_hand("three_finger"))) in error.message
        assert owner.status().mode == before.mode
        sleep(0.01)
        # The refused message reaches nobody.
        last = reader.haptics()
        assert last is None or last.forces == FORCES


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.1, 1e9, "1", None])
@pytest.mark.parametrize("field", ["forces", "efforts"])
def test_numbers_that_cannot_be_are_refused(field: str, value: object) -> None:
    request = {"type": "touch", "protocol": PROTOCOL, "seq": 7, "session": "a" * 24}
    answer = decode_request(msgpack.encode(request | {field: {"thumb": value}}))
    assert isinstance(answer, Error)
    assert (answer.code, answer.seq) == ("invalid", 7)
    assert answer.field.startswith(field)
    assert isinstance(
        decode_request(msgpack.encode(request | {field: {"thumb": 0.5}})), Touch
    )


def test_what_waited_too_long_is_left_out(server: Server) -> None:
    with connected(server, name="old", is_shared=True) as owner:
        felt(owner, owner, forces=FORCES)
        owner.touch(forces={"thumb": 9.0})
        start = monotonic()
        while monotonic() < start + 1.5 * HAPTICS_LIFE:
            sleep(0.01)
        assert owner.haptics() is None
        assert felt(owner, owner, forces={"thumb": 2.0}).forces == {"thumb": 2.0}


async def talk(server: Server, name: str) -> dict[str, dict[str, Any]]:
    """Subscribe to haptics over WebSocket and say some; return the replies by their type."""
    address = f"ws://127.0.0.1:{server.ports['web']}"
    async with connect(address, subprotocols=[Subprotocol("handmap.v1")]) as web:
        head = {"protocol": PROTOCOL, "name": name}
        ask = {"type": "subscribe", "stream": "haptics", "seq": 1}
        await web.send(json.encode(head | ask).decode())
        assert json.decode(await web.recv())["type"] == "done"
        await web.send(
            json.encode(head | {"type": "touch", "forces": FORCES, "seq": 2}).decode()
        )
        replies: dict[str, dict[str, Any]] = {}
        while not replies.keys() & {"done", "error"}:
            reply = json.decode(await web.recv())
            replies[reply["type"]] = reply
        return replies


def test_haptics_over_websocket(server: Server) -> None:
    with connected(server, name="web", is_shared=True):
        replies = asyncio.run(talk(server, "web"))
    assert replies.keys() == {"haptics", "done"}
    assert replies["haptics"]["forces"] == FORCES


def test_haptics_over_websocket_reach_who_is_of_another_worker() -> None:
    with (
        serving(**WEB, workers=2, max_load=1.0) as several,
        connected(several, name="first"),
        connected(several, name="web", is_shared=True),
    ):
        replies = asyncio.run(talk(several, "web"))
    assert replies["haptics"]["forces"] == FORCES


def test_a_state_says_for_how_long_haptics_count(server: Server) -> None:
    with connected(server, name="life") as owner, client_of(server) as other:
        assert owner.status().haptics_life == HAPTICS_LIFE
        assert other.status().haptics_life == HAPTICS_LIFE


def test_others_may_not_say_what_a_private_session_feels(server: Server) -> None:
    with connected(server, name="private"):
        replies = asyncio.run(talk(server, "private"))
    assert replies.keys() == {"error"}
    assert (replies["error"]["code"], replies["error"]["field"]) == ("denied", "name")


def test_fingers_have_the_names_of_the_hand() -> None:
    names = finger_names(load_hand("three_finger"))
    assert sorted(names) == ["index", "middle", "thumb"]
    assert len(finger_names(load_hand("leap_right"))) == 4
