"""CHANGELOG.md: one line is one change, short enough to be read."""

from __future__ import annotations

import re
from pathlib import Path

TEXT = (Path(__file__).parents[2] / "CHANGELOG.md").read_text(encoding="utf-8")
KINDS = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def test_every_change_is_one_short_line() -> None:
    for line in TEXT.partition("\n## ")[2].splitlines()[1:]:
        is_change = line.startswith("- ") and line.endswith((".", "!"))
        is_heading = line.startswith(("## [", "### ")) or re.fullmatch(
            r"[A-Z][a-z, ]+:", line
        )
        assert not line or is_change or is_heading, line
        assert len(line) <= 140, line
    assert {*re.findall(r"^### (.+)$", TEXT, re.MULTILINE)} <= KINDS


def test_pages_that_it_names_exist() -> None:
    root = Path(__file__).parents[2]
    for page in re.findall(r"\bdocs/[\w/]+\.md", TEXT):
        assert (root / page).is_file(), page
