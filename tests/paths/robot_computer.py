"""A robot's computer: `handmap-core` alone follows saved hands as the library does.

Prints sizes, times and the largest difference of commands, and takes commands of a service; with
numpy 1.26 and the newest, on every supported Python that uv finds.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from paths.fresh import ROOT, Fresh, build, find_uv, run, stop
from run_cases import ALONE, difference

NUMPY = ("numpy==1.26.4", "numpy")
MOST = 1e-9
"""Largest difference of commands that are the same [rad or m]."""
PYTHONS = ("3.11", "3.12", "3.13")
_CASES = """
import sys
from pathlib import Path

sys.path[:0] = sys.argv[2:]
import run_cases

run_cases.write_all(Path(sys.argv[1]))
"""
_IMPORT = """
import time

started = time.process_time()
import numpy

print(time.process_time() - started)
import handmap_core.run

print(time.process_time() - started)
"""
_NAMES = """
import ast
import re
from operator import attrgetter
from pathlib import Path

import handmap_core
import numpy

for file in Path(handmap_core.__file__).parent.rglob("*.py"):
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute):
            if found := re.fullmatch(r"np\\.([\\w.]+)", ast.unparse(node)):
                attrgetter(found[1])(numpy)
"""
"""Ends with an error at a name that this numpy does not have, in whatever function it is."""
PARTS = ("handmap_core", "numpy")
"""What the environment is measured by."""
UNNEEDED = ("mink", "yourdfpy", "osqp", "proxsuite", "qpsolvers")
"""What is installed for other formulations, solvers and formats."""


def wheel_for(python: str, folder: Path) -> Path:
    """Return the core's wheel for an interpreter, built into a folder."""
    build(ROOT / "core", folder, python)
    (wheel,) = folder.glob("*.whl")
    return wheel


def find_pythons() -> list[str]:
    """Return the interpreters that are here, of those that are supported."""
    found = []
    for version in PYTHONS:
        words = [find_uv(), "python", "find", "--no-project", "--system", version]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode:
            print(f"           LEFT OUT: Python {version}: not installed")
        else:
            found.append(done.stdout.strip())
    return found


def size_of(folder: Path) -> float:
    """Return the size of the files in a folder [MB]."""
    return (
        sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6
    )


def compare(cases: Path) -> tuple[list[float], list[float]]:
    """Return how far commands are from those of the library, of each case.

    Those that rounding decides, in the library as well, come second; they say the same.
    """
    same, decided = [], []
    for file in sorted(cases.glob("*.hand")):
        columns = []
        for end in (".out.npz", ".expected.npz"):
            with np.load(file.with_suffix(end)) as archive:
                columns.append(dict(archive))
        found, own = difference(*columns), float(columns[1]["own"])
        is_decided = own > MOST
        if found > (np.finfo(float).max if is_decided else MOST):
            stop(f"the core alone commands something else: {file.stem}, {found:.1e}")
        (decided if is_decided else same).append(found)
    return same, decided


def try_alone(wheel: Path, python: str, numpy: str, cases: Path) -> str:
    """Follow all cases in a fresh environment, compare, and return its Python."""
    environment = wheel.parent / f"with {numpy}"
    run([find_uv(), "venv", "--quiet", "--python", python, str(environment)])
    own = str(environment / "bin" / "python")
    words = [find_uv(), "pip", "install", "--quiet", "--python", own]
    run([*words, f"{wheel}[client]", numpy])
    packages = next(environment.glob("lib/python3*/site-packages"))
    sizes = {name: size_of(packages / name) for name in PARTS}
    sizes["numpy"] += size_of(packages / "numpy.libs")
    # Before its bytecode is written.
    size = size_of(packages)
    variables = {"PATH": os.environ["PATH"], "OMP_NUM_THREADS": "1"}
    found = json.loads(run([own, str(ALONE), str(cases)], env=variables))
    run([own, "-c", _NAMES], env=variables)
    tried = [run([own, "-c", _IMPORT], env=variables).split() for _ in range(9)]
    own_numpy, everything = (
        1e3 * min(map(float, each)) for each in zip(*tried, strict=True)
    )
    print(
        f"           Python {found['python']}, numpy {found['numpy']}: "
        f"{size:.1f} MB, of which numpy {sizes['numpy']:.1f}, handmap_core "
        f"{sizes['handmap_core']:.1f}; its wheel {wheel.stat().st_size / 1e6:.2f} MB\n"
        f"           import {everything:.0f} ms of CPU (best of 9), of which numpy "
        f"{own_numpy:.0f}"
    )
    for kind, times in found["times"].items():
        load_s, sample_us = map(statistics.median, zip(*times, strict=True))
        print(
            f"           a {kind}: load {1e3 * load_s:.0f} ms, a sample {sample_us:.0f} us"
        )
    same, decided = compare(cases)
    print(
        f"           {len(same)} cases: commands differ by {max(same):.1e} at most; in "
        f"{len(decided)} that rounding decides, by {max(decided, default=0.0):.1e}",
        flush=True,
    )
    return own


def follow_service(path: Fresh, own: str) -> None:
    """Take commands of a service by the client of the core."""
    with path.serving() as ports:
        to = f"127.0.0.1:{ports['requests']}"
        replay = ("track", "replay", "demo", "--loop", "--to", to)
        with path.running(*replay, "--robot", "three_finger", "--session", "lab"):
            path.watch(ports, "lab", own)


def leave_out(path: Fresh) -> None:
    """Remove what mapping does without, print its sizes, and map."""
    code = (ROOT / "tests" / "paths" / "needed.py").read_text(encoding="utf-8")
    sizes, unneeded, everything = json.loads(path.python(code, "handmap-qp", *UNNEEDED))
    for name, own in sizes.items():
        parts = sorted(own.items(), key=lambda item: -item[1])[:5]
        largest = ", ".join(f"{part} {size:.0f}" for part, size in parts)
        path.note(f"{name} brings {sum(own.values()):.0f} MB: {largest}")
    most = sum(everything.values())
    path.note(f"not needed to map: {sum(unneeded.values()):.0f} MB of {most:.0f}")
    path.uninstall(*unneeded)
    path.handmap("map", "demo", "--robot", "three_finger")


def main() -> None:
    """Save hands by the library, and follow them by the core alone."""
    with (
        tempfile.TemporaryDirectory() as scratch,
        Fresh("A robot's computer", "robots", "service") as path,
    ):
        folder = Path(scratch)
        cases = folder / "cases"
        cases.mkdir()
        path.handmap("hands", "save", "three_finger")
        path.handmap("hands", "save", "three_finger", "--check")
        with path.step(
            "follow recordings with every hand and robot by the library, and save them"
        ):
            shared = os.environ.get("HANDMAP_RECORDINGS", "")
            code = f"import os\nos.environ['HANDMAP_RECORDINGS'] = {shared!r}\n{_CASES}"
            path.python(code, str(cases), str(ROOT / "tests" / "support"))
        for k, python in enumerate(find_pythons()):
            wheel = wheel_for(python, folder / f"{k}")
            for numpy in NUMPY:
                with path.step(f"follow them with {numpy} by the core alone"):
                    own = try_alone(wheel, python, numpy, cases)
                follow_service(path, own)
        # Last: the service needs some of it.
        leave_out(path)


if __name__ == "__main__":
    main()
