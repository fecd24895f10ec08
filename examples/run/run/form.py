"""The form of a saved hand: one msgpack file, whose numbers are flat arrays by name."""

from __future__ import annotations

import math
from typing import Any, cast

import msgspec
import numpy as np

KIND = "handmap hand"
HAND, ROBOT = 1, 2
"""Forms of what a file has: a hand, or a robot with two."""
TYPES = ("<f8", "<i8", "<i4", "|b1")
"""Numbers that arrays may have."""
_ARRAY = 1


class File(msgspec.Struct, frozen=True):
    """What a file has.

    Attributes:
        kind: `KIND`.
        version: Version of the library that saved it: another one may have other names.
        checksum: CRC-32 of `body`.
        body: The hand and how it follows, or a robot with its hands, in msgpack again.
        form: Form of `body`. The first version had hands alone, and did not name it.
    """

    kind: str
    version: str
    checksum: int
    body: bytes
    form: int = HAND


def _pack(value: Any) -> msgspec.msgpack.Ext:
    if not isinstance(value, np.ndarray):
        raise TypeError(f"no form for {type(value).__name__}")
    kind = np.dtype(value.dtype).newbyteorder("<").str
    if kind not in TYPES:
        raise TypeError(f"no form for numbers of the type {kind}")
    head = kind, value.shape, np.ascontiguousarray(value, kind).tobytes()
    return msgspec.msgpack.Ext(_ARRAY, msgspec.msgpack.encode(head))


def _unpack(code: int, data: memoryview) -> np.ndarray:
    kind, shape, numbers = msgspec.msgpack.decode(
        data, type=tuple[str, tuple[int, ...], bytes]
    )
    if code != _ARRAY or kind not in TYPES:
        raise ValueError("no such numbers")
    if math.prod(shape) * np.dtype(kind).itemsize != len(numbers):
        raise ValueError("an array of another size")
    # A copy, aligned; nobody writes to it.
    array = np.frombuffer(numbers, kind).reshape(shape).copy()
    array.setflags(write=False)
    return array


encode = msgspec.msgpack.Encoder(enc_hook=_pack).encode
_decode = msgspec.msgpack.Decoder(ext_hook=_unpack).decode


def decode(body: bytes) -> Any:
    """Return what `encode` was given, with tuples in place of lists."""
    return _tuples(_decode(body))


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _tuples(each) for name, each in cast("dict", value).items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
