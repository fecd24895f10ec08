"""Compare `handmap_core/_core.pyi`, which is written by hand, with the compiled core.

    python .ci/core_stub.py

Prints what one of them has and the other one has not: functions, classes with their bases, methods
with the names of their arguments, properties and constants. nanobind's own stub says what the core
has. Types are in the stub alone: `ty` checks the callers by them.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

STUB = Path(__file__).parents[1] / "core" / "handmap_core" / "_core.pyi"
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
            bases = [base for base in map(_base_name, node.bases) if base != "Generic"]
            found[path + node.name] = [("class", *bases)]
            found |= names_in(node.body, f"{path}{node.name}.")
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[path + node.target.id] = [("constant",)]
    return found


def _base_name(base: ast.expr) -> str:
    """Return the name of a base, whatever its parameters."""
    return ast.unparse(base).partition("[")[0]


def compiled_names() -> dict[str, list[Signature]]:
    """Return the names of the compiled module."""
    from nanobind.stubgen import StubGen

    from handmap_core.core import load_core

    module = load_core()
    generator = StubGen(module)
    generator.put(module)
    return names_in(ast.parse(generator.get()).body)


def written_names(text: str | None = None) -> dict[str, list[Signature]]:
    """Return the names of the stub, or of another text."""
    text = STUB.read_text(encoding="utf-8") if text is None else text
    return names_in(ast.parse(text).body)


if __name__ == "__main__":
    compiled, written = compiled_names(), written_names()
    differences = [
        f"{name}: the core has {compiled.get(name)}, the stub {written.get(name)}"
        for name in sorted(compiled.keys() | written.keys())
        if compiled.get(name) != written.get(name)
    ]
    print("\n".join(differences) or "The stub of the core is complete")
    sys.exit(bool(differences))
