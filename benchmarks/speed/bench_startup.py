"""What is paid once: CPU time of imports and of a recording, memory of an import and of a session.

Every number is that of a fresh process, the least of several. Modules are compiled once before, as
in an installed package. Memory of a session is what `malloc` has handed out, and memory of an
import what the process holds. With `--quick`, one process runs all programs, so that their numbers
mean nothing. With `--compare`, processes of another checkout take turns with these.

    python benchmarks bench_startup
    python benchmarks bench_startup --compare ../another_checkout
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import interleaved

_RECORDING = "quest3_webxr_right"
_CLOCK = """
import ctypes, gc, json, resource, sys, time
def cpu():
    used = resource.getrusage(resource.RUSAGE_SELF)
    return 1e3 * (used.ru_utime + used.ru_stime)
def memory():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e6
def in_use():
    gc.collect()
    names = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"
    fields = [(name, ctypes.c_size_t) for name in names.split()]
    count = ctypes.CDLL("libc.so.6").mallinfo2
    count.restype = type("Counts", (ctypes.Structure,), {"_fields_": fields})
    found = count()
    return (found.uordblks + found.hblkhd) / 1e6
"""
_HANDS = """
import numpy as np
from handmap_qp import HandMapper, HumanLengths, load_hand
lengths = HumanLengths.from_hand_length(0.19)
def session(robot, preset="teleoperation"):
    human = load_hand("human", points="landmarks", lengths=lengths)
    mapper = HandMapper(human, robot, preset)
    mapper.map_step(human.rest, np.eye(4))
    return mapper
