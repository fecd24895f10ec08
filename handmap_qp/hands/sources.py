"""Where robots and their meshes lie: in a description's folder, or in an installed package.

A `urdf` is a path, `package://PACKAGE/path` or `robot_descriptions:MODULE`.
"""

import importlib
import importlib.metadata
import io
import os
import pkgutil
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from types import ModuleType

from handmap_core.errors import (
    HandError,
    MissingExtraError,
    MissingPackageError,
    did_you_mean,
    reason_of,
    require,
)
from .spec import DESCRIPTION_SCHEME, PACKAGE_SCHEME, ArmSpec, HandSpec

_POINTER = b"version https://git-lfs.github.com/spec/"
_ZIP = b"PK\x03\x04"
_ARRAYS = (
    "holds arrays (npz), such as a recording of a human hand, and no robot: give a robot's "
    "URDF or MJCF, or map the recording by `handmap retarget FILE --robot HAND`"
)
# Beginnings of files that are no robot, and what to do about each.
_OTHER_KINDS = {
    _POINTER: "is a pointer of git-lfs in place of a file: run `git lfs pull` in its repository",
    b"PXR-USDC": "is USD, which is not read: export the robot as URDF, or give the URDF or MJCF "
    "that the USD was made from",
    _ZIP: "is an archive: unpack it, and give the URDF or MJCF inside",
    b"<!DOCTYPE html": "is a web page: download the raw file that it shows",
}
_OTHER_KINDS |= {b"#usda": _OTHER_KINDS[b"PXR-USDC"]}
# Which variable of a description's module is taken, the first that it has.
_VARIABLES = ("URDF_PATH", "MJCF_PATH")


def urdf_directory() -> Path:
    """Return the folder with one subfolder per hand.

    It is inside the package when installed from a wheel, and beside it in a checkout.
    """
    package = Path(__file__).resolve().parents[1]
    installed = package / "urdf"
    return installed if installed.is_dir() else package.parent / "urdf"


def source_path(reference: str) -> Path | None:
    """Return the file, which need not exist, of a robot that is given by name; else None.

    Args:
        reference: `package://PACKAGE/path`, `robot_descriptions:MODULE` or
            `robot_descriptions:MODULE.VARIABLE`, or a path.

    Raises:
        HandError: If `robot_descriptions` has no such robot, or cannot clone it.
        MissingExtraError: If `robot_descriptions` or a package of an extra is not installed.
        MissingPackageError: If another package is not installed.
    """
    if reference.startswith(PACKAGE_SCHEME):
        package, _, inside = reference.removeprefix(PACKAGE_SCHEME).partition("/")
        return package_folder(package) / inside
    if reference.startswith(DESCRIPTION_SCHEME):
        return _described(reference.removeprefix(DESCRIPTION_SCHEME))
    return None


def package_folder(package: str) -> Path:
    """Return the folder in which an installed package keeps its robots.

    It is the package's part of the `share` folder if the package has one (a cmeel wheel), else the
    folder that is imported.

    Raises:
        MissingExtraError: If the package of an extra is not installed.
        MissingPackageError: If another package is not installed.
    """
    try:
        found = importlib.metadata.distribution(package)
    # ValueError: no name.
    except (importlib.metadata.PackageNotFoundError, ValueError) as error:
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
    for candidate in (variable,) if variable else _VARIABLES:
        if isinstance(path := getattr(module, candidate, None), str):
            return Path(path)
    paths = {key for key in vars(module) if key.endswith("PATH") or "_PATH_" in key}
    files = ", ".join(sorted(paths - {"REPOSITORY_PATH", "PACKAGE_PATH"}))
    expected = f"one of {files}" if files else "a URDF or MJCF"
    got = f"no {variable}" if variable else "neither URDF_PATH nor MJCF_PATH"
    raise HandError(
        f"robot_descriptions.{name} has {got}: expected {expected}", value=name
    )


def _module(name: str) -> ModuleType:
    package = require("robot_descriptions", "descriptions")
    known = [module.name for module in pkgutil.iter_modules(package.__path__)]
    if name not in known and f"robot_descriptions.{name}" not in sys.modules:
        advice = did_you_mean(name, known) or "see its list of robots"
        raise HandError(
            f"robot_descriptions has no robot {name!r}; {advice}", value=name
        )
    try:
        return importlib.import_module(f"robot_descriptions.{name}")
    # git raises many types of its own; without a network, nothing can be cloned.
    except Exception as error:
        reason = reason_of(error) or type(error).__name__
        advice = f"connect to the network and try again ({reason:.200})"
        raise HandError(
            f"robot_descriptions cannot clone {name}: {advice}", value=name
        ) from error


def source_file(spec: HandSpec | ArmSpec) -> Path:
    """Return the URDF or MJCF file of a hand or an arm, as `urdf_path` before it converts."""
    return source_path(spec.urdf) or (spec.directory or Path()) / os.path.expandvars(
        spec.urdf
    )


