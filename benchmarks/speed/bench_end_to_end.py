"""Landmarks in, robot command out: CPU time of a sample, beside dexi-rs and dex-retargeting.

All programs map the same landmarks, in turns. Ours are whole calls of `HandMapper.map_landmarks`,
with every preset that the hand can be mapped with; `teleoperation` has its pinch and contact rows.
A peer's time is that of its own `retarget` alone. What its examples compute before that, the hand's
frame in numpy, is the column `frame_us`. `least_us` leaves out what other processes cost: it is the
median over the samples of the least time of each in all rounds. Reading the joints of our command
is part of the time.

    make peers
    python benchmarks bench_end_to_end
    python benchmarks bench_end_to_end --compare ../another_checkout --no-peers

`teleoperation:free` has no contact rows, `teleoperation:guard` goes through the follower's guard.
With `--compare`, the same presets of another checkout take turns with these, and the last column
says by how much the robot's joints and wrist differ at most [rad or m]. All use one matched
posture. `teleoperation, other, shifted` is the other checkout against itself with its landmarks
moved by 1e-15 m: so much do contact rows magnify rounding.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import interleaved
import numpy as np
import shared_hands
from interleaved import Worker
from peers import build

from handmap_qp import HandmapError

ROBOTS = {
    "allegro_right": "allegro_hand_right",
    "leap_right": "leap_hand_right",
    "svh_right": "schunk_svh_hand_right",
    "shadow_right": "shadow_hand_right",
    "inspire_right": "inspire_hand_right",
    "ability_right": "ability_hand_right",
}
"""Hands with four and five fingers, and their names in the peers' configurations."""
PRESETS = (
    "teleoperation",
    "teleoperation:guard",
    "teleoperation:free",
    "object",
    "paper",
)
"""Our presets; `:free` is without contact rows, `:guard` is `Follower.map_sample`."""
PEERS = (
    ("dexi-rs", "vector"),
    ("dexi-rs", "dexpilot"),
    ("dex-retargeting", "vector"),
    ("dex-retargeting", "dexpilot"),
)
"""Peers and their methods."""
_SHIFTED = "teleoperation, other, shifted"
_RECORDINGS = ("quest3_webxr_right", "leap_pinch_move_right")
"""Free motion, and constant pinching."""


def measure(
    robot: str,
    file: Path,
    samples: int,
    rounds: int,
    *,
    other: Path | None,
    has_peers: bool,
    only: Sequence[str] | None = None,
) -> list[dict[str, Any]]:
    """Time all programs on one robot.

    Args:
        robot: One of `ROBOTS`.
        file: Inputs of `interleaved.write_inputs`.
        samples: Their number.
        rounds: How often all samples are mapped.
        other: Another checkout to compare with.
        has_peers: Whether to run the peers.
        only: Names of the programs to run; all if omitted.

    Returns:
        A row a program.
    """
    commands: dict[str, tuple[list[str], Path | None]] = {}
    for preset in PRESETS:
        command = interleaved.tree_command(file, robot, preset, "map_landmarks")
        commands[preset] = (command, common.ROOT)
        if other is not None:
            commands[f"{preset}, other"] = (command, other)
    if other is not None:
        command = interleaved.tree_command(
            file, robot, "teleoperation:shifted", "map_landmarks"
        )
        commands[_SHIFTED] = (command, other)
    for peer, method in PEERS if has_peers else ():
        command = interleaved.peer_command(file, peer, method, ROBOTS[robot])
        commands[f"{peer} {method}"] = (command, None)
    if only:
        commands = {name: one for name, one in commands.items() if name in only}
    with (
        interleaved.workers(commands) as working,
        common.progress(robot, interleaved.turns(samples, rounds)) as advance,
    ):
        interleaved.take_turns(working, samples, rounds, advance)
        return [_row(worker, working) for worker in working]


