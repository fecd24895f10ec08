"""The library cross-compiled for aarch64 commands as that of this machine does."""

from __future__ import annotations

import csv
import shutil
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from library_in_c import EXAMPLES, ROOT, built_examples, run

from handmap_qp.trackers import read_recording, write_recordings

# Another compilation of the library, and an emulator.
pytestmark = [pytest.mark.slow, pytest.mark.full]
COMPILER, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"


def test_an_emulated_aarch64_commands_the_same(
    prefix: Path, saved: bytes, tmp_path: Path
) -> None:
    for program in (COMPILER, EMULATOR):
        if shutil.which(program) is None:
            pytest.skip(f"needs {program}")
    hand, samples = tmp_path / "allegro.hand", tmp_path / "demo.csv"
    hand.write_bytes(saved)
    write_recordings([read_recording("demo", "right")], samples)
    # Static, so that the emulator needs no system of aarch64; -O1 takes less time to compile.
    words = ["-std=c++17", "-O1", "-static", "-ffp-contract=off"]
    words += ["-Wall", "-Wextra", "-Werror"]
    words += [
        f"-I{ROOT / 'core' / 'include'}",
        f'-DHANDMAP_VERSION="{version("handmap-core")}"',
    ]
    sources = [ROOT / "core" / "library" / "handmap.cpp", EXAMPLES / "01_loop.cpp"]
    emulated = tmp_path / "01_loop"
    run(COMPILER, *words, *sources, "-o", emulated)
    native = built_examples(prefix, tmp_path) / "01_loop"
    printed = (run(native, hand, samples), run(EMULATOR, emulated, hand, samples))
    (header, *here), (other, *there) = (
        list(csv.reader(text.splitlines())) for text in printed
    )
    assert header == other
    # Rules and holds.
    assert [row[1:3] for row in here] == [row[1:3] for row in there]
    numbers = [
        np.array([row[:1] + row[3:] for row in rows], float) for rows in (here, there)
    ]
    difference = float(np.abs(numbers[0] - numbers[1]).max())
    print(f"largest difference of times and joints: {difference:.3g}")
    assert difference <= 1e-9
