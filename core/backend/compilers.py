"""Which C++ compiler builds the core: the machine's own, else that of the `ziglang` package."""

from __future__ import annotations

import os
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

ZIG = "ziglang>=0.13,<1"
"""What a build needs besides where the machine has no C++ compiler: 100 MB."""
ADVICE = (
    "install a C++17 compiler and Python's headers (on Debian and Ubuntu: the packages g++ and "
    "python3-dev), then install again"
)
_NAMES = ("c++", "g++", "clang++")
# For the processor that the system asks for, not the one that compiles; without the checks that Zig
# adds to code that is not optimised.
_ZIG_CXX = "c++ -mcpu=baseline -fno-sanitize=undefined"


def needs_zig() -> bool:
    """Return whether the machine has no C++ compiler, and the user names none by CXX."""
    return not os.environ.get("CXX") and not any(map(shutil.which, _NAMES))


def check_compiler() -> None:
    """End the build with one line if there is no compiler to build with."""
    named = os.environ.get("CXX", "").split()
    if named and shutil.which(named[0]) is None:
        sys.exit(f"handmap_core: CXX names {named[0]}, which is not there; {ADVICE}.")
    if needs_zig() and find_spec("ziglang") is None:
        sys.exit(
            f"handmap_core: no C++ compiler was found, and no package ziglang; {ADVICE}, or: "
            "pip install ziglang"
        )


def use_zig(folder: Path) -> dict[str, str]:
    """Let CMake compile with Zig.

    Args:
        folder: Where the programs that stand for a compiler's are written.

    Returns:
        Definitions for CMake by their names.
    """
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["CXX"] = _script(folder / "zig-c++", _ZIG_CXX)
    return {
        "CMAKE_AR": _script(folder / "zig-ar", "ar"),
        "CMAKE_RANLIB": _script(folder / "zig-ranlib", "ranlib"),
    }


def _script(file: Path, words: str) -> str:
    """Write a program that calls Zig with some words before its own; return its path."""
    file.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ziglang {words} "$@"\n')
    file.chmod(0o755)
    return str(file)
