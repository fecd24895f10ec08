"""Files of `handmap hands init`: the robot that it is given, and the `hand.yaml` that it writes.

Comments in the `hand.yaml` explain each key and how its value was found.
"""

import os
import textwrap
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import yaml

from handmap_core.errors import (
    HandError,
    MissingExtraError,
    MissingPackageError,
    expect,
)
from handmap_qp.hands import (
    ArmSpec,
    HandSpec,
    Names,
    is_mjcf,
    is_named_source,
    package_folder,
    source_file,
    source_path,
)
from handmap_qp.output_files import check_new, make_folder, writing
from .detect import Detection

_wrapped = partial(
    textwrap.wrap, width=120, break_long_words=False, break_on_hyphens=False
)
# Allowed difference between the poses of a link in the URDF and in MuJoCo [m].
_MOST_DIFFERENCE = 1e-9
# Keys in their order, and those whose values are written on several lines.
_KEYS = (
    *("name", "urdf", "mirror", "upright", "root", "side", "palm", "wrist", "arm"),
    *(
        "joints",
        "rest",
        "neutral_match",
        "locked",
        "limits",
        "speeds",
        "mimic",
        "shapes",
    ),
    *("points", "sets", "reference", "collision", "tuning"),
)
_BLOCKS = {*_KEYS[6:], "collision.pairs", "tuning.joints"} - {"speeds", "reference"}
_EDITORS = "`handmap hands init` or `edit`"
_ROBOT = """# {0}: written by `handmap hands init`; look at it with `handmap robots check`.
name: {0}
hands:
  left: {{hand: left.yaml}}
  right: {{hand: right.yaml}}
"""
# Comments above keys: fixed ones, and evidence by the name of its clue and what it is of.
_ABOVE = {
    "root": "The hand starts at this link; the rest of the robot is ignored.",
    "wrist": "It floats, with six free coordinates of at most 3 m/s and 12 rad/s, or its mount is "
    "`fixed`: to the world, or to an arm among the joints.",
    "joints": "Active joints, in the order of every q; mimic joints are not among them.",
    "locked": "Locked joints and their positions [rad or m].",
    "limits": "Limits that the URDF lacks, and speeds in place of its own [rad or m, and per s].",
    "speeds": "Where the speed limits are from: urdf, maker, given, estimated or assumed.",
    "mimic": "Rules in place of the URDF's; null makes a joint independent that mimics one outside "
    "this part of the robot.",
    "points": "Reference points on links [m]; `partner` names the corresponding human point.",
    "tuning": "What `handmap calibrate-actuators` found of this hand and its motors [rad, s, m].",
    "collision": "Links that self-collision avoidance keeps apart: thumb and fingers, thumb and "
    "palm, and neighbouring fingers.",
}
FOUND = {
    "side": ("side", ""),
    "palm.link": ("palm", "the palm: "),
    "palm.xyz": ("palm origin", "origin, at the wrist [m]: "),
    "palm.distal": ("distal", "distal, the direction of the straight fingers: "),
    "palm.dorsal": ("dorsal", "dorsal, out of the back of the hand: "),
    "rest": ("rest", "rest posture [rad or m]: "),
}


class RobotSource(NamedTuple):
    """The URDF of a robot.

    Attributes:
        urdf: The file.
        reference: How `hand.yaml` refers to it.
        notes: What a conversion from MJCF left out or assumed, in sentences.
        speeds: Top speeds by joint that an MJCF file's actuators tell [rad/s or m/s]; None for a
            URDF, which has its own.
    """

    urdf: Path
    reference: str
    notes: Names = ()
    speeds: Mapping[str, float] | None = None


def open_source(
    robot: Path, folder: Path | None = None, *, overwrite: bool = False
) -> RobotSource:
    """Find the URDF of a robot, and convert an MJCF file to one.

    Args:
        robot: A URDF or MJCF file, `package://PACKAGE/path`, or `robot_descriptions:MODULE`.
        folder: Folder of the `hand.yaml`. The URDF and the meshes of an MJCF file are written
            beside it; into the user's cache if omitted, and `hand.yaml` refers to the MJCF file.
        overwrite: Whether to replace another URDF that is there.

    Raises:
        HandError: If there is no such robot, or it cannot be converted.
        InvalidInputError: If the URDF exists, or cannot be written.
        MissingExtraError: If `robot_descriptions` or a package of an extra is not installed.
        MissingPackageError: If another package is not installed.
    """
    given = str(robot).replace("package:/", "package://", 1).replace(":///", "://")
    source = source_path(given)
    path = source or robot
    named = given if source else str(path)
    if not is_mjcf(path):
        return RobotSource(path, named)
    # MuJoCo takes longer to import than most hands take to load.
    from handmap_qp.hands import mjcf

    if source or not folder:
        converted = mjcf.ConvertedMjcf(path)
        urdf = mjcf.cached_urdf(path, converted)
        return RobotSource(urdf, named, converted.notes, converted.speeds)
    urdf = folder / f"{path.stem}.urdf"
    converted = mjcf.ConvertedMjcf(path, f"{path.stem}_meshes")
    # One that was written before the hand in it was refused may stay.
    if not urdf.is_file() or urdf.read_bytes() != converted.text.encode():
        _check_new(urdf, overwrite=overwrite)
    difference = mjcf.kinematics_difference(converted)
    if not difference < _MOST_DIFFERENCE:
        problem = f"the URDF's kinematics differ from MuJoCo's by {difference:.1e} m"
        raise HandError(f"{problem}: please report it", file=path)
    with writing(urdf, "out"):
        mjcf.write_converted(converted, urdf)
    return RobotSource(urdf, str(urdf), converted.notes, converted.speeds)


