"""Where URDFs and their meshes lie.

Beside a `hand.yaml`, or in an installed package of robot descriptions.
"""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

from handmap_qp.errors import HandError, MissingExtraError
from handmap_qp.hands.spec import ArmSpec, HandSpec


def read_urdf(spec: HandSpec | ArmSpec) -> str:
    """The text of the URDF of a hand or an arm.

    Raises:
        HandError: If there is no such file.
        MissingExtraError: If it lives in a package that is not installed.
    """
    path = urdf_path(spec)
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        message = f"the URDF cannot be read: {error}"
        if isinstance(spec, ArmSpec):
            raise HandError(message, key="arm.urdf", value=spec.urdf) from error
        raise spec.error(message, key="urdf", value=spec.urdf) from error


def urdf_path(spec: HandSpec | ArmSpec) -> Path:
    """Where the URDF of a hand or an arm lies.

    Raises:
        MissingExtraError: If it lives in a package that is not installed.
    """
    if spec.urdf.startswith("package://"):
        package, _, inside = spec.urdf.removeprefix("package://").partition("/")
        return package_share(package) / package / inside
    return (spec.directory or Path()) / spec.urdf


def package_share(package: str) -> Path:
    """The `share` folder of an installed package of robot descriptions (a cmeel wheel).

    Raises:
        MissingExtraError: If the package is not installed.
    """
    try:
        distribution = importlib.metadata.distribution(package)
    except importlib.metadata.PackageNotFoundError as error:
        raise MissingExtraError(package, "robots") from error
    return Path(str(distribution.locate_file("cmeel.prefix/share")))


def find_mesh(name: str, folder: Path) -> Path:
    """Where a mesh that a URDF names lies.

    `package://PACKAGE/...` is looked for in installed packages of robot descriptions, and else in
    the folders above the URDF, where a ROS package is a folder of its own name or one that holds a
    `package.xml`.

    Args:
        name: The file name in the URDF.
        folder: The URDF's folder.

    Returns:
        A path, which need not exist.
    """
    if not name.startswith(("package://", "model://")):
        return folder / name.removeprefix("file://")
    package, _, inside = name.partition("://")[2].partition("/")
    try:
        installed = package_share(package) / package / inside
    except MissingExtraError:
        installed = folder / inside
    if installed.exists():
        return installed
    for above in (folder.resolve(), *folder.resolve().parents):
        for candidate in (
            above / package / inside,
            *([above / inside] if (above / "package.xml").exists() else []),
        ):
            if candidate.exists():
                return candidate
    return installed
