"""The library in WebAssembly: compiled once for its sources, and kept in `build`."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "packages" / "handmap-js"


def compiled_library() -> Path:
    """Return `handmap.wasm` of today's sources; skip without Emscripten."""
    if shutil.which("emcc") is None:
        pytest.skip("needs Emscripten: apt install emscripten")
    sources = [
        PACKAGE / "compile_wasm.py",
        ROOT / "core" / "library" / "handmap.cpp",
        *sorted((ROOT / "core" / "include" / "handmap").iterdir()),
    ]
    content = zlib.crc32(b"".join(source.read_bytes() for source in sources))
    target = ROOT / "build" / "wasm" / f"handmap-{content:08x}.wasm"
    if not target.is_file():
        part = target.with_suffix(f".{content:x}.part.wasm")
        program = [sys.executable, PACKAGE / "compile_wasm.py", part]
        done = subprocess.run(program, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        part.replace(target)
    return target
