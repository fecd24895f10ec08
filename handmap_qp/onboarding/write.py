"""Write a `hand.yaml` with comments that explain each key and how its value was found."""

from __future__ import annotations

import json
import os
from pathlib import Path

from handmap_qp.errors import InvalidInputError, MissingExtraError, MissingPackageError
from handmap_qp.hands.spec import HandSpec, LimitSpec, PointSpec
from handmap_qp.hands.urdf.sources import is_named_source, package_folder
from handmap_qp.onboarding.anatomy import Clue
from handmap_qp.onboarding.detect import Detection
from handmap_qp.output_files import make_folder, writing

_WIDTH = 120


def write_hand(detection: Detection, path: Path, *, overwrite: bool = False) -> None:
    """Write a `hand.yaml`.

    Args:
        detection: What was found.
        path: The file; its folder is made if it does not exist.
        overwrite: Whether to replace an existing file.

    Raises:
        InvalidInputError: If the file exists, or cannot be written.
    """
    check_free(path, overwrite=overwrite)
    make_folder(path.parent, "--out")
    with writing(path, "--out"):
        path.write_text(hand_text(detection, path.parent), encoding="utf-8")


def check_free(path: Path, *, overwrite: bool) -> None:
    """Reject a file that is no YAML, or that exists, unless it may be replaced.

    Args:
        path: The file to write.
        overwrite: Whether to replace it.

    Raises:
        InvalidInputError: If it has another suffix, or exists.
    """
    if path.suffix not in (".yaml", ".yml"):
        raise InvalidInputError(
            argument="--out", expected="a file that ends in .yaml", value=str(path)
        )
    if path.exists() and not overwrite:
        raise InvalidInputError(
            argument="--out",
            problem=f"{path} exists already",
            value=str(path),
            advice="give --overwrite to replace it",
        )


def hand_text(detection: Detection, folder: Path) -> str:
    """Return the text of a `hand.yaml`; the URDF's path is relative to `folder`."""
    spec = detection.spec
    clues = {clue.what: clue for clue in detection.clues}
    lines = [
        f"# {spec.name}: written by `handmap hands init`. Comments say how each value was found",
        "# and how certain it is. Correct what is wrong, then run `handmap hands check`.",
        *(f"# Note: {line}" for note in detection.notes for line in _wrapped(note)),
        f"name: {_quoted(spec.name)}",
        f"urdf: {_quoted(_urdf_reference(spec.urdf, folder))}",
    ]
    if spec.root is not None:
        lines += [
            "# The hand starts at this link; the rest of the robot is ignored.",
            f"root: {_quoted(spec.root)}",
        ]
    lines += [*_comment(clues["side"]), f"side: {spec.side}"]
    lines += _palm(spec, clues)
    lines += _wrist(spec)
    lines += _joints(detection)
    lines += _rest(spec, clues["rest"])
    if spec.locked:
        lines += ["# Locked joints and their positions [rad or m].", "locked:"]
        lines += [f"  {_quoted(joint)}: {_number(value)}" for joint, value in spec.locked.items()]
    if spec.limits:
        lines += [
            "# Assumed limits that the URDF lacks; give the true values [rad or m, and per s].",
            "limits:",
        ]
        lines += [f"  {_quoted(joint)}: {_limit(limit)}" for joint, limit in spec.limits.items()]
    if spec.mimic:
        lines += [
            "# Joints that mimic a joint outside this part of the robot: treated as independent.",
            "mimic:",
        ]
        lines += [f"  {_quoted(joint)}: null" for joint in spec.mimic]
    lines += _points(spec, clues)
    if spec.collision is not None:
        lines += [
            "# Links that self-collision avoidance keeps apart: thumb and fingers, thumb and palm,",
            "# and neighbouring fingers.",
            "collision:",
            f"  margin: {_number(spec.collision.margin)}  # m",
            "  pairs:",
            *(f"    - [{_quoted(one)}, {_quoted(other)}]" for one, other in spec.collision.pairs),
        ]
    return "\n".join(lines) + "\n"


def _palm(spec: HandSpec, clues: dict[str, Clue]) -> list[str]:
    palm = spec.palm
    return [
        *_comment(clues["palm"], "the palm"),
        "palm:",
        f"  link: {_quoted(palm.link)}",
        *_comment(clues["palm origin"], "origin, at the wrist [m]", "  "),
        f"  xyz: {_vector(palm.xyz)}",
        *_comment(clues["distal"], "distal, the direction of the straight fingers", "  "),
        f"  distal: {_vector(palm.distal)}",
        *_comment(clues["dorsal"], "dorsal, out of the back of the hand", "  "),
        f"  dorsal: {_vector(palm.dorsal)}",
    ]


