"""The library in C: its sizes, and CPU time of a sample beside Python, in turns in one run.

The library is compiled as `core/CMakeLists.txt` does it by default, static and shared, and
installed into a folder. A program that is linked with it follows the demo's right hand by
`handmap_follow`; a process of Python follows the same by `Follower.map_sample`. Both take turns.

    python benchmarks bench_library

`median_us` is over all samples and rounds. `worst_us` is the largest, over the samples, of the
least time of each in all rounds: other processes slow a call down and never quicken it.
`difference` is the largest of joints and wrist to those of Python [rad or m]. `--quick` compiles
without optimization, so that its numbers mean nothing.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import interleaved
import numpy as np
from faulty_recordings import DEMO
from interleaved import Worker
from run_cases import mapper_of

from handmap_qp.apps.saving import saved_bytes
from handmap_qp.trackers import write_recordings

HANDS = {
    "allegro_right": "teleoperation",
    "leap_right": "teleoperation",
    "panda_gripper": "picking",
}
"""Hands that follow, with their presets."""
EXAMPLES = common.ROOT / "examples" / "cpp"
_WORKER = Path(__file__).with_name("library_worker.cpp")


def build_library(build: Path, *, is_shared: bool, quick: bool) -> Path:
    """Compile and install the library.

    Args:
        build: Folder of the build. A later run compiles only what changed.
        is_shared: Whether to build a shared library.
        quick: Whether to leave out optimization.

    Returns:
        The file of the library; headers are in `include` beside its folder.
    """
    prefix = build / "installed"
    flags = [f"-DBUILD_SHARED_LIBS={'ON' if is_shared else 'OFF'}"]
    flags += [f"-DCMAKE_INSTALL_PREFIX={prefix}", "-DCMAKE_INSTALL_LIBDIR=lib"]
    if quick:
        flags.append("-DCMAKE_CXX_FLAGS_RELEASE=-O0")
    call("cmake", "-S", common.ROOT / "core", "-B", build, *flags)
    call("cmake", "--build", build)
    call("cmake", "--install", build)
    return prefix / "lib" / ("libhandmap.so" if is_shared else "libhandmap.a")


def build_program(source: Path, library: Path) -> Path:
    """Compile a program, and link it with the installed static library."""
    program = library.parent / source.stem
    folders = [f"-I{library.parents[1] / 'include'}", f"-I{EXAMPLES}"]
    compiler = os.environ.get("CXX", "c++")
    call(compiler, "-std=c++17", "-O2", *folders, source, library, "-o", program)
    return program


def call(*command: str | Path) -> None:
    """Run a program quietly; stop the benchmark with the end of what it says if it fails."""
    # cmake may be that of the environment.
    folders = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    program = shutil.which(command[0], path=folders)
    if program is None:
        common.stop(f"needs {command[0]}")
    done = subprocess.run(
        [program, *command[1:]], capture_output=True, text=True, check=False
    )
    if done.returncode:
        common.stop(f"{command[0]} failed: {(done.stdout + done.stderr)[-1000:]}")


def sizes_of(files: dict[str, Path]) -> list[dict[str, Any]]:
    """Return a row for each file: its size as it is, and without symbols [kB]."""
    rows = []
    for what, file in files.items():
        stripped = file.with_suffix(".stripped")
        call("strip", "--strip-unneeded", "-o", stripped, file)
        whole, least = (1e-3 * each.stat().st_size for each in (file, stripped))
        rows.append({"file": what, "kB": whole, "stripped kB": least})
    return rows


def measure(
    robot: str, worker: Path, samples: Path, count: int, rounds: int
) -> list[dict[str, Any]]:
    """Let both programs follow with one hand, in turns.

    Args:
        robot: One of `HANDS`.
        worker: The program in C++.
        samples: The demo's right hand, as a table.
        count: Number of samples to follow.
        rounds: How often all are followed.

    Returns:
        A row for each program.
    """
    preset = HANDS[robot]
    hand = samples.with_name(f"{robot}.hand")
    content = saved_bytes(mapper_of(robot, preset))
    hand.write_bytes(content)
    script = [sys.executable, str(common.ROOT / "benchmarks"), "follower_worker"]
    commands: dict[str, tuple[list[str], Path | None]] = {
        "handmap_follow": ([str(worker), str(hand), str(samples)], None),
        "Follower.map_sample": ([*script, robot, preset], common.ROOT),
    }
    with (
        interleaved.workers(commands) as working,
        common.progress(robot, interleaved.turns(count, rounds)) as advance,
    ):
        interleaved.take_turns(working, count, rounds, advance)
        return [_row(robot, len(content), each, working[-1]) for each in working]


def _row(robot: str, size: int, worker: Worker, python: Worker) -> dict[str, Any]:
    times = 1e6 * np.reshape(worker.times, (-1, len(worker.q)))
    return {
        "robot": robot,
        "hand kB": 1e-3 * size,
        "program": worker.name,
        "median_us": float(np.median(times)),
        "worst_us": float(times.min(axis=0).max()),
        "difference": interleaved.largest_difference(worker, python),
    }


def draw(rows: Sequence[dict[str, Any]]) -> Any:
    """Draw the median and the worst time of each hand and program."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 0.5 * len(rows) + 1.0), layout="constrained")
    axes = figure.subplots()
    names = [f"{row['robot']}, {row['program']}" for row in rows]
    axes.barh(names, [row["worst_us"] for row in rows], color="#cfd6df", label="worst")
    medians = [row["median_us"] for row in rows]
    axes.barh(names, medians, color=common.PALETTE[1], label="median")
    axes.invert_yaxis()
    axes.set_xlabel("CPU time of a sample [us]")
    axes.legend()
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser("The library in C: sizes, and CPU time of a sample.")
    parser.add_argument(
        "--build",
        metavar="FOLDER",
        type=Path,
        help="folder to compile in, and to keep (default: a temporary one)",
    )
    arguments = common.parse_arguments(parser, words)
    quick = arguments.quick
    with tempfile.TemporaryDirectory() as folder:
        build = (arguments.build or Path(folder)).absolute()
        static, shared = (
            build_library(build / kind, is_shared=kind == "shared", quick=quick)
            for kind in ("static", "shared")
        )
        files = {"static library": static, "shared library": shared.resolve()}
        loop = build_program(EXAMPLES / "01_loop.cpp", static)
        sizes = sizes_of(files | {"01_loop with the static library": loop})
        samples = Path(folder) / "demo.csv"
        write_recordings([DEMO], samples)
        worker = build_program(_WORKER, static)
        count, rounds = (100, 1) if quick else (len(DEMO), 5)
        rows: list[dict[str, Any]] = []
        for robot in HANDS:
            rows += measure(robot, worker, samples, count, rounds)
    to_stderr = arguments.json == "-"
    common.print_table("Sizes", sizes, to_stderr=to_stderr)
    common.print_table("A sample of the demo", rows, to_stderr=to_stderr)
    common.save_picture(arguments.picture, lambda: draw(rows))
    results = {"sizes": sizes, "rows": rows, "samples": count, "rounds": rounds}
    common.write_json(arguments.json, "library", results)


if __name__ == "__main__":
    main()
