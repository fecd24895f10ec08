"""Profile `map_step` over a recording, by function, with cProfile.

    python benchmarks profile_step --robot three_finger --sort cumtime --lines 40

The profiler slows short functions most. Use the profile for calls and counts, and `bench_step.py`
for times.
"""

from __future__ import annotations

import cProfile
import pstats
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import common
import synthetic

from handmap_qp import HandMapper, MappingOptions, load_hand


def costliest(statistics: pstats.Stats, steps: int, count: int) -> list[dict[str, Any]]:
    """Return the functions with the largest own time, per step [us]."""
    rows = [
        {
            "function": f"{name} ({Path(file).name}:{line})" if line else name,
            "calls": calls / steps,
            "own_us": 1e6 * own / steps,
        }
        for (file, line, name), (_, calls, own, _, _) in statistics.stats.items()  # ty: ignore[missing-attribute]
    ]
    return sorted(rows, key=lambda row: -row["own_us"])[:count]  # ty: ignore[unsupported-operator]


def draw(functions: list[dict[str, Any]]) -> Any:
    """Draw the own time of each function as a bar."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 0.3 * len(functions) + 1.0), layout="constrained")
    axes = figure.subplots()
    axes.barh(
        [row["function"] for row in functions],
        [row["own_us"] for row in functions],
        color=common.PALETTE[1],
    )
    axes.set(
        title="Own time of functions in a step, slowed by the profiler",
        xlabel="us per step",
    )
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the profiler and print its result."""
    parser = common.make_parser("Profile map_step over a recording.")
    parser.add_argument(
        "--robot",
        default="allegro_right",
        help="robot hand: a name or the path of a hand.yaml",
    )
    parser.add_argument(
        "--sort",
        default="tottime",
        choices=("tottime", "cumtime", "ncalls"),
        help="column to sort by",
    )
    parser.add_argument("--lines", type=int, default=25, help="functions to print")
    parser.add_argument(
        "--save", metavar="FILE", help="write the profile for a viewer such as snakeviz"
    )
    arguments = common.parse_arguments(parser, words)
    motion = synthetic.motion_or_synergies(arguments.recordings, "quest3_webxr_right")
    if arguments.quick:
        motion = synthetic.shortened(motion, 60)
    mapper = HandMapper(motion.human, load_hand(arguments.robot), MappingOptions())
    mapper.map_step(motion.q[0], motion.wrist[0])
    profile = cProfile.Profile()
    profile.enable()
    for i in range(len(motion.time)):
        mapper.map_step(motion.q[i], motion.wrist[i], dt=motion.dt[i])
    profile.disable()
    statistics = pstats.Stats(
        profile, stream=sys.stderr if arguments.json == "-" else sys.stdout
    )
    statistics.strip_dirs().sort_stats(arguments.sort).print_stats(arguments.lines)
    functions = costliest(statistics, len(motion.time), arguments.lines)
    common.write_json(
        arguments.json,
        "profile_step",
        {"steps": len(motion.time), "functions": functions},
    )
    common.save_picture(arguments.picture, lambda: draw(functions))
    if arguments.save:
        statistics.dump_stats(arguments.save)


if __name__ == "__main__":
    main()
