"""CPU time of one `map_step`: in total, by part, per hand, and by number of points and joints.

Times are CPU times of one thread. The ratio to one `pin.computeJointJacobians` on the same robot in
the same run hardly depends on the machine. The motion is a headset recording, mapped with
`MappingOptions()` (the paper's choices); without recordings, it is the human hand moving along its
synergies. Parts and growth are measured on the Allegro hand with a floating wrist (22 variables).

Ratios measured on a shared two-core machine: 58 for allegro_right (67 us), 95 for three_finger
(62 us), 67 for romeo_right, 98 for g1_right. Most of a step does not depend on the number of
joints, so the ratio is larger for smaller hands.

    python benchmarks/bench_step.py --picture step.png
    python benchmarks/bench_step.py --save before.json     # change something
    python benchmarks/bench_step.py --compare before.json
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import common
import numpy as np
import pinocchio as pin
import synthetic

import handmap_qp.ik.qp
import handmap_qp.mapping.mapper
import handmap_qp.mapping.transfer
from handmap_qp import HandMapper, MappingOptions, MissingExtraError, load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.methods import homogeneous
from handmap_qp.mapping.methods.homogeneous import HomogeneousMap
from handmap_qp.trackers.recording import HumanMotion

RECORDING = "quest3_webxr_right"
POINT_COUNTS = (3, 4, 6, 10, 20, 35, 50)
FINGER_COUNTS = (2, 3, 4, 5, 6, 8, 10)
ROBOTS = ("allegro_right", "three_finger", "romeo_right", "g1_right")
"""Hands in the table of ratios; the first is the one that is measured by part."""


def measure_step(mapper: HandMapper, motion: HumanMotion, rounds: int) -> dict[str, Any]:
    """Time whole steps over a motion, interleaved with batches of the robot's Jacobian.

    Args:
        mapper: The mapper.
        motion: The motion; all samples must be valid.
        rounds: How often to map the motion.

    Returns:
        CPU times [us], their ratios to one `pin.computeJointJacobians` and numbers of iterations.
    """
    jacobian, steps, iterations = [], [], []
    data, q = mapper.robot.model.createData(), mapper.robot.configuration_vector(mapper.robot.rest)
    jacobi = partial(pin.computeJointJacobians, mapper.robot.model, data, q)
    for _ in range(rounds):
        mapper.reset()
        mapper.map_step(motion.q[0], motion.wrist[0])
        for i in range(len(motion.time)):
            if i % 25 == 0:
                jacobian.append(common.mean_cpu_time(jacobi, 20))
            started = time.thread_time_ns()
            step = mapper.map_step(motion.q[i], motion.wrist[i], dt=motion.dt[i])
            steps.append(1e-9 * (time.thread_time_ns() - started))
            iterations.append(step.iterations)
    one, median, p99 = np.median(jacobian), np.median(steps), np.percentile(steps, 99)
    return {
        "jacobian_cpu_us_median": 1e6 * one,
        "step_cpu_us_median": 1e6 * median,
        "step_cpu_us_p99": 1e6 * p99,
        "ratio_median": median / one,
        "ratio_p99": p99 / one,
        "iterations_mean": float(np.mean(iterations)),
        "steps": len(steps),
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
    """Mean CPU time of each part of a step [us], less the measured cost of the wrapper."""
    watches = Stopwatches()
    mapper.reset()
    mapper.map_step(motion.q[0], motion.wrist[0])
    ik, course = mapper.point_ik, mapper._course
    counted = course.map if course else None
    reference = counted.reference if isinstance(counted, HomogeneousMap) else None
    wrapped = [
        (handmap_qp.mapping.mapper, "check_pose", "checks"),
        (mapper, "_check_joints", "checks"),
        (mapper, "_human_sample", "human FK"),
        (reference.estimator if reference else None, "estimate", "estimation"),
        (handmap_qp.mapping.transfer, "polar", "decomposition"),
        (homogeneous, "transfer_motion", "targets"),
        (ik._limits, "bounds", "limits"),
        (ik.configuration, "stacked_jacobian", "Jacobians"),
        (ik, "_linearise", "assembly"),
        (ik._solver, "solve", "solve"),
        (ik.configuration, "place_with_jacobians", "integrate and place"),
        (ik, "solve", "iteration and result"),
    ]
    originals = [(owner, name, getattr(owner, name)) for owner, name, _ in wrapped]
    calls = dict.fromkeys((part for _, _, part in wrapped), 0)
    for owner, name, part in wrapped:
        setattr(owner, name, _counted(calls, part, watches.wrap(part, getattr(owner, name))))
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


def _counted(calls: dict[str, int], part: str, function: Callable[..., Any]) -> Callable[..., Any]:
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
        result = measure_step(HandMapper(motion.human, robot, MappingOptions()), motion, 1)
        rows.append(
            {
                what: size,
                "variables": robot.model.nv,
                "step_us": result["step_cpu_us_median"],
                "ratio": result["ratio_median"],
            }
        )
    return rows


def measure_robots(motion: HumanMotion, rounds: int) -> list[dict[str, Any]]:
    """Median step of each hand of `ROBOTS` that is installed, and its ratio to one Jacobian."""
    rows = []
    for name in ROBOTS:
        try:
            robot = load_hand(name)
        except MissingExtraError:
            continue
        mapper = HandMapper(motion.human, robot, MappingOptions())
        measure_step(mapper, synthetic.shortened(motion, 20), 1)
        result = measure_step(mapper, motion, rounds)
        rows.append(
            {
                "robot": name,
                "variables": robot.model.nv,
                "step_us": result["step_cpu_us_median"],
                "jacobian_us": result["jacobian_cpu_us_median"],
                "ratio": result["ratio_median"],
                "ratio_p99": result["ratio_p99"],
                "iterations": result["iterations_mean"],
            }
        )
    return rows


def draw(
    step: dict[str, Any], parts: dict[str, float], growth: dict[str, list[dict[str, float]]]
) -> Any:
    """Draw the parts as bars and the growth as two curves."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 3.6), layout="constrained")
    bars, by_points, by_joints = figure.subplots(1, 3, width_ratios=(1.5, 1.0, 1.0))
    names = sorted(parts, key=lambda part: parts[part])
    bars.barh(names, [parts[name] for name in names], color=common.PALETTE[1])
    bars.set(
        title=f"{step['step_cpu_us_median']:.0f} us = {step['ratio_median']:.0f} Jacobians",
        xlabel="mean CPU time [us]",
    )
    bars.grid(axis="y", visible=False)
    for axes, (what, rows) in zip((by_points, by_joints), growth.items(), strict=True):
        axes.plot(
            [row[what] for row in rows],
            [row["step_us"] for row in rows],
            "o-",
            color=common.PALETTE[0],
        )
        axes.set(
            title=f"Growth with {what}",
            xlabel=what,
            ylabel="median CPU time [us]",
            ylim=(0.0, 1.1 * max(row["step_us"] for row in rows)),
        )
    return figure


