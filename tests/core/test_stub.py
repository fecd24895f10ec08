"""`_core.pyi` says what the compiled module has: the same names, with the same arguments."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from nanobind.stubgen import StubGen

from handmap_qp import _core

STUB = Path(_core.__file__).with_name("_core.pyi")
# Copies go by them, not callers.
_COPYING = {"__reduce__", "__getstate__", "__setstate__"}

Signature = tuple[str, ...]


def signature_of(function: ast.FunctionDef) -> Signature:
    """Return the names of arguments, and how many of the last ones may be left out."""
    arguments = function.args
    named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    names = [each.arg for each in named if each.arg != "self"]
    is_property = any(
        isinstance(each, ast.Name) and each.id == "property"
        for each in function.decorator_list
    )
    kind = "property" if is_property else f"{len(arguments.defaults)} defaults"
    return kind, *names


def names_in(body: list[ast.stmt], path: str = "") -> dict[str, list[Signature]]:
    """Return the names of a stub: those of functions with the arguments of each overload."""
    found: dict[str, list[Signature]] = {}
    for node in body:
        if isinstance(node, ast.FunctionDef) and node.name not in _COPYING:
            found.setdefault(path + node.name, []).append(signature_of(node))
        elif isinstance(node, ast.ClassDef):
            bases = [base for base in map(base_name, node.bases) if base != "Generic"]
            found[path + node.name] = [("class", *bases)]
            found |= names_in(node.body, f"{path}{node.name}.")
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[path + node.target.id] = [("constant",)]
    return found


def base_name(base: ast.expr) -> str:
    """Return the name of a base, whatever its parameters."""
    return ast.unparse(base).partition("[")[0]


def test_the_stub_has_what_the_module_has() -> None:
    generator = StubGen(_core)
    generator.put(_core)
    compiled = names_in(ast.parse(generator.get()).body)
    written = names_in(ast.parse(STUB.read_text(encoding="utf-8")).body)
    assert written == compiled


def test_every_argument_has_a_type() -> None:
    for node in ast.walk(ast.parse(STUB.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef):
            arguments = [each for each in node.args.args if each.arg != "self"]
            assert all(each.annotation for each in arguments), node.name
            assert node.returns is not None, node.name


def test_a_stub_that_differs_is_noticed() -> None:
    text = STUB.read_text(encoding="utf-8")
    right = names_in(ast.parse(text).body)
    for before, after in (
        ("def forget(self)", "def forget_it(self)"),
        ("time: float, landmarks: Array)", "stamp: float, landmarks: Array)"),
        ("class Stages(Step)", "class Stages"),
        ("share: float = 1.0, stops", "share: float, stops"),
    ):
        assert before in text
        other = names_in(ast.parse(text.replace(before, after, 1)).body)
        with pytest.raises(AssertionError):
            assert other == right
