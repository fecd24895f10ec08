"""`docs/reading.md` leads through the code as it is."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reading.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| `([\w/]+\.(?:py|hpp))` \| (.*) \|$", PAGE, flags=re.MULTILINE)


def names_in_cpp(text: str) -> set[str]:
    """Return the names of a header's functions and types, and of methods with their type."""
    kinds = set(re.findall(r"^(?:struct|class) (\w+)", text, flags=re.MULTILINE))
    functions = set(re.findall(r"\b(\w+)\(", text))
    return (
        kinds | functions | {f"{kind}.{name}" for kind in kinds for name in functions}
    )


def names_of(file: Path) -> set[str]:
    """Return the names of a module's functions and classes, and of methods with their class."""
    if file.suffix == ".hpp":
        return names_in_cpp(file.read_text(encoding="utf-8"))
    names = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            functions = [
                part for part in node.body if isinstance(part, ast.FunctionDef)
            ]
            names |= {f"{node.name}.{function.name}" for function in functions}
    return names


@pytest.mark.parametrize(("name", "text"), ROWS, ids=[row[0] for row in ROWS])
def test_every_file_has_what_the_page_says(name: str, text: str) -> None:
    file = ROOT / "handmap_qp" / name
    named = re.findall(r"`([A-Za-z_.]+)`", text)
    assert named
    assert set(named) <= names_of(file)


def test_names_in_the_text_are_those_of_the_files() -> None:
    known = set().union(*(names_of(ROOT / "handmap_qp" / name) for name, _ in ROWS))
    known |= {name.split(".")[-1] for name in known}
    prose = "\n".join(line for line in PAGE.splitlines() if not line.startswith("|"))
    named = set(re.findall(r"`([A-Z]\w+(?:\.\w+)?)`", prose)) - {"HandSpec"}
    assert named <= known
    assert len(ROWS) > 20
