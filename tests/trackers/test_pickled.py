"""Tables in pickles: what is read, and that no bytes of a file are trusted."""

from __future__ import annotations

import io
import pickle
import random
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import scipy.sparse

from handmap_qp import RecordingError
from handmap_qp.trackers.formats.pickled import Sparse, load_table, read_table

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)
RECONSTRUCT: Any = np.zeros(0).__reduce__()[0]


class Reduced:
    """Pickled as a call of a function, with a state."""

    def __init__(self, *reduced: Any) -> None:
        self.reduced = reduced

    def __reduce__(self) -> tuple[Any, ...]:
        return self.reduced


def kind(text: Any, *state: Any) -> Reduced:
    """Return a `numpy.dtype` whose state need not be true."""
    return Reduced(np.dtype, (text, False, True), state)


def array_of(shape: Any, dtype: Any, content: Any, is_fortran: bool = False) -> Reduced:
    """Return a `numpy.ndarray` whose state need not be true."""
    state = (1, shape, dtype, is_fortran, content)
    return Reduced(RECONSTRUCT, (np.ndarray, (0,), b"b"), state)


def load(content: bytes) -> Any:
    return load_table(io.BytesIO(content))


def table() -> dict[str, Any]:
    """Return a table of all that data sets have."""
    rng = np.random.default_rng(3)
    return {
        "floats": rng.normal(size=(4, 3)),
        "fortran": np.asfortranarray(rng.normal(size=(3, 4, 2))),
        "strided": rng.normal(size=(6, 6))[::2, 1::3],
        "big_endian": rng.normal(size=5).astype(">f4"),
        "integers": np.arange(12, dtype=np.uint16).reshape(3, 4),
        "flags": np.array([True, False, True]),
        "complex": np.array([1 + 2j, 3 - 4j]),
        "texts": np.array(["left", "right"]),
        "bytes": np.array([b"ab", b"c"]),
        "empty": np.zeros((0, 7)),
        "scalar": np.float32(0.25),
        "objects": np.array([{"a": np.ones(2)}, None, "x"], dtype=object),
        "side": "right",
        "name": b"ab",
        "number": 7,
        "large": 2**40,
        "rate": 29.97,
        "nothing": None,
        "nested": {"list": [1, 2.5, [True]], "tuple": (1, "a")},
    }


