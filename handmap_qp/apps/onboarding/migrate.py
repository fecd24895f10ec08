"""From a configuration of dex-retargeting to a hand's description.

dex-retargeting (github.com/dexsuite/dex-retargeting) describes a task by links of the robot and
indices of human landmarks. Both are taken over as reference points; palm, rest posture and the rest
are found in the URDF, as by `handmap hands init`.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from handmap_core.errors import HandError
from handmap_qp.hands import Names, PointSpec, read_yaml
from handmap_qp.human import LANDMARK_NAMES, TIPS
from .detect import Detection, detect, point_sets
from .robot import Robot

_Kind = Literal["dexpilot", "vector", "position"]
_Index = Annotated[int, Meta(ge=0, lt=len(LANDMARK_NAMES))]
# Settings without a counterpart, and what takes their place.
_ELSEWHERE = {
    "scaling_factor": "sizes are measured on both hands; --scale of the presets object and paper",
    "low_pass_alpha": "samples are smoothed by their noise, without lag of 56 ms",
    "project_dist": "pinches begin at a gap of 70 mm; --contact-gap",
    "escape_dist": "pinches begin at a gap of 70 mm; --contact-gap",
    "ignore_mimic_joint": "mimic joints always follow",
    "has_joint_limits": "joint limits always hold",
}
# Settings that name the links, by the type of a configuration.
_LINKS = {
    "dexpilot": "finger_tip_link_names",
    "vector": "target_task_link_names",
    "position": "target_link_names",
}


def read_dex_configuration(path: Path) -> tuple[str, dict[str, str], Names]:
    """Read the parts of a configuration that have a counterpart here.

    Returns:
        Path of the URDF as it says, relative to a folder that it does not name; robot links by the
        names of human landmarks; and settings that were not taken over, and what takes their place.

    Raises:
        HandError: If the file cannot be read, or is not a configuration of dex-retargeting.
    """
    document = read_yaml(path)
    table = document.get("retargeting") if isinstance(document, dict) else None
    if not isinstance(table, dict):
        problem = "expected a table `retargeting`, as in dex-retargeting's files"
        raise HandError(problem, file=path)

    def setting(
        key: str,
        kind: Any,
        what: str,
        value: Any = None,
    ) -> Any:
        given = table.get(key)
        try:
            return msgspec.convert(given if value is None else value, kind)
        except msgspec.ValidationError as error:
            raise HandError(
                f"expected {what}", file=path, key=key, value=given
            ) from error

    urdf = setting("urdf_path", str, "a path")
    kind = str(table.get("type")).lower()
    field = _LINKS[setting("type", _Kind, "vector, position or DexPilot", kind)]

    def numbered(key: str, numbers: Any) -> dict[str, str]:
        """Return the links of a list by the names of their landmarks, but the wrist's."""
        links = setting(
            key, Annotated[list[str], Meta(min_length=1)], "a list of link names"
        )
        count = len(links)
        if kind == "dexpilot":
            numbers = TIPS[:count].tolist()
        numbers = setting(
            "target_link_human_indices",
            Annotated[list[_Index], Meta(min_length=count, max_length=count)],
            f"{count} indices of landmarks from 0 to 20 for {key}, of DexPilot at most five",
            numbers,
        )
        # The wrist's own landmark is not a reference point.
        return {
            LANDMARK_NAMES[i]: link for i, link in zip(numbers, links, strict=True) if i
        }

    indices: Any = table.get("target_link_human_indices")
    named: dict[str, str] = {}
    match kind, indices:
        # Two rows of indices: where vectors begin, and where they end. Most begin at the wrist, a
        # gripper's at its other jaw.
        case "vector", [[*starts], indices] if any(starts):
            named = numbered("target_origin_link_names", starts)
        case "vector", [_, indices]:
            pass
    named |= numbered(field, indices)
    unused = [name for name in _ELSEWHERE if name in table]
    notes = (f"{name} is not used: {_ELSEWHERE[name]}" for name in unused)
    return urdf, named, tuple(notes)


def migrate(path: Path, urdf: Path | None, name: str | None) -> Detection:
    """Find the hand in its URDF, with a configuration's links as reference points.

    Args:
        path: The configuration.
        urdf: The URDF; as the configuration says, from its folder, if omitted.
        name: The hand's name; that of the robot if omitted.

    Raises:
        HandError: If a file cannot be used, or the URDF has no link of the configuration.
    """
    given, links, notes = read_dex_configuration(path)
    urdf = urdf or path.parent / given
    if not urdf.is_file():
        problem = f"{path}: no URDF {urdf}: give the file by --urdf"
        raise HandError(problem, key="urdf_path", value=given)
    robot = Robot(urdf)
    carriers = {landmark: _carrier(robot, link) for landmark, link in links.items()}
    found = detect(urdf, thumb=carriers.get("thumb_tip"), name=name)
    # The found points take the configuration's names; of other fingers they are left out.
    names = {
        finger: landmark.partition("_")[0]
        for landmark, joint in carriers.items()
        for finger, chain in found.chains.items()
        if joint in chain
    }
    points = dict[str, PointSpec]()
    for point in found.spec.points:
        if finger := names.get(str(point.finger)):
            own = f"{finger}_{point.name.rpartition('_')[2]}"
            points[own] = replace(point, name=own, finger=finger, partner=None)
    for landmark, link in links.items():
        points[landmark] = PointSpec(landmark, link, finger=landmark.partition("_")[0])
    every, sets = point_sets(points.values())
    spec = replace(found.spec, points=every, sets=sets)
    intro = f"reference points are those of {path.name}"
    return found._replace(spec=spec, notes=(intro, *notes, *found.notes))


def _carrier(robot: Robot, link: str) -> str:
    """Return the joint that moves a link: the last one on the way to it."""
    problem = f"has no link {link!r} of the configuration"
    if link in robot.frames:
        if body := robot.frames[link].parentJoint:
            return robot.model.names[body]
        problem = f"no joint moves the link {link!r}"
    raise robot.error(problem, link)
