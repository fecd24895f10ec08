"""The parts of the core that need no Python, with hostile numbers, under the sanitizers.

Compiling them takes half a minute, so `make full` does it, and `make sanitize`, which so runs the
tests of the whole core.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.full

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = Path(__file__).with_name("sanitized.cpp")
CHECKS = "address,undefined,float-cast-overflow"
# Half the time of -O1 to compile; the program runs for seconds.
OPTIONS = ["-std=c++17", "-O0", "-g1", "-ffp-contract=off", "-D_GLIBCXX_ASSERTIONS"]


def built(folder: Path) -> Path:
    """Compile the program; skip without GCC and its sanitizers."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("needs g++")
    trial = folder / "trial.cpp"
    trial.write_text("int main() { return 0; }\n")
    checks = [f"-fsanitize={CHECKS}", "-fno-sanitize-recover=all"]
    program = folder / "sanitized"
    command = [compiler, *OPTIONS, *checks]
    if subprocess.run([*command, trial, "-o", program], check=False).returncode:
        pytest.skip("needs the sanitizers of g++ (libasan, libubsan)")
    sources = f"-I{ROOT / 'handmap_qp/core'}"
    subprocess.run([*command, sources, PROGRAM, "-o", program], check=True)
    return program


def test_hostile_numbers_read_and_write_only_what_is_theirs(tmp_path: Path) -> None:
    program = built(tmp_path)
    # Another library that a run of tests loads first would hide the sanitizers.
    clean = {n: v for n, v in os.environ.items() if n != "LD_PRELOAD"}
    for seed in ("1", "2"):
        run = subprocess.run(
            [program, seed], capture_output=True, text=True, check=False, env=clean
        )
        assert run.returncode == 0, run.stdout[-500:] + run.stderr[-3000:]
        calls = int(run.stdout.split()[0])
        assert calls > 10_000
