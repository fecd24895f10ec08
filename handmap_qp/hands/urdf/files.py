"""Where URDFs and their meshes lie: in the folder of a description, or in an installed package."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

from handmap_qp.errors import HandError, MissingExtraError, MissingPackageError
from handmap_qp.hands.spec import ArmSpec, HandSpec
from handmap_qp.hands.urdf.elements import parse_urdf
from handmap_qp.hands.urdf.sources import package_folder, source_path
from handmap_qp.hands.urdf.xml_text import decode_xml


def read_urdf(spec: HandSpec | ArmSpec) -> str:
    """Read the URDF of a hand or an arm.

    Returns:
        The text of the file.

    Raises:
        HandError: If the file cannot be read.
        MissingExtraError: If it lies in a package that is not installed.
    """
    path = urdf_path(spec)
    try:
        return decode_xml(path.read_bytes())
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        unset = re.search(r"\$\{(\w+)\}", str(path))
        reason = f"set the environment variable {unset[1]}" if unset else error
        raise _source_error(spec, f"the URDF cannot be read: {reason}") from error


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
        if path.suffix in (".xml", ".mjcf"):
            from handmap_qp.hands.mjcf.compile import is_mjcf

            if is_mjcf(path):
                from handmap_qp.hands.mjcf.cache import cached_urdf

                return cached_urdf(path)
    except HandError as error:
        raise _source_error(spec, error.problem) from error
    return path


def source_file(spec: HandSpec | ArmSpec) -> Path:
    """Return the URDF or MJCF file of a hand or an arm, as `urdf_path` before it converts."""
    source = source_path(spec.urdf)
    return source or (spec.directory or Path()) / os.path.expandvars(spec.urdf)


def _source_error(spec: HandSpec | ArmSpec, problem: str) -> HandError:
    if isinstance(spec, ArmSpec):
        return HandError(problem, key="arm.urdf", value=spec.urdf)
    return spec.error(problem, key="urdf", value=spec.urdf)


def find_mesh(name: str, folder: Path) -> Path:
    """Find a mesh that a URDF names.

    A relative name starts at the URDF's folder. `package://PACKAGE/...` is searched in installed
    packages of robot descriptions first. After that, it is searched in the folders above the URDF:
    a ROS package is a folder of the package's name, or one that holds a `package.xml`.

    Args:
        name: The file name in the URDF.
        folder: The URDF's folder.

    Returns:
        A path, which need not exist.
    """
    if not name.startswith(("package://", "model://")):
        return folder / name.removeprefix("file://")
    package, _, inside = name.partition("://")[2].partition("/")
    candidates = []
    try:
        candidates.append(package_folder(package) / inside)
    except (MissingExtraError, MissingPackageError):
        candidates.append(folder / inside)
    for above in (folder.resolve(), *folder.resolve().parents):
        candidates.append(above / package / inside)
        if (above / "package.xml").exists():
            candidates.append(above / inside)
    return next((path for path in candidates if path.exists()), candidates[0])


def set_mesh_paths(robot: ET.Element, folder: Path) -> None:
    """Replace the file names of all meshes by absolute paths, as `find_mesh` finds them.

    Args:
        robot: The `<robot>` element, changed in place.
        folder: The folder of its URDF.
    """
    for mesh in robot.iter("mesh"):
        if name := mesh.get("filename"):
            mesh.set("filename", str(find_mesh(name, folder).resolve()))


def urdf_with_mesh_paths(spec: HandSpec, urdf_text: str) -> str:
    """Return a hand's URDF with absolute paths of its meshes, for readers that know no folder.

    Args:
        spec: The hand, whose URDF file tells where its meshes lie.
        urdf_text: Its URDF, composed or as in the file.

    Raises:
        HandError: If the text is not a URDF.
        MissingExtraError: If the URDF lies in a package that is not installed.
    """
    robot = parse_urdf(urdf_text)
    set_mesh_paths(robot, urdf_path(spec).parent)
    return ET.tostring(robot, encoding="unicode")
