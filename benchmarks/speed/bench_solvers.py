"""Compare QP solvers on the same problems.

`core` is the solver of the compiled core. The proof: on 100,000 problems its answer equals those
of DAQP, ProxQP and OSQP, or has the better objective. There are four sets. *Recorded*: the problems
of mapping recordings to four hands by the paper's method. *Contacts*: those of teleoperation, with
rows that keep links apart. *Hard*: random problems with targets out of reach, joints at and outside
their limits, singular (stretched) postures, and short and long time steps. *Hostile*: those of
random targets up to 1e9 m away, options, times and margins (`hostile.py`).

An answer that violates a bound or row by more than 1e-9 of the largest step fails. Two that do not
are equal if they, or their objectives, differ by at most 1e-9; else the lower objective is better.
The core's answer is certified too: multipliers of its active constraints, found by non-negative
least squares, bound the optimum from below.

Measured besides, for each installed solver on recorded and hard problems: time, failures, distance
to the exact solution and violation.

    python benchmarks bench_solvers --picture solvers.png --json solvers.json
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import cycle, product
from operator import itemgetter
from typing import Any, NamedTuple, TypeGuard

import common
import hostile
import numpy as np
import pinocchio as pin
import synthetic
from scipy.optimize import nnls

from handmap_core.core import core
from handmap_core.ik.gate import Rows
from handmap_core.ik.tasks import Goal
from handmap_qp import HandMapper, IkOptions, hand_names, load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import all_pairs
from handmap_qp.human import HumanMotion
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.presets import get_preset
from handmap_qp.reference.daqp_solver import solve_by_daqp
from handmap_qp.reference.problem import direct_cost
from handmap_qp.reference.solvers import make_solver
from handmap_qp.se3 import affine

QpSolver = Callable[..., np.ndarray | None]
_COMPARED = ("daqp", "proxqp", "osqp")
_VERDICTS = ("equal", "core better", "core worse", "core failed", "other failed")
_EQUAL = 1e-9
_ACTIVE = (1e-9, 1e-12, 1e-15)
_TIMED = 5000
_MAPPED = ("allegro_right", "three_finger", "g1_right", "ur5_allegro")
_HOSTILE = ("allegro_right", "three_finger", "shadow_right", "ability_right", "g1_left")
_ROBOTS = ("allegro_right", "three_finger")


class Problem(NamedTuple):
    """`min 1/2 x' H x + c' x  s.t.  lower <= x <= upper`."""

    H: np.ndarray
    c: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    rows: Rows | None = None


class Recorder:
    """A solver that records its problems.

    Args:
        count: Number of problems after which it is full.
    """

    def __init__(self, count: int) -> None:
        self.problems: list[Problem] = []
        self._count = count

    @property
    def is_full(self) -> bool:
        """Whether it has all problems that it wants."""
        return len(self.problems) >= self._count

    def __call__(
        self,
        H: np.ndarray,
        c: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        rows: Rows | None = None,
    ) -> np.ndarray | None:
        """As `solve_by_daqp`."""
        taken = Problem(H.copy(), c.copy(), lower.copy(), upper.copy(), rows)
        if not self.is_full:
            self.problems.append(taken)
        return solve_by_daqp(H, c, lower, upper, rows)


def _record(ik: PointIk, recorder: Recorder) -> None:
    """Let a recorder solve the QPs of a hand that are posed in Python."""
    assert ik.reference
    ik.reference.solver = recorder


def mapped_problems(
    motions: Sequence[HumanMotion], robots: Sequence[str], preset: str, count: int
) -> list[Problem]:
    """Record the problems of mapping motions to robots, in order; the same number of each.

    Args:
        motions: The motions, repeated as often as it takes.
        robots: Names of the robots.
        preset: Name of the preset.
        count: Number of problems.
    """
    ik = get_preset(preset).ik.replaced(formulation="direct")
    pairs = list(product(motions, robots))
    problems: list[Problem] = []
    for k, (motion, name) in enumerate(pairs):
        recorder = Recorder(-(-(count - len(problems)) // (len(pairs) - k)))
        human = motion.human.with_points("landmarks")
        mapper = HandMapper(human, load_hand(name), preset, ik=ik)
        _record(mapper.point_ik, recorder)
        for i in cycle(range(len(motion.time))):
            if recorder.is_full:
                break
            landmarks = human.points(motion.q[i], motion.wrist[i])
            mapper.map_landmarks(landmarks, dt=motion.dt[i])
        problems += recorder.problems
    return problems


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
    goal = Goal(targets, wrist[None], hand.rest, (), dt)
    cost = direct_cost(ik.gate, ik.configuration, goal)
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


def hostile_problems(count: int, seed: int = 0) -> list[Problem]:
    """Record the problems of hostile targets, times, limits and margins on the hands there are."""
    problems: list[Problem] = []
    hands = [name for name in _HOSTILE if name in hand_names()]
    kinds = list(product(hands, (False, True)))
    for k, (name, has_contacts) in enumerate(kinds):
        recorder = Recorder(-(-(count - len(problems)) // (len(kinds) - k)))
        hand, rng = load_hand(name), np.random.default_rng(seed + k)
        shapes = all_pairs(hand) if has_contacts else None
        while not recorder.is_full:
            options = hostile.wild_options(rng).replaced(
                formulation="direct", max_acceleration=rng.choice([None, 40.0])
            )
            run = hostile.IkRun(hand, options, seed + k, shapes)
            _record(run.ik, recorder)
            run.checker.meter = None
            run.advance(min(500, count), hostile.Tally())
        problems += recorder.problems
    return problems


class Certificate(NamedTuple):
    """By how much at most an objective is above the optimum, and the multipliers that show it."""

    excess: float
    multipliers: np.ndarray


def certify(problem: Problem, x: np.ndarray) -> Certificate:
    """Bound by how much an answer is above the optimum, by weak duality.

    For multipliers l >= 0 of A x <= b and r = H x + c + A' l, no feasible point has an objective
    below f(x) - r' H^-1 r / 2 - l' (b - A x). The multipliers are those of the constraints that are
    active at x, up to the tolerance that gives the best bound, that make the second term smallest.

    Args:
        problem: The problem.
        x: An answer, shape (n,).
    """
    A, slack = constraints(problem, x)
    root = np.linalg.cholesky(problem.H)
    slope = np.linalg.solve(root, problem.H @ x + problem.c)
    normals = np.linalg.solve(root, A.T)
    steepest = max(np.abs(slope).max(), 1e-300)
    best = Certificate(np.inf, np.zeros(len(A)))
    for tolerance in _ACTIVE:
        is_active = slack <= tolerance * max(1.0, np.abs(x).max())
        multipliers, left = np.zeros(len(A)), float(np.linalg.norm(slope))
        if is_active.any():
            # Scaled, because the method stops at an absolute tolerance.
            try:
                found, rest = nnls(normals[:, is_active], -slope / steepest, 1000)
            except RuntimeError:
                continue  # it cycles; another tolerance may do
            multipliers[is_active], left = steepest * found, steepest * rest
        excess = 0.5 * left**2 + multipliers[is_active] @ slack[is_active]
        best = min(best, Certificate(float(excess), multipliers), key=itemgetter(0))
    return best


def constraints(problem: Problem, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the normals of all constraints, shape (2 n + r, n), and their slacks at x."""
    eye = np.eye(len(x))
    G, h = problem.rows or (eye[:0], x[:0])
    slack = (x - problem.lower, problem.upper - x, h - G @ x)
    return np.vstack([-eye, eye, G]), np.concatenate(slack)


