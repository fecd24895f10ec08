"""The compiled core (`core/src`, C++): loaded once, or one error that says what is wrong."""

import importlib
import zlib
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

_FOLDER = Path(__file__).parents[1]
"""In a checkout, the folder of the distribution, which has the sources."""


def fingerprint() -> str:
    """Return a fingerprint of the core's sources; empty in a wheel, which has none."""
    headers = sorted((_FOLDER / "include" / "handmap").glob("*.hpp"))
    sources = sorted((_FOLDER / "src").glob("*.[ch]pp"))
    content = b"".join(file.read_bytes() for file in headers + sources)
    return f"{zlib.crc32(content):08x}" if content else ""


def load_core() -> ModuleType:
    """Load the compiled module.

    Raises:
        MissingCoreError: If it is missing, cannot be loaded, or is older than its sources.
    """
    # Not above: a build runs this file by itself, before anything else can be imported.
    from handmap_core.errors import MapperBusyError, MissingCoreError

    try:
        module = importlib.import_module("handmap_core._core")
    except ImportError as error:
        problem = f"cannot be loaded ({error})"
        raise MissingCoreError(problem, command=_installing()) from error
    if fingerprint() not in ("", module.SOURCES):
        raise MissingCoreError("is older than its sources", command=_installing())
    module.raise_if_busy(MapperBusyError)
    return module


def _installing() -> str:
    """Return the command that installs the package again, with its core."""
    if (_FOLDER / "pyproject.toml").is_file():
        return f"pip install --no-deps --editable {_FOLDER}"
    return "pip install --no-deps --force-reinstall handmap-core"


if TYPE_CHECKING:
    from handmap_core import _core as core
else:
    # None where a build runs this file by itself, for `fingerprint`.
    core = load_core() if __package__ else None


def without_core(of: object) -> dict[str, object]:
    """Return the attributes of an object but those of the core, which a copy makes again."""
    made = core.TargetMap, core.PalmMap, core.PairBounds, core.PointDistances
    return {
        name: value for name, value in vars(of).items() if not isinstance(value, made)
    }
