"""`docs/reading.md` leads through the code as it is, in at most 3,000 lines."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reading.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| `([\w/]+\.(?:py|hpp))` \| (.*) \|$", PAGE, flags=re.MULTILINE)
LONGEST = 3000
"""Lines that a reader may be sent through."""
# What a parenthesis after a word is, besides a definition.
_STATEMENTS = {"if", "for", "while", "switch", "return", "catch", "sizeof"}


def closing(text: str, start: int, pair: str) -> int:
    """Return where the bracket that opens at `start` is closed."""
    depth = 0
    for i in range(start, len(text)):
        depth += (text[i] == pair[0]) - (text[i] == pair[1])
        if not depth:
            return i
    return len(text)


def without_comments(text: str) -> str:
    return re.sub(r"//[^\n]*", lambda found: " " * len(found[0]), text)


def cpp_classes(text: str) -> list[tuple[str, int, int]]:
    """Return the name, begin and end of each class of a header."""
    found = re.finditer(r"^(?:struct|class) (\w+)[^;{]*\{", text, flags=re.MULTILINE)
    return [(one[1], one.start(), closing(text, one.end() - 1, "{}")) for one in found]


def cpp_functions(text: str) -> Iterator[tuple[str, int, int]]:
    """Yield the name, begin and end of each function of a header that has a body there."""
    for one in re.finditer(r"^[ \w:<>,&*\[\]~]*?\b(\w+)\(", text, flags=re.MULTILINE):
        if one[1] in _STATEMENTS or one[0].split()[0] in _STATEMENTS:
            continue
        end = closing(text, one.end() - 1, "()") + 1
        # Qualifiers, or the members that a constructor initialises.
        if body := re.compile(
            r"(?:\s*(?:const|override|noexcept|:[^;{]*))*\s*\{"
        ).match(text, end):
            yield one[1], one.start(), closing(text, body.end() - 1, "{}")


def names_in_cpp(text: str) -> dict[str, int]:
    """Return the lines of functions and classes of a header, of methods with their class."""
    text = without_comments(text)
    classes = cpp_classes(text)
    lines = {name: text.count("\n", a, b) + 1 for name, a, b in classes}
    for name, begin, end in cpp_functions(text):
        owners = [kind for kind, a, b in classes if a <= begin < b]
        full = ".".join((*owners, name))
        # Of overloads all are read.
        lines[full] = lines.get(full, 0) + text.count("\n", begin, end) + 1
    return lines


def names_in_python(text: str) -> dict[str, int]:
    """Return the lines of functions and classes of a module, of methods with their class."""
    lines = {}
    for node in ast.parse(text).body:
        if not isinstance(node, ast.FunctionDef | ast.ClassDef):
            continue
        lines[node.name] = (node.end_lineno or 0) - node.lineno + 1
        for part in node.body:
            if isinstance(part, ast.FunctionDef):
                length = (part.end_lineno or 0) - part.lineno + 1
                lines[f"{node.name}.{part.name}"] = length
    return lines


def lines_of(name: str) -> dict[str, int]:
    """Return the lines of each function and class of a file of the page."""
    file = ROOT / ("" if name.startswith("core/") else "handmap_qp") / name
    text = file.read_text(encoding="utf-8")
    return names_in_cpp(text) if file.suffix == ".hpp" else names_in_python(text)


def named_in(text: str) -> list[str]:
    return re.findall(r"`([A-Za-z_.]+)`", text)


@pytest.mark.parametrize(
    ("name", "text"), ROWS, ids=[f"{i}-{row[0]}" for i, row in enumerate(ROWS)]
)
def test_every_file_has_what_the_page_says(name: str, text: str) -> None:
    named = named_in(text)
    assert named
    assert set(named) <= lines_of(name).keys()


def test_names_in_the_text_are_those_of_the_files() -> None:
    known = set().union(*(lines_of(name) for name, _ in ROWS))
    known |= {name.split(".")[-1] for name in known}
    prose = "\n".join(line for line in PAGE.splitlines() if not line.startswith("|"))
    assert {*re.findall(r"`([A-Z]\w+(?:\.\w+)?)`", prose)} <= known
    assert len(ROWS) > 20


def test_it_is_short_enough_to_be_read_at_once() -> None:
    read = {(name, one) for name, text in ROWS for one in named_in(text)}
    total = sum(lines_of(name)[one] for name, one in read)
    assert 1000 < total <= LONGEST, total


def test_it_leads_through_what_runs_in_a_sample() -> None:
    # All but the seams, what a sample is, words, and the service.
    read = {(name, one) for name, text in ROWS for one in named_in(text)}
    lines = {pair: lines_of(pair[0])[pair[1]] for pair in read}
    in_core = sum(n for (name, _), n in lines.items() if name.endswith(".hpp"))
    assert in_core > 0.5 * sum(lines.values())
