"""Invalid messages on every transport of the service, and the effect on robots meanwhile."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import msgspec
import zmq
from service_clients import Driver, honest, summary
from service_invalid import InvalidMessages
from service_process import MemoryWatch, ServiceProcess, serving

from handmap_qp.client import Command

_SESSIONS: tuple[dict[str, Any], ...] = (
    {"robot": "three_finger"},
    {
        "robot": "three_finger",
        "input": "landmarks",
        "hand_length": 0.19,
        "has_detail": True,
    },
    {
        "robot": "three_finger",
        "preset": "paper",
        "input": "landmarks",
        "hand_length": 0.19,
    },
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
# Messages to one session, and messages between two checks of its answers.
_TO_ONE, _AT_ONCE = 4000, 50
_PATIENCE = 5.0


def fuzz(duration: float, count: int = 1_000_000) -> dict[str, Any]:
    """Send a million altered and truncated messages to sessions whose secret is known.

    A short run sends 40,000.
    """
    if duration < 30.0:
        count = 40_000
    with (
        serving(rate=1e7, sessions=16, idle=2.0, web=True, web_port=0) as service,
        honest(service) as clients,
        MemoryWatch(service) as memory,
    ):
        codes, routes, broken, commands = (
            Counter[str](),
            Counter[str](),
            Counter[str](),
            0,
        )
        started = time.monotonic()
        for number in range(count // _TO_ONE):
            # Every other session over WebSocket, and every kind of session on every transport.
            with _ROUTES[(number + number // len(_SESSIONS)) % len(_ROUTES)](
                service
            ) as route:
                driver = _disturb(service, route, number, codes)
                routes[route.name] += _TO_ONE
            broken += driver.checker.violations
            commands += driver.commands
        elapsed = time.monotonic() - started
    sent = routes.total()
    numbers = {
        "messages": sent,
        "per_second": sent / elapsed,
        "through": dict(routes),
        "answers": dict(codes.most_common()),
    }
    found = summary(
        clients, **memory.found(), failures=len(service.failures), **numbers
    )
    if broken:
        found["wrong"].append("a robot jumped")
    return found | {
        "commands_of_disturbed": commands,
        "violations_of_disturbed": dict(broken),
        "first_failure": "".join(service.failures[:1]),
    }


class Route(AbstractContextManager["Route"]):
    """A connection to the service; a context manager.

    Attributes:
        name: Name in the summary.
        is_json: Whether messages are JSON; msgpack otherwise.
    """

    name = "requests"
    is_json = False

    @abstractmethod
    def send(self, payload: bytes) -> None:
        """Send a message as it is."""

    @abstractmethod
    def receive(self) -> bytes:
        """Wait for the next answer, or for a command of a subscribed stream."""

    def ask(self, **message: Any) -> None:
        """Send a valid message."""
        payload = {"protocol": 1, **message}
        self.send(
            msgspec.json.encode(payload)
            if self.is_json
            else msgspec.msgpack.encode(payload)
        )

    def answer(self) -> dict[str, Any]:
        """Wait for the next answer, and decode it."""
        payload = self.receive()
        return (
            msgspec.json.decode(payload)
            if self.is_json
            else msgspec.msgpack.decode(payload)
        )


class ZeroMQRoute(Route):
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


class WebSocketRoute(Route):
    """WebSocket: binary frames with msgpack, or text frames with JSON."""

    def __init__(self, service: ServiceProcess, *, is_json: bool) -> None:
        from websockets.sync.client import connect

        self.name, self.is_json = ("web, JSON" if is_json else "web, msgpack"), is_json
        self._connection = connect(
            f"ws://127.0.0.1:{service.ports['web']}",
            compression=None,
            ping_interval=None,
        )

    def send(self, payload: bytes) -> None:
        """Send a message.

        In text frames every byte is a character, because invalid UTF-8 ends the connection.
        """
        self._connection.send(payload.decode("latin-1") if self.is_json else payload)

    def receive(self) -> bytes:
        """Wait for the next answer, as bytes."""
        answer = self._connection.recv(_PATIENCE)
        return answer.encode() if isinstance(answer, str) else answer

    def __exit__(self, *_: object) -> None:
        self._connection.close()


_ROUTES: tuple[Callable[[ServiceProcess], Route], ...] = (
    ZeroMQRoute,
    partial(WebSocketRoute, is_json=False),
    ZeroMQRoute,
    partial(WebSocketRoute, is_json=True),
)


def _disturb(
    service: ServiceProcess, route: Route, number: int, codes: Counter[str]
) -> Driver:
    """Open a session, send invalid messages to it, close it; return the driver of its robot."""
    # The number is in the secret twice, so that one altered byte never makes another's secret.
    secret, name = f"a-secret-{number}-that-got-about-{number}", f"disturbed-{number}"
    invalid = InvalidMessages(secret, name, number, is_json=route.is_json)
    with zmq.Context.instance().socket(zmq.SUB) as listener:
        listener.linger = 0
        listener.connect(f"tcp://127.0.0.1:{service.ports['stream']}")
        listener.subscribe(name.encode() + b"\0")
        choices = _SESSIONS[number % len(_SESSIONS)]
        opened: dict[str, Any] = {"type": "error"}
        while opened["type"] == "error":
            # Altered messages open sessions too, by chance, up to the caps.
            route.ask(
                type="open", seq=1, session=secret, name=name, is_shared=True, **choices
            )
            opened = route.answer()
            if opened["type"] == "error":
                if opened["code"] not in ("busy", "rate"):
                    raise RuntimeError(f"no session: {opened}")
                time.sleep(0.05)
        driver = Driver(choices["robot"])
        for _ in range(_TO_ONE // _AT_ONCE):
            for _ in range(_AT_ONCE):
                route.send(invalid())
            # A request that is always answered: its answer follows those of all messages before.
            route.ask(type="status", seq=1, session="")
            while not (answer := route.answer()).get("robots"):
                codes[answer.get("code", answer["type"])] += 1
            while listener.poll(0):
                message = msgspec.msgpack.decode(listener.recv().partition(b"\0")[2])
                if message["type"] == "command":
                    driver.take(msgspec.convert(message, Command))
        route.ask(type="close", seq=2**53, session=secret)
        while route.answer()["seq"] != 2**53:
            pass
    return driver
