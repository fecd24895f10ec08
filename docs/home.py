"""Hook of mkdocs that makes the site's first page of the README, so that both say the same.

Links of the README start at the checkout. Those into `docs` become links between pages; those to
other files become their text, because the site has no such file.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

README = Path(__file__).parents[1] / "README.md"
_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?://|#)([^)]+)\)")


def on_page_read_source(*, page: Any, **_: Any) -> str | None:
    """Return the text of the first page; other pages are read from their files."""
    if page.file.src_uri != "index.md":
        return None
    return first_page(README.read_text(encoding="utf-8"))


def first_page(readme: str) -> str:
    """Return the README with links that lead to pages of the site."""

    def on_site(link: re.Match[str]) -> str:
        mark, text, target = link.groups()
        page = target.removeprefix("docs/")
        return text if page == target else f"{mark}[{text}]({page})"

    return _LINK.sub(on_site, readme)
