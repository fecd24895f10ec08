"""Pickled tables of arrays, numbers and texts, read without running code and without trusting them.

A pickle is a program for a machine with a stack. It runs code by naming a function that is called,
and numpy's own `__setstate__` takes bytes of the file for pointers. So nothing here is unpickled by
`pickle`: this is a machine of its own, with the instructions that tables need. Names stand for what
they would build (`_NAMES`), and arrays are made by `np.frombuffer` of plain kinds of numbers.

Every size is checked against the bytes that are there before anything is allocated.
"""

import pickle
import pickletools
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from io import BytesIO
from pathlib import Path
from typing import IO, NoReturn

import numpy as np
from numpy.lib.format import MAGIC_PREFIX

from handmap_core.se3 import Array
from handmap_qp.hands import Values
from .archive import LARGEST_ARCHIVE
from .base import reading

_DEEPEST = 32
"""Levels of containers inside each other; data sets have up to five."""
_MOST_VALUES = 10_000_000
"""Most values that containers may have in all, each counted as often as it is reached."""
_MOST_INSTRUCTIONS = 20_000_000
"""Most instructions of a pickle: one byte of it may ask for a container of 64 bytes."""
_MOST_DENSE = 1 << 24
"""Most numbers of a sparse matrix that is made dense; MANO's has 16 times 778."""
_KIND = re.compile(r"b1|[iu][1248]|f(2|4|8|16)|c(8|16|32)|[SU][1-9]\d{0,8}")
"""Kinds of numpy whose bytes are numbers or texts, whatever the bytes are."""


class _Name(Enum):
    """What a name in a pickle stands for."""

    ARRAY = "numpy.ndarray"
    KIND = "numpy.dtype"
    EMPTY_ARRAY = "_reconstruct"
    SCALAR = "scalar"
    FILLED_ARRAY = "_frombuffer"
    BYTES = "bytes"
    ENCODE = "_codecs.encode"
    SPARSE = "csc_matrix"
    CHUMPY = "chumpy"


_NAMES = {
    "numpy.ndarray": _Name.ARRAY,
    "numpy.dtype": _Name.KIND,
    "numpy.core.multiarray._reconstruct": _Name.EMPTY_ARRAY,
    "numpy._core.multiarray._reconstruct": _Name.EMPTY_ARRAY,
    "numpy.core.multiarray.scalar": _Name.SCALAR,
    "numpy._core.multiarray.scalar": _Name.SCALAR,
    "numpy.core.numeric._frombuffer": _Name.FILLED_ARRAY,
    "numpy._core.numeric._frombuffer": _Name.FILLED_ARRAY,
    "_codecs.encode": _Name.ENCODE,
    # Up to protocol 2, empty bytes are a call.
    "builtins.bytes": _Name.BYTES,
    "__builtin__.bytes": _Name.BYTES,
    "scipy.sparse.csc.csc_matrix": _Name.SPARSE,
    "scipy.sparse._csc.csc_matrix": _Name.SPARSE,
}


class _Mark(Enum):
    """Where on the stack the items of a container begin."""

    MARK = "mark"


@dataclass(eq=False)
class _Kind:
    """Stands for a `numpy.dtype`.

    Attributes:
        text: Kind and bytes of an item, such as `f8`; `O8` for objects.
        order: Order of the bytes: `<`, `>`, or `|` and `=` where there is nothing to say.
    """

    text: str
    order: str = "="

    @property
    def is_object(self) -> bool:
        """Whether items are objects of Python."""
        return self.text in ("O4", "O8")

    def dtype(self) -> np.dtype:
        """Return the kind of numpy; refuse one of anything but numbers and texts."""
        if not _KIND.fullmatch(self.text) or self.order not in ("<", ">", "|", "="):
            _refuse(f"holds an array of kind {self.order}{self.text}")
        return np.dtype(self.order + self.text)


@dataclass(eq=False)
class _Array:
    """Stands for a `numpy.ndarray`, which a pickle first names and fills later.

    Attributes:
        values: The array of a plain kind; None before it is filled, or if it holds objects.
        items: The objects of an array of objects, in C order.
        shape: Its shape.
    """

    values: Array | None = None
    items: list[object] = field(default_factory=list)
    shape: tuple[int, ...] = ()


