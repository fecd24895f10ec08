"""Python-Markdown extension: LaTeX between `$...$` or `$$...$$` becomes MathML in the site.

Browsers draw MathML by themselves, so pages need no script, no fonts and no requests. mkdocs and
Zensical both take it by its name, with this folder on PYTHONPATH.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from typing import Any

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.blockprocessors import BlockProcessor
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor

# Below code (190), so that code keeps its dollars, and above escapes (180), which eat backslashes.
_PRIORITY = 185


class _Inline(InlineProcessor):
    """Formulas inside a line."""

    def handleMatch(self, m: re.Match[str], data: str) -> tuple[Any, int, int]:  # noqa: N802
        """Return the formula in place of its source."""
        return self.md.htmlStash.store(convert(m[1])), m.start(0), m.end(0)


class _Display(BlockProcessor):
    """Formulas in a paragraph of their own."""

    def test(self, parent: ET.Element, block: str) -> bool:
        """Return whether a block is a formula."""
        return block.startswith("$$") and block.rstrip().endswith("$$")

    def run(self, parent: ET.Element, blocks: list[str]) -> None:
        """Append the formula."""
        formula = ET.SubElement(parent, "div", {"class": "formula"})
        source = blocks.pop(0).strip().strip("$")
        formula.text = self.parser.md.htmlStash.store(convert(source, display="block"))


class MathExtension(Extension):
    """LaTeX formulas as MathML."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802
        """Register both processors."""
        md.inlinePatterns.register(
            _Inline(r"(?<![\\$])\$([^$\n]+?)\$(?!\d)", md), "math", _PRIORITY
        )
        md.parser.blockprocessors.register(_Display(md.parser), "math", _PRIORITY)


def makeExtension(**settings: Any) -> MathExtension:  # noqa: N802
    """Return the extension, as Python-Markdown expects it of a module."""
    return MathExtension(**settings)
