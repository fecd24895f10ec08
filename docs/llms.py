"""Hook of mkdocs that writes `llms.txt`: the contents of the site for language models.

The form is that of llmstxt.org: a link and a sentence for each page. Links lead to the pages'
Markdown, which is copied into the site, where a page is text; pages of the API are made from
docstrings, so links lead to their HTML.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

_pages: list[Any] = []
"""Pages in the order of the navigation; those of single hands and trackers are linked from it."""


def on_nav(nav: Any, **_: Any) -> None:
    """Take the pages of the navigation."""
    _pages[:] = nav.pages


def on_post_build(*, config: Any) -> None:
    """Write the list of pages, and their Markdown."""
    site = Path(config.site_dir)
    sections: dict[str, list[str]] = {}
    for page in _pages:
        file, text = page.file.dest_uri, page.markdown
        if not page.file.src_uri.startswith("api/"):
            file = page.file.src_uri
            (site / file).write_text(text, encoding="utf-8")
        top = page.ancestors[-1].title if page.ancestors else config.site_name
        row = f"- [{page.title}]({file}): {_summary(text)}"
        sections.setdefault(top, []).append(row)
    parts = [f"# {config.site_name}\n\n> {config.site_description}"]
    parts += [f"## {title}\n\n" + "\n".join(rows) for title, rows in sections.items()]
    (site / "llms.txt").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _summary(text: str) -> str:
    """Return the first sentence of a page, without links."""
    paragraph = next(
        p for p in text.split("\n\n") if re.match(r"\S", p) and p[0] != "#"
    )
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(paragraph.split()))
    return re.split(r"(?<=[.])\s|:$", plain.replace("**", ""))[0].rstrip(".") + "."
