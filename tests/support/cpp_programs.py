"""Programs in C++ that test the core without Python, compiled from its headers."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

CORE = Path(__file__).resolve().parents[2] / "core"
"""Its headers need no Python; `tests` has programs that check them."""
# Half the time of -O1 to compile; the programs run for seconds.
_OPTIONS = ["-std=c++17", "-O0", "-g1", "-ffp-contract=off", "-D_GLIBCXX_ASSERTIONS"]


def compiled(source: Path, folder: Path, checks: str = "") -> Path:
    """Compile a program into a folder; skip without GCC, or without its sanitizers.

    Args:
        source: The program.
        folder: Where it goes.
        checks: Sanitizers to build it with, separated by commas.
    """
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("needs g++")
    command: list[str | Path] = [compiler, *_OPTIONS]
    if checks:
        command += [f"-fsanitize={checks}", "-fno-sanitize-recover=all"]
        trial = folder / "trial.cpp"
        trial.write_text("int main() { return 0; }\n")
        linked = subprocess.run([*command, trial, "-o", folder / "trial"], check=False)
        if linked.returncode:
            pytest.skip("needs the sanitizers of g++ (libasan, libubsan)")
    program = folder / source.stem
    subprocess.run(
        [*command, f"-I{CORE / 'include'}", source, "-o", program], check=True
    )
    return program


def run_counted(program: Path, seed: int) -> int:
    """Run a program with a seed; return the count that it prints first.

    Raises:
        AssertionError: With the end of what it printed, if it fails.
    """
    # Another library that a run of tests loads first would hide the sanitizers.
    clean = {n: v for n, v in os.environ.items() if n != "LD_PRELOAD"}
    run = subprocess.run(
        [program, str(seed)], capture_output=True, text=True, check=False, env=clean
    )
    assert run.returncode == 0, run.stdout[-500:] + run.stderr[-3000:]
    return int(run.stdout.split()[0])