def _read(file: str) -> dict[str, Any]:
    """Read the numbers of an earlier run."""
    try:
        return json.loads(Path(file).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        common.stop(f"--compare {file}: {error}")


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser(
        "CPU time of one map_step: in total, by part, per hand, by number of points and joints."
    )
    parser.add_argument(
        "--save", metavar="FILE", help="the same as --json: numbers to compare with later"
    )
    parser.add_argument(
        "--compare", metavar="FILE", help="numbers of an earlier run to compare with"
    )
    arguments = common.parse_arguments(parser, words)
    before = _read(arguments.compare) if arguments.compare else {}
    motion = synthetic.motion_or_synergies(arguments.recordings, RECORDING)
    if arguments.quick:
        motion = synthetic.shortened(motion, 60)
    mapper = HandMapper(motion.human, load_hand(ROBOTS[0]), MappingOptions())
    measure_step(mapper, motion, 1)  # warm-up: fill caches
    step = measure_step(mapper, motion, 1 if arguments.quick else 5)
    parts = measure_parts(mapper, motion)
    robots = measure_robots(motion, 1 if arguments.quick else 2)
    counts, fingers = (
        (POINT_COUNTS[:2], FINGER_COUNTS[:2]) if arguments.quick else (POINT_COUNTS, FINGER_COUNTS)
    )
    synergies = synthetic.synergy_motion(60 if arguments.quick else 300)
    growth = {
        "points": measure_growth(
            motion, [(count, synthetic.allegro_with_points(count)) for count in counts], "points"
        ),
        "joints": measure_growth(
            synergies, [(4 * count, synthetic.comb_hand(count)) for count in fingers], "joints"
        ),
    }
    results = {**step, "parts_cpu_us": parts, "robots": robots, "growth": growth}
    is_json = arguments.json == "-"
    summary = [
        {"what": name, "now": value, **({"before": before.get(name, "")} if before else {})}
        for name, value in step.items()
    ]
    common.print_table(
        "map_step, Allegro hand with floating wrist, the paper's options",
        summary,
        to_stderr=is_json,
    )
    common.print_table(
        "Per hand: map_step over one pin.computeJointJacobians", robots, to_stderr=is_json
    )
    ordered = sorted(parts.items(), key=lambda item: -item[1])
    earlier = before.get("parts_cpu_us", {})
    rows = [
        {"part": name, "mean us": value, **({"before": earlier.get(name, "")} if before else {})}
        for name, value in ordered
    ]
    common.print_table("By part", rows, to_stderr=is_json)
    for what, table in growth.items():
        common.print_table(f"Growth with {what}", table, to_stderr=is_json)
    for target in (arguments.json, arguments.save):
        common.write_json(target, "bench_step", results)
    common.save_picture(arguments.picture, lambda: draw(step, parts, growth))


if __name__ == "__main__":
    main()