@dataclass(eq=False)
class Sparse:
    """Stands for `scipy.sparse.csc_matrix`, whose own conversion trusts its indices.

    Attributes:
        state: Its attributes: `_shape` or `shape`, `data`, `indices`, `indptr`.
    """

    state: dict[object, object] = field(default_factory=dict)

    def toarray(self) -> Array:
        """Return the matrix as an array.

        Raises:
            ValueError: If its indices or sizes contradict each other, or it is too large.
        """
        rows, columns = _shape_of(self.state.get("_shape", self.state.get("shape")))
        data, indices, starts = (
            np.asarray(self.state.get(name)) for name in ("data", "indices", "indptr")
        )
        counts = np.diff(starts)
        is_right = (
            rows * columns <= _MOST_DENSE
            and data.dtype.kind in "biuf"
            and data.ndim == indices.ndim == starts.ndim == 1
            and indices.dtype.kind in "iu"
            and starts.dtype.kind in "iu"
            and len(starts) == columns + 1
            and starts[0] == 0
            and starts[-1] == len(data) == len(indices)
            and (starts[1:] >= starts[:-1]).all()
            and (indices >= 0).all()
            and (indices < rows).all()
        )
        if not is_right:
            raise ValueError("a sparse matrix whose sizes contradict each other")
        dense = np.zeros((rows, columns))
        np.add.at(dense, (indices, np.repeat(np.arange(columns), counts)), data)
        return dense


@dataclass(eq=False)
class Shell:
    """Stands for chumpy's classes, which wrap the model's arrays; holds their state.

    Attributes:
        state: Their attributes; `x` is the array.
    """

    state: dict[object, object] = field(default_factory=dict)

    def __array__(
        self, dtype: np.dtype | None = None, copy: bool | None = None
    ) -> Array:
        return np.asarray(self.state.get("x"), dtype=dtype)


def read_table(file: Path) -> Values:
    """Read a pickled table without running code in it: it may hold arrays, numbers and texts only.

    Args:
        file: A pickle, or an array of numpy (`.npy`) whose one value is a table.

    Raises:
        RecordingError: If it holds something else, is no table, or is larger than
            `LARGEST_ARCHIVE`.
    """
    with reading(file), file.open("rb") as stream:
        return load_table(stream)


def load_table(stream: IO[bytes]) -> Values:
    """Load a table of an open file, as `read_table`.

    Raises:
        UnpicklingError: If it holds something else, or is too large.
        Exception: If it is damaged, of any kind: callers turn it into theirs.
    """
    content = stream.read(LARGEST_ARCHIVE + 1)
    if len(content) > LARGEST_ARCHIVE:
        _refuse(f"holds more than the {LARGEST_ARCHIVE >> 20} MB that are read")
    if content.startswith(MAGIC_PREFIX[:1]):
        # The header of an array is one line; a pickle follows.
        _, _, content = content.partition(b"\n")
    found = _Finisher(len(content)).finish(_Machine(content).run())
    if isinstance(found, np.ndarray) and found.shape == ():
        found = found.item()
    if not isinstance(found, dict):
        raise TypeError("it is no table")
    return found


def _refuse(problem: str) -> NoReturn:
    raise pickle.UnpicklingError(f"{problem}, which is not read; save arrays of numpy")


def _shape_of(given: object) -> tuple[int, ...]:
    """Return a shape of an array, at most 32 sizes; refuse what is none."""
    if not isinstance(given, tuple) or len(given) > 32:
        _refuse("holds an array without a shape")
    sizes = []
    for size in given:
        if type(size) is not int or not 0 <= size < 1 << 48:
            _refuse("holds an array of an impossible shape")
        sizes.append(size)
    return tuple(sizes)


def _count_of(shape: Sequence[int]) -> int:
    """Return the number of items of a shape, exactly: numpy's own product overflows."""
    count = 1
    for size in shape:
        count *= size
    return count


def _read_text(stream: IO[bytes]) -> str:
    """Read a text of Python 2: one line, quoted and escaped."""
    line = stream.readline().rstrip(b"\r\n")
    if len(line) < 2 or line[:1] not in (b"'", b'"') or line[:1] != line[-1:]:
        _refuse("holds a text without quotes")
    return line[1:-1].decode("unicode_escape")