def assert_same(found: Any, expected: Any) -> None:
    """Check that values and their types are the same, arrays by their numbers."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for name in expected:
            assert_same(found[name], expected[name])
    elif isinstance(expected, np.ndarray) and expected.dtype == object:
        assert found.dtype == object
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other)
    elif isinstance(expected, np.ndarray):
        assert found.dtype == expected.dtype
        assert found.shape == expected.shape
        np.testing.assert_array_equal(found, expected)
        assert found.flags.writeable
    elif isinstance(expected, list | tuple):
        assert type(found) is type(expected)
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other)
    else:
        assert type(found) is type(expected)
        assert found == expected


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_table_is_what_was_written(protocol: int) -> None:
    expected = table()
    assert_same(load(pickle.dumps(expected, protocol=protocol)), expected)
    file = io.BytesIO()
    np.save(file, np.array(expected, dtype=object))
    assert_same(load(file.getvalue()), expected)


def test_what_python_2_wrote_is_read() -> None:
    """Raw bytes and names are texts there, in protocol 0 escaped."""
    numbers = np.array([0.1, -2.5e300, 255.0])
    raw = numbers.tobytes()
    escaped = "".join(f"\\x{byte:02x}" for byte in raw).encode()
    content = (
        b"(dp0\nS'x'\np1\ncnumpy.core.multiarray\n_reconstruct\np2\n(cnumpy\nndarray\np3\n"
        b"(I0\ntp4\nS'b'\np5\ntp6\nRp7\n(I1\n(I3\ntp8\ncnumpy\ndtype\np9\n(S'f8'\np10\nI0\nI1\n"
        b"tp11\nRp12\n(I3\nS'<'\np13\nNNNI-1\nI-1\nI0\ntp14\nbI00\nS'"
        + escaped
        + b"'\n"
        b"p15\ntp16\nbs."
    )
    np.testing.assert_array_equal(load(content)["x"], numbers)


@pytest.mark.parametrize("protocol", PROTOCOLS[2:])
def test_sparse_matrices_and_chumpy_are_read(
    protocol: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    dense = np.random.default_rng(0).normal(size=(5, 9)) * (
        np.eye(5, 9) + np.eye(5, 9, 3)
    )
    found = load(pickle.dumps({"a": scipy.sparse.csc_matrix(dense)}, protocol))["a"]
    np.testing.assert_array_equal(found.toarray(), dense)
    for module in ("chumpy", "chumpy.ch"):
        monkeypatch.setitem(sys.modules, module, ModuleType(module))
    wrapper = type("Ch", (), {"__module__": "chumpy.ch"})
    sys.modules["chumpy.ch"].__dict__["Ch"] = wrapper
    wrapped = wrapper()
    wrapped.__dict__["x"] = dense
    found = load(pickle.dumps({"a": wrapped}, protocol))["a"]
    np.testing.assert_array_equal(np.asarray(found), dense)


def test_a_kind_is_what_its_name_says() -> None:
    """The flags by which numpy would take numbers for pointers do nothing."""
    lying = kind("f8", 3, "<", None, None, None, 8, 1, 63)
    content = pickle.dumps({"x": array_of((2,), lying, np.ones(2).tobytes())})
    np.testing.assert_array_equal(load(content)["x"], np.ones(2))


def of_objects(dtype: Any) -> Reduced:
    return array_of((1,), dtype, b"A" * 8)


FALSE = {
    "an array of objects in bytes": of_objects(np.dtype("O")),
    "a structure that hides objects": of_objects(
        kind("V8", 3, "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 1, 0)
    ),
    "a kind that hides objects": of_objects(
        kind("V8", 3, "|", None, None, None, 8, 1, 1)
    ),
    "a part of an array": of_objects(
        kind("V8", 3, "|", (np.dtype("O"), (1,)), None, None, 8, 1, 0)
    ),
    "a structure": np.zeros(2, dtype=[("a", "f8"), ("b", "O")]),
    "times": np.zeros(2, dtype="datetime64[s]"),
    "a shape that is larger": array_of((1 << 40,), np.dtype("f8"), b"A" * 8),
    "a shape that overflows": array_of((1 << 32, 1 << 32), np.dtype("f8"), b""),
    "a shape that is smaller": array_of((1,), np.dtype("f8"), b"A" * 16),
    "a negative shape": array_of((-1, -1), np.dtype("f8"), b"A" * 8),
    "a shape of fractions": array_of((1.0,), np.dtype("f8"), b"A" * 8),
    "a shape that is a number": array_of(1, np.dtype("f8"), b"A" * 8),
    "70 dimensions": array_of((1,) * 70, np.dtype("f8"), b"A" * 8),
    "items without bytes": array_of(
        (1 << 40,), kind("S0", 3, "|", None, None, None, 0, 1, 0), b""
    ),
    "an array of numbers": array_of((1,), np.dtype("f8"), 5),
    "more objects than places": array_of((1,), np.dtype("O"), [1, 2]),
    "fewer objects than places": array_of((1 << 40,), np.dtype("O"), [1]),
    "a huge integer": 1 << 100_000,
    "a set": {1, 2},
    "a key that is a tuple": {("a", 1): 2},
    "a function": print,
    "a kind": np.dtype("f8"),
    "an array that is a kind": Reduced(np.ndarray, ((3,),)),
}


@pytest.mark.parametrize("what", FALSE)
@pytest.mark.parametrize("protocol", [2, 5])
def test_what_lies_is_refused_in_one_line(
    tmp_path: Path, what: str, protocol: int
) -> None:
    file = tmp_path / "table.pkl"
    file.write_bytes(pickle.dumps({"x": FALSE[what]}, protocol))
    with pytest.raises(RecordingError) as caught:
        read_table(file)
    text = str(caught.value)
    assert text.startswith(f"{file}: cannot be read: ")
    assert "\n" not in text
    assert len(text) < 250 + len(str(file))


def test_buffers_out_of_band_are_refused() -> None:
    buffers: list[Any] = []
    content = pickle.dumps(
        {"x": np.ones(9)}, protocol=5, buffer_callback=buffers.append
    )
    assert buffers
    with pytest.raises(pickle.UnpicklingError, match="NEXT_BUFFER"):
        load(content)


def nested(levels: int) -> bytes:
    return b"\x80\x04}\x8c\x01x" + b"(" * levels + b"l" * levels + b"s."


def doubled(levels: int) -> bytes:
    """Return a table of tuples that hold the one before twice: 2^levels values in few bytes."""
    content = b"\x80\x04}\x8c\x01xK\x01q\x00"
    for _ in range(levels):
        content += b"0h\x00h\x00\x86q\x00"
    return content + b"s."


def named_by_lists(levels: int) -> bytes:
    """Return a name that is a list of ten times the list before: a text of 10^levels characters."""
    content = b"\x80\x04]q\x00"
    for _ in range(levels):
        content += b"](" + b"h\x00" * 10 + b"eq\x00"
    return content + b"\x8c\x01x\x93."


def repeated(times: int) -> bytes:
    """Return a table of many arrays, all of the same 64 kB."""
    content = pickle.dumps({"x": np.zeros(8192)}, protocol=2)
    whole = load(content)
    assert whole["x"].nbytes == 65536
    # The raw bytes are the largest; the array is built again from the memo.
    shared = b"A" * 65536
    rows = [array_of((8192,), np.dtype("f8"), shared) for _ in range(times)]
    return pickle.dumps({"x": rows}, protocol=4)


BOMBS: dict[str, Callable[[], bytes]] = {
    "100,000 lists in each other": lambda: nested(100_000),
    "2^200 values": lambda: doubled(200),
    "a name of 10^7 values": lambda: named_by_lists(7),
    "the same bytes 2000 times": lambda: repeated(2000),
    "a place in the memo": lambda: b"\x80\x04}r\xff\xff\xff\xff.",
    "bytes that are not there": lambda: b"\x80\x04\x8e" + b"\xff" * 7 + b"\x7f.",
    "a frame that is not there": lambda: b"\x80\x04\x95" + b"\xff" * 7 + b"\x7f}.",
    "a table in itself": lambda: b"\x80\x04}q\x00\x8c\x01xh\x00s.",
    "a large sparse matrix": lambda: pickle.dumps(
        {"x": scipy.sparse.csc_matrix((1 << 30, 1))}
    ),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_needs_little_memory(name: str) -> None:
    content = BOMBS[name]()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        found = load(content)
    except (pickle.UnpicklingError, ValueError):
        found = {}
    if isinstance(matrix := found.get("x"), Sparse):
        with pytest.raises(ValueError, match="contradict"):
            matrix.toarray()
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert after - before < 64 << 10  # KiB


def sparse_with(**changes: Any) -> Sparse:
    matrix = scipy.sparse.csc_matrix(np.eye(3))
    state = {
        "_shape": (3, 3),
        "data": matrix.data,
        "indices": matrix.indices,
        "indptr": matrix.indptr,
    }
    return Sparse({**state, **changes})


@pytest.mark.parametrize(
    "changes",
    [
        {"indices": np.array([0, 1, 3])},
        {"indices": np.array([0, 1, -1])},
        {"indices": np.array([0.0, 1.0, 2.0])},
        {"indptr": np.array([0, 1, 2, 1 << 40])},
        {"indptr": np.array([0, 3, 1, 3])},
        {"indptr": np.array([0, 3])},
        {"data": np.ones(2)},
        {"data": np.array([None, 1, 2])},
        {"data": None},
    ],
)
def test_indices_of_a_sparse_matrix_are_not_trusted(changes: dict[str, Any]) -> None:
    np.testing.assert_array_equal(sparse_with().toarray(), np.eye(3))
    with pytest.raises(ValueError, match="contradict"):
        sparse_with(**changes).toarray()


def mutated(rng: random.Random, content: bytes) -> bytes:
    """Return a pickle with some bytes changed, left out, or taken from elsewhere in it."""
    changed = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 4, 16])):
        at = rng.randrange(len(changed))
        match rng.randrange(4):
            case 0:
                changed[at] = rng.randrange(256)
            case 1:
                changed[at] ^= 1 << rng.randrange(8)
            case 2:
                del changed[at : at + rng.randrange(1, 9)]
            case 3:
                start = rng.randrange(len(content))
                changed[at:at] = content[start : start + rng.randrange(1, 40)]
        changed = changed or bytearray(b".")
    return bytes(changed)


def use(value: Any) -> None:
    """Touch all that was read, as a format does."""
    if isinstance(value, dict):
        for each in value.values():
            use(each)
    elif isinstance(value, Sparse):
        value.toarray()
    elif value is not None:
        str(np.asarray(value, dtype=object).tolist())


def fuzz(seed: int, count: int) -> None:
    """Read pickles that were damaged; most of them are refused."""
    rng = random.Random(seed)
    matrix = scipy.sparse.csc_matrix(np.eye(4))
    wholes = [pickle.dumps({**table(), "m": matrix}, p) for p in PROTOCOLS[2:]]
    wholes += [pickle.dumps({"x": false}, 2) for false in FALSE.values()]
    refused = 0
    for _ in range(count):
        try:
            use(load(mutated(rng, rng.choice(wholes))))
        except Exception:
            refused += 1
    assert 0 < refused < count
    # Not `ru_maxrss`, which begins with that of the process that has started this one.
    status = Path("/proc/self/status").read_text(encoding="ascii")
    peak = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    assert int(peak.split()[1]) < 1 << 20  # KiB


def test_no_damage_ends_the_process() -> None:
    run = subprocess.run(
        [sys.executable, __file__, "1", "4000"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-2000:]


if __name__ == "__main__":
    fuzz(int(sys.argv[1]), int(sys.argv[2]))
