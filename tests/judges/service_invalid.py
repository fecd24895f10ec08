"""Invalid messages in msgpack or JSON: altered, truncated, or well-formed with absurd values."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np

# After a very large number, the session refuses all smaller ones: keep that rare.
_RARELY = 500
_NUMBERS = (
    0.0,
    -1.0,
    1e-300,
    1e9,
    1e300,
    -1e308,
    math.nan,
    math.inf,
    -math.inf,
    2**63,
    -(2**63),
    0,
    7,
)
_OTHERS: tuple[Any, ...] = (
    None,
    True,
    "",
    "x" * 300,
    b"\x00\xff",
    [],
    {},
    [[]],
    {"a": {"b": 1}},
    "../../etc/passwd",
    "\x00",
)


class InvalidMessages:
    """Generate messages to one session.

    Args:
        secret: Secret of the session, so that messages get past the look-up.
        name: Its public name, which some messages use instead.
        seed: Seed of the generator.
        is_json: Whether messages are JSON; msgpack otherwise.
    """

    def __init__(
        self, secret: str, name: str, seed: int = 0, *, is_json: bool = False
    ) -> None:
        self._generator = np.random.default_rng(seed)
        # Always six digits in JSON and five bytes in msgpack.
        self._seq = 100_000
        self._templates = _templates(secret, name)
        self._encode = msgspec.json.encode if is_json else msgspec.msgpack.encode
        self._before_seq = b'"seq":' if is_json else b"\xa3seq"
        self._seq_length = 6 if is_json else 5

    def __call__(self) -> bytes:
        """Return the next message."""
        self._seq += 1
        draw = self._generator.random()
        message = dict(self._templates[self._pick(len(self._templates))], seq=self._seq)
        if draw < 0.1:
            # A valid message, so that the session does something that can be disturbed.
            return self._encode(message)
        if draw < 0.4:
            # A well-formed message with one or two absurd values.
            for _ in range(1 + self._pick(2)):
                self._spoil(message)
            return self._encode(message)
        payload = bytearray(self._encode(message))
        if draw < 0.6:
            return bytes(payload[: self._pick(len(payload) + 1)])
        if draw < 0.9:
            number = payload.index(self._before_seq) + len(self._before_seq)
            kept = payload[number : number + self._seq_length]
            for place in self._generator.integers(
                0, len(payload), size=1 + self._pick(6)
            ):
                payload[place] = self._pick(256)
            if self._pick(_RARELY):
                payload[number : number + self._seq_length] = kept
            return bytes(payload)
        return self._generator.bytes(self._pick(400))

    def _spoil(self, message: dict[str, Any]) -> None:
        """Replace one value, at any depth."""
        keys = [key for key in message if key != "seq" or not self._pick(_RARELY)]
        key = keys[self._pick(len(keys))]
        value = message[key]
        if isinstance(value, list) and value and self._pick(3):
            # Copy it, because the template is shared.
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


def _templates(secret: str, name: str) -> list[dict[str, Any]]:
    """Return a valid message of every kind."""
    head, by_name = {"protocol": 1, "session": secret}, {"protocol": 1, "name": name}
    wrist = {"position": [0.0, 0.1, 0.2], "quat_xyzw": [0.0, 0.0, 0.0, 1.0]}
    sample = head | {"time": 1.0, "q": [0.1] * 20, "wrist": wrist}
    points = [[0.01 * i, 0.02, 0.03 * (i % 3)] for i in range(21)]
    return [
        sample | {"type": "step"},
        sample | {"type": "step"},
        sample | {"type": "sample"},
        head | {"type": "step", "time": 2.0, "landmarks": points},
        head | {"type": "step", "time": 2.0, "landmarks": points, "wrist": wrist},
        head | {"type": "step", "time": 2.0, "points": points[:5], "wrist": wrist},
        head | {"type": "clutch"},
        head | {"type": "release"},
        head | {"type": "reset", "robot_q": [0.1] * 8, "robot_wrist": wrist},
        head
        | {
            "type": "configure",
            "mapping": {"scale": 1.5, "pivot": "palm", "ridge": 0.2},
            "has_detail": True,
        },
        head
        | {
            "type": "configure",
            "ik": {"rest_weight": 0.3, "max_iterations": 2, "max_acceleration": 50.0},
        },
        head
        | {
            "type": "configure",
            "preset": "teleoperation",
            "teleoperation": {"pinch_weight": 2.0, "contact_gap": 0.01},
        },
        head | {"type": "status"},
        by_name
        | {
            "type": "configure",
            "preset": "object",
            "mapping": {"reference": "previous", "stretch_max": 2.0},
            "ik": {"damping": 0.2},
        },
        by_name | {"type": "clutch"},
        by_name | {"type": "release"},
        by_name | {"type": "status"},
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
