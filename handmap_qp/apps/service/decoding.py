"""Decode and check requests, and encode replies."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from handmap_qp.client import messages
from handmap_qp.client.messages import (
    NAME,
    AnyReply,
    AnyRequest,
    Clear,
    Error,
    Open,
    Pose,
    Stop,
)

LARGEST = 1e3
"""Largest coordinate [m] and angle [rad]; larger numbers are mistakes."""
LATEST = 1e15
"""Largest time stamp [s]."""
# Numbers of a layout may be in millimetres or degrees.
_BOUNDS = {"time": LATEST, "values": 1e6} | dict.fromkeys(
    ("q", "landmarks", "points", "robot_q"), LARGEST
)
_QUAT_TOLERANCE = 1e-2
_STOP_PROTOCOL = 2


class _Head(msgspec.Struct):
    """The fields that identify a request which is invalid elsewhere."""

    protocol: Any = None
    seq: Any = 0


# Invalid UTF-8 and excessive nesting raise errors other than msgspec's.
_UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
_CODECS = {False: msgspec.msgpack, True: msgspec.json}
_DECODE = {key: codec.Decoder(AnyRequest).decode for key, codec in _CODECS.items()}
_DECODE_HEAD = {key: codec.Decoder(_Head).decode for key, codec in _CODECS.items()}
_ENCODE = {key: codec.Encoder().encode for key, codec in _CODECS.items()}


def decode_request(
    payload: bytes | str, *, is_json: bool = False
) -> AnyRequest | Error:
    """Read and check one request.

    Args:
        payload: The message as received.
        is_json: Whether it is JSON; msgpack otherwise.

    Returns:
        The request; or the error to answer with, which has the field at fault, and the number of
        the request if it can be read.
    """
    if isinstance(payload, str):
        payload = payload.encode(errors="replace")
    try:
        request = _DECODE[is_json](payload)
    except msgspec.ValidationError as error:
        protocol, seq = _head(payload, is_json)
        if type(protocol) is int and protocol not in messages.PROTOCOLS:
            return _wrong_protocol(seq, protocol)
        message, path = _split(error)
        return Error(
            seq=seq, code="invalid", message=_explain(message, path), field=path
        )
    except _UNREADABLE as error:
        kind = "JSON" if is_json else "msgpack"
        return Error(code="invalid", message=f"not a {kind} message: {error}"[:200])
    is_newer = isinstance(request, Stop | Clear) and request.protocol < _STOP_PROTOCOL
    if request.protocol not in messages.PROTOCOLS or is_newer:
        return _wrong_protocol(request.seq, request.protocol)
    for field, message in _bad_numbers(request):
        return Error(seq=request.seq, code="invalid", message=message, field=field)
    return request


def encode_reply(reply: AnyReply, *, is_json: bool = False) -> bytes:
    """Encode one reply."""
    return _ENCODE[is_json](reply)


def _head(payload: bytes, is_json: bool) -> tuple[Any, int]:
    """Return protocol and number of a request that is invalid elsewhere."""
    try:
        head = _DECODE_HEAD[is_json](payload)
    except _UNREADABLE:
        return None, 0
    return head.protocol, head.seq if type(
        head.seq
    ) is int and 0 <= head.seq <= 2**53 else 0


def _wrong_protocol(seq: int, protocol: int) -> Error:
    known = messages.PROTOCOLS
    message = f"expected version {' or '.join(map(str, known))}, got {protocol}"
    return Error(
        seq=seq, code="protocol", field="protocol", message=message, protocols=known
    )


def _split(error: msgspec.ValidationError) -> tuple[str, str]:
    """Split the text of msgspec's error into its message and the path of the value at fault.

    msgspec has no attributes for them. It appends a JSON path to its message, as in "Expected
    `float`, got `str` - at `$.q[1]`". For a missing or unknown field of the message itself, it
    quotes the field instead, as in "Object missing required field `time`".
    """
    message, separator, path = str(error).rpartition(" - at `$")
    if separator:
        return message, path.rstrip("`").lstrip(".")
    named = re.search(r"field `(\w+)`$", path)
    return path, named[1] if named else ""


def _explain(message: str, path: str) -> str:
    """Replace messages of msgspec that would not help a client."""
    if "matching regex" in message:
        return f"expected {NAME}"
    if path == "name" and message.startswith("Object contains unknown field"):
        return (
            "by a session's name you may only watch it, and steer it if it is shared; "
            "this request requires its secret"
        )
    return message


def _bad_numbers(request: AnyRequest) -> Iterator[tuple[str, str]]:
    """Yield field and message of numbers that are not finite, or out of range."""
    for field, largest in _BOUNDS.items():
        if (values := getattr(request, field, None)) is not None:
            yield from _outside(field, values, largest)
    if isinstance(request, Open) and request.lengths is not None:
        for field, rows in msgspec.structs.asdict(request.lengths).items():
            yield from _outside(f"lengths.{field}", rows)
    for field in ("wrist", "robot_wrist"):
        pose: Pose | None = getattr(request, field, None)
        if pose is not None:
            norm = math.hypot(*pose.quat_xyzw)
            if not abs(norm - 1.0) <= _QUAT_TOLERANCE:
                yield (
                    f"{field}.quat_xyzw",
                    f"expected a unit quaternion, got norm {norm:g}",
                )
            yield from _outside(f"{field}.position", pose.position)


def _outside(
    field: str, values: Any, largest: float = LARGEST
) -> Iterator[tuple[str, str]]:
    array = np.array(values, dtype=float)
    # `~(a <= b)` is also true of NaN.
    for index in np.argwhere(~(np.abs(array) <= largest)):
        value = array[tuple(index)]
        place = field + "".join(f"[{i}]" for i in index)
        yield place, f"expected a number within {largest:g} of 0, got {value:g}"
