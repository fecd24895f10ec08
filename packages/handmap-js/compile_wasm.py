"""Compile the library in C to `dist/handmap.wasm`, for browsers and Node.

python packages/handmap-js/compile_wasm.py [FILE.wasm]

It takes Emscripten (`emcc`, 3.1.6 or later: `apt install emscripten`). Exceptions are those of
WebAssembly, which Chrome 95, Firefox 100, Safari 15.2 and Node 18 have.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

_FOLDER = Path(__file__).resolve().parent
_CORE = _FOLDER.parents[1] / "core"
_HEADER = _CORE / "include" / "handmap" / "handmap.h"


def exported() -> list[str]:
    """Return the functions of the header, and those of memory."""
    declared = re.findall(r"\b(handmap_\w+)\(", _HEADER.read_text())
    return ["malloc", "free", *sorted(set(declared))]


def version() -> str:
    """Return the version of the core."""
    project = (_CORE / "pyproject.toml").read_text()
    found = re.search(r'^version = "(.+)"', project, re.MULTILINE)
    assert found
    return found[1]


def compile_wasm(target: Path) -> None:
    """Compile the library into a file.

    Raises:
        SystemExit: Without Emscripten, or if it fails.
    """
    compiler = shutil.which("emcc")
    if compiler is None:
        sys.exit(
            "handmap-js: emcc is missing; install Emscripten: apt install emscripten"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    functions = ",".join(f"_{name}" for name in exported())
    command: list[str | Path] = [
        compiler,
        _CORE / "library" / "handmap.cpp",
        f"-I{_CORE / 'include'}",
        f'-DHANDMAP_VERSION="{version()}"',
        "-std=c++17",
        "-O3",
        # As native code rounds.
        "-ffp-contract=off",
        "-fwasm-exceptions",
        "-sSTANDALONE_WASM=1",
        "--no-entry",
        "-sALLOW_MEMORY_GROWTH=1",
        f"-sEXPORTED_FUNCTIONS={functions}",
        "-o",
        target,
    ]
    done = subprocess.run(command, check=False)
    if done.returncode:
        sys.exit("handmap-js: emcc failed")
    print(f"{target}: {target.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    compile_wasm(
        Path(sys.argv[1]) if sys.argv[1:] else _FOLDER / "dist" / "handmap.wasm"
    )
