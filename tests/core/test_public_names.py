"""The public names: one list, found where it says, at their first use and in any order."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import handmap_qp

FILE = Path(handmap_qp.__file__)
PACKAGES = (
    *("hands", "human", "ik", "mapping", "reference", "stream"),
    *("trackers", "client"),
    *("apps.drawing", "apps.onboarding"),
)
HEAVY = {"numpy", "pinocchio", "coal", "daqp", "mujoco", "scipy", "yaml", "msgspec"}

FIRST = """
import importlib, os, sys
import numpy, pinocchio, scipy.optimize, scipy.spatial.transform
for package in sys.argv[1:]:
    assert not {name for name in sys.modules if name.startswith("handmap_")}
    child = os.fork()
    if not child:
        print(importlib.import_module(f"handmap_qp.{package}").__name__, flush=True)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        sys.exit(f"{package} cannot be imported first")
"""
"""Imports each package in a process that has not loaded another one.

The processes are copies of one that has the libraries of others, which take most of the time.
"""


def loaded_by(statements: str) -> set[str]:
    """Return the modules of a fresh interpreter after statements."""
    code = f"import json, sys\n{statements}\nprint(json.dumps([*sys.modules]))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(json.loads(done.stdout))


def imported_names() -> dict[str, str]:
    """Return the names that checkers read, by the file's imports, and their modules."""
    return {
        alias.asname or alias.name: node.module or ""
        for node in ast.walk(ast.parse(FILE.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.level
        for alias in node.names
    }


def test_checkers_and_python_read_the_same_names() -> None:
    homes = {n: module for module, names in handmap_qp._HOMES.items() for n in names}
    assert imported_names() == homes
    assert {*handmap_qp.__all__} == homes.keys()
    assert {*homes} <= {*dir(handmap_qp)}


@pytest.mark.parametrize("name", handmap_qp.__all__)
def test_a_public_name_is_what_its_module_has(name: str) -> None:
    home = import_module(f"handmap_qp.{imported_names()[name]}")
    assert getattr(handmap_qp, name) is vars(home)[name]
    # Packages have lists of their own.
    assert name in vars(home).get("__all__", [name])


def test_a_name_that_does_not_exist_is_an_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'HandMaper'"):
        handmap_qp.HandMaper  # noqa: B018  # ty: ignore[missing-attribute]


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_lists_what_it_has(package: str) -> None:
    module = import_module(f"handmap_qp.{package}")
    assert len({*module.__all__}) == len(module.__all__)
    assert {*module.__all__} <= vars(module).keys()


@pytest.mark.slow
def test_a_package_may_be_imported_first() -> None:
    # A circle would show as a name that is missing from a module half read.
    done = subprocess.run(
        [sys.executable, "-c", FIRST, *PACKAGES],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [f"handmap_qp.{package}" for package in PACKAGES]


def test_the_package_and_the_client_load_no_more_than_they_need() -> None:
    own = {n for n in loaded_by("import handmap_qp") if n.startswith("handmap_")}
    assert own == {"handmap_qp"}
    assert not loaded_by("import handmap_qp") & HEAVY
    client = loaded_by("import handmap_qp.client") & HEAVY
    assert client <= {"numpy", "msgspec"}
    command = loaded_by("import handmap_qp.cli") & HEAVY
    assert command <= {"numpy", "msgspec"}


@pytest.mark.slow
def test_a_mapping_loads_neither_simulation_nor_other_solvers() -> None:
    loaded = loaded_by("from handmap_qp import HandMapper, load_hand; load_hand")
    assert not loaded & {
        "mujoco",
        "mink",
        "qpsolvers",
        "scipy",
        "matplotlib",
        "trimesh",
    }


@pytest.mark.slow
def test_a_mapping_by_the_core_loads_no_published_method() -> None:
    # Tasks of users, and samples without a wrist pose, do not need it either.
    loaded = loaded_by("""
import numpy as np
from handmap_qp import AttachedPoints, HandMapper, PointDistances, load_hand
human, robot = load_hand("human"), load_hand("three_finger")
task = PointDistances(AttachedPoints.reference_points(robot), [(0, 1)], 0.05)
for preset in ("teleoperation", "paper"):
    mapper = HandMapper(human, robot, preset, tasks=[task])
    mapper.map_step(human.rest, np.eye(4))
mapper.map_points(human.points(human.rest))
""")
    assert not {name for name in loaded if name.startswith("handmap_qp.reference")}
