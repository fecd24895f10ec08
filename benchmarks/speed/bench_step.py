"""CPU time of one `map_step`: per hand, by part, and its growth with the size of the problem.

Times are CPU times of one thread. The ratio to one `pin.computeJointJacobians` on the same robot in
the same run hardly depends on the machine. The motion is a headset recording, mapped with
`MappingOptions()` (the paper's choices); without recordings, it is the human hand moving along its
synergies. Parts and growth are measured on the Allegro hand with a floating wrist (22 variables).

    python benchmarks bench_step --picture step.png
    python benchmarks bench_step --compare ../another_checkout

With `--compare`, every hand is mapped by both checkouts in turns (`interleaved.py`), and the last
columns are the ratio of the medians, that of the 99th percentiles, and the largest difference of
joints and wrists [rad or m].

Parts are those of the published method in Python (`handmap_qp.reference`), mostly calls into numpy,
Pinocchio and DAQP.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import interleaved
import numpy as np
import pinocchio as pin
import shared_hands
import synthetic

from handmap_qp import (
    AttachedPoints,
    HandMapper,
    IkOptions,
    MappingOptions,
    MissingExtraError,
    PointDistances,
    PublishedMethod,
    load_hand,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs, all_pairs
from handmap_qp.human import HumanMotion
from handmap_qp.ik.qp import PointIk
from handmap_qp.reference import inverse_kinematics, targets

RECORDING = "quest3_webxr_right"
POINT_COUNTS = (3, 4, 6, 10, 20, 35, 50)
FINGER_COUNTS = (2, 3, 4, 5, 6, 8, 10)
PAIR_COUNTS = (0, 1, 2, 4, 8, 16)
CONTACT_COUNTS = (0, 10, 20, 40, 80, 160)
ROBOTS = (
    "allegro_right",
    "three_finger",
    "leap_right",
    "svh_right",
    "romeo_right",
    "g1_right",
)
"""Hands in the table of ratios; the first is the one that is measured by part."""


def measure_step(
    mapper: HandMapper, motion: HumanMotion, rounds: int
) -> dict[str, Any]:
    """Time whole steps over a motion, interleaved with batches of the robot's Jacobian.

    Args:
        mapper: The mapper.
        motion: The motion; all samples must be valid.
        rounds: How often to map the motion.

    Returns:
        Median and 99th percentile [us], and their ratios to one `pin.computeJointJacobians`.
    """
    jacobian, steps = [], []
    data, q = (
        mapper.robot.model.createData(),
        mapper.robot.configuration_vector(mapper.robot.rest),
    )
    jacobi = partial(pin.computeJointJacobians, mapper.robot.model, data, q)
    for _ in range(rounds):
        mapper.reset()
        mapper.map_step(motion.q[0], motion.wrist[0])
        for i in range(len(motion.time)):
            if i % 25 == 0:
                jacobian.append(common.mean_cpu_time(jacobi, 20))
            started = time.thread_time_ns()
            mapper.map_step(motion.q[i], motion.wrist[i], dt=motion.dt[i])
            steps.append(1e-9 * (time.thread_time_ns() - started))
    one, median, p99 = np.median(jacobian), np.median(steps), np.percentile(steps, 99)
    return {
        "step_us": 1e6 * median,
        "p99_us": 1e6 * p99,
        "ratio": median / one,
        "ratio_p99": p99 / one,
    }


class Stopwatches:
    """Own times of nested functions: the time inside a wrapped callee is not the caller's."""

    def __init__(self) -> None:
        self.sums: dict[str, float] = {}
        self._open: list[float] = []

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function wrapped so that its own time is added up under a name."""
        self.sums.setdefault(name, 0.0)

        def timed(*arguments: Any, **keywords: Any) -> Any:
            self._open.append(0.0)
            started = time.thread_time_ns()
            result = function(*arguments, **keywords)
            spent = 1e-9 * (time.thread_time_ns() - started)
            self.sums[name] += spent - self._open.pop()
            if self._open:
                self._open[-1] += spent
            return result

        return timed


def measure_parts(mapper: HandMapper, motion: HumanMotion) -> dict[str, float]:
    """Mean CPU time of each part of a step [us], less the measured cost of the wrapper.

    It is that of the published method: a step in the core has no parts that could be timed.
    """
    watches = Stopwatches()
    mapper.reset()
    mapper.map_step(motion.q[0], motion.wrist[0])
    ik, counted = mapper.point_ik, mapper.source.target_map
    solver = ik.reference
    assert solver
    wrapped = [
        (mapper.source.joints, "read", "human FK"),
        (targets, "estimate", "estimation"),
        (targets, "polar", "decomposition"),
        (counted, "targets", "targets"),
        (ik.gate, "bounds", "limits"),
        (ik.gate, "admit", "gate"),
        (solver.configuration, "point_jacobian", "Jacobians"),
        (inverse_kinematics, "direct_cost", "assembly"),
        (solver, "solver", "solve"),
        (solver.configuration, "place", "integrate and place"),
        (ik, "solve", "iteration and result"),
    ]
    originals = [(owner, name, getattr(owner, name)) for owner, name, _ in wrapped]
    calls = dict.fromkeys((part for _, _, part in wrapped), 0)
    for owner, name, part in wrapped:
        setattr(
            owner, name, _counted(calls, part, watches.wrap(part, getattr(owner, name)))
        )
    whole = watches.wrap("the rest", mapper.map_step)
    try:
        for i in range(len(motion.time)):
            whole(motion.q[i], motion.wrist[i], dt=motion.dt[i])
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original)
    empty = watches.wrap("empty", lambda: None)
    for _ in range(2000):
        empty()
    cost = watches.sums.pop("empty") / 2000
    count = len(motion.time)
    return {
        part: 1e6 * max(0.0, spent - cost * calls.get(part, count)) / count
        for part, spent in watches.sums.items()
    }


def _counted(
    calls: dict[str, int], part: str, function: Callable[..., Any]
) -> Callable[..., Any]:
    def counted(*arguments: Any, **keywords: Any) -> Any:
        calls[part] += 1
        return function(*arguments, **keywords)

    return counted


def measure_growth(
    motion: HumanMotion, hands: Sequence[tuple[int, Hand]], what: str
) -> list[dict[str, float]]:
    """Median step over a motion for each robot of a sequence of growing ones.

    Args:
        motion: The motion.
        hands: Sizes and robots.
        what: Name of the size.

    Returns:
        One row per robot: size, variables, median step [us], ratio to one Jacobian.
    """
    rows = []
    for size, robot in hands:
        result = measure_step(
            HandMapper(motion.human, robot, MappingOptions()), motion, 1
        )
        rows.append({what: size, "variables": robot.model.nv, **result})
    return rows


def measure_pairs(motion: HumanMotion, counts: Sequence[int]) -> list[dict[str, float]]:
    """Median step with a growing number of distance rows, as pinches have them."""
    robot = load_hand(ROBOTS[0])
    points = AttachedPoints.reference_points(robot)
    every = [(i, j) for i in range(len(points)) for j in range(i)]
    rows = []
    for count in counts:
        pairs = [every[k % len(every)] for k in range(count)]
        tasks = [PointDistances(points, pairs, np.full(count, 0.05))] if count else []
        mapper = HandMapper(motion.human, robot, MappingOptions(), tasks=tasks)
        rows.append({"pinch pairs": count, **measure_step(mapper, motion, 1)})
    return rows


def measure_contacts(
    motion: HumanMotion, counts: Sequence[int]
) -> list[dict[str, float]]:
    """Median IK of a step with a growing number of pairs of shapes that are kept apart.

    The fingertips are sent to one place, so that pairs are near and rows hold.
    """
    robot = load_hand(ROBOTS[0])
    every = all_pairs(robot)
    rows = []
    for count in counts:
        geometry = pin.GeometryModel(every.geometry)
        geometry.removeAllCollisionPairs()
        for pair in list(every.geometry.collisionPairs)[:count]:
            geometry.addCollisionPair(pair)
        pairs = ShapePairs(geometry, every.fingers[:count])
        ik = PointIk(robot, IkOptions(), contacts=pairs if count else None)
        ik.place(robot.configuration_vector(robot.rest))
        points = ik.configuration.points.copy()
        wrist = ik.configuration.wrist.homogeneous
        times = []
        for k in range(len(motion.time)):
            share = 0.5 - 0.5 * np.cos(0.1 * k)
            targets = points + share * (points.mean(axis=0) - points)
            started = time.thread_time_ns()
            ik.solve(targets, wrist, 1.0 / 90.0)
            times.append(1e-3 * (time.thread_time_ns() - started))
        rows.append(
            {
                "contact pairs": len(geometry.collisionPairs),
                "ik_us": float(np.median(times)),
                "p99_us": float(np.percentile(times, 99)),
            }
        )
    return rows


def measure_robots(
    names: Sequence[str], file: Path, samples: int, rounds: int, other: Path | None
) -> list[dict[str, Any]]:
    """Time whole steps of each hand that is installed, each in a process of its own.

    Args:
        names: Names of the hands.
        file: Inputs of the workers.
        samples: Their number.
        rounds: How often to map them.
        other: Another checkout that takes turns; none if omitted.

    Returns:
        A row a robot.
    """
    rows = []
    with common.progress("hands", len(names)) as advance:
        for name in filter(_is_there, names):
            trees = {"this": common.ROOT} | ({} if other is None else {"other": other})
            try:
                rows.append(_measure_robot(name, file, samples, rounds, trees))
            except interleaved.WorkerError as error:
                # An older checkout may not read the description of every hand.
                print(f"without {name}: {error}", file=sys.stderr)
            advance()
    return rows


def _measure_robot(
    name: str, file: Path, samples: int, rounds: int, trees: dict[str, Path]
) -> dict[str, Any]:
    command = interleaved.tree_command(file, name, "paper", "map_step")
    with interleaved.workers(
        {tree: (command, folder) for tree, folder in trees.items()}
    ) as working:
        interleaved.take_turns(working, samples, rounds)
        numbers = working[0].numbers()
        row = {"robot": name, "variables": working[0].facts["variables"], **numbers}
        if len(working) > 1:
            before = working[1].numbers()
            row["of other"] = numbers["median_us"] / before["median_us"]
            row["of other p99"] = numbers["p99_us"] / before["p99_us"]
            row["difference"] = interleaved.largest_difference(*working)
        return row


def _is_there(name: str) -> bool:
    try:
        shared_hands.load(name)
    except (MissingExtraError, FileNotFoundError):
        return False
    return True


def draw(
    step: dict[str, Any],
    parts: dict[str, float],
    growth: dict[str, list[dict[str, float]]],
) -> Any:
    """Draw the parts as bars and the growth as curves."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 5.6), layout="constrained")
    panels = figure.subplot_mosaic("ABC;ADE", width_ratios=(1.5, 1.0, 1.0))
    bars = panels["A"]
    names = sorted(parts, key=lambda part: parts[part])
    bars.barh(names, [parts[name] for name in names], color=common.PALETTE[1])
    bars.set(
        title=f"{step['step_us']:.0f} us = {step['ratio']:.0f} Jacobians",
        xlabel="mean CPU time [us]",
    )
    bars.grid(axis="y", visible=False)
    for axes, (what, rows) in zip(
        list(panels.values())[1:], growth.items(), strict=True
    ):
        times = [row.get("step_us", row.get("ik_us", 0.0)) for row in rows]
        axes.plot([row[what] for row in rows], times, "o-", color=common.PALETTE[0])
        axes.set(
            title=f"Growth with {what}",
            xlabel=what,
            ylabel="median CPU time [us]",
            ylim=(0.0, 1.1 * max(times)),
        )
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser(
        "CPU time of one map_step: per hand, by part, and its growth."
    )
    parser.add_argument(
        "--compare",
        metavar="CHECKOUT",
        type=Path,
        help="another checkout, which takes turns",
    )
    arguments = common.parse_arguments(parser, words)
    other = (
        None if arguments.compare is None else interleaved.check_tree(arguments.compare)
    )
    motion = synthetic.motion_or_synergies(arguments.recordings, RECORDING)
    quick = arguments.quick
    if quick:
        motion = synthetic.shortened(motion, 60)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "samples.npz"
        interleaved.write_motion(motion, file)
        names = ROBOTS[: 2 if quick else None]
        robots = measure_robots(names, file, len(motion.time), 1 if quick else 3, other)
    caption = f"load {os.getloadavg()[0]:.1f}"
    is_json = arguments.json == "-"
    common.print_table(
        "Per hand: map_step over one pin.computeJointJacobians",
        robots,
        to_stderr=is_json,
        caption=caption,
    )
    reference = IkOptions(formulation="direct")
    published = PublishedMethod(MappingOptions())
    mapper = HandMapper(motion.human, load_hand(ROBOTS[0]), published, ik=reference)
    measure_step(mapper, motion, 1)  # warm-up: fill caches
    step = measure_step(mapper, motion, 1 if quick else 3)
    parts = measure_parts(mapper, motion)
    ordered = sorted(parts.items(), key=lambda item: -item[1])
    common.print_table(
        "Allegro hand with floating wrist, Python path, by part",
        [{"part": name, "mean us": value} for name, value in ordered],
        to_stderr=is_json,
    )
    few = slice(0, 2 if quick else None)
    synergies = synthetic.synergy_motion(60 if quick else 300)
    growth = {
        "points": measure_growth(
            motion,
            [(n, synthetic.allegro_with_points(n)) for n in POINT_COUNTS[few]],
            "points",
        ),
        "joints": measure_growth(
            synergies,
            [(4 * n, synthetic.comb_hand(n)) for n in FINGER_COUNTS[few]],
            "joints",
        ),
        "pinch pairs": measure_pairs(motion, PAIR_COUNTS[few]),
        "contact pairs": measure_contacts(synergies, CONTACT_COUNTS[few]),
    }
    for what, table in growth.items():
        common.print_table(f"Growth with {what}", table, to_stderr=is_json)
    results = {
        "allegro": step,
        "parts_cpu_us": parts,
        "robots": robots,
        "growth": growth,
    }
    common.write_json(arguments.json, "bench_step", results)
    common.save_picture(arguments.picture, lambda: draw(step, parts, growth))


if __name__ == "__main__":
    main()
