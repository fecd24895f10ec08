"""A million messages that no honest client sends, through every door of the service, and what the robots are told meanwhile."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import msgspec
import numpy as np
import zmq
from service_clients import Driver, honest, told
from service_nonsense import Nonsense
from service_process import MemoryWatch, ServiceProcess, serving

from handmap_qp.client import Command

_VICTIMS: tuple[dict[str, Any], ...] = (
    {"robot": "three_finger"},
    {"robot": "three_finger", "input": "landmarks", "hand_length": 0.19, "has_detail": True},
    {
        "robot": "three_finger",
        "input": "points",
        "mapping": {"rigid_from": "wrist", "reference": "previous"},
    },
    {
        "robot": "three_finger",
        "mount": "fixed",
        "mapping": {"rigid_from": "none"},
        "return_after": 0.0,
    },
)
# Messages to one victim, and between two looks at what has become of them.
_TO_ONE, _AT_ONCE = 4000, 50
_PATIENCE = 5.0


def fuzz(duration: float, count: int = 1_000_000) -> dict[str, Any]:
    """A million altered and truncated messages, to sessions whose secret has got about.

    Fewer in a short run.
    """
    if duration < 30.0:
        count = 40_000
    with (
        serving(rate=1e7, sessions=16, idle=2.0, web=True, web_port=0) as service,
        honest(service) as clients,
        MemoryWatch(service) as memory,
    ):
        codes, doors, fastest, commands = Counter[str](), Counter[str](), 0.0, 0
        started = time.monotonic()
        for number in range(count // _TO_ONE):
            # Every other one over WebSocket, and every victim at every door.
            with _DOORS[(number + number // len(_VICTIMS)) % len(_DOORS)](service) as door:
                driver = _maltreat(service, door, number, codes)
                doors[door.name] += _TO_ONE
            fastest, commands = max(fastest, driver.fastest), commands + driver.commands
        elapsed = time.monotonic() - started
    sent = doors.total()
    numbers = {
        "messages": sent,
        "per_second": sent / elapsed,
        "through": dict(doors),
        "answers": dict(codes.most_common()),
    }
    found = told(clients, **memory.found(), failures=len(service.failures), **numbers)
    if fastest > 1.0 + 1e-6:
        found["wrong"].append("the victim jumped")
    return found | {
        "victims_commands": commands,
        "victims_fastest": fastest,
        "first_failure": "".join(service.failures[:1]),
    }


class Door(AbstractContextManager["Door"]):
    """A way into the service; a context manager.

    Attributes:
        name: What it is called in the tally.
        is_json: Whether it speaks JSON; msgpack otherwise.
    """

    name = "requests"
    is_json = False

    @abstractmethod
    def send(self, payload: bytes) -> None:
        """Send a message as it is."""

    @abstractmethod
    def receive(self) -> bytes:
        """Wait for the next answer, or command of a stream that nonsense has subscribed to."""

    def ask(self, **message: Any) -> None:
        """Send a message that is in order."""
        payload = {"protocol": 1, **message}
        self.send(msgspec.json.encode(payload) if self.is_json else msgspec.msgpack.encode(payload))

    def answer(self) -> dict[str, Any]:
        """Wait for the next answer, and read it."""
        payload = self.receive()
        return msgspec.json.decode(payload) if self.is_json else msgspec.msgpack.decode(payload)


class RequestsDoor(Door):
    """ZeroMQ."""

    def __init__(self, service: ServiceProcess) -> None:
        self._socket = zmq.Context.instance().socket(zmq.DEALER)
        self._socket.linger, self._socket.rcvtimeo = 0, round(1e3 * _PATIENCE)
        self._socket.connect(service.address)

    def send(self, payload: bytes) -> None:
        """Send a message as it is."""
        self._socket.send(payload)

    def receive(self) -> bytes:
        """Wait for the next answer."""
        return self._socket.recv()

    def __exit__(self, *_: object) -> None:
        self._socket.close()


class WebDoor(Door):
    """WebSocket: binary frames with msgpack, or text frames with JSON."""

    def __init__(self, service: ServiceProcess, *, is_json: bool) -> None:
        from websockets.sync.client import connect

        self.name, self.is_json = ("web, JSON" if is_json else "web, msgpack"), is_json
        self._connection = connect(
            f"ws://127.0.0.1:{service.ports['web']}", compression=None, ping_interval=None
        )

    def send(self, payload: bytes) -> None:
        """Send a message.

        In text every byte is a character, since a frame that is no UTF-8 ends its connection.
        """
        self._connection.send(payload.decode("latin-1") if self.is_json else payload)

    def receive(self) -> bytes:
        """Wait for the next answer, as the bytes that it came in."""
        return self._connection.recv(_PATIENCE, decode=False)

    def __exit__(self, *_: object) -> None:
        self._connection.close()


_DOORS: tuple[Callable[[ServiceProcess], Door], ...] = (
    RequestsDoor,
    partial(WebDoor, is_json=False),
    RequestsDoor,
    partial(WebDoor, is_json=True),
)


def _maltreat(service: ServiceProcess, door: Door, number: int, codes: Counter[str]) -> Driver:
    """Open a session, send nonsense to it, close it; what its robot was told."""
    # Its number twice: with one byte altered, it is not the next victim's.
    secret, name = f"a-secret-{number}-that-got-about-{number}", f"victim-{number}"
    nonsense = Nonsense(secret, name, number, is_json=door.is_json)
    with zmq.Context.instance().socket(zmq.SUB) as listener:
        listener.linger = 0
        listener.connect(f"tcp://127.0.0.1:{service.ports['stream']}")
        listener.subscribe(name.encode() + b"\0")
        opened: dict[str, Any] = {"type": "error"}
        while opened["type"] == "error":
            # Nonsense opens sessions too, by chance, up to the caps.
            victim = _VICTIMS[number % len(_VICTIMS)]
            door.ask(type="open", seq=1, session=secret, name=name, is_shared=True, **victim)
            opened = door.answer()
            if opened["type"] == "error":
                if opened["code"] not in ("busy", "rate"):
                    raise RuntimeError(f"no victim: {opened}")
                time.sleep(0.05)
        driver = Driver(np.array(opened["speed"]))
        for _ in range(_TO_ONE // _AT_ONCE):
            for _ in range(_AT_ONCE):
                door.send(nonsense())
            # A question that is always answered: when its answer comes, what was before it has been
            # dealt with.
            door.ask(type="status", seq=1, session="")
            while not (answer := door.answer()).get("robots"):
                codes[answer.get("code", answer["type"])] += 1
            while listener.poll(0):
                message = msgspec.msgpack.decode(listener.recv().partition(b"\0")[2])
                if message["type"] == "command":
                    driver.take(msgspec.convert(message, Command))
        door.ask(type="close", seq=2**53, session=secret)
        while door.answer()["seq"] != 2**53:
            pass
    return driver
