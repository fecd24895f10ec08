"""Pages for users have none of the private words that were replaced by the terms of the field."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
BACKGROUND = {
    "benchmarks",
    "dependencies",
    "measurements",
    "reading",
    "release",
    "simulation_results",
    "theory",
}
"""Pages for those who change the package, or check its figures."""
PAGES = [
    ROOT / "README.md",
    *(page for page in sorted(DOCS.glob("*.md")) if page.stem not in BACKGROUND),
    *sorted((DOCS / "trackers").glob("*.md")),
]
PRIVATE = {
    r"asked|told|tells?": "commanded, reported, given",
    r"led|leader of": "moved by, followed",
    r"anew": "again",
    r"shall": "must, may",
    r"whoever|who knocks": "a subject",
    r"wishes|news|trouble": "requests, status, error",
    r"(?:made|makes?) up for": "compensated",
    r"lies? on each other": "touch, overlap",
    r"stand-ins?": "a simulated or recorded one",
    r"foreseen?|foresees|in_core|gap_task|misfit": "the field's term",
    r"it loses when": "not suitable if",
    r"(?<!data )sheet|house": "panel; gone",
    r"on straight lines": "interpolated linearly",
}
"""Private words, as regular expressions of whole words, and what to write instead."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_has_no_private_words(page: Path) -> None:
    prose = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.DOTALL | re.M)
    prose = re.sub(r"`[^`\n]*`", "", prose)
    found = [
        f"{match[0]!r}: {instead}"
        for private, instead in PRIVATE.items()
        for match in re.finditer(rf"\b(?:{private})\b", prose, re.IGNORECASE)
    ]
    assert not found
