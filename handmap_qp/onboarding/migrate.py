"""From a configuration of dex-retargeting to a hand's description.

dex-retargeting (github.com/dexsuite/dex-retargeting) describes a task by links of the robot and
indices of human landmarks. Both are taken over as reference points; palm, rest posture and the rest
are found in the URDF, as by `handmap hands init`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import yaml

from handmap_qp.errors import HandError, without_errno
from handmap_qp.hands.spec import PointSpec
from handmap_qp.hands.urdf.xml_text import decode_xml
from handmap_qp.onboarding.detect import Detection, detect
from handmap_qp.onboarding.robot import Robot
from handmap_qp.trackers.sample import LANDMARK_NAMES

_TIPS = (4, 8, 12, 16, 20)
# Settings without a counterpart, and what takes their place.
_ELSEWHERE = {
    "scaling_factor": "sizes are measured on both hands; --scale of the presets object and paper",
    "low_pass_alpha": "--smooth filters samples, without lag of 56 ms",
    "project_dist": "pinches begin at a gap of 70 mm; --contact-gap",
    "escape_dist": "pinches begin at a gap of 70 mm; --contact-gap",
    "ignore_mimic_joint": "mimic joints always follow",
    "has_joint_limits": "joint limits always hold",
}


@dataclass(frozen=True)
class DexConfiguration:
    """The parts of a configuration that have a counterpart here.

    Attributes:
        file: The configuration.
        urdf: Path of the URDF as it says, relative to a folder that it does not name.
        wrist: Link of the wrist; None if it names none.
        links: Robot links by the names of human landmarks.
        notes: Settings that were not taken over, and what takes their place.
    """

    file: Path
    urdf: str
    wrist: str | None
    links: dict[str, str]
    notes: tuple[str, ...]


def read_dex_configuration(path: Path) -> DexConfiguration:
    """Read a configuration.

    Args:
        path: The YAML file.

    Raises:
        HandError: If the file cannot be read, or is not a configuration of dex-retargeting.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:  # ValueError: not UTF-8
        raise HandError(f"cannot be read: {without_errno(error)}", file=path) from error
    except yaml.YAMLError as error:
        raise HandError(f"is not YAML: {' '.join(str(error).split())}", file=path) from error
    table = document.get("retargeting") if isinstance(document, dict) else None
    if not isinstance(table, dict):
        raise HandError("expected a table `retargeting`, as in dex-retargeting's files", file=path)
    urdf = table.get("urdf_path")
    if not isinstance(urdf, str):
        raise HandError("expected a path", file=path, key="urdf_path", value=urdf)
    notes = tuple(
        f"{name} is not used: {advice}" for name, advice in _ELSEWHERE.items() if name in table
    )
    kind = str(table.get("type", "")).lower()
    if kind == "dexpilot":
        tips = _names(table, "finger_tip_link_names", path)
        if len(tips) > len(_TIPS):
            problem = f"expected at most five fingertips, got {len(tips)}"
            raise HandError(problem, file=path, key="finger_tip_link_names")
        wrist = table.get("wrist_link_name")
        return DexConfiguration(path, urdf, wrist, _by_landmark(tips, _TIPS[: len(tips)]), notes)
    field = {"vector": "target_task_link_names", "position": "target_link_names"}.get(kind)
    if field is None:
        expected = "vector, position or DexPilot"
        raise HandError(f"expected {expected}", file=path, key="type", value=table.get("type"))
    links, indices = _names(table, field, path), table.get("target_link_human_indices")
    # A vector has two rows of indices: where it begins, and where it ends.
    is_pair = isinstance(indices, list) and len(indices) == 2
    ends = indices if kind != "vector" else indices[1] if is_pair else None
    is_index = [isinstance(i, int) and 0 <= i <= 20 for i in ends] if isinstance(ends, list) else []
    if not isinstance(ends, list) or not all(is_index) or len(is_index) != len(links):
        problem = f"expected {len(links)} indices of landmarks from 0 to 20 for {field}"
        raise HandError(problem, file=path, key="target_link_human_indices", value=indices)
    origins = table.get("target_origin_link_names") or [None]
    return DexConfiguration(path, urdf, origins[0], _by_landmark(links, ends), notes)


def migrate(configuration: DexConfiguration, urdf: Path, *, name: str | None = None) -> Detection:
    """Find the hand in its URDF, with the configuration's links as reference points.

    Args:
        configuration: The configuration.
        urdf: The URDF that it means.
        name: Name of the hand; that of the robot if omitted.

    Raises:
        HandError: If the URDF cannot be used, or has no link of the configuration.
    """
    if not urdf.is_file():
        problem = f"{configuration.file}: no URDF {urdf}: give the file by --urdf"
        raise HandError(problem, key="urdf_path", value=configuration.urdf)
    robot = Robot(decode_xml(urdf.read_bytes()), urdf)
    links = configuration.links
    carriers = {landmark: _carrier(robot, link) for landmark, link in links.items()}
    found = detect(urdf, thumb=carriers.get("thumb_tip"), name=name)
    points = {point.name: point for point in _renamed(found, carriers)} | {
        landmark: PointSpec(landmark, link, finger=landmark.partition("_")[0])
        for landmark, link in links.items()
    }
    tips = tuple(name for name in points if name.endswith("_tip"))
    others = tuple(name for name in points if name not in tips)
    spec = msgspec.structs.replace(
        found.spec,
        points=tuple(points[name] for name in (*tips, *others)),
        sets={"fingertips": tips} | ({"fingertips_middle": (*tips, *others)} if others else {}),
    )
    notes = (f"reference points are those of {configuration.file.name}", *configuration.notes)
    return replace(found, spec=spec, notes=(*notes, *found.notes))


def _carrier(robot: Robot, link: str) -> str:
    """Return the joint that moves a link: the last one on the way to it.

    Raises:
        HandError: If there is no such link, or no joint moves it.
    """
    if link not in robot.links:
        raise HandError(f"has no link {link!r} of the configuration", file=robot.file, value=link)
    passed = robot.chain(link, robot.root)
    if not passed:
        raise HandError(f"no joint moves the link {link!r}", file=robot.file, value=link)
    return passed[-1][0]


def _renamed(found: Detection, carriers: dict[str, str]) -> list[PointSpec]:
    """Return the found points under the finger names of the configuration.

    Points of fingers that the configuration does not name are left out.
    """
    names = {
        finger: landmark.partition("_")[0]
        for landmark, joint in carriers.items()
        for finger, chain in found.chains.items()
        if joint in chain
    }
    return [
        msgspec.structs.replace(
            point,
            name=f"{names[point.finger]}_{point.name.rpartition('_')[2]}",
            finger=names[point.finger],
            partner=None,
        )
        for point in found.spec.points
        if point.finger in names
    ]


def _by_landmark(links: Sequence[str], indices: Sequence[int]) -> dict[str, str]:
    """Return links by landmark names; the wrist's own is not a reference point."""
    return {LANDMARK_NAMES[i]: link for i, link in zip(indices, links, strict=True) if i != 0}


def _names(table: dict[str, Any], field: str, file: Path) -> list[str]:
    names = table.get(field)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise HandError("expected a list of link names", file=file, key=field, value=names)
    return names
