"""The form of a saved hand: one msgpack file, whose numbers are flat arrays by name."""

from __future__ import annotations

from typing import Any, cast

import msgspec

from handmap_core.models import unpacked

KIND = "handmap hand"
HAND, ROBOT = 1, 2
"""Forms of what a file has: a hand, or a robot with two."""


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


_decode = msgspec.msgpack.Decoder(ext_hook=unpacked).decode


def decode(body: bytes) -> Any:
    """Return what `encode` was given, with tuples in place of lists."""
    return _tuples(_decode(body))


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _tuples(each) for name, each in cast("dict", value).items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