_READERS = {
    code.code.encode("latin1"): (code.name, code.arg.reader if code.arg else None)
    for code in pickletools.opcodes
} | {b"S": ("STRING", _read_text)}
"""Name of each instruction by its byte, and what reads its argument."""
_NOTHING = {"PROTO", "FRAME"}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_NUMBERS = {"INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4"}
_NUMBERS |= {"FLOAT", "BINFLOAT"}
_TEXTS = {"STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES"}
_TEXTS |= {"BINBYTES8", "BYTEARRAY8", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE"}
_TEXTS |= {"BINUNICODE8"}
_PUTS = {"PUT", "BINPUT", "LONG_BINPUT"}
_GETS = {"GET", "BINGET", "LONG_BINGET"}
_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


_EMPTY = {_Name.EMPTY_ARRAY: _Array, _Name.SPARSE: Sparse, _Name.CHUMPY: Shell}
"""What names make, whatever their arguments."""


class _Machine:
    """Runs the instructions of a pickle that tables need; any other one ends the reading.

    Containers, arrays and kinds are built as the pickle says; `_Finisher` puts arrays in the place
    of what stands for them.

    Args:
        content: The pickle.
    """

    def __init__(self, content: bytes) -> None:
        self._stream = BytesIO(content)
        self._stack: list[object] = []
        self._memo: dict[int, object] = {}
        # Bytes of arrays that may be built: a file that names the same bytes again and again would
        # fill the memory.
        self._left = 2 * len(content)
        self._runs: dict[str, Callable[[], object]] = {
            "MARK": lambda: self._stack.append(_Mark.MARK),
            "POP": self._stack.pop,
            "POP_MARK": self._items,
            "EMPTY_LIST": lambda: self._stack.append([]),
            "EMPTY_DICT": lambda: self._stack.append({}),
            "LIST": lambda: self._stack.append(self._items()),
            "TUPLE": lambda: self._stack.append(tuple(self._items())),
            "DICT": self._make_dict,
            "APPEND": lambda: self._extend([self._stack.pop()]),
            "APPENDS": lambda: self._extend(self._items()),
            "SETITEM": lambda: self._set([self._stack.pop(-2), self._stack.pop()]),
            "SETITEMS": lambda: self._set(self._items()),
            "MEMOIZE": lambda: self._put(len(self._memo)),
            "STACK_GLOBAL": self._name_of_stack,
            "REDUCE": self._reduce,
            "NEWOBJ": self._reduce,
            "BUILD": self._build,
        }

    def run(self) -> object:
        """Return what the pickle holds.

        Raises:
            UnpicklingError: If it needs an instruction, a name or a kind that tables do not have.
            ValueError: If it is damaged; likewise `IndexError`, `KeyError` and others.
        """
        for _ in range(_MOST_INSTRUCTIONS):
            code = self._stream.read(1)
            if not code:
                raise EOFError("it ends too early")
            name, reader = _READERS.get(code, ("", None))
            argument = reader(self._stream) if reader else None
            if name == "STOP":
                return self._stack.pop()
            self._take(name, argument)
        _refuse(f"holds more than {_MOST_INSTRUCTIONS:,} values")

    def _take(self, name: str, argument: object) -> None:
        """Run one instruction with its argument."""
        if run := self._runs.get(name):
            run()
        elif name in _TEXTS:
            self._stack.append(argument)
        elif name in _NUMBERS:
            self._stack.append(_plain_number(argument))
        elif name in _CONSTANTS:
            self._stack.append(_CONSTANTS[name])
        elif name in _TUPLES:
            count = _TUPLES[name]
            self._stack.append(tuple(self._last(count)))
        elif name in _PUTS:
            self._put(int(str(argument)))
        elif name in _GETS:
            self._stack.append(self._memo[int(str(argument))])
        elif name == "GLOBAL":
            self._push_name(str(argument).replace(" ", ".", 1))
        elif name not in _NOTHING:
            _refuse(f"needs the instruction {name or 'of no pickle'}")

    # -- the stack

    def _last(self, count: int) -> list[object]:
        """Take the last values from the stack."""
        if count > len(self._stack):
            raise IndexError("it takes more than there is")
        values = self._stack[len(self._stack) - count :]
        del self._stack[len(self._stack) - count :]
        return values

    def _items(self) -> list[object]:
        """Take what lies above the last mark, and the mark."""
        items = []
        while (value := self._stack.pop()) is not _Mark.MARK:
            items.append(value)
        return items[::-1]

    def _put(self, place: int) -> None:
        self._memo[place] = self._stack[-1]

    # -- containers

    def _make_dict(self) -> None:
        items = self._items()
        self._stack.append({})
        self._set(items)

    def _extend(self, items: list[object]) -> None:
        """Append items to the list on the stack."""
        target = self._stack[-1]
        if not isinstance(target, list):
            raise TypeError("it appends to what is no list")
        target.extend(items)

    def _set(self, items: list[object]) -> None:
        """Set items of the dictionary on the stack: key, value, key, value."""
        target = self._stack[-1]
        if not isinstance(target, dict) or len(items) % 2:
            raise TypeError("it sets items of what is no table")
        for key, value in zip(items[::2], items[1::2], strict=True):
            # Hashing a tuple inside a tuple inside a tuple... exhausts the C stack.
            if not isinstance(key, str | bytes | int | float | None):
                _refuse(f"holds a key of type {type(key).__name__}")
            target[key] = value

    # -- what names stand for

    def _name_of_stack(self) -> None:
        module, name = self._last(2)
        # The text of a list may be far longer than the file: lists may share their items.
        if not isinstance(module, str) or not isinstance(name, str):
            _refuse("holds a name that is not a text")
        self._push_name(f"{module}.{name}")

    def _push_name(self, place: str) -> None:
        is_chumpy = place.partition(".")[0] == "chumpy"
        name = _Name.CHUMPY if is_chumpy else _NAMES.get(place)
        if name is None:
            _refuse(f"holds {place}")
        self._stack.append(name)

    def _reduce(self) -> None:
        """Call a name with a tuple of arguments."""
        name, arguments = self._last(2)
        if not isinstance(arguments, tuple):
            raise TypeError("it calls a name without arguments")
        if not isinstance(name, _Name):
            raise TypeError("it calls what is no name")
        self._stack.append(self._made(name, arguments))

    def _made(self, name: _Name, arguments: tuple[object, ...]) -> object:
        """Return what a name makes of its arguments."""
        if empty := _EMPTY.get(name):
            # `BUILD` fills it.
            return empty()
        match name, arguments:
            case _Name.BYTES, ():
                return b""
            case _Name.KIND, (str(text), *_):
                return _Kind(text)
            case _Name.SCALAR, (kind, content):
                return _Array(self._filled(content, kind, ()))
            case _Name.FILLED_ARRAY, (content, kind, shape, order):
                is_fortran = order == "F"
                return _Array(self._filled(content, kind, shape, is_fortran=is_fortran))
            case _Name.ENCODE, (str(text), "latin1" | "latin-1"):
                self._spend(len(text))
                return text.encode("latin1")
        _refuse(f"holds a call of {name.value} that arrays do not need")

    def _build(self) -> None:
        """Give the object on the stack its state."""
        state = self._stack.pop()
        target = self._stack[-1]
        match target, state:
            case _Kind(), (_, str(order), None, None, None, *_):
                target.order = order
            case _Array(), (_, shape, _Kind() as kind, is_fortran, content):
                self._fill(target, shape, kind, bool(is_fortran), content)
            case ((Sparse() | Shell()), dict()):
                target.state = state
            case _:
                _refuse("holds an array of parts or a state")

    def _fill(
        self,
        target: _Array,
        shape: object,
        kind: _Kind,
        is_fortran: bool,
        content: object,
    ) -> None:
        """Give an array its values; objects are those that the pickle has built, in a list."""
        if not kind.is_object:
            target.values = self._filled(content, kind, shape, is_fortran=is_fortran)
            return
        sizes = _shape_of(shape)
        if (
            not isinstance(content, list)
            or len(content) != _count_of(sizes)
            or is_fortran
        ):
            _refuse("holds an array of objects without its objects")
        target.values = None
        target.items = content
        target.shape = sizes

    def _filled(
        self, content: object, kind: object, shape: object, *, is_fortran: bool = False
    ) -> Array:
        """Return an array of a plain kind, whose bytes are exactly those of its shape."""
        if not isinstance(kind, _Kind):
            raise TypeError("it has an array without a kind")
        dtype = kind.dtype()
        sizes = _shape_of(shape)
        # Python 2 has bytes as text.
        if not isinstance(content, bytes | bytearray | str):
            _refuse("holds an array without bytes")
        if len(content) != _count_of(sizes) * dtype.itemsize:
            _refuse(
                f"holds an array of shape {sizes} and kind {kind.text} in {len(content)} bytes"
            )
        self._spend(len(content))
        if not content:
            return np.zeros(sizes, dtype)
        raw = content.encode("latin1") if isinstance(content, str) else content
        if dtype.kind == "b":
            # Any byte but 0 is true.
            flat = np.frombuffer(raw, np.uint8) != 0
        else:
            flat = np.frombuffer(raw, dtype).copy()
        return flat.reshape(sizes, order="F" if is_fortran else "C")

    def _spend(self, count: int) -> None:
        """Count bytes that are built of the file's."""
        self._left -= count
        if self._left < 0:
            _refuse("holds the same bytes again and again")


def _plain_number(value: object) -> int | float | bool:
    """Return a number; an integer of up to 64 bits."""
    if isinstance(value, int) and -(1 << 63) <= value < 1 << 64:
        return value
    if isinstance(value, float):
        return value
    _refuse("holds an integer of more than 64 bits")


class _Finisher:
    """Puts arrays in the place of what stands for them in containers.

    A container may be in itself, or in many others: both would exhaust memory later, so containers
    are counted as often as they are reached.

    Args:
        length: Bytes of the pickle; it may hold as many values, and `_MOST_VALUES`.
    """

    def __init__(self, length: int) -> None:
        self._most = max(length, _MOST_VALUES)
        self._open: set[int] = set()
        # What each container has become, and how many values are in it.
        self._done: dict[int, tuple[object, int]] = {}

    def finish(self, value: object) -> object:
        """Return a value with arrays in place.

        Raises:
            UnpicklingError: If it holds something else than arrays, numbers, texts and containers
                of them, or too many of those.
        """
        finished, _ = self._finished(value)
        return finished

    def _finished(self, value: object) -> tuple[object, int]:
        """Return a value with arrays in place, and the number of values in it."""
        if value is None or isinstance(
            value, bool | int | float | str | bytes | bytearray
        ):
            return value, 1
        if isinstance(value, _Array) and value.values is not None:
            # A scalar is one of numpy's own.
            array = value.values
            return (array if array.shape else array[()]), 1
        if isinstance(value, _Kind | Enum):
            _refuse("holds a name by itself")
        known = self._done.get(id(value))
        if known is None:
            if id(value) in self._open or len(self._open) == _DEEPEST:
                _refuse(
                    f"holds a table in itself, or more than {_DEEPEST} inside each other"
                )
            self._open.add(id(value))
            known = self._container(value)
            self._open.remove(id(value))
            self._done[id(value)] = known
        if known[1] > self._most:
            _refuse("holds the same values again and again")
        return known

    def _container(self, value: object) -> tuple[object, int]:
        """Return a container with arrays in place, and the number of values in it."""
        if isinstance(value, dict):
            items, count = self._all(value.values())
            return dict(zip(value, items, strict=True)), count
        if isinstance(value, list | tuple):
            items, count = self._all(value)
            return type(value)(items), count
        if isinstance(value, Sparse | Shell):
            items, count = self._all(value.state.values())
            state = dict(zip(value.state, items, strict=True))
            return type(value)(state), count
        if isinstance(value, _Array):
            items, count = self._all(value.items)
            array = np.empty(len(items), dtype=object)
            for i, item in enumerate(items):
                array[i] = item
            return array.reshape(value.shape), count
        raise TypeError(f"it holds a {type(value).__name__}")

    def _all(self, values: Iterable[object]) -> tuple[list[object], int]:
        """Return values with arrays in place, and the number of values in all."""
        finished = []
        count = 1
        for value in values:
            item, size = self._finished(value)
            finished.append(item)
            count += size
            if count > self._most:
                _refuse("holds the same values again and again")
        return finished, count
