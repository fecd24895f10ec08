"""hatchling's hook that compiles the core (`handmap_qp/core`) by scikit-build-core.

An editable install puts the library into the checkout, a wheel has it inside. Where the machine has
no C++ compiler, that of the package `ziglang` compiles. A line for each compiled file is printed,
which pip shows with -v only; what it does and what came of it is told on the terminal, too.

The core is compiled in `build/core` of the source, so that the next build compiles only what
changed, or in a temporary folder if the source cannot be written.
"""

from __future__ import annotations

import fcntl
import importlib.util
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from compilers import ADVICE, check_compiler, needs_zig, use_zig
from scikit_build_core.errors import FailedLiveProcessError
from scikit_build_core.hatch.plugin import ScikitBuildHook
from terminal import tell


class Compile(ScikitBuildHook):
    """Compile the core."""

    @property
    def config(self) -> dict[str, Any]:
        """Options of scikit-build-core beside those of its own table."""
        if not _is_writable(Path(self.root, "build")):
            return {"experimental": True}
        return {"experimental": True, "build-dir": "build/core/{wheel_tag}"}

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile into the wheel, or into the checkout for an editable install."""
        if self.target_name != "wheel":
            return
        package = Path(self.root, "handmap_qp")
        if version == "editable":
            for stale in package.glob("_core.*"):
                # The stub is a source.
                if stale.suffix != ".pyi":
                    stale.unlink()
        check_compiler()
        tell("handmap_qp: compiling the core, which takes a minute or two")
        before = dict(build_data)
        started = time.perf_counter()
        with (
            _alone(Path(self.root, "build")),
            tempfile.TemporaryDirectory() as programs,
        ):
            defined = [f"HANDMAP_SOURCES={_fingerprint(package)}"]
            if needs_zig():
                tell("No C++ compiler was found: that of the package ziglang compiles.")
                defined += use_zig(Path(programs))
            os.environ["SKBUILD_CMAKE_DEFINE"] = ";".join(defined)
            try:
                super().initialize("standard", build_data)
            except (FailedLiveProcessError, SystemExit) as error:
                sys.exit(f"handmap_qp: compiling the core failed ({error}); {ADVICE}.")
        tell(f"Compiled the core in {time.perf_counter() - started:.0f} s.")
        if version == "editable":
            for source in list(build_data["force_include"]):
                for library in Path(source).rglob("_core*.so"):
                    shutil.copy2(library, package)
            build_data.clear()
            build_data.update(before)


def get_build_hook() -> type[Compile]:
    """Tell hatchling which of the hooks in this file to take."""
    return Compile


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
def _alone(folder: Path) -> Iterator[None]:
    """Wait for other builds in a folder; where it cannot be written, each build has its own."""
    if not _is_writable(folder):
        yield
        return
    with (folder / "core.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _fingerprint(package: Path) -> str:
    """Return the fingerprint of the sources, by the package's own function."""
    spec = importlib.util.spec_from_file_location("core", package / "ik" / "core.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.fingerprint()
