"""The worst sample: time, QPs and measured distances of every sample of recordings.

Of each sample the least of three runs counts, so that what else the machine does drops out. Times
are CPU time. QPs and distances are counted by the core: they are the same on every machine, and
tests hold their bounds.

Robots with two hands follow both hands of a recording, and one hand beside its mirror image that is
moved until both meet.

    python benchmarks bench_worst
    python benchmarks bench_worst --hands leap_right --robots
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shared_hands

from handmap_core._core import Ik
from handmap_core.hands import Side
from handmap_qp import HandMapper, Recording, read_recording
from handmap_qp.hands.robot import load_robot
from handmap_qp.human import scaled_human
from handmap_qp.mapping.presets import get_preset
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.stream import measure_person

HANDS = ("allegro_right", "leap_right", "shadow_right", "wuji_right", "orca_right")
ROBOTS = ("g1", "tiago_dual", "panda_pair")
SIDES: tuple[Side, Side] = ("left", "right")
_RUNS = 3
# Distance of each hand from the plane in which both are each other's image [m].
_APART = 0.06


class Samples(NamedTuple):
    """What a mapper is given, sample by sample.

    Attributes:
        make: Returns a mapper's core, and what maps a sample by its number.
        count: Number of samples.
    """

    make: Callable[[], tuple[Ik, Callable[[int], object]]]
    count: int


def of_hand(name: str, recording: Recording) -> Samples:
    """Return the samples of a recording, for a hand."""
    robot = shared_hands.load(name)
    lengths = measure_person(recording).lengths
    human = scaled_human(recording, points="landmarks", lengths=lengths)
    kept = recording.part(recording.valid)

    def make() -> tuple[Ik, Callable[[int], object]]:
        mapper = HandMapper(human, robot)

        def map_one(k: int) -> object:
            return mapper.map_landmarks(kept.landmarks[k], time=float(kept.time[k]))

        return mapper.point_ik.core, map_one

    return Samples(make, len(kept))


def of_robot(name: str, hands: dict[Side, Recording]) -> Samples:
    """Return the samples of two recordings, for a robot with two hands."""
    robot = load_robot(name)
    tracked = {
        side: scaled_human(one).with_points("landmarks") for side, one in hands.items()
    }
    preset = get_preset("teleoperation")
    count = min(map(len, hands.values()))
    seen = np.all([one.valid[:count] for one in hands.values()], axis=0)
    samples = np.flatnonzero(seen)
    dt = float(np.median(next(iter(hands.values())).steps))

    def make() -> tuple[Ik, Callable[[int], object]]:
        mapper = RobotMapper(robot, tracked, preset.method, ik=preset.ik)

        def map_one(k: int) -> object:
            at = samples[k]
            both = {side: one.landmarks[at] for side, one in hands.items()}
            return mapper.map_landmarks(both, dt=dt)

        return mapper.point_ik.core, map_one

    return Samples(make, len(samples))


def meeting(recording: Recording) -> dict[Side, Recording]:
    """Return a right hand and its mirror image, which come near each other."""
    found: dict[Side, Recording] = {}
    for side, sign in zip(SIDES, (-1.0, 1.0), strict=True):
        landmarks = recording.landmarks * [sign, 1.0, 1.0] + [sign * _APART, 0.0, 0.0]
        found[side] = replace(
            recording, name=side, side=side, landmarks=landmarks, wrist=None
        )
    return found


def measure(samples: Samples) -> np.ndarray:
    """Return CPU time [us], QPs and distances of each sample but the first, shape (n, 3)."""
    least = np.full((samples.count, 3), np.inf)
    for _ in range(_RUNS):
        core, map_one = samples.make()
        gc.collect()
        gc.disable()
        for k in range(samples.count):
            before = core.costs, core.queries
            started = time.thread_time_ns()
            map_one(k)
            taken = 1e-3 * (time.thread_time_ns() - started)
            now = taken, core.costs - before[0], core.queries - before[1]
            least[k] = np.minimum(least[k], now)
        gc.enable()
    return least[1:]


def row_of(name: str, what: str, found: np.ndarray) -> dict[str, Any]:
    """Return a row of the table."""
    times, qps, distances = found.T
    return {
        "robot": name,
        "recordings": what,
        "samples": len(found),
        "median_us": float(np.median(times)),
        "p99_us": float(np.percentile(times, 99)),
        "worst_us": float(times.max()),
        "QPs": int(qps.max()),
        "distances": int(distances.max()),
    }


def draw(rows: list[dict[str, Any]]) -> Any:
    """Draw median, 99th percentile and worst sample of every hand and robot."""
    from matplotlib.figure import Figure

    names = [f"{row['robot']}, {row['recordings']}" for row in rows][::-1]
    height = 1.0 + 0.4 * len(rows)
    figure = Figure(figsize=(7.0, height), layout="constrained")
    axes = figure.subplots()
    for key, color in (("worst_us", "#e6e9ee"), ("p99_us", "#cfd6df")):
        axes.barh(names, [row[key] for row in rows][::-1], color=color, label=key[:-3])
    medians = [row["median_us"] for row in rows][::-1]
    axes.barh(names, medians, color=common.PALETTE[1], label="median")
    axes.set(xlabel="CPU time of a sample [us]", xscale="log")
    axes.grid(axis="y", visible=False)
    axes.legend(frameon=False)
    return figure


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = common.make_parser("The worst sample of recordings.")
    parser.add_argument("--hands", nargs="*", default=list(HANDS), metavar="HAND")
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS), metavar="ROBOT")
    return parser


def measure_hands(names: Sequence[str], folder: Path, is_quick: bool) -> list[Any]:
    """Return a row for each hand, of all recordings of a right hand."""
    right = [read_recording(file) for file in common.find_recordings(folder)]
    right = [one for one in right if one.side == "right"][: 1 if is_quick else None]
    rows = []
    for name in names:
        found = np.concatenate([measure(of_hand(name, one)) for one in right])
        rows.append(row_of(name, f"{len(right)} of a hand", found))
    return rows


def measure_robots(names: Sequence[str], folder: Path) -> list[Any]:
    """Return two rows for each robot with two hands."""
    both = {side: read_recording(folder / f"quest3_webxr_{side}.npz") for side in SIDES}
    near = meeting(read_recording(folder / "leap_hmd_right.npz"))
    rows = []
    for name in names:
        for what, hands in (("both hands", both), ("hands that meet", near)):
            rows.append(row_of(name, what, measure(of_robot(name, hands))))
    return rows


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    arguments: argparse.Namespace = common.parse_arguments(make_parser(), words)
    is_quick = arguments.quick
    if is_quick:
        arguments.hands, arguments.robots = arguments.hands[:1], []
    rows = measure_hands(arguments.hands, arguments.recordings, is_quick)
    rows += measure_robots(arguments.robots, arguments.recordings)
    to_stderr = arguments.json == "-"
    common.print_table("The worst sample", rows, to_stderr=to_stderr)
    common.save_picture(arguments.picture, lambda: draw(rows))
    common.write_json(arguments.json, "bench_worst", {"rows": rows})


if __name__ == "__main__":
    main()
