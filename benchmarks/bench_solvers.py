"""Compare QP solvers on the same problems.

Measured: time, failures, distance to the exact solution, violation, and the gain of a warm start.
There are two sets of box-constrained problems. *Recorded*: the sequence of problems of a headset
recording mapped to the Allegro hand, where a warm start can help. *Hard*: random problems with
targets out of reach, joints at and outside their limits, singular (stretched) postures, and short
and long time steps.

    python benchmarks/bench_solvers.py --picture solvers.png --json solvers.json
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import common
import numpy as np
import pinocchio as pin
import synthetic

from handmap_qp import HandMapper, IkOptions, MappingOptions, load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.human.recording import HumanMotion
from handmap_qp.ik.qp import (
    PointIk,
    QpSolver,
    Rows,
    direct_cost,
    make_solver,
    solve_by_daqp,
)
from handmap_qp.ik.tasks import Goal
from handmap_qp.se3 import affine

_HARD = 5000
_ROBOTS = ("allegro_right", "three_finger")


class Problem(NamedTuple):
    """`min 1/2 x' H x + c' x  s.t.  lower <= x <= upper`."""

    H: np.ndarray
    c: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


class Recorder:
    """A solver that records its problems."""

    def __init__(self) -> None:
        self.problems: list[Problem] = []

    def __call__(
        self,
        H: np.ndarray,
        c: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        rows: Rows | None = None,
    ) -> np.ndarray | None:
        """As `QpSolver`."""
        self.problems.append(Problem(H.copy(), c.copy(), lower.copy(), upper.copy()))
        return solve_by_daqp(H, c, lower, upper, rows)


def recorded_problems(motion: HumanMotion) -> list[Problem]:
    """Record the problems of mapping a motion to the Allegro hand, in order."""
    mapper = HandMapper(
        motion.human,
        load_hand("allegro_right"),
        MappingOptions(),
        ik=IkOptions(formulation="direct"),
    )
    recorder = Recorder()
    mapper.point_ik._solver = recorder
    for i in range(len(motion.time)):
        mapper.map_step(motion.q[i], motion.wrist[i], dt=motion.dt[i])
    return recorder.problems


def hard_problems(count: int, seed: int = 0) -> list[Problem]:
    """Generate hard random problems, for two hands in turn."""
    rng = np.random.default_rng(seed)
    iks = [PointIk(load_hand(name), IkOptions()) for name in _ROBOTS]
    return [
        _hard_problem(iks[i % len(iks)], i // len(iks) % 4, rng) for i in range(count)
    ]


def _hard_problem(ik: PointIk, kind: int, rng: np.random.Generator) -> Problem:
    hand: Hand = ik.hand
    q = rng.uniform(hand.lower_limits, hand.upper_limits)
    if kind == 1:  # half of the joints at a limit
        q = np.where(
            rng.random(len(q)) < 0.5,
            np.where(rng.random(len(q)) < 0.5, hand.lower_limits, hand.upper_limits),
            q,
        )
    elif kind == 2:  # stretched: singular
        q = np.clip(np.zeros(len(q)), hand.lower_limits, hand.upper_limits)
    elif kind == 3:  # outside the limits
        q = q + rng.uniform(-0.5, 0.5, len(q))
    ik.place(hand.configuration_vector(q))
    targets = ik.configuration.points + rng.normal(
        scale=10.0 ** rng.uniform(-3.0, 0.0), size=ik.configuration.points.shape
    )
    wrist = affine(pin.exp3(rng.normal(size=3)), rng.normal(scale=0.3, size=3))
    dt = 10.0 ** rng.uniform(-3.0, -1.0)
    goal = Goal(targets, wrist, ik.postures(dt, None), ())
    cost = direct_cost(hand, ik.options, ik.configuration, goal)
    return Problem(*cost, *ik.gate.bounds(dt))


def exact_answer(problem: Problem) -> np.ndarray:
    """Return the minimiser up to rounding.

    Takes DAQP's active set, solves for the free variables directly and checks the KKT conditions.

    Raises:
        RuntimeError: If DAQP fails or the KKT conditions do not hold.
    """
    H, c, lower, upper = problem
    start = solve_by_daqp(*problem)
    if start is None:
        raise RuntimeError("DAQP found no solution to start from")
    tolerance = 1e-9 * (1.0 + np.abs(start))
    at_lower, at_upper = start <= lower + tolerance, start >= upper - tolerance
    x = np.where(at_lower, lower, np.where(at_upper, upper, start))
    free = ~(at_lower | at_upper)
    if free.any():
        x[free] = np.linalg.solve(
            H[np.ix_(free, free)], -c[free] - H[np.ix_(free, ~free)] @ x[~free]
        )
    slope, scale = H @ x + c, 1e-9 * np.abs(H).max()
    ok = (
        (x >= lower - 1e-12).all()
        and (x <= upper + 1e-12).all()
        and (np.abs(slope[free]) <= scale).all()
    )
    # At a weakly active bound both gradient and distance are zero: either set is correct.
    signs = (slope[at_lower & ~at_upper] >= -scale).all() and (
        slope[at_upper & ~at_lower] <= scale
    ).all()
    if not (ok and signs):
        raise RuntimeError("the exact solution violates the KKT conditions")
    return x


def measure(
    solver: QpSolver, problems: Sequence[Problem], answers: Sequence[np.ndarray]
) -> dict[str, Any]:
    """Run one solver on one set of problems.

    Args:
        solver: The solver.
        problems: The problems.
        answers: Their exact solutions.

    Returns:
        CPU times [us], number of failures, largest distance to the exact solution and violation.
    """
    times, distances, violations, failures = [], [], [], 0
    for problem, answer in zip(problems, answers, strict=True):
        started = time.thread_time_ns()
        try:
            x = solver(*problem)
        except Exception:
            x = None  # any exception counts as a failure
        times.append(1e-3 * (time.thread_time_ns() - started))
        if x is None or not np.isfinite(x).all():
            failures += 1
            continue
        distances.append(np.abs(x - answer).max())
        violations.append(
            max(0.0, (problem.lower - x).max(), (x - problem.upper).max())
        )
    return {
        "median_us": float(np.median(times)),
        "p99_us": float(np.percentile(times, 99)),
        "failures": failures,
        "distance_max": float(max(distances, default=np.nan)),
        "violation_max": float(max(violations, default=np.nan)),
    }


def solvers() -> dict[str, QpSolver]:
    """Return each installed solver by its name."""
    import qpsolvers

    return {
        name: make_solver(name)
        for name in sorted({"daqp", *qpsolvers.available_solvers})
    }


def draw(results: dict[str, list[dict[str, Any]]]) -> Any:
    """Draw the time of each solver as a bar, labelled with its distance and failures."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    panels = figure.subplots(1, len(results), sharey=True, squeeze=False)[0]
    for axes, (name, rows) in zip(panels, results.items(), strict=True):
        names, times = (
            [row["solver"] for row in rows],
            [row["median_us"] for row in rows],
        )
        axes.barh(
            names,
            times,
            color=[common.PALETTE[0 if name == "daqp" else 1] for name in names],
            height=0.6,
        )
        for i, row in enumerate(rows):
            failed = f", {row['failures']} failed" if row["failures"] else ""
            axes.text(
                1.15 * row["median_us"],
                i,
                f"{row['median_us']:.0f} us, off by {row['distance_max']:.0e}{failed}",
                va="center",
                size=7.5,
            )
        axes.set(
            title=f"{name} problems",
            xscale="log",
            xlabel="median CPU time [us]",
            xlim=(1.0, 3e4),
        )
        axes.grid(axis="y", visible=False)
    figure.axes[0].invert_yaxis()
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser("Compare QP solvers on recorded and on hard problems.")
    parser.add_argument(
        "--hard", type=int, default=_HARD, help="number of hard problems"
    )
    arguments = common.parse_arguments(parser, words)
    motion = synthetic.motion_or_synergies(arguments.recordings, "quest3_webxr_right")
    if arguments.quick:
        motion, arguments.hard = synthetic.shortened(motion, 20), 20
    sets = {
        "recorded": recorded_problems(motion),
        "hard": hard_problems(arguments.hard),
    }
    results: dict[str, list[dict[str, Any]]] = {}
    for name, problems in sets.items():
        answers = [exact_answer(problem) for problem in problems]
        rows = []
        with (
            common.progress(f"{name} problems", len(solvers())) as advance,
            warnings.catch_warnings(),
        ):
            # Warnings of solvers show as failures or distances.
            warnings.simplefilter("ignore")
            for name, solver in solvers().items():
                rows.append({"solver": name, **measure(solver, problems, answers)})
                advance()
        results[name] = rows
        common.print_table(
            f"{len(problems)} {name} problems", rows, to_stderr=arguments.json == "-"
        )
    common.write_json(arguments.json, "bench_solvers", results)
    common.save_picture(arguments.picture, lambda: draw(results))


if __name__ == "__main__":
    main()
