"""Models: structs with the same fields in Python and in the compiled core, and their bytes.

A `Model` has numbers, flags, names, arrays, other models, tuples of models, and None. `encode`
makes its bytes: MessagePack, a map with the fields in the order of the class, in which an array is
an extension of three parts, the type of its numbers, its shape, and the numbers row by row. The
core reads them by `handmap/model_reader.hpp` into a struct whose fields have the same names and
forms; `_core.model_fields()` lists those.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

_ARRAY = 1
"""Code of the extension of MessagePack that has an array."""
_TYPES = {np.dtype(kind): kind for kind in ("<f8", "<i8", "<i4", "|b1")}
"""Numbers that arrays may have."""

# The forms of arrays, as the core names them. Other sizes are for the core to check.
Vector = Annotated[NDArray[np.float64], "float (n)"]
Matrix = Annotated[NDArray[np.float64], "float (n, m)"]
Point = Annotated[NDArray[np.float64], "float (3)"]
Points = Annotated[NDArray[np.float64], "float (n, 3)"]
Rotation = Annotated[NDArray[np.float64], "float (3, 3)"]
Pose = Annotated[NDArray[np.float64], "float (4, 4)"]
Indices = Annotated[NDArray[np.int64], "int (n)"]
Flags = Annotated[NDArray[np.bool_], "bool (n)"]


class Model(msgspec.Struct, frozen=True, eq=False):
    """Base of all models. Their fields are not checked here, but where the core reads them."""


def _packed(value: Any) -> Any:
    # A person's hand is bound by some hundred calls, so that each one here counts.
    if type(value) is not np.ndarray:
        if isinstance(value, np.generic):
            return value.item()
        raise TypeError(f"no form for {type(value).__name__}")
    if value.dtype not in _TYPES:
        raise TypeError(f"no form for numbers of the type {value.dtype.str}")
    head = _head_of(value.dtype, value.shape)
    numbers = value.data if value.flags.c_contiguous else value.tobytes()
    return msgspec.msgpack.Ext(_ARRAY, head + numbers)


@lru_cache(maxsize=256)
def _head_of(kind: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """Return what an array's extension begins with, before the numbers."""
    size = kind.itemsize * math.prod(shape)
    whole = msgspec.msgpack.encode((_TYPES[kind], shape, bytes(size)))
    return whole[: len(whole) - size]


def unpacked(code: int, data: memoryview) -> NDArray[Any]:
    """Return the array of an extension of MessagePack; a hook of `msgspec`.

    Raises:
        ValueError: If it is none.
    """
    kind, shape, numbers = msgspec.msgpack.decode(
        data, type=tuple[str, tuple[int, ...], bytes]
    )
    if code != _ARRAY or kind not in _TYPES.values():
        raise ValueError("no such numbers")
    if min(shape, default=0) < 0:
        raise ValueError("a negative size")
    if math.prod(shape) * np.dtype(kind).itemsize != len(numbers):
        raise ValueError("an array of another size")
    # A copy, aligned; nobody writes to it.
    array = np.frombuffer(numbers, kind).reshape(shape).copy()
    array.setflags(write=False)
    return array


encode = msgspec.msgpack.Encoder(enc_hook=_packed).encode
"""Return the bytes of a model, or of a mapping or sequence of what models have."""

encoded = lru_cache(maxsize=64)(encode)
"""Return the same of a model that is used again."""
