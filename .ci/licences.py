"""Print the licences of all packages of the environment whose Python runs this, with their texts.

    build/alone/bin/python .ci/licences.py > dist/licences.txt

It needs nothing but Python, so that the environment has only what is asked about.
"""

from __future__ import annotations

import re
from importlib.metadata import Distribution, distributions
from pathlib import Path

# Names that packages give to the texts of their licences and of what they copied from others.
_TEXT = re.compile(r"(?:licen[cs]e|copying|notice|authors)[^/]*$", re.IGNORECASE)


def licence(package: Distribution) -> str:
    """Return what a package's metadata says: its expression, its classifiers, or its first line."""
    data = package.metadata
    if expression := data.get("License-Expression"):
        return expression
    classes = [
        line.rpartition(" :: ")[2]
        for line in data.get_all("Classifier") or []
        if line.startswith("License ::")
    ]
    text = (data.get("License") or "not stated").strip().splitlines()[0]
    return ", ".join(classes) or text[:60]


def texts(package: Distribution) -> list[str]:
    """Return the texts that a package brings with its metadata."""
    files = package.files or []
    found = [file for file in files if _TEXT.search(str(file))]
    paths = [Path(str(file.locate())) for file in found if ".dist-info/" in str(file)]
    return [
        path.read_text(encoding="utf-8", errors="replace").strip() for path in paths
    ]


def main() -> None:
    """Print a list of all packages, then the texts of each."""
    packages = {package.metadata["Name"]: package for package in distributions()}
    ordered = sorted(packages.items(), key=lambda item: item[0].lower())
    rows = [
        f"{name} {package.version}: {licence(package)}" for name, package in ordered
    ]
    print("\n".join(rows))
    for row, (_, package) in zip(rows, ordered, strict=True):
        for text in texts(package):
            print(f"\n{'=' * 80}\n{row}\n\n{text}")


if __name__ == "__main__":
    main()
