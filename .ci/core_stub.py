"""Compare `handmap_qp/_core.pyi`, which is written by hand, with the compiled core.

    python .ci/core_stub.py

Prints what one of them has and the other one has not: functions, classes with their bases, methods
with the names of their arguments, properties and constants. nanobind's own stub says what the core
has. Types are for the stub alone: `ty` checks the callers by them.
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

STUB = Path(__file__).parents[1] / "handmap_qp" / "_core.pyi"

Names = dict[str, list[str]]
"""What there is, by its dotted name; of a function, the names of its arguments, by overload."""


def names_in(text: str) -> Names:
    """Return what a stub names."""
    found: Names = defaultdict(list)
    for name, what in _names(ast.parse(text).body, ""):
        found[name].append(what)
    # An overload more or less is a difference, their order is none.
    return {name: sorted(each) for name, each in found.items()}


def _names(body: list[ast.stmt], owner: str) -> Iterator[tuple[str, str]]:
    for node in body:
        match node:
            case ast.ClassDef():
                bases = ", ".join(ast.unparse(base) for base in node.bases)
                yield owner + node.name, f"class({bases})"
                yield from _names(node.body, f"{owner}{node.name}.")
            case ast.FunctionDef():
                marks = [ast.unparse(mark) for mark in node.decorator_list]
                if "property" in marks:
                    yield owner + node.name, "value"
                else:
                    yield owner + node.name, _arguments(node.args)
            case ast.AnnAssign(target=ast.Name(id=name)) if _is_public(name):
                yield owner + name, "value"


def _arguments(given: ast.arguments) -> str:
    every = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    optional = len(given.defaults) + sum(each is not None for each in given.kw_defaults)
    return f"({', '.join(each.arg for each in every)}), {optional} optional"


def _is_public(name: str) -> bool:
    return not name.startswith("_")


def differences() -> list[str]:
    """Return the differences of the stub from the compiled core, a line each."""
    from nanobind.stubgen import StubGen

    from handmap_qp.ik.core import core

    generator = StubGen(core, include_docstrings=False)
    generator.put(core)
    compiled = names_in(generator.get())
    written = names_in(STUB.read_text(encoding="utf-8"))
    return [
        f"{name}: the core has {compiled.get(name)}, the stub {written.get(name)}"
        for name in sorted(compiled.keys() | written.keys())
        if compiled.get(name) != written.get(name)
    ]


if __name__ == "__main__":
    found = differences()
    print("\n".join(found) or "The stub of the core is complete")
    sys.exit(bool(found))
