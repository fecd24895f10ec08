"""The compiled core (`handmap_qp/core`, C++): loaded once, or one error that says what is wrong."""

import importlib
import zlib
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING


def fingerprint() -> str:
    """Return a fingerprint of the core's sources; empty in a wheel, which has none."""
    sources = Path(__file__).parents[1] / "core"
    files = sorted(sources.glob("*.[ch]pp"))
    content = b"".join(file.read_bytes() for file in files)
    return f"{zlib.crc32(content):08x}" if content else ""


def load_core() -> ModuleType:
    """Load the compiled module.

    Raises:
        MissingCoreError: If it is missing, cannot be loaded, or is older than its sources.
    """
    # Not above: a build runs this file by itself, before anything else can be imported.
    from handmap_qp.errors import MapperBusyError, MissingCoreError

    try:
        module = importlib.import_module("handmap_qp._core")
    except ImportError as error:
        problem = f"cannot be loaded ({error})"
        raise MissingCoreError(problem, command=_installing()) from error
    if fingerprint() not in ("", module.SOURCES):
        raise MissingCoreError("is older than its sources", command=_installing())
    module.raise_if_busy(MapperBusyError)
    return module


def _installing() -> str:
    """Return the command that installs the package again, with its core."""
    checkout = Path(__file__).parents[2]
    if (checkout / "pyproject.toml").is_file():
        return f"pip install --no-deps --editable {checkout}"
    package = __name__.partition(".")[0].replace("_", "-")
    return f"pip install --no-deps --force-reinstall {package}"


if TYPE_CHECKING:
    from handmap_qp import _core as core
else:
    # None where a build runs this file by itself, for `fingerprint`.
    core = load_core() if __package__ else None