def write_hand(detection: Detection, path: Path, by: str = _EDITORS) -> None:
    """Write a `hand.yaml`, which says by which command; a file that is there is replaced.

    Raises:
        InvalidInputError: If it cannot be written.
    """
    _write(path, hand_text(detection, path.parent, by))


def write_robot(name: str, path: Path) -> None:
    """Write a `robot.yaml` of the hands in `left.yaml` and `right.yaml` beside it.

    Raises:
        InvalidInputError: If it cannot be written.
    """
    _write(path, _ROBOT.format(_flow(name)))


def _write(path: Path, text: str) -> None:
    make_folder(path.parent, "out")
    with writing(path, "out"):
        path.write_text(text, encoding="utf-8")


def check_free(path: Path, *, overwrite: bool) -> None:
    """Reject a file that is no YAML, or that exists, unless it may be replaced.

    Args:
        path: The file to write.
        overwrite: Whether to replace it.

    Raises:
        InvalidInputError: If it has another suffix, or exists.
    """
    is_yaml = path.suffix in (".yaml", ".yml")
    expect(is_yaml, "out", "a file that ends in .yaml", value=str(path))
    _check_new(path, overwrite=overwrite)


def _check_new(path: Path, *, overwrite: bool) -> None:
    advice = "overwrite=True, or --overwrite, replaces it"
    check_new("out", path, overwrite=overwrite, advice=advice)


def hand_text(detection: Detection, folder: Path, by: str = _EDITORS) -> str:
    """Return the text of a `hand.yaml`; the URDF's path is relative to `folder`."""
    spec = _beside(detection.spec, folder)
    given = _given(spec)
    document = {key: given[key] for key in _KEYS if key in given}
    document["palm"] = msgspec.structs.asdict(spec.palm)
    if spec.arm:
        document["arm"] = _beside(spec.arm, folder)
    intro = (
        f"{spec.name}: written by {by}. Comments say how each value was "
        "found and how certain it is. Correct what is wrong, then run `handmap hands check`.",
        *(f"Note: {note}" for note in detection.notes),
    )
    lines = [line for note in intro for line in _comment(note, "")]
    return "\n".join([*lines, *_lines(document, "", _comments(detection))]) + "\n"


def _comments(detection: Detection) -> dict[str, str]:
    """Return the comments above keys by their paths: evidence, and each finger's first joint."""
    evidence = {clue.what: f"{clue.how} ({clue.certainty})" for clue in detection.clues}
    found = {
        key: f"{what}{evidence.get(name, 'as given')}"
        for key, (name, what) in FOUND.items()
    }
    above = _ABOVE | found
    for i, point in enumerate(detection.spec.points):
        above[f"points.{i}"] = evidence.get(point.name, "")
    for finger, chain in detection.chains.items():
        moved = (i for i, joint in enumerate(detection.spec.joints) if joint in chain)
        # A fixed jaw has none.
        first = f"joints.{next(moved, '')}"
        above[first] = f"{above[first]} and {finger}" if first in above else finger
    return above


def _lines(values: Any, path: str, above: Mapping[str, str]) -> Iterator[str]:
    """Yield the lines of a mapping, struct or list, with comments by the paths of keys."""
    values = _given(values)
    is_list = isinstance(values, tuple)
    indent = "  " * path.count(".")
    for key, value in enumerate(values) if is_list else values.items():
        at = f"{path}{key}"
        yield from _comment(above.get(at, ""), indent)
        start = f"{indent}-" if is_list else f"{indent}{_flow(key)}:"
        if at in _BLOCKS:
            yield start
            yield from _lines(value, f"{at}.", above)
        else:
            # YAML reads a line break inside a value as a space.
            yield from _wrapped(
                f"{start} {_flow(value)}", subsequent_indent=f"{indent}    "
            )


def _comment(text: str, indent: str) -> list[str]:
    return [f"{indent}# {line}" for line in _wrapped(text)]


def _given(value: Any) -> Any:
    """Return the fields of a struct that differ from their defaults; any other value as it is."""
    if not isinstance(value, msgspec.Struct):
        return value
    return {
        field.name: given
        for field in msgspec.structs.fields(value)
        if (given := getattr(value, field.name)) not in (field.default, {})
    }


def _beside(part: Any, folder: Path) -> Any:
    """Return a hand or an arm whose URDF is given as a file in a folder gives it."""
    urdf = _urdf_reference(part, folder)
    return msgspec.structs.replace(part, urdf=urdf, directory=None)


def _urdf_reference(part: HandSpec | ArmSpec, folder: Path) -> str:
    """Return a URDF's path as written in `folder`: in a package, relative, or absolute."""
    if is_named_source(part.urdf):
        return part.urdf
    file = source_file(part).resolve()
    if inside := file.as_posix().partition("/cmeel.prefix/share/")[2]:
        package, _, path = inside.partition("/")
        try:
            if package_folder(package).resolve() / path == file:
                return f"package://{inside}"
        except (MissingExtraError, MissingPackageError):
            pass
    relative = os.path.relpath(file, folder.resolve())
    return relative if relative.count("..") <= 2 else str(file)


def _flow(value: object) -> str:
    """Return a value as YAML on one line."""
    plain = msgspec.to_builtins(_given(value))
    text = yaml.safe_dump(
        plain, default_flow_style=True, sort_keys=False, allow_unicode=True, width=10**6
    )
    return text.removesuffix("...\n").rstrip("\n")
