"""Blocks of memory that a warm sample takes from the heap: each may wait for other threads.

The library in C takes none (tests/cpp/test_warm_samples.py). In Python, it is memory for what a
step says, and for the pose of the sample.

A library that is preloaded counts them. Small objects of Python do not count: they are in memory of
its own. Nor do small arrays, whose memory numpy keeps.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

# A compiler, and a process of its own.
pytestmark = pytest.mark.slow

SOURCE = Path(__file__).resolve().parents[2] / "core" / "tests" / "heap_count.cpp"
MOST = {"mapped": 2, "followed": 2, "read": 0}
"""Most blocks of a sample: `map_landmarks`, `Follower.map_sample`, and what is read of a step."""
PROGRAM = """
import ctypes, json, sys
from handmap_qp import Follower, HandMapper, load_hand, read_recording

library = ctypes.CDLL(sys.argv[1])
library.blocks_taken.restype = ctypes.c_long

def blocks(work):
    before = library.blocks_taken()
    result = work()
    return library.blocks_taken() - before, result

recording = read_recording("demo", "right")
human, robot = load_hand("human", points="landmarks"), load_hand("allegro_right")
mapper, follower = HandMapper(human, robot), Follower(HandMapper(human, robot))
counts = {"mapped": [], "followed": [], "read": []}
for sample in [each for each in recording if each.valid][:200]:
    mapped, _ = blocks(lambda: mapper.map_landmarks(sample.landmarks, dt=1 / 60))
    followed, step = blocks(lambda: follower.map_sample(sample))
    read, _ = blocks(lambda: (step.command, step.status, step.stages.summary))
    for name, count in zip(counts, (mapped, followed, read), strict=True):
        counts[name].append(count)
# The first samples fill what the next ones use.
print(json.dumps({name: max(each[20:]) for name, each in counts.items()}))
"""


def test_a_warm_sample_takes_few_blocks_of_memory(tmp_path: Path) -> None:
    compiler = shutil.which("g++")
    if compiler is None or platform.libc_ver()[0] != "glibc":
        pytest.skip("needs g++ and glibc")
    library = tmp_path / "heap_count.so"
    command = [compiler, "-std=c++17", "-O1", "-shared", "-fPIC", SOURCE]
    subprocess.run([*command, "-o", library], check=True)
    found = subprocess.run(
        [sys.executable, "-c", PROGRAM, library],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"LD_PRELOAD": str(library)},
    )
    counts = json.loads(found.stdout)
    assert counts.keys() == MOST.keys()
    assert all(counts[name] <= most for name, most in MOST.items()), counts
    # It counts: a sample of Python alone would take none.
    assert counts["mapped"] > 0
