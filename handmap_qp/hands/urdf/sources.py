"""Robots by name: `package://PACKAGE/path` and `robot_descriptions:MODULE`."""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import pkgutil
import sys
from pathlib import Path
from types import ModuleType

from handmap_qp.errors import HandError, MissingExtraError, MissingPackageError

_PACKAGE, _DESCRIPTION = "package://", "robot_descriptions:"
# Which variable of a description's module is taken, the first that it has.
_VARIABLES = ("URDF_PATH", "MJCF_PATH")


def is_named_source(reference: str) -> bool:
    """Return whether a `urdf` of a description has the same meaning in every folder."""
    return reference.startswith((_PACKAGE, _DESCRIPTION, "$"))


def source_path(reference: str) -> Path | None:
    """Return the file of a robot that is given by name; None if it is given by path.

    Args:
        reference: `package://PACKAGE/path`, `robot_descriptions:MODULE` or
            `robot_descriptions:MODULE.VARIABLE`, or a path.

    Returns:
        The URDF or MJCF file, which need not exist.

    Raises:
        HandError: If `robot_descriptions` has no such robot, or cannot clone it.
        MissingExtraError: If `robot_descriptions` or a package of an extra is not installed.
        MissingPackageError: If another package is not installed.
    """
    if reference.startswith(_PACKAGE):
        package, _, inside = reference.removeprefix(_PACKAGE).partition("/")
        return package_folder(package) / inside
    if reference.startswith(_DESCRIPTION):
        return _described(reference.removeprefix(_DESCRIPTION))
    return None


def package_folder(package: str) -> Path:
    """Return the folder in which an installed package keeps its robots.

    It is the package's part of the `share` folder if the package has one (a cmeel wheel), else the
    folder that is imported.

    Raises:
        MissingExtraError: If the package of an extra is not installed.
        MissingPackageError: If another package is not installed.
    """
    # Its import takes 20 ms, and only such packages need it.
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        found = distribution(package)
    except (PackageNotFoundError, ValueError) as error:  # ValueError: no name
        if package == "example-robot-data":
            raise MissingExtraError(package, "robots") from error
        raise MissingPackageError(package) from error
    share = Path(str(found.locate_file("cmeel.prefix/share"))) / package
    if share.is_dir():
        return share
    return Path(str(found.locate_file(package.replace("-", "_"))))


def _described(name: str) -> Path:
    """Return the file of a robot of `robot_descriptions`, which clones it at first use."""
    name, _, variable = name.partition(".")
    module = _module(name)
    variables = (variable,) if variable else _VARIABLES
    for candidate in variables:
        if isinstance(path := getattr(module, candidate, None), str):
            return Path(path)
    paths = sorted(key for key in vars(module) if key.endswith("PATH") or "_PATH_" in key)
    files = [key for key in paths if key not in ("REPOSITORY_PATH", "PACKAGE_PATH")]
    expected = f"one of {', '.join(files)}" if files else "a URDF or MJCF"
    got = f"no {variable}" if variable else "neither URDF_PATH nor MJCF_PATH"
    raise HandError(f"robot_descriptions.{name} has {got}: expected {expected}", value=name)


def _module(name: str) -> ModuleType:
    try:
        package = importlib.import_module("robot_descriptions")
    except ImportError as error:
        raise MissingExtraError("robot_descriptions", "descriptions") from error
    known = [module.name for module in pkgutil.iter_modules(package.__path__)]
    if name not in known and f"robot_descriptions.{name}" not in sys.modules:
        near = difflib.get_close_matches(name, [k for k in known if k.endswith("description")], 3)
        advice = f"; did you mean {' or '.join(near)}?" if near else ""
        raise HandError(f"robot_descriptions has no robot {name!r}{advice}", value=name)
    try:
        return importlib.import_module(f"robot_descriptions.{name}")
    # git raises many types of its own; without a network, nothing can be cloned.
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise HandError(
            f"robot_descriptions cannot clone {name}: connect to the network and try again "
            f"({reason:.200})",
            value=name,
        ) from error
