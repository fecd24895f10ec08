"""Write docs/dependencies.md: the direct dependencies of the package with their licences."""

from __future__ import annotations

import re
import runpy
import tomllib
from importlib import metadata
from pathlib import Path

DOCS = Path(__file__).parent
licence = runpy.run_path(str(DOCS.parent / ".ci" / "licences.py"))["licence"]
HEAD = """# Dependencies

Written by `python docs/dependencies.py` from the metadata of the installed packages. All packages,
also indirect ones, are in `.ci/constraints.txt`. `make wheel` and each release write beside the
wheel what it needs: `sbom.json`, a software bill of materials (CycloneDX), and `licences.txt`, with
the texts. The package itself is under Apache-2.0. Two dependencies are under
stricter licences: qpsolvers (LGPL), and quadprog (GPL) in the extra `solvers` only.

qpsolvers is imported, not copied, and only by `formulation="mink"`, by a solver other than DAQP and
by `handmap doctor`. It is not an extra, because mink needs it, and mink also brings the MuJoCo that
reads MJCF files. If you cannot use packages under the LGPL, install `handmap-core` alone ([a
robot's computer](run.md)): it needs neither.

| package | needed by | bounds | licence |
|---|---|---|---|
"""


def main() -> None:
    """Write the page."""
    project = tomllib.loads((DOCS.parent / "pyproject.toml").read_text("utf-8"))[
        "project"
    ]
    groups = {
        "the package": project["dependencies"],
        **project["optional-dependencies"],
    }
    rows = []
    for group, requirements in groups.items():
        for requirement in requirements:
            found = re.match(r"([\w-]+)(?:\[[\w,]+\])?(.*)", requirement)
            assert found is not None
            name, bounds = found.groups()
            if name == project["name"]:
                continue
            try:
                stated = licence(metadata.distribution(name))
                rows.append(f"| {name} | {group} | `{bounds}` | {stated} |")
            except metadata.PackageNotFoundError:
                rows.append(f"| {name} | {group} | `{bounds}` | not installed here |")
    (DOCS / "dependencies.md").write_text(
        HEAD + "\n".join(rows) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
