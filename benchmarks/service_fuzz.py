"""A million messages that no honest client sends: altered, truncated, and well-formed ones full of nonsense."""

from __future__ import annotations

import math
import time
from collections import Counter
from typing import Any

import msgspec
import numpy as np
import zmq
from service_clients import Driver, honest, told
from service_process import MemoryWatch, ServiceProcess, serving

from handmap_qp.client import Command

# After a number that is too high, the session takes no other: that has to be seldom.
_SELDOM = 500
_NUMBERS = (0.0, -1.0, 1e-300, 1e9, 1e300, -1e308, math.nan, math.inf, -math.inf, 2**63, -(2**63), 0, 7)
_OTHERS: tuple[Any, ...] = (None, True, "", "x" * 300, b"\x00\xff", [], {}, [[]], {"a": {"b": 1}}, "../../etc/passwd", "\x00")


_VICTIMS: tuple[dict[str, Any], ...] = (
    {"robot": "three_finger"},
    {"robot": "three_finger", "input": "landmarks", "hand_length": 0.19, "has_detail": True},
    {"robot": "three_finger", "input": "points", "mapping": {"rigid_from": "wrist", "reference": "previous"}},
    {"robot": "three_finger", "mount": "fixed", "mapping": {"rigid_from": "none"}, "return_after": 0.0},
)
# Messages to one victim, and between two looks at what has become of them.
_TO_ONE, _AT_ONCE = 4000, 50