def _row(worker: Worker, working: Sequence[Worker]) -> dict[str, Any]:
    """Return a program's numbers, as shares of those of dexi-rs vector where it took part."""
    numbers = worker.numbers()
    by_name = {each.name: each for each in working}
    row: dict[str, Any] = {
        "program": worker.name,
        "median_us": numbers["median_us"],
        "p99_us": numbers["p99_us"],
        "least_us": numbers["least_us"],
        "iterations": numbers.get("iterations", ""),
    }
    frames = worker.extra.get("frame_ns")
    row["frame_us"] = 1e-3 * float(np.median(frames)) if frames else ""
    if dexi := by_name.get("dexi-rs vector"):
        theirs = dexi.numbers()
        row["of dexi"] = numbers["median_us"] / theirs["median_us"]
        row["of dexi p99"] = numbers["p99_us"] / theirs["p99_us"]
        row["of dexi least"] = numbers["least_us"] / theirs["least_us"]
    if _SHIFTED in by_name:
        plain = "teleoperation" if worker.name == _SHIFTED else worker.name
        other = by_name.get(f"{plain}, other")
        before = other.numbers() if other else None
        row["of other"] = numbers["median_us"] / before["median_us"] if before else ""
        row["of other p99"] = numbers["p99_us"] / before["p99_us"] if before else ""
        row["of other least"] = (
            numbers["least_us"] / before["least_us"] if before else ""
        )
        row["difference"] = (
            interleaved.largest_difference(worker, other) if other else ""
        )
    return row


def _is_there(robot: str) -> bool:
    """Return whether a hand can be loaded; say on stderr what it needs if not."""
    try:
        shared_hands.load(robot)
    except (HandmapError, FileNotFoundError) as error:
        print(f"without {robot}: {error}", file=sys.stderr)
        return False
    return True


def draw(results: dict[str, list[dict[str, Any]]]) -> Any:
    """Draw median and 99th percentile of every program, a panel a robot."""
    from matplotlib.figure import Figure

    columns = min(len(results), 3)
    lines = -(-len(results) // columns)
    figure = Figure(figsize=(4.0 * columns, 3.4 * lines), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in panels[len(results) :]:
        axes.set_axis_off()
    for axes, (robot, rows) in zip(panels, results.items(), strict=False):
        names = [row["program"] for row in rows][::-1]
        axes.barh(
            names, [row["p99_us"] for row in rows][::-1], color="#cfd6df", label="p99"
        )
        axes.barh(
            names,
            [row["median_us"] for row in rows][::-1],
            color=common.PALETTE[1],
            label="median",
        )
        axes.set(title=robot, xlabel="CPU time of a sample [us]", xscale="log")
        axes.grid(axis="y", visible=False)
    panels[0].legend(loc="lower right")
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser(
        "Landmarks in, robot command out: CPU time of a sample."
    )
    parser.add_argument(
        "--compare",
        metavar="CHECKOUT",
        type=Path,
        help="another checkout, which takes turns",
    )
    parser.add_argument("--no-peers", action="store_true", help="run no peers")
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="PROGRAM",
        help="run these presets and peers alone, such as 'dexi-rs vector'",
    )
    parser.add_argument(
        "--robots", nargs="+", choices=list(ROBOTS), default=list(ROBOTS)
    )
    parser.add_argument(
        "--names",
        nargs="+",
        default=list(_RECORDINGS),
        metavar="RECORDING",
        help="recordings of right hands (default: %(default)s)",
    )
    arguments = common.parse_arguments(parser, words)
    other = (
        None if arguments.compare is None else interleaved.check_tree(arguments.compare)
    )
    missing = [] if arguments.no_peers else build.missing_peers()
    if missing:
        print(
            f"without {', '.join(missing)}: not built, run make peers", file=sys.stderr
        )
    robots = [name for name in arguments.robots if _is_there(name)]
    files = {file.stem: file for file in common.find_recordings(arguments.recordings)}
    for name in arguments.names:
        if name not in files:
            common.stop(f"--names {name}: expected one of {', '.join(files)}")
    results: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "samples.npz"
        cases = [(robot, name) for robot in robots for name in arguments.names]
        for robot, name in cases[: 1 if arguments.quick else None]:
            samples = interleaved.write_inputs(
                files[name], robot, file, points="landmarks", quick=arguments.quick
            )
            rows = measure(
                robot,
                file,
                samples,
                2 if arguments.quick else 5,
                other=other,
                has_peers=not (arguments.no_peers or missing),
                only=arguments.only,
            )
            results[f"{robot}, {name}"] = rows
            caption = f"{samples} samples of {name}, load {os.getloadavg()[0]:.1f}"
            common.print_table(
                f"Landmarks to {robot}, CPU time of a sample",
                rows,
                to_stderr=arguments.json == "-",
                caption=caption,
            )
    common.write_json(arguments.json, "bench_end_to_end", {"robots": results})
    common.save_picture(arguments.picture, lambda: draw(results))


if __name__ == "__main__":
    main()