def _wrist(spec: HandSpec) -> list[str]:
    wrist = spec.wrist
    how = (
        "six free coordinates"
        if wrist.mount == "floating"
        else "to the world, or to an arm among the joints below"
    )
    lines = ["wrist:", f"  link: {_quoted(wrist.link)}", f"  mount: {wrist.mount}  # {how}"]
    if wrist.mount == "floating":
        lines += [
            f"  max_linear_speed: {_number(wrist.max_linear_speed)}  # m/s",
            f"  max_angular_speed: {_number(wrist.max_angular_speed)}  # rad/s",
        ]
    return lines


def _joints(detection: Detection) -> list[str]:
    """Return the joints; the first joint of each finger has its name as a comment."""
    spec, lines = (
        detection.spec,
        ["# Active joints, in the order of every q; mimic joints are not among them.", "joints:"],
    )
    said = ""
    for joint in spec.joints:
        owners = [finger for finger, chain in detection.chains.items() if joint in chain]
        owner = (
            "all fingers"
            if len(owners) == len(detection.chains) > 1
            else " and ".join(owners) or "arm"
        )
        lines.append(f"  - {_quoted(joint)}" + (f"  # {owner}" if owner != said else ""))
        said = owner
    return lines


def _rest(spec: HandSpec, clue: Clue) -> list[str]:
    return [
        *_comment(clue, "rest posture [rad or m]"),
        "rest:",
        *(f"  {_quoted(joint)}: {_number(spec.rest[joint])}" for joint in spec.joints),
    ]


def _points(spec: HandSpec, clues: dict[str, Clue]) -> list[str]:
    lines = [
        "# Reference points on links [m]; `partner` names the corresponding human point.",
        "points:",
    ]
    for point in spec.points:
        if point.name in clues:
            lines += _comment(clues[point.name], "", "  ")
        lines.append(f"  - {_point(point)}")
    lines.append("sets:")
    for name, members in spec.sets.items():
        rows = _wrapped(f"[{', '.join(members)}]")
        lines += (
            [f"  {name}: {rows[0]}"]
            if len(rows) == 1
            else [f"  {name}:", *(f"    {row}" for row in rows)]
        )
    lines.append(f"reference: {spec.reference}")
    return lines


def _comment(clue: Clue, what: str = "", indent: str = "") -> list[str]:
    text = f"{what + ': ' if what else ''}{clue.how} ({clue.certainty})"
    return [f"{indent}# {line}" for line in _wrapped(text)]


def _wrapped(text: str) -> list[str]:
    lines, line = [], ""
    for word in text.split():
        if line and len(line) + len(word) + 1 > _WIDTH:
            lines.append(line)
            line = word
        else:
            line = f"{line} {word}".strip()
    return [*lines, line]


def _urdf_reference(urdf: str, folder: Path) -> str:
    """Return a URDF's path as written in `folder`: in a package, relative, or absolute."""
    if is_named_source(urdf):
        return urdf
    file = Path(urdf).resolve()
    parts = file.parts
    if "cmeel.prefix" in parts:
        inside = parts[parts.index("cmeel.prefix") + 2 :]
        try:
            if package_folder(inside[0]).resolve().joinpath(*inside[1:]) == file:
                return f"package://{'/'.join(inside)}"
        except (MissingExtraError, MissingPackageError):
            pass
    relative = os.path.relpath(file, folder.resolve())
    return relative if relative.count("..") <= 2 else str(file)


def _point(point: PointSpec) -> str:
    fields = [f"name: {point.name}", f"link: {_quoted(point.link)}"]
    if any(point.xyz):
        fields.append(f"xyz: {_vector(point.xyz)}")
    if point.finger:
        fields.append(f"finger: {point.finger}")
    if point.partner:
        fields.append(f"partner: {point.partner}")
    if point.pad is not None:
        radius, xyz = _number(point.pad.radius), _vector(point.pad.xyz)
        fields.append(f"pad: {{radius: {radius}, xyz: {xyz}}}")
    return "{" + ", ".join(fields) + "}"


def _limit(limit: LimitSpec) -> str:
    given = ((key, getattr(limit, key)) for key in ("lower", "upper", "velocity"))
    return (
        "{"
        + ", ".join(f"{key}: {_number(value)}" for key, value in given if value is not None)
        + "}"
    )


def _vector(values: tuple[float, float, float]) -> str:
    return "[" + ", ".join(_number(value) for value in values) + "]"


def _number(value: float) -> str:
    """Return all digits, never as `1e-05`, which YAML 1.1 reads as text."""
    text = repr(float(value))
    return text if "e" not in text else f"{value:.12f}".rstrip("0")


def _quoted(text: str) -> str:
    """Return a YAML string, quoted if YAML would read it as another type."""
    plain = text.replace("_", "").replace(".", "").replace("/", "").replace("-", "")
    is_plain = (
        plain.isalnum()
        and text[0].isalpha()
        and text.lower() not in ("yes", "no", "on", "off", "true", "false", "null", "y", "n")
    )
    is_path = is_named_source(text) or text.startswith(("../", "./"))
    return text if is_plain or is_path else json.dumps(text)
