"""Recognise and compile MJCF files: `is_mjcf`, `compile_mjcf`."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, NamedTuple

from handmap_qp.errors import HandError

_ROOT = re.compile(rb"<\s*([A-Za-z_][\w.:-]*)")
# A comment may come first and hold an example; the root is searched behind it.
_NOT_ELEMENTS = re.compile(rb"<!--.*?-->|<\?.*?\?>|<!DOCTYPE[^>]*>", re.DOTALL)
SMALL_RANGE = 0.06
"""A range of this size in radians is one of pi in degrees [rad]."""
# The unit of angles, Euler angles, and included files in an MJCF; larger angles are in degrees.
_UNIT = re.compile(r"""<compiler\b[^>]*\bangle\s*=""")
_ANGLES = re.compile(r"""\beuler\s*=\s*["']([^"']*)["']""")
_NUMBER = re.compile(r"[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?")
_INCLUDE = re.compile(r"""<include\b[^>]*\bfile\s*=\s*["']([^"']*)["']""")
_LARGE_ANGLE = 2.0 * math.pi + 0.01


def root_tag(content: bytes) -> str:
    """Return the name of an XML text's root element; empty if there is none.

    Args:
        content: The bytes of the file, in UTF-8, UTF-16 or an encoding that contains ASCII.
    """
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        content = content.decode("utf-16", "replace").encode()
    found = _ROOT.search(_NOT_ELEMENTS.sub(b"", content))
    return "" if found is None else found[1].decode("ascii", "replace")


def is_mjcf(file: Path) -> bool:
    """Return whether a file is an MJCF model; False if it cannot be read."""
    try:
        return root_tag(file.read_bytes()) in ("mujoco", "mujocoinclude")
    except (OSError, ValueError):  # ValueError: a null character in the path
        return False


class CompiledMjcf(NamedTuple):
    """A compiled MJCF file.

    Attributes:
        model: `mujoco.MjModel`.
        name: Its name; the file's stem if it has none.
        notes: Assumptions, one sentence each.
    """

    model: Any
    name: str
    notes: tuple[str, ...] = ()


def compile_mjcf(file: Path) -> CompiledMjcf:
    """Compile an MJCF file, keeping bodies without joints and shapes that only show.

    MuJoCo's default unit of angles is the degree. Parts of robots that other files include often
    rely on their `compiler` element for radians: where no file states a unit, and every hinge would
    move by a few degrees at most, angles are taken as radians.

    Args:
        file: The file.

    Returns:
        The model, its name, and a note if the unit of angles was assumed.

    Raises:
        HandError: If MuJoCo cannot compile it, in its words, or a name is not UTF-8.
    """
    import mujoco

    try:
        content = file.read_bytes()
    except OSError as error:
        raise HandError(f"cannot be read: {error.strerror or error}", file=file) from error
    if root_tag(content) == "mujocoinclude":
        problem = "is a part that other MJCF files include: give the file that includes it"
        raise HandError(problem, file=file)
    try:
        spec = mujoco.MjSpec.from_file(str(file))
        spec.compiler.fusestatic = False
        spec.compiler.discardvisual = False
        model = spec.compile()
        notes: tuple[str, ...] = ()
        if widest_range(model) < SMALL_RANGE and not _states_angles(file):
            notes = (
                f"the file states no unit of angles, and ranges of at most "
                f"{math.degrees(widest_range(model)):.2g} deg make no sense: taken as radians",
            )
            spec.compiler.degree = False
            model = spec.compile()
        # Bindings decode names only when they are asked for them.
        bytes(model.names).decode()
    except UnicodeDecodeError as error:
        raise HandError("a word in the MJCF is not UTF-8", file=file) from error
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise HandError(f"MuJoCo cannot compile the MJCF: {reason}", file=file) from error
    named = spec.modelname and spec.modelname != "MuJoCo Model"
    return CompiledMjcf(model, spec.modelname if named else file.stem, notes)


def widest_range(model: Any) -> float:
    """Return the widest range of a hinge [rad]; infinity if no hinge has one."""
    import mujoco

    is_hinge = model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)
    hinges = is_hinge & (model.jnt_limited != 0)
    widths = model.jnt_range[hinges, 1] - model.jnt_range[hinges, 0]
    return float(widths.max()) if len(widths) else math.inf


def _states_angles(file: Path, seen: frozenset[Path] = frozenset()) -> bool:
    """Return whether a file, or one that it includes, states a unit or contains large angles."""
    if file in seen or not file.is_file():
        return False
    text = file.read_bytes().decode("utf-8", "replace")
    if _UNIT.search(text) or any(
        max((abs(float(number)) for number in _NUMBER.findall(angles)), default=0.0) > _LARGE_ANGLE
        for angles in _ANGLES.findall(text)
    ):
        return True
    parts = (file.parent / name for name in _INCLUDE.findall(text))
    return any(_states_angles(part, seen | {file}) for part in parts)
