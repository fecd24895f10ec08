"""The command `handmap doctor`: the state of an installation, for users and bug reports."""

import ctypes.util
import importlib
import os
import platform
import re
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from handmap_core.errors import MissingCoreError
from handmap_qp.version import PACKAGE, __version__
from .tables import print_result

_CORE = "numpy scipy pin mink mujoco qpsolvers daqp osqp proxsuite tyro rich"
_FOLDERS = {"HANDMAP_RECORDINGS": "*.npz", "HANDMAP_HANDS": "*/*.urdf"}
"""Folders that tests and benchmarks read, with the files expected there."""
_GL = ("EGL", "OSMesa", "GL")
"""Libraries with which MuJoCo can render."""


@dataclass(frozen=True)
class Doctor:
    """Report versions, extras, solvers, recordings and rendering.

    Prints what a bug report needs, and how to install each extra that is missing.

    Examples:
        handmap doctor
        handmap doctor --json

    Attributes:
        json: Print one JSON object instead of tables.
    """

    json: bool = False

    def run(self) -> None:
        """Examine the installation and print the result."""
        parts = versions, extras, solvers, folders, libraries
        report = {part.__name__: part() for part in parts}
        tables = {title.capitalize(): rows for title, rows in report.items()}
        print_result(report, tables, as_json=self.json)


def versions() -> dict[str, str]:
    """Return the versions of this package, Python, the system and the core dependencies.

    And whether the compiled core is there, or what is wrong with it.
    """
    system = f"{platform.system()} {platform.release()} {platform.machine()}"
    return {
        PACKAGE: __version__,
        "python": sys.version.split()[0],
        "system": system,
        "core": _core_state(),
        **{name: _version(name) for name in _CORE.split()},
    }


def extras() -> dict[str, str]:
    """Return for every extra `installed`, or how to install it."""
    found: dict[str, list[str]] = {}
    for requirement in metadata.requires(PACKAGE) or []:
        parts = re.match(r"([\w.-]+).*extra == ['\"]([\w-]+)['\"]", requirement)
        # `all` repeats the others.
        if not parts or parts[2] == "all":
            continue
        missing = found.setdefault(parts[2], [])
        if _version(parts[1]) == "not installed":
            missing.append(parts[1])
    return {
        extra: "installed"
        if not missing
        else f"{', '.join(missing)} not installed: pip install '{PACKAGE}[{extra}]'"
        for extra, missing in found.items()
    }


def solvers() -> dict[str, str]:
    """Return the QP solvers that `--ik.solver` accepts here."""
    import qpsolvers

    names = sorted({"daqp", "proxqp", *qpsolvers.available_solvers})
    return {"default": "daqp", "available": ", ".join(names)}


def folders() -> dict[str, str]:
    """Return the state of the folders of recordings and hands that tests and benchmarks read."""
    return {name: _folder_state(name, files) for name, files in _FOLDERS.items()}


def libraries() -> dict[str, str]:
    """Return the system libraries for solvers and for MuJoCo's rendering."""
    # Slim images lack libgomp, to which compiled dependencies link.
    state = {
        f"lib{name}": ctypes.util.find_library(name) or "not found"
        for name in ("gomp", *_GL)
    }
    return state | {"MUJOCO_GL": os.environ.get("MUJOCO_GL", "not set")}


def _core_state() -> str:
    try:
        importlib.import_module("handmap_core.core")
    except MissingCoreError as error:
        return str(error)
    return "compiled core"


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _folder_state(name: str, files: str) -> str:
    folder = os.environ.get(name)
    if folder is None:
        return "not set"
    return f"{folder}: {len([*Path(folder).glob(files)])} files {files}"
