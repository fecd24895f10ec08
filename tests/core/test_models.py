"""Models: the same fields in Python and in the core, and bytes that no file can break."""

from __future__ import annotations

import typing
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from handmap_core.core import core
from handmap_core.ik.limits import box_limits
from handmap_core.ik.options import ik_model
from handmap_qp import models
from handmap_qp.hands import core_tree, load_hand
from handmap_qp.hands.compiled import hand_model
from handmap_qp.hands.shape_pairs import all_pairs
from handmap_qp.ik import IkOptions, PointIk
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.mapping.hand_pair import robot_fingers
from handmap_qp.models import Model, encode

_HAND = load_hand("allegro_right")
_SIMPLE = {float: "float", int: "int", bool: "bool", str: "str"}
_MODELS = {
    name: kind
    for name, kind in vars(models).items()
    if isinstance(kind, type) and issubclass(kind, Model) and kind is not Model
}


def _form(kind: Any) -> str:
    """Return the form of a field, as the core names it."""
    if kind in _SIMPLE:
        return _SIMPLE[kind]
    if forms := getattr(kind, "__metadata__", None):
        return forms[0]
    arguments = typing.get_args(kind)
    if type(None) in arguments:
        (other,) = set(arguments) - {type(None)}
        return f"{_form(other)} or None"
    if typing.get_origin(kind) is tuple:
        return f"tuple of {_form(arguments[0])}"
    if typing.get_origin(kind) is typing.Literal:
        return "str"
    return kind.__name__


def _fields(kind: type[Model]) -> list[tuple[str, str]]:
    hints = typing.get_type_hints(kind, include_extras=True)
    return [(name, _form(hints[name])) for name in kind.__struct_fields__]


def test_both_sides_have_the_same_models() -> None:
    assert {name: _fields(kind) for name, kind in _MODELS.items()} == (
        core.model_fields()
    )


def _build(content: bytes) -> Any:
    """Return a gate of bytes of limits."""
    return core.Gate(core_tree(_HAND), content, None)


