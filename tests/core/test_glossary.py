"""The glossary is in order, short, and of words that other pages use."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GLOSSARY = ROOT / "docs" / "glossary.md"
ROWS = re.findall(r"^\| (.+?) \| (.+) \|$", GLOSSARY.read_text("utf-8"), re.MULTILINE)[
    1:
]
"""Terms with their meaning, without the head of the table."""
LONGEST = 36
"""Words of a meaning: two lines."""


def test_terms_are_in_alphabetical_order() -> None:
    terms = [re.split(r"[ ,]", term)[0].lower() for term, _ in ROWS]
    assert terms == sorted(terms)
    assert len(ROWS) > 40


def test_terms_are_of_other_pages() -> None:
    others = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    text = "\n".join(
        page.read_text("utf-8") for page in others if page != GLOSSARY
    ).lower()
    for term, _ in ROWS:
        for word in term.split(", "):
            assert re.search(rf"\b{re.escape(word.lower())}", text), word


def test_meanings_are_short() -> None:
    for term, meaning in ROWS:
        plain = re.sub(r"\]\([^)]*\)", "]", meaning)
        assert len(plain.split()) <= LONGEST, term
