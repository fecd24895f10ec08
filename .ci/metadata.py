"""hatchling's hook for metadata that depends on where the package is built.

In GitHub Actions the address of the repository is known (`.ci/addresses.py`). There, the long
description shows the pictures of the tag that is built, and the project has its addresses. A build
elsewhere knows no address, and a package index shows no relative ones: pictures are left out, and
links to files become their text.
"""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?://|#)([^)]+)\)")


class Metadata(MetadataHookInterface):
    """Set the fields `readme` and `urls`."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set both from README.md and the environment."""
        pages = runpy.run_path(str(Path(self.root) / ".ci" / "addresses.py"))
        address = pages["repository"]()
        readme = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = long_description(readme, address, f"v{metadata['version']}")
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
        if address:
            metadata["urls"] = pages["addresses"](address)


def long_description(readme: str, address: str, tag: str) -> str:
    """Return the README with absolute links.

    Args:
        readme: Its Markdown.
        address: Address of the repository; without one, pictures and links to files are left out.
        tag: The tag whose files links lead to.
    """

    def absolute(link: re.Match[str]) -> str:
        mark, text, target = link.groups()
        if not address:
            return "" if mark else text
        return f"{mark}[{text}]({address}/{'raw' if mark else 'blob'}/{tag}/{target})"

    return re.sub(r"\n{3,}", "\n\n", _LINK.sub(absolute, readme))