def _limits(**changes: Any) -> bytes:
    return encode(msgspec.structs.replace(box_limits(_HAND), **changes))


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (
            _limits(speeds=np.zeros((2, 3))),
            r"BoxLimits\.speeds: expected an array of floats \(n\), "
            r"got one of floats \(2, 3\)",
        ),
        (
            _limits(together=np.zeros(16)),
            r"BoxLimits\.together: expected an array of flags \(n\), "
            r"got one of floats \(16\)",
        ),
        (_limits(acceleration=None), r"BoxLimits\.acceleration: .* number, got None"),
        (_limits(acceleration="1"), r"BoxLimits\.acceleration: .* number, got a text"),
        (_limits(lower=np.zeros(3)), r"BoxLimits"),
        (
            _limits(coordinates=np.full(22, 99)),
            r"BoxLimits\.coordinates: expected indices below 23, got 99",
        ),
        (_limits(coordinates=np.full(22, 2**40)), r"coordinates: .* 32 bits"),
        (b"", r"BoxLimits: expected a model BoxLimits, got the end of the bytes"),
        (b"\x80", r"BoxLimits: expected the field lowest, got no more fields"),
        (
            encode({"speeds": np.zeros(3)}),
            r"expected the field lowest, got the field speeds",
        ),
        (_limits() + b"\x00", "expected the end of the bytes, got more bytes"),
        (
            encode(msgspec.structs.asdict(box_limits(_HAND)) | {"more": 1}),
            "expected no more fields, got the field more",
        ),
    ],
)
def test_says_what_is_wrong_and_where(content: bytes, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        _build(content)


def _models() -> dict[str, tuple[Callable[[bytes], object], bytes]]:
    """Return a constructor of each model that is made of bytes alone, and its bytes."""
    collisions = CollisionLimit(_HAND, all_pairs(_HAND))
    task = robot_fingers(_HAND).distances
    return {
        "BoxLimits": (_build, _limits()),
        "HandModel": (core.Tree, encode(hand_model(_HAND))),
        "PairsModel": (core.PairBounds, encode(collisions.bounds.model())),
        "DistancesModel": (core.PointDistances, encode(task.model())),
        "IkModel": (
            lambda content: core.Ik(core_tree(_HAND), content, _limits()),
            encode(ik_model(_HAND, IkOptions())),
        ),
    }


@pytest.mark.parametrize("name", _models())
def test_no_part_of_a_model_is_one(name: str) -> None:
    make, whole = _models()[name]
    make(whole)
    for length in range(0, len(whole), 1 + len(whole) // 700):
        with pytest.raises(ValueError, match=f"{name}.*got"):
            make(whole[:length])


@pytest.mark.parametrize("name", _models())
def test_no_damage_of_bytes_leads_out_of_them(name: str) -> None:
    # Other numbers may be right. Others are refused, and none needs more memory than the bytes.
    numbers = np.random.default_rng(0)
    make, content = _models()[name]
    whole = np.frombuffer(content, np.uint8)
    refused = 0
    for _ in range(600):
        damaged = whole.copy()
        places = numbers.integers(len(whole), size=numbers.integers(1, 30))
        damaged[places] = numbers.choice([0, 1, 0x7F, 0x80, 0xC0, 0xC9, 0xDD, 0xFF])
        try:
            make(damaged.tobytes())
        except ValueError:
            refused += 1
    assert refused > 60


def test_sizes_beyond_the_bytes_are_refused() -> None:
    def limits(shape: tuple[int, ...], numbers: bytes = b"") -> bytes:
        array = msgspec.msgpack.encode(("<f8", shape, numbers))
        return encode({"lowest": msgspec.msgpack.Ext(1, array)})

    sizes = [
        (2**62,),
        (2**62, 4),
        (0, 2**40),
        (2**32, 2**32),
        (-1,),
        (-1, -1),
        (3,),
        (2**64 - 1,),
    ]
    for shape in sizes:
        with pytest.raises(ValueError, match=r"BoxLimits\.lowest"):
            _build(limits(shape))


@pytest.mark.parametrize("size", [*range(20), 300, 70000])
def test_arrays_of_all_sizes_are_read_back(size: int) -> None:
    flags = np.arange(size) % 2 == 0
    content = encode({"flags": flags})
    decoder = msgspec.msgpack.Decoder(ext_hook=models.unpacked)
    assert decoder.decode(content)["flags"].tolist() == flags.tolist()
    # MessagePack has other heads for extensions of 16 bytes, and of more than 255.
    with pytest.raises(ValueError, match=rf"got one of flags \({size}\)"):
        _build(_limits(lowest=flags))


def test_what_is_in_no_model_is_refused() -> None:
    with pytest.raises(TypeError, match="no form for complex"):
        encode({"x": 1j})
    with pytest.raises(TypeError, match="no form for numbers of the type <f4"):
        encode({"x": np.zeros(3, np.float32)})


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"kind": "joint", "joint": -1}, "the joint that it is of"),
        ({"kind": "nonsense"}, "joint, fixed_joint, link or other"),
        ({"parent": 1_000_000}, "expected indices below"),
    ],
)
def test_frames_that_cannot_be_are_refused(
    changed: dict[str, Any], problem: str
) -> None:
    model = hand_model(_HAND)
    *others, last = model.frames
    frames = (*others, msgspec.structs.replace(last, **changed))
    with pytest.raises(ValueError, match=problem):
        core.Tree(encode(msgspec.structs.replace(model, frames=frames)))


def test_points_and_detours_of_another_hand_are_refused() -> None:
    tree = core_tree(_HAND)
    with pytest.raises(ValueError, match="points of another hand"):
        tree.points_on_joints(_HAND.rest, [99_999], np.zeros((1, 3)))
    ik = PointIk(_HAND, IkOptions())
    with pytest.raises(ValueError, match="a detour for each hand"):
        ik.core.go_on([])
