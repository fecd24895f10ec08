"""Recognise and compile MJCF files: `is_mjcf`, `compile_mjcf`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from handmap_qp.errors import HandError

_ROOT = re.compile(rb"<\s*([A-Za-z_][\w.:-]*)")
# A comment may come first and hold an example; the root is searched behind it.
_NOT_ELEMENTS = re.compile(rb"<!--.*?-->|<\?.*?\?>|<!DOCTYPE[^>]*>", re.DOTALL)


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


def compile_mjcf(file: Path) -> tuple[Any, str]:
    """Compile an MJCF file, keeping bodies without joints and shapes that only show.

    Args:
        file: The file.

    Returns:
        `mujoco.MjModel`, and the model's name; the file's stem if it has none.

    Raises:
        HandError: If MuJoCo cannot compile it, in its words.
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
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise HandError(f"MuJoCo cannot compile the MJCF: {reason}", file=file) from error
    named = spec.modelname and spec.modelname != "MuJoCo Model"
    return model, spec.modelname if named else file.stem