def objective(problem: Problem, x: np.ndarray) -> float:
    """Return the objective at x."""
    return float(0.5 * x @ problem.H @ x + problem.c @ x)


def verdict(problem: Problem, ours: np.ndarray | None, x: np.ndarray | None) -> str:
    """Say which of two answers is better; see the top of this file.

    Args:
        problem: The problem.
        ours: The core's answer; None for none.
        x: Another solver's.
    """
    if not is_answer(ours, problem):
        return "core failed"
    if not is_answer(x, problem):
        return "other failed"
    if np.abs(ours - x).max() <= _EQUAL * max(1.0, np.abs(ours).max()):
        return "equal"
    own, other = objective(problem, ours), objective(problem, x)
    if abs(own - other) <= _EQUAL * abs(own):
        return "equal"
    # An answer outside the bounds may be below the optimum by multipliers times violations.
    _, multipliers = certify(problem, ours)
    _, slack = constraints(problem, x)
    paid = multipliers @ np.maximum(-slack, 0.0)
    return "core worse" if other + paid < own - _EQUAL * abs(own) else "core better"


def prove(problems: Sequence[Problem]) -> list[dict[str, Any]]:
    """Hold the core's answers against those of other solvers, and certify them.

    Returns:
        A row of each other solver: on how many problems both answers are equal, the core's is
        better or worse, or one of them fails. And the core's largest relative excess above the
        certified optimum, and its largest violation.
    """
    others = {name: solve for name, solve in solvers().items() if name in _COMPARED}
    counts = {name: Counter[str]() for name in others}
    gaps, violations = [], []
    with common.progress("proof", len(problems)) as advance:
        for problem in problems:
            ours = solve_by_core(*problem)
            for name, solve in others.items():
                counts[name][verdict(problem, ours, solve(*problem))] += 1
            if ours is not None:
                excess = certify(problem, ours).excess
                # A step of 1e-12 against the slope is rounding.
                slope = 1e-12 * np.abs(problem.c).sum()
                gaps.append(excess / max(abs(objective(problem, ours)), slope))
                violations.append(violation_of(problem, ours))
            advance()
    return [
        {"solver": name, **{what: count[what] for what in _VERDICTS}}
        | {"gap_max": float(np.max(gaps)), "violation_max": float(np.max(violations))}
        for name, count in counts.items()
    ]


