"""What is paid once: CPU time of imports and of a recording, memory of an import and of a session.

Every number is that of a fresh process, the least of several; with `--quick`, one process runs all
programs, so that their numbers mean nothing. With `--compare`, processes of
another checkout take turns with these.

    python benchmarks/bench_startup.py
    python benchmarks/bench_startup.py --compare ../another_checkout
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import interleaved

_RECORDING = "quest3_webxr_right"
_CLOCK = """
import json, resource, sys, time
def cpu():
    used = resource.getrusage(resource.RUSAGE_SELF)
    return 1e3 * (used.ru_utime + used.ru_stime)
def memory():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e6
"""
_HANDS = """
from handmap_qp import HandMapper, HumanLengths, load_hand
lengths = HumanLengths.from_hand_length(0.19)
def session(robot):
    human = load_hand("human", points="landmarks", lengths=lengths)
    mapper = HandMapper(human, robot, "teleoperation")
    mapper.map_step(human.rest, human.frame_pose("wrist", human.rest))
    return mapper
"""
PROGRAMS = {
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
    "memory of one more session, MB": (
        _HANDS + "robot = load_hand('allegro_right')\n"
        "kept = [session(robot) for _ in range(count // 4)]\n"
        "start = memory()\n"
        "kept += [session(robot) for _ in range(count)]\n"
        "result = (memory() - start) / count"
    ),
    "measuring a person, per sample, us": (
        "from handmap_qp import read_recording\n"
        "from handmap_qp.trackers.landmarks import measure_hand\n"
        "recording = read_recording({recording!r})\n"
        "measure_hand(recording)\n"
        "start = cpu()\n"
        "for _ in range(count // 4):\n"
        "    measure_hand(recording)\n"
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


def measure(tree: Path, *programs: str, count: int = 20) -> list[float]:
    """Run programs in a fresh process with the package of a checkout; return their results."""
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    code = "".join(
        f"{_CLOCK}\ncount = {count}\n{program}\nprint(json.dumps(result))\n" for program in programs
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
        rounds: Processes for each number, of which the least counts; 0 for one process in all.

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
    with common.progress("programs", len(together)) as advance:
        for names in together:
            texts = [programs[what] for what in names]
            for _ in range(max(rounds, 1)):
                for tree, folder in trees.items():
                    for what, value in zip(
                        names, measure(folder, *texts, count=20 if rounds else 4), strict=True
                    ):
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
    axes.barh([row["what"] for row in rows], [row["this"] for row in rows], color=common.PALETTE[1])
    axes.set(title="Paid once", xlabel="in the unit of each row")
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser("CPU time and memory that are paid once.")
    parser.add_argument(
        "--compare", metavar="CHECKOUT", type=Path, help="another checkout, which takes turns"
    )
    arguments = common.parse_arguments(parser, words)
    trees = {"this": common.ROOT}
    if arguments.compare is not None:
        trees["other"] = interleaved.check_tree(arguments.compare)
    file = arguments.recordings / f"{_RECORDING}.npz"
    rows = measure_all(trees, file if file.is_file() else None, 0 if arguments.quick else 3)
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
