"""Run a script of this tree by its name: `python benchmarks NAME`, `python tests/judges NAME`.

Scripts import modules of other folders by their plain names, as tests do. A folder whose scripts
are run so has a `__main__.py`, which puts these folders on the path.
"""

from __future__ import annotations

import ast
import runpy
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path


def find_scripts(folders: Iterable[Path]) -> dict[str, Path]:
    """Return the files that are run as programs, by name, in the order of folders and names."""
    files = [file for folder in folders for file in sorted(folder.glob("*.py"))]
    return {
        file.stem: file
        for file in files
        if file.stem != "__main__"
        and '__name__ == "__main__"' in file.read_text("utf-8")
    }


def first_line_of(file: Path) -> str:
    """Return the first line of a module's docstring."""
    return (ast.get_docstring(ast.parse(file.read_text("utf-8"))) or "").partition(
        "\n"
    )[0]


def run_named(program: str, folders: Sequence[Path], words: Sequence[str]) -> None:
    """Run the script that the first word names, with the others as its command line.

    Without a word, or if no script has the name, print the names with what each does.

    Args:
        program: What is typed before the name.
        folders: Folders of the scripts.
        words: The command line.

    Raises:
        SystemExit: That of the script, or code 2 if no script has the name.
    """
    scripts = find_scripts(folders)
    name = Path(words[0]).stem if words else ""
    if name in scripts:
        sys.argv = [str(scripts[name]), *words[1:]]
        runpy.run_path(str(scripts[name]), run_name="__main__")
        return
    print(f"{program} NAME [options], with NAME one of", file=sys.stderr)
    for folder in folders:
        own = {name: file for name, file in scripts.items() if file.parent == folder}
        if own:
            print(f"\n{folder.name}", file=sys.stderr)
        for each, file in own.items():
            print(f"  {each:20} {first_line_of(file)}", file=sys.stderr)
    raise SystemExit(2)
