"""The robot that `handmap hands init` is given: a URDF, an MJCF file, or a robot by name."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from handmap_qp import hands
from handmap_qp.errors import HandError, InvalidInputError
from handmap_qp.hands.sources import is_mjcf, source_path
from handmap_qp.output_files import writing

# Allowed difference between the poses of a link in the URDF and in MuJoCo [m].
_MOST_DIFFERENCE = 1e-9


class RobotSource(NamedTuple):
    """A URDF to detect a hand in.

    Attributes:
        urdf: The URDF file.
        reference: How `hand.yaml` refers to it.
        notes: What a conversion from MJCF left out, one sentence each.
        written: Files that were written.
    """

    urdf: Path
    reference: str
    notes: tuple[str, ...] = ()
    written: tuple[Path, ...] = ()


def open_source(robot: Path, folder: Path, *, overwrite: bool = False) -> RobotSource:
    """Find the URDF of a robot, and convert an MJCF file to one.

    Args:
        robot: A URDF or MJCF file, `package://PACKAGE/path`, or `robot_descriptions:MODULE`.
        folder: Folder of the `hand.yaml`. The URDF and the meshes of an MJCF file are written
            beside it.
        overwrite: Whether to replace a URDF that is there.

    Raises:
        HandError: If there is no such robot, or it cannot be converted.
        InvalidInputError: If the URDF exists, or cannot be written.
        MissingExtraError: If `robot_descriptions` or a package of an extra is not installed.
        MissingPackageError: If another package is not installed.
    """
    given = str(robot).replace("package:/", "package://", 1).replace(":///", "://")
    source = source_path(given)
    path = robot if source is None else source
    if not is_mjcf(path):
        return RobotSource(path, str(path) if source is None else given)
    if source is not None:
        return RobotSource(
            hands.mjcf.cached_urdf(path), given, hands.mjcf.convert_mjcf(path).notes
        )
    urdf = folder / f"{path.stem}.urdf"
    if urdf.exists() and not overwrite:
        raise InvalidInputError(
            argument="--out",
            problem=f"the URDF is written beside it, and {urdf} exists already",
            value=str(urdf),
            advice="give --overwrite to replace it, or another folder",
        )
    converted = hands.mjcf.convert_mjcf(path, f"{path.stem}_meshes")
    difference = hands.mjcf.kinematics_difference(converted)
    if not difference < _MOST_DIFFERENCE:
        problem = f"the URDF's kinematics differ from MuJoCo's by {difference:.1e} m"
        raise HandError(f"{problem}: please report it", file=path)
    with writing(urdf, "--out"):
        hands.mjcf.write_converted(converted, urdf)
    return RobotSource(urdf, str(urdf), converted.notes, (urdf,))