def memory_of(preset):
    robot = load_hand("allegro_right")
    kept = [session(robot, preset) for _ in range(count // 4)]
    start = in_use()
    kept += [session(robot, preset) for _ in range(count)]
    return (in_use() - start) / count
"""
PROGRAMS = {
    "import numpy and pinocchio, ms": "import numpy, pinocchio\nresult = cpu()",
    "import handmap_qp, ms": "import handmap_qp\nresult = cpu()",
    "import HandMapper and load_hand, ms": (
        "from handmap_qp import HandMapper, load_hand\nresult = cpu()"
    ),
    "handmap --help, ms": (
        "import contextlib, io\n"
        "from handmap_qp.cli import main\n"
        "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n"
        "    main(['--help'])\n"
        "result = cpu()"
    ),
    "memory of that import, MB": (
        "start = memory()\nfrom handmap_qp import HandMapper, load_hand\nresult = memory() - start"
    ),
    "memory of a session, teleoperation, MB": _HANDS
    + "result = memory_of('teleoperation')",
    "memory of a session, object, MB": _HANDS + "result = memory_of('object')",
    "measuring a person, per sample, us": (
        "from copy import copy\n"
        "from handmap_qp import read_recording\n"
        "from handmap_qp.human.measure import measure_hand\n"
        "recording = read_recording({recording!r})\n"
        "measure_hand(recording)\n"
        "start = cpu()\n"
        "for _ in range(count // 4):\n"
        "    measure_hand(copy(recording))\n"
        "result = 1e3 * (cpu() - start) / (count // 4 * int(recording.valid.sum()))"
    ),
    "reading the hands of a recording, ms": (
        _HANDS + "load_hand('human', points='landmarks')\n"
        "load_hand('allegro_right')\n"
        "start = cpu()\n"
        "for _ in range(count // 2):\n"
        "    load_hand('human', points='landmarks', lengths=lengths)\n"
        "    load_hand('allegro_right')\n"
        "result = (cpu() - start) / (count // 2)"
    ),
    "the first hands and mapper of a process, ms": (
        _HANDS
        + "start = cpu()\nsession(load_hand('allegro_right'))\nresult = cpu() - start"
    ),
    "matching person and robot, ms": (
        _HANDS + "robot = load_hand('allegro_right')\n"
        "session(robot)\n"
        "human = load_hand('human', points='landmarks', lengths=lengths)\n"
        "start = cpu()\n"
        "HandMapper(human, robot, 'teleoperation')\n"
        "result = cpu() - start"
    ),
}
"""Programs by what they measure; each sets `result`, the mean of about `count` repetitions."""


def measure(tree: Path, compiled: Path, *programs: str, count: int = 20) -> list[float]:
    """Run programs in a fresh process with the package of a checkout; return their results.

    Args:
        tree: The checkout.
        compiled: Folder for compiled modules.
        *programs: The programs.
        count: Repetitions, about.
    """
    environment = {
        **os.environ,
        "PYTHONPATH": interleaved.search_path(tree),
        "PYTHONPYCACHEPREFIX": str(compiled),
        "PYTHONDONTWRITEBYTECODE": "",
    }
    if any("in_use" in program for program in programs):
        # Python's own pools would hide what its objects take.
        environment["PYTHONMALLOC"] = "malloc"
    code = "".join(
        f"{_CLOCK}\ncount = {count}\n{program}\nprint(json.dumps(result))\n"
        for program in programs
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tree,  # which comes before PYTHONPATH
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        common.stop(f"{tree}: {done.stderr.strip().splitlines()[-1]}")
    return [json.loads(line) for line in done.stdout.splitlines()]


def measure_all(
    trees: dict[str, Path], recording: Path | None, rounds: int
) -> list[dict[str, Any]]:
    """Measure all programs with all checkouts, in turns.

    Args:
        trees: Checkouts by name.
        recording: The recording to measure a person in; None to leave that out.
        rounds: Processes for each number, of which the least counts, after one that compiles; 0
            for one process in all.

    Returns:
        A row a program.
    """
    programs = {
        what: text.replace("{recording!r}", repr(str(recording)))
        for what, text in PROGRAMS.items()
        if recording is not None or "{recording" not in text
    }
    found: dict[str, dict[str, float]] = {what: {} for what in programs}
    together = [[what] for what in programs] if rounds else [list(programs)]
    count = 20 if rounds else 4
    with (
        common.progress("programs", len(together)) as advance,
        tempfile.TemporaryDirectory() as compiled,
    ):
        for names in together:
            texts = [programs[what] for what in names]
            for k in range(rounds + 1):
                for tree, folder in trees.items():
                    values = measure(folder, Path(compiled), *texts, count=count)
                    if k == 0 and rounds:
                        continue
                    for what, value in zip(names, values, strict=True):
                        found[what][tree] = min(value, found[what].get(tree, value))
            advance()
    rows = []
    for what, least in found.items():
        ratio = {"of other": least["this"] / least["other"]} if "other" in least else {}
        rows.append({"what": what, **least, **ratio})
    return rows


def draw(rows: list[dict[str, Any]]) -> Any:
    """Draw each number as a bar, in its own unit."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 0.4 * len(rows) + 1.0), layout="constrained")
    axes = figure.subplots()
    axes.barh(
        [row["what"] for row in rows],
        [row["this"] for row in rows],
        color=common.PALETTE[1],
    )
    axes.set(title="Paid once", xlabel="in the unit of each row")
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser("CPU time and memory that are paid once.")
    parser.add_argument(
        "--compare",
        metavar="CHECKOUT",
        type=Path,
        help="another checkout, which takes turns",
    )
    arguments = common.parse_arguments(parser, words)
    trees = {"this": common.ROOT}
    if arguments.compare is not None:
        trees["other"] = interleaved.check_tree(arguments.compare)
    file = arguments.recordings / f"{_RECORDING}.npz"
    rows = measure_all(
        trees, file if file.is_file() else None, 0 if arguments.quick else 3
    )
    common.print_table(
        "Paid once: the least of fresh processes",
        rows,
        to_stderr=arguments.json == "-",
        caption=f"load {os.getloadavg()[0]:.1f}",
    )
    common.write_json(arguments.json, "bench_startup", {"rows": rows})
    common.save_picture(arguments.picture, lambda: draw(rows))


if __name__ == "__main__":
    main()
