"""`handmap_core` needs numpy and msgspec alone, and `handmap_qp` has its public names."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

import handmap_core

FOLDER = Path(handmap_core.__file__).parent
NEEDED = {"handmap_core", "msgspec", "numpy"}
SHARED = ("errors", "options", "se3", "models", "client", "client.messages")
"""Modules of which `handmap_qp` has the names, too."""


def modules() -> Iterator[tuple[str, Path]]:
    """Yield the name and the file of each module."""
    for file in sorted(FOLDER.rglob("*.py")):
        parts = file.relative_to(FOLDER).with_suffix("").parts
        yield ".".join(part for part in parts if part != "__init__"), file


def imported(file: Path) -> set[str]:
    """Return the packages that a module imports, wherever it does."""
    packages = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            packages |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            packages.add((node.module or "").partition(".")[0])
    return packages - sys.stdlib_module_names


def test_numpy_and_msgspec_are_all_that_is_imported() -> None:
    assert len([*modules()]) > 15
    for name, file in modules():
        needed = NEEDED | {"zmq"} if name.startswith("client") else NEEDED
        assert imported(file) <= needed, name


NUMPY_2 = {
    *("astype", "bitwise_count", "concat", "cumulative_prod", "cumulative_sum"),
    *("isdtype", "matrix_transpose", "matvec", "permute_dims", "unstack"),
    *("vecdot", "vecmat"),
    *("linalg.cross", "linalg.diagonal", "linalg.matmul", "linalg.matrix_norm"),
    *("linalg.matrix_transpose", "linalg.outer", "linalg.svdvals", "linalg.tensordot"),
    *("linalg.trace", "linalg.vecdot", "linalg.vector_norm", "strings", "trapezoid"),
    *("unique_all", "unique_counts", "unique_inverse", "unique_values"),
}
"""Functions that numpy 1.26 does not have; its arrays have no `mT` either."""


def test_nothing_is_called_that_numpy_1_does_not_have() -> None:
    for name, file in modules():
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute):
                called = ast.unparse(node).removeprefix("np.")
                assert called not in NUMPY_2, (name, node.lineno)
                assert node.attr != "mT", (name, node.lineno)


# Finds no package that an environment with `handmap-core[client]` alone does not have.
ALONE = """
import sys

class Alone:
    def find_spec(self, name, *_):
        package = name.partition(".")[0]
        if package not in {*sys.stdlib_module_names, *sys.argv[2].split()}:
            raise ModuleNotFoundError(f"{name} is absent here", name=name)

sys.meta_path.insert(0, Alone())
from importlib import import_module
for name in sys.argv[1].split():
    import_module(name)
import numpy as np
from handmap_core.se3 import quat_wxyz_from_rotation, rotation_from_quat_wxyz
assert np.allclose(quat_wxyz_from_rotation(rotation_from_quat_wxyz([0, 0, 1, 0])), [0, 0, 1, 0])
"""


def test_every_module_runs_without_other_packages() -> None:
    names = " ".join(f"handmap_core.{name}".rstrip(".") for name, _ in modules())
    present = " ".join([*NEEDED, "zmq"])
    done = subprocess.run(
        [sys.executable, "-c", ALONE, names, present],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def public_names(module: ModuleType) -> set[str]:
    """Return the names that a module defines or lists, without the private ones."""
    if "__all__" in vars(module):
        return {*module.__all__}
    assert module.__file__
    body = ast.parse(Path(module.__file__).read_text(encoding="utf-8")).body
    names = set()
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign):
            names |= {each.id for each in node.targets if isinstance(each, ast.Name)}
        elif isinstance(node, ast.ImportFrom) and node.level:
            names |= {alias.asname or alias.name for alias in node.names}
    return {name for name in names if not name.startswith("_")}


@pytest.mark.parametrize("name", SHARED)
def test_the_library_has_all_public_names_of_the_core(name: str) -> None:
    own = import_module(f"handmap_core.{name}")
    shared = vars(import_module(f"handmap_qp.{name}"))
    expected = public_names(own) - {"messages"}
    assert expected
    assert {each for each in expected if shared.get(each) is not vars(own)[each]} == (
        set()
    )


IMPORTED = """
import sys
import numpy

before = {*sys.modules}
import handmap_core.run

print(*sorted({*sys.modules} - before))
"""


def test_what_follows_imports_nothing_that_takes_long() -> None:
    # Entry points are searched for where a name is not our own.
    printed = subprocess.check_output([sys.executable, "-c", IMPORTED], text=True)
    slow = {
        "importlib.metadata",
        "importlib.resources",
        "email",
        "zipfile",
        "json.tool",
    }
    assert not slow & {*printed.split()}
    assert "handmap_core.stream.follower" in printed