def urdf_path(spec: HandSpec | ArmSpec) -> Path:
    """Return the path of the URDF of a hand or an arm, which need not exist.

    Environment variables in it, such as `${FOLDER}/hand.urdf`, are replaced by their values. An
    MJCF file is converted to a URDF in the cache folder of the user.

    Raises:
        HandError: If it is a robot of `robot_descriptions` that cannot be had, or an MJCF file that
            MuJoCo cannot compile.
        MissingExtraError: If it lies in a package that is not installed.
    """
    try:
        path = source_file(spec)
        if is_mjcf(path):
            # MuJoCo takes longer to import than most hands take to load.
            from .mjcf import cached_urdf

            return cached_urdf(path)
    except HandError as error:
        raise spec.error(error.problem, "urdf", spec.urdf) from error
    return path


def read_urdf(spec: HandSpec | ArmSpec) -> bytes:
    """Read the URDF of a hand or an arm.

    Raises:
        HandError: If the file cannot be read.
        MissingExtraError: If it lies in a package that is not installed.
    """
    path = urdf_path(spec)
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        unset = re.search(r"\$\{(\w+)\}", str(path))
        reason = f"set the environment variable {unset[1]}" if unset else error
        problem = f"the URDF cannot be read: {reason}"
        raise spec.error(problem, "urdf", spec.urdf) from error


def find_mesh(name: str, folder: Path) -> Path:
    """Find a mesh that a URDF in a folder names; the path need not exist.

    A relative name starts at the URDF's folder. `package://PACKAGE/...` is searched in installed
    packages of robot descriptions first. After that, it is searched in the folders above the URDF:
    a ROS package is a folder of the package's name, or one that holds a `package.xml`. A file that
    is at none of these places is looked for by its name in the folders of meshes around the URDF.
    """
    candidates = _mesh_places(name, folder)
    first = next(candidates)
    if first.exists():
        return first
    found = next(filter(Path.exists, candidates), None)
    return found or _meshes_near(folder).get(Path(name).name, first)


def _mesh_places(name: str, folder: Path) -> Iterator[Path]:
    """Yield where a mesh is looked for by its whole name; see `find_mesh`."""
    if not name.startswith((PACKAGE_SCHEME, "model://")):
        yield folder / name.removeprefix("file://")
        return
    package, _, inside = name.partition("://")[2].partition("/")
    try:
        yield package_folder(package) / inside
    except (MissingExtraError, MissingPackageError):
        yield folder / inside
    resolved = folder.resolve()
    for above in (resolved, *resolved.parents):
        yield above / package / inside
        if (above / "package.xml").exists():
            yield above / inside


@lru_cache(maxsize=8)
def _meshes_near(folder: Path) -> dict[str, Path]:
    """Return the files in folders of meshes beside a URDF, and beside its folder, by their names.

    Of files with one name, the shortest path counts.
    """
    near = [folder, *folder.glob("*"), *folder.parent.glob("*")]
    # Not what only has such a word in its name.
    ending = re.compile(r"(mesh(es)?|assets?)$")
    named = [each for each in near if ending.search(each.name.lower())]
    files = [file for each in named for file in each.rglob("*.*")]
    files.sort(key=lambda file: -len(file.parts))
    return {file.name: file for file in files}


def other_kind(content: bytes) -> str:
    """Return what a file is, by its first bytes, and what to do; empty if it may be a robot."""
    if not content.strip():
        return "is empty"
    # Length and name of the first file of the archive, which may be cut short.
    length = int.from_bytes(content[26:28], "little")
    if content.startswith(_ZIP) and content[30 : 30 + length].endswith(b".npy"):
        return _ARRAYS
    begins = content.lstrip()[: max(map(len, _OTHER_KINDS))].lower()
    return next(
        (
            what
            for first, what in _OTHER_KINDS.items()
            if begins.startswith(first.lower())
        ),
        "",
    )


def is_lfs_pointer(file: Path) -> bool:
    """Return whether a pointer of git-lfs is in the place of a file; False if there is none."""
    try:
        with file.open("rb") as stream:
            return stream.read(len(_POINTER)) == _POINTER
    except (OSError, ValueError):  # ValueError: a null character in the path
        return False


def root_tag(content: bytes) -> str:
    """Return the name of an XML file's root element; empty if there is none."""
    try:
        return next(ET.iterparse(io.BytesIO(content), ["start"]))[1].tag
    except (ET.ParseError, LookupError, ValueError, StopIteration):
        return ""


def is_mjcf(file: Path) -> bool:
    """Return whether a file is an MJCF model; False if it cannot be read, or by its suffix."""
    if file.suffix not in (".xml", ".mjcf"):
        return False
    try:
        return root_tag(file.read_bytes()) in ("mujoco", "mujocoinclude")
    except (OSError, ValueError):  # ValueError: a null character in the path
        return False
