"""The Python of `handmap_run`: files of this tree that need no more than `handmap_core`, renamed.

    python taken.py FOLDER        # writes FOLDER/handmap_run

A robot's computer runs what `handmap_qp` runs, so there is no second text of it: files are taken as
they are, but for the name of the package and for what numpy 1.26, or an environment without
Pinocchio, does not have. Files in `run` take the place of those that need more.
"""

from __future__ import annotations

import ast
import shutil
import sys
from collections.abc import Iterator
from importlib.util import resolve_name
from pathlib import Path
from symtable import symtable
from typing import NoReturn

NAME = "handmap_run"
ROOT = Path(__file__).parents[2] / "handmap_qp"
OWN = Path(__file__).with_name("run")

TAKEN = """
errors se3 options models client/__init__ client/messages
hands/configuration
ik/qp ik/collision
mapping/alignment mapping/estimation
mapping/hand_mapper
mapping/method mapping/named_method mapping/palm
mapping/robot_mapper
mapping/target_source
mapping/methods/__init__ mapping/methods/homogeneous mapping/methods/teleoperation
stream/follower stream/grip
stream/guard stream/hand_grip
stream/robot_follower
trackers/plausibility
"""
# What is written otherwise: the name, then what is missing here.
CHANGES = (
    ("handmap_qp", NAME),
    ("import pinocchio as pin", f"from {NAME} import rotations as pin"),
    # numpy 2 has this.
    (".mT", ".swapaxes(-1, -2)"),
)
# These run beside `handmap_qp`, whose objects they write down.
BESIDE = ("command.py", "saving.py")
# Imported where an option is used that no saved hand has: other formulations and solvers.
UNUSED = ("reference.inverse_kinematics",)
# Names of a package that are in a file of `run`.
ELSEWHERE = {"ik": {"PointIk": f"{NAME}.ik.saved"}}
PACKAGES = ("human", "ik", "mapping", "stream", "trackers")
# All that may be imported besides.
PRESENT = {*sys.stdlib_module_names, "handmap_core", "msgspec", "numpy"}


def stop(problem: str) -> NoReturn:
    """End the build with one line."""
    raise SystemExit(f"taken.py: {problem}")


def read(file: Path) -> str:
    """Return the text of a file of the tree."""
    if not file.is_file():
        stop(f"the tree has no {file} any more; change the names in taken.py")
    return file.read_text(encoding="utf-8")


def changed(text: str) -> str:
    """Return the text of a file as it is in `handmap_run`."""
    for before, after in CHANGES:
        text = text.replace(before, after)
    return text


def homes_in(package: str) -> dict[str, str]:
    """Return the module of each name of a package, by its `__init__.py`."""
    module = ast.parse(read(ROOT / package / "__init__.py"))
    homes = {
        alias.name: resolve_name(
            "." * node.level + (node.module or alias.name), f"{NAME}.{package}"
        )
        for node in module.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    return homes | ELSEWHERE.get(package, {})


def imports_of(tree: ast.AST, package: str) -> Iterator[tuple[str, str]]:
    """Yield each import that runs, not only for checks of types: module and name, or ""."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = resolve_name("." * node.level + (node.module or ""), package)
            yield from ((module, alias.name) for alias in node.names)
        elif not isinstance(node, ast.If) or ast.unparse(node.test) != "TYPE_CHECKING":
            yield from imports_of(node, package)


def check_imports(written: dict[str, str], homes: dict[str, dict[str, str]]) -> None:
    """Stop if a file imports what a robot's computer does not have.

    Args:
        written: Text of each file.
        homes: Modules of the names of each package.
    """
    names = {}
    for file, text in written.items():
        module = f"{NAME}/{file}".removesuffix(".py").removesuffix("/__init__")
        symbols = symtable(text, file, "exec").get_symbols()
        names[module.replace("/", ".")] = {""} | {
            each.get_name()
            for each in symbols
            if each.is_assigned() or each.is_imported()
        }
    for name, own in homes.items():
        package = f"{NAME}.{name}"
        names[package] = {""} | {
            each
            for each, home in own.items()
            if home.startswith("handmap_core.") or each in names.get(home, ())
        }
    for file, text in written.items():
        package = ".".join((NAME, *Path(file).parent.parts))
        for module, name in imports_of(ast.parse(text), package):
            if module.removeprefix(f"{NAME}.") in UNUSED:
                continue
            is_there = name in names.get(module, ()) or f"{module}.{name}" in names
            if not is_there and module.partition(".")[0] not in PRESENT:
                stop(f"{file} imports {module} {name}, which {NAME} does not have")


def write_package(folder: Path) -> Path:
    """Write the package into a folder; return it."""
    package = folder / NAME
    shutil.rmtree(package, ignore_errors=True)
    files = {f"{name}.py": ROOT / f"{name}.py" for name in TAKEN.split()}
    files |= {str(file.relative_to(OWN)): file for file in OWN.rglob("*.py")}
    texts = {name: read(file) for name, file in files.items()}
    beside = {name: texts.pop(name) for name in BESIDE}
    for before, _ in CHANGES:
        if not any(before in text for text in texts.values()):
            stop(f"no file has {before!r} any more; change CHANGES")
    written = {name: changed(text) for name, text in texts.items()}
    homes = {name: homes_in(name) for name in PACKAGES}
    check_imports(written, homes)
    for name, each in homes.items():
        written[f"{name}/__init__.py"] = (
            f"from {NAME}.lazy import named\n\n__getattr__ = named(__name__, {each})\n"
        )
    written |= beside
    for name, text in written.items():
        target = package / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text, encoding="utf-8")
    return package


if __name__ == "__main__":
    write_package(Path(sys.argv[1]))
