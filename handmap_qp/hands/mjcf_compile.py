"""Compile MJCF files, and guess the unit of angles where none is stated: `compile_mjcf`."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import NamedTuple

import mujoco

from handmap_qp.errors import HandError
from handmap_qp.hands.sources import root_tag

# A range of this size in radians is one of pi in degrees [rad].
_SMALL_RANGE = 0.06
# The unit of angles, Euler angles, and included files in an MJCF; larger angles are in degrees.
_UNIT = re.compile(r"""<compiler\b[^>]*\bangle\s*=""")
_ANGLES = re.compile(r"""\beuler\s*=\s*["']([^"']*)["']""")
_NUMBER = re.compile(r"[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?")
_INCLUDE = re.compile(r"""<include\b[^>]*\bfile\s*=\s*["']([^"']*)["']""")
_LARGE_ANGLE = 2.0 * math.pi + 0.01


class CompiledMjcf(NamedTuple):
    """A compiled MJCF file.

    Attributes:
        model: The model.
        name: Its name; the file's stem if it has none.
        notes: Assumptions, one sentence each.
    """

    model: mujoco.MjModel
    name: str
    notes: list[str]


def compile_mjcf(file: Path) -> CompiledMjcf:
    """Compile an MJCF file, keeping bodies without joints and shapes that only show.

    MuJoCo's default unit of angles is the degree. Parts of robots that other files include often
    rely on their `compiler` element for radians: where no file states a unit, and every hinge would
    move by a few degrees at most, angles are taken as radians.

    Raises:
        HandError: If MuJoCo cannot compile it, in its words, or a name is not UTF-8.
    """
    try:
        content = file.read_bytes()
    except OSError as error:
        raise HandError(
            f"cannot be read: {error.strerror or error}", file=file
        ) from error
    if root_tag(content) == "mujocoinclude":
        problem = (
            "is a part that other MJCF files include: give the file that includes it"
        )
        raise HandError(problem, file=file)
    try:
        spec = mujoco.MjSpec.from_file(str(file))
        spec.compiler.fusestatic = False
        spec.compiler.discardvisual = False
        model, notes = spec.compile(), []
        widest = _widest_range(model)
        if widest < _SMALL_RANGE and not _states_angles(file):
            notes.append(
                f"the file states no unit of angles, and ranges of at most "
                f"{math.degrees(widest):.2g} deg make no sense: taken as radians"
            )
            spec.compiler.degree = False
            model = spec.compile()
        # Bindings decode names only when they are asked for them.
        bytes(model.names).decode()
    except UnicodeDecodeError as error:
        raise HandError("a word in the MJCF is not UTF-8", file=file) from error
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise HandError(
            f"MuJoCo cannot compile the MJCF: {reason}", file=file
        ) from error
    named = spec.modelname and spec.modelname != "MuJoCo Model"
    return CompiledMjcf(model, spec.modelname if named else file.stem, notes)


def small_range_notes(model: mujoco.MjModel) -> list[str]:
    """Return a note if all hinges have a range so small that radians were read as degrees."""
    if (widest := _widest_range(model)) > _SMALL_RANGE:
        return []
    return [
        f"no hinge has a range of more than {math.degrees(widest):.2g} deg: if the file "
        'means radians, write <compiler angle="radian"/> into it'
    ]


def _widest_range(model: mujoco.MjModel) -> float:
    """Return the widest range of a hinge [rad]; infinity if no hinge has one."""
    is_hinge = model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)
    low, high = model.jnt_range[is_hinge & (model.jnt_limited != 0)].T
    return float((high - low).max()) if len(low) else math.inf


def _states_angles(file: Path, seen: frozenset[Path] = frozenset()) -> bool:
    """Return whether a file, or one that it includes, states a unit or contains large angles."""
    if file in seen or not file.is_file():
        return False
    text = file.read_bytes().decode("utf-8", "replace")
    angles = (
        float(n) for words in _ANGLES.findall(text) for n in _NUMBER.findall(words)
    )
    if _UNIT.search(text) or any(abs(angle) > _LARGE_ANGLE for angle in angles):
        return True
    parts = (file.parent / name for name in _INCLUDE.findall(text))
    return any(_states_angles(part, seen | {file}) for part in parts)