def is_answer(x: np.ndarray | None, problem: Problem) -> TypeGuard[np.ndarray]:
    """Whether a solver has an answer that holds all constraints."""
    return x is not None and violation_of(problem, x) <= _EQUAL


def violation_of(problem: Problem, x: np.ndarray) -> float:
    """Return the largest violation of a bound or a normalised row, over the largest step or 1."""
    worst = max(0.0, (problem.lower - x).max(), (x - problem.upper).max())
    if problem.rows is not None:
        G, h = problem.rows
        lengths = np.linalg.norm(G, axis=1)
        # Shorter ones hold no coordinate: their numbers are rounding.
        excess, is_row = G @ x - h, lengths >= 1e-12
        worst = max(worst, (excess[is_row] / lengths[is_row]).max(initial=0.0))
    worst = worst if np.isfinite(x).all() else np.inf
    return float(worst / max(1.0, np.abs(x).max()))


def solve_by_core(
    H: np.ndarray,
    c: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    rows: Rows | None = None,
) -> np.ndarray | None:
    """Solve by the compiled core; see `solve_by_daqp`."""
    is_found, x, _ = core.solve_qp(H, c, lower, upper, *(rows or (None, None)))
    return x if is_found else None


def solvers() -> dict[str, QpSolver]:
    """Return each installed solver by its name."""
    import qpsolvers

    own: dict[str, QpSolver] = {"core": solve_by_core}
    return own | {
        name: solve_by_daqp if name == "daqp" else make_solver(name)
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
        "--problems",
        type=int,
        default=100_000,
        help="number of problems of the proof (default: %(default)s)",
    )
    arguments = common.parse_arguments(parser, words)
    count = (80 if arguments.quick else arguments.problems) // 4
    timed = min(_TIMED, count)
    names = [file.stem for file in sorted(arguments.recordings.glob("*.npz"))]
    names = names[: 1 if arguments.quick else None]
    motions = [
        synthetic.motion_or_synergies(arguments.recordings, name)
        for name in (names or ["none"])
    ]
    sets = {
        "recorded": mapped_problems(motions, _MAPPED, "paper", count),
        "hard": hard_problems(count),
        "contacts": mapped_problems(motions, _MAPPED, "teleoperation", count),
        "hostile": hostile_problems(count),
    }
    to_stderr = arguments.json == "-"
    results: dict[str, list[dict[str, Any]]] = {}
    with warnings.catch_warnings():
        # Warnings of solvers show as failures or distances.
        warnings.simplefilter("ignore")
        for name in ("recorded", "hard"):
            problems = sets[name][:timed]
            answers = [exact_answer(problem) for problem in problems]
            results[name] = [
                {"solver": which, **measure(solver, problems, answers)}
                for which, solver in solvers().items()
            ]
            title = f"Times on {len(problems)} {name} problems"
            common.print_table(title, results[name], to_stderr=to_stderr)
        drawn = dict(results)
        if core is not None:
            for name, problems in sets.items():
                rows = prove(problems)
                results[f"proof: {name}"] = rows
                title = f"Proof: {len(problems)} {name} problems"
                common.print_table(title, rows, to_stderr=to_stderr)
    common.write_json(arguments.json, "bench_solvers", results)
    common.save_picture(arguments.picture, lambda: draw(drawn))
    proofs = [row for name in results.keys() - drawn.keys() for row in results[name]]
    if any(row["core worse"] or row["core failed"] for row in proofs):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