def fuzz(duration: float, count: int = 1_000_000) -> dict[str, Any]:
    """A million altered and truncated messages, to sessions whose secret has got about; fewer in a short run."""
    if duration < 30.0:
        count = 40_000
    with (
        serving(rate=1e7, sessions=16, idle=2.0) as service,
        honest(service) as clients,
        MemoryWatch(service) as memory,
        zmq.Context() as context,
    ):
        codes, fastest, commands = Counter[str](), 0.0, 0
        sent, started = 0, time.monotonic()
        while sent < count:
            driver = _maltreat(service, context, sent // _TO_ONE, codes)
            fastest, commands, sent = max(fastest, driver.fastest), commands + driver.commands, sent + _TO_ONE
        elapsed = time.monotonic() - started
    numbers = {"messages": sent, "per_second": sent / elapsed, "answers": dict(codes.most_common())}
    found = told(clients, **memory.found(), failures=len(service.failures), **numbers)
    if fastest > 1.0 + 1e-6:
        found["wrong"].append("the victim jumped")
    return found | {"victims_commands": commands, "victims_fastest": fastest, "first_failure": "".join(service.failures[:1])}


def _maltreat(service: ServiceProcess, context: zmq.Context, number: int, codes: Counter[str]) -> Driver:
    """Open a session, send nonsense to it, close it; what its robot was told."""
    secret = f"a-secret-that-got-about-{number}"
    name = f"victim-{number}"
    head, victim, nonsense = {"protocol": 1, "session": secret}, _VICTIMS[number % len(_VICTIMS)], Nonsense(secret, number)
    with context.socket(zmq.DEALER) as dealer, context.socket(zmq.SUB) as listener:
        for each in (dealer, listener):
            each.linger, each.rcvtimeo = 0, 5000
        dealer.connect(service.address)
        listener.connect(f"tcp://127.0.0.1:{service.ports['stream']}")
        listener.subscribe(name.encode() + b"\0")
        opened: dict[str, Any] = {"type": "error"}
        while opened["type"] == "error":
            # Nonsense opens sessions too, by chance, up to the caps.
            dealer.send(msgspec.msgpack.encode(head | victim | {"type": "open", "seq": 1, "name": name}))
            opened = msgspec.msgpack.decode(dealer.recv())
            if opened["type"] == "error":
                if opened["code"] not in ("busy", "rate"):
                    raise RuntimeError(f"no victim: {opened}")
                time.sleep(0.05)
        driver = Driver(np.array(opened["speed"]))
        for _ in range(_TO_ONE // _AT_ONCE):
            for _ in range(_AT_ONCE):
                dealer.send(nonsense())
            # A question that is always answered: when its answer comes, what was before it has been dealt with.
            dealer.send(msgspec.msgpack.encode({"type": "status", "protocol": 1, "seq": 1, "session": ""}))
            while not (answer := msgspec.msgpack.decode(dealer.recv())).get("robots"):
                codes[answer.get("code", answer["type"])] += 1
            while listener.poll(0):
                message = msgspec.msgpack.decode(listener.recv().partition(b"\0")[2])
                if message["type"] == "command":
                    driver.take(msgspec.convert(message, Command))
        dealer.send(msgspec.msgpack.encode(head | {"type": "close", "seq": 2**53}))
        while msgspec.msgpack.decode(dealer.recv())["seq"] != 2**53:
            pass
    return driver


class Nonsense:
    """Makes messages.

    Args:
        secret: Of the session that they are for, so that they reach more than the door.
        seed: Which ones.
    """

    def __init__(self, secret: str, seed: int = 0) -> None:
        self._generator = np.random.default_rng(seed)
        # Of five bytes on the wire, always.
        self._seq = 100_000
        self._templates = _templates(secret)

    def __call__(self) -> bytes:
        """The next message."""
        self._seq += 1
        draw = self._generator.random()
        message = dict(self._templates[self._pick(len(self._templates))], seq=self._seq)
        if draw < 0.1:
            # An honest one, so that there is something to disturb.
            return msgspec.msgpack.encode(message)
        if draw < 0.4:
            # Well-formed, with one or two values that are not.
            for _ in range(1 + self._pick(2)):
                self._spoil(message)
            return msgspec.msgpack.encode(message)
        payload = bytearray(msgspec.msgpack.encode(message))
        number = payload.index(b"\xa3seq") + 4
        kept = payload[number : number + 5]
        if draw < 0.6:
            return bytes(payload[: self._pick(len(payload) + 1)])
        if draw < 0.9:
            for place in self._generator.integers(0, len(payload), size=1 + self._pick(6)):
                payload[place] = self._pick(256)
            if self._pick(_SELDOM):
                payload[number : number + 5] = kept
            return bytes(payload)
        return self._generator.bytes(self._pick(400))

    def _spoil(self, message: dict[str, Any]) -> None:
        """Put something else in the place of one value, somewhere inside."""
        keys = [key for key in message if key != "seq" or not self._pick(_SELDOM)]
        key = keys[self._pick(len(keys))]
        value = message[key]
        if isinstance(value, list) and value and self._pick(3):
            # Copied, since the template's is shared.
            value = [list(item) if isinstance(item, list) else item for item in value]
            place = self._pick(len(value))
            if isinstance(value[place], list) and value[place]:
                value[place][self._pick(len(value[place]))] = self._value()
            else:
                value[place] = self._value()
            message[key] = value
        elif isinstance(value, dict) and value:
            inner = tuple(value)[self._pick(len(value))]
            message[key] = value | {inner: self._value()}
        elif self._pick(8) == 0:
            del message[key]
        else:
            message[key] = self._value()

    def _value(self) -> Any:
        if self._pick(2):
            number = _NUMBERS[self._pick(len(_NUMBERS))]
            return number if self._pick(4) else [number] * self._pick(40)
        return _OTHERS[self._pick(len(_OTHERS))]

    def _pick(self, count: int) -> int:
        return int(self._generator.integers(count))


def _templates(secret: str) -> list[dict[str, Any]]:
    """An honest message of every kind."""
    head = {"protocol": 1, "session": secret}
    wrist = {"position": [0.0, 0.1, 0.2], "quat_xyzw": [0.0, 0.0, 0.0, 1.0]}
    sample = head | {"time": 1.0, "q": [0.1] * 20, "wrist": wrist}
    points = [[0.01 * i, 0.02, 0.03 * (i % 3)] for i in range(21)]
    return [
        sample | {"type": "step"},
        sample | {"type": "step"},
        sample | {"type": "sample"},
        head | {"type": "step", "time": 2.0, "landmarks": points},
        head | {"type": "step", "time": 2.0, "points": points[:5], "wrist": wrist},
        head | {"type": "clutch"},
        head | {"type": "release"},
        head | {"type": "reset", "robot_q": [0.1] * 8, "robot_wrist": wrist},
        head | {"type": "status"},
        head | {"type": "subscribe", "name": "honest-0"},
        {
            **head,
            "type": "open",
            "robot": "three_finger",
            "name": "other",
            "input": "q",
            "mapping": {"ridge": 0.1, "rigid_from": "wrist"},
            "ik": {"max_iterations": 2, "solver": "daqp"},
            "robot_q": [0.1] * 8,
            "watchdog": 0.2,
            "max_dt": 0.03,
        },
    ]
