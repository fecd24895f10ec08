"""The build backend: scikit-build-core, told which compiler to take and where to compile.

An editable install puts the library beside the package's files, a wheel has it inside. Where the
machine has no C++ compiler, that of the package `ziglang` compiles (`compilers`), and a build asks
for that package. A line for each compiled file is printed, which pip shows with -v only; what it
does and what came of it is told on the terminal, too.

The core is compiled in `build` of the source, so that the next build compiles only what changed, or
in a temporary folder if the source cannot be written.
"""

from __future__ import annotations

import fcntl
import importlib.util
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

from compilers import ADVICE, ZIG, check_compiler, needs_zig, use_zig
from scikit_build_core import build
from scikit_build_core.build import (
    build_sdist,
    get_requires_for_build_sdist,
    prepare_metadata_for_build_wheel,
)
from terminal import tell

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

Settings: TypeAlias = "dict[str, str | list[str]]"

_ROOT = Path(__file__).parents[1]
_PACKAGE = _ROOT / "handmap_core"
_BUILD = _ROOT / "build"
# The wheel of an editable install leads to the checkout, and has nothing compiled.
_EDITABLE: Settings = {
    "editable.mode": "inplace",
    "wheel.cmake": "false",
    "wheel.py-api": "py3",
}


def get_requires_for_build_wheel(config_settings: Settings | None = None) -> list[str]:
    """Return what a build of the wheel needs besides what pyproject.toml names (PEP 517)."""
    needed = build.get_requires_for_build_wheel(config_settings)
    return [*needed, ZIG] if needs_zig() else needed


def get_requires_for_build_editable(
    config_settings: Settings | None = None,
) -> list[str]:
    """Return the same for an editable install (PEP 660)."""
    return get_requires_for_build_wheel(config_settings)


def prepare_metadata_for_build_editable(
    metadata_directory: str, config_settings: Settings | None = None
) -> str:
    """Write the metadata of an editable install; return the folder's name (PEP 660)."""
    settings = (config_settings or {}) | _EDITABLE
    return build.prepare_metadata_for_build_editable(metadata_directory, settings)


def build_wheel(
    wheel_directory: str,
    config_settings: Settings | None = None,
    metadata_directory: str | None = None,
) -> str:
    """Compile the core into a wheel; return the wheel's name (PEP 517)."""
    check_compiler()
    tell("handmap_core: compiling the core, which takes a minute or two")
    started = time.perf_counter()
    with _alone(), tempfile.TemporaryDirectory() as programs:
        settings = _compiling(Path(programs)) | (config_settings or {})
        try:
            name = build.build_wheel(wheel_directory, settings, metadata_directory)
        except SystemExit as error:
            sys.exit(f"handmap_core: compiling the core failed ({error}); {ADVICE}.")
    tell(f"Compiled the core in {time.perf_counter() - started:.0f} s.")
    return name


def build_editable(
    wheel_directory: str,
    config_settings: Settings | None = None,
    metadata_directory: str | None = None,
) -> str:
    """Compile the core into the checkout; return the name of a wheel that leads there (PEP 660)."""
    with tempfile.TemporaryDirectory() as folder:
        wheel = zipfile.ZipFile(Path(folder, build_wheel(folder, config_settings)))
        for stale in _PACKAGE.glob("_core.*.so"):
            stale.unlink()
        for name in wheel.namelist():
            if name.startswith("handmap_core/_core.") and name.endswith(".so"):
                wheel.extract(name, _ROOT)
    settings = (config_settings or {}) | _EDITABLE
    return build.build_editable(wheel_directory, settings, metadata_directory)


def _compiling(programs: Path) -> Settings:
    """Return scikit-build-core's settings for this machine.

    Args:
        programs: Where programs go that stand for a compiler's.
    """
    settings: Settings = {"cmake.define.HANDMAP_SOURCES": _fingerprint()}
    if _is_writable(_BUILD):
        settings["build-dir"] = f"{_BUILD}/{{wheel_tag}}"
    if needs_zig():
        tell("No C++ compiler was found: that of the package ziglang compiles.")
        for name, value in use_zig(programs).items():
            settings[f"cmake.define.{name}"] = value
    return settings


def _is_writable(folder: Path) -> bool:
    """Return whether files can be made in a folder, which is made if it can be.

    Permissions do not tell: the source may be mounted read-only, or root may build it.
    """
    try:
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


@contextmanager
def _alone() -> Iterator[None]:
    """Wait for other builds in the folder; where it cannot be written, each build has its own."""
    if not _is_writable(_BUILD):
        yield
        return
    with (_BUILD / "core.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _fingerprint() -> str:
    """Return the fingerprint of the sources, by the package's own function."""
    spec = importlib.util.spec_from_file_location("core", _PACKAGE / "core.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.fingerprint()
