"""Compare QP solvers on the same problems.

Measured: time, failures, distance to the exact solution and violation. `core` is the solver of the
compiled core. There are two sets of box-constrained problems. *Recorded*: the problems of a headset
recording mapped to the Allegro hand. *Hard*: random problems with targets out of reach, joints at
and outside their limits, singular (stretched) postures, and short and long time steps.

Two more sets have rows too, and no exact solutions: *contacts*, those of mapping the recording with
contacts to four hands, and *hostile*, those of random targets up to 1e6 m away, options and times
(`hostile.py`). There the best answer of all solvers counts that violates nothing by more than 1e-12
of the largest step. A solver fails if it has no answer, or one that violates something by 1e-7.

    python benchmarks/bench_solvers.py --picture solvers.png --json solvers.json
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import common
import hostile
import numpy as np
import pinocchio as pin
import synthetic

from handmap_qp import HandMapper, IkOptions, MappingOptions, load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.human.recording import HumanMotion
from handmap_qp.ik import core as core_module
from handmap_qp.ik.qp import (
    PointIk,
    QpSolver,
    Rows,
    direct_cost,
    make_solver,
    solve_by_daqp,
)
from handmap_qp.ik.tasks import Goal
from handmap_qp.mapping.presets import get_preset
from handmap_qp.se3 import affine

_HARD = 5000
COMPILED: Any = core_module.core
_COMPARED = ("core", "daqp", "proxqp", "osqp")
_ROBOTS = ("allegro_right", "three_finger")


class Problem(NamedTuple):
    """`min 1/2 x' H x + c' x  s.t.  lower <= x <= upper`."""

    H: np.ndarray
    c: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    rows: Rows | None = None


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
        taken = Problem(H.copy(), c.copy(), lower.copy(), upper.copy(), rows)
        self.problems.append(taken)
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
    H, c, lower, upper, _ = problem
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


def contact_problems(motion: HumanMotion) -> list[Problem]:
    """Record the problems of mapping landmarks with contacts, on four hands."""
    recorder = Recorder()
    human = motion.human.with_points("landmarks")
    ik = get_preset("teleoperation").ik.replaced(formulation="direct")
    for name in ("allegro_right", "three_finger", "g1_right", "ur5_allegro"):
        mapper = HandMapper(human, load_hand(name), "teleoperation", ik=ik)
        mapper.point_ik._solver = recorder
        for i in range(len(motion.time)):
            landmarks = human.points(motion.q[i], motion.wrist[i])
            mapper.map_landmarks(landmarks, dt=motion.dt[i])
    return recorder.problems


def hostile_problems(steps: int, seed: int = 0) -> list[Problem]:
    """Record the problems of hostile targets, times and limits on four hands."""
    recorder = Recorder()
    for k, name in enumerate(("allegro_right", "three_finger", "human", "g1_left")):
        for limit in (None, 40.0):
            hand = load_hand(name)
            options = IkOptions(
                formulation="direct",
                max_acceleration=limit,
                avoids_self_collision=hand.spec.collision is not None,
            )
            run, tally = hostile.IkRun(hand, options, seed + k), hostile.Tally()
            run._ik._solver = recorder
            for _ in range(steps // 8):
                run.step(tally)
    return recorder.problems


def compare_objectives(problems: Sequence[Problem]) -> list[dict[str, Any]]:
    """Hold each solver's objective against the best feasible one of all.

    Returns:
        For each solver its time [us], failures, how often its objective is above the best by more
        than 1e-9 of it, by how much at most, and the largest violation of an answer, over the
        largest step or 1.
    """
    chosen = {name: solve for name, solve in solvers().items() if name in _COMPARED}
    tallies = {name: _Objectives([], [], []) for name in chosen}
    for problem in problems:
        values = {}
        best = np.inf
        for name, solve in chosen.items():
            started = time.thread_time_ns()
            x = solve(*problem)
            tally = tallies[name]
            tally.times.append(1e-3 * (time.thread_time_ns() - started))
            violation = np.inf if x is None else violation_of(problem, x)
            tally.violations.append(violation)
            values[name] = np.inf
            if x is not None and violation <= 1e-7:
                values[name] = 0.5 * x @ problem.H @ x + problem.c @ x
            if violation <= 1e-12:
                best = min(best, values[name])
        scale = max(abs(best), 1e-300)
        for name, value in values.items():
            tallies[name].excess.append((value - best) / scale)
    return [
        {
            "solver": name,
            "median_us": float(np.median(tally.times)),
            "failures": int(np.sum(np.array(tally.violations) > 1e-7)),
            "worse": int(
                np.sum(np.isfinite(tally.excess) & (np.array(tally.excess) > 1e-9))
            ),
            "worst": float(
                np.max(tally.excess, where=np.isfinite(tally.excess), initial=0.0)
            ),
            "violation_max": float(np.max(tally.violations)),
        }
        for name, tally in tallies.items()
    ]


class _Objectives(NamedTuple):
    """Times [us], violations and excess of the objective of one solver."""

    times: list[float]
    violations: list[float]
    excess: list[float]


def violation_of(problem: Problem, x: np.ndarray) -> float:
    """Return the largest violation of a bound or a normalised row, over the largest step or 1."""
    worst = max(0.0, (problem.lower - x).max(), (x - problem.upper).max())
    if problem.rows is not None:
        G, h = problem.rows
        lengths = np.maximum(np.linalg.norm(G, axis=1), 1e-12)
        worst = max(worst, ((G @ x - h) / lengths).max(initial=0.0))
    worst = worst if np.isfinite(x).all() else np.inf
    return float(worst / max(1.0, np.abs(x).max()))


def solve_by_core(
    H: np.ndarray,
    c: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    rows: Rows | None = None,
) -> np.ndarray | None:
    """Solve by the compiled core; see `QpSolver`."""
    is_found, x, _ = COMPILED.solve_qp(H, c, lower, upper, *(rows or (None, None)))
    return x if is_found else None


def solvers() -> dict[str, QpSolver]:
    """Return each installed solver by its name."""
    import qpsolvers

    own: dict[str, QpSolver] = {} if COMPILED is None else {"core": solve_by_core}
    return own | {
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
            for which, solver in solvers().items():
                rows.append({"solver": which, **measure(solver, problems, answers)})
                advance()
        results[name] = rows
        common.print_table(
            f"{len(problems)} {name} problems", rows, to_stderr=arguments.json == "-"
        )
    drawn = dict(results)
    with_rows = {
        "contacts": contact_problems(motion),
        "hostile": hostile_problems(80 if arguments.quick else 4 * arguments.hard),
    }
    for name, problems in with_rows.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            results[name] = compare_objectives(problems)
        common.print_table(
            f"{len(problems)} {name} problems",
            results[name],
            to_stderr=arguments.json == "-",
        )
    common.write_json(arguments.json, "bench_solvers", results)
    common.save_picture(arguments.picture, lambda: draw(drawn))


if __name__ == "__main__":
    main()
