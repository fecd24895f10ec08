"""Ways of solving the QPs of the mapping, and what each takes: pose, wrapper and solver apart.

A `Way` poses a problem where it was recorded, and solves it. `measure` takes all ways in turns on
each problem. *Pose* is the time from kinematics to the matrices of the cost, with mink those of the
limits too. *Solver* is the time inside the solver's own call. *Wrapper* is all else between the
matrices and the answer: checks, copies, stacked or sparse matrices, and where qpsolvers calls the
solver, its set-up, which qpsolvers counts as building.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from types import ModuleType
from typing import Any, Generic, NamedTuple, TypeVar
from unittest.mock import patch

import daqp
import mink
import numpy as np
import pinocchio as pin
import qpsolvers
from pseudoinverse import PseudoinverseIk, weighted_task
from qp_problems import PosedProblem, Problem
from qp_proof import limit_violation, row_violation, solve_by_core

from handmap_core.core import core
from handmap_core.ik.gate import Rows
from handmap_core.se3 import Array
from handmap_qp import IkOptions
from handmap_qp.hands.hand import Hand
from handmap_qp.reference.daqp_solver import solve_by_daqp
from handmap_qp.reference.mink_problem import build_problem
from handmap_qp.reference.problem import direct_cost
from handmap_qp.reference.solvers import answer_in, solve_exactly

BROKEN = 1e-6
"""A limit or row counts as broken from this violation on [rad or m]."""
WRONG = 1e-3
"""An answer counts as wrong from this distance to the optimum on [rad or m]."""

_Cost = TypeVar("_Cost")
Matrices = tuple[Array, Array]
"""H and c of the cost; of eq. (8) the weighted Jacobian and error."""


class Solved(NamedTuple):
    """An answer, shape (n,), None for none; and the time inside the solver's call [s]."""

    x: Array | None
    seconds: float


class Way(NamedTuple, Generic[_Cost]):
    """A way of solving.

    Attributes:
        solver: Name of the solver.
        limits: How limits are handled: in the QP as `box` or `rows`, or `clipped` afterwards.
        posed_by: What poses the cost.
        pose: Poses a problem; returns the matrices.
        solve: Solves it with these matrices.
    """

    solver: str
    limits: str
    posed_by: str
    pose: Callable[[PosedProblem], _Cost]
    solve: Callable[[PosedProblem, _Cost], Solved]

    @property
    def name(self) -> str:
        """All three."""
        return f"{self.solver}, {self.limits}, {self.posed_by}"


class Timing(NamedTuple):
    """Times of one problem [s]."""

    pose: float
    wrapper: float
    solver: float

    @property
    def whole(self) -> float:
        """Time from the posed matrices to the answer."""
        return self.wrapper + self.solver


class Measured(NamedTuple):
    """What a way has done.

    Attributes:
        way: The way.
        times: A `Timing` a problem: that of the repeat which took least.
        answers: An answer a problem, None for none.
    """

    way: Way[Any]
    times: list[Timing]
    answers: list[Array | None]


class Stopwatch:
    """Measures the time inside a function, as long as it stands in that function's place.

    Args:
        call: The function.

    Attributes:
        seconds: Time inside it so far [s].
    """

    def __init__(self, call: Callable[..., Any]) -> None:
        self.seconds = 0.0
        self._call = call

    def __call__(self, *values: Any, **named: Any) -> Any:
        """Call it."""
        started = time.perf_counter()
        try:
            return self._call(*values, **named)
        finally:
            self.seconds += time.perf_counter() - started


class KeptLimits(mink.Limit):
    """The box and the rows of a problem as a limit of mink.

    Args:
        problem: The problem.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> mink.Constraint:
        """Return all as rows, as mink's own limits do."""
        _, _, lower, upper, rows = self._problem
        eye = np.eye(len(lower))
        G = [eye, -eye]
        h = [upper, -lower]
        if rows is not None:
            G.append(rows[0])
            h.append(rows[1])
        return mink.Constraint(np.vstack(G), np.concatenate(h))


@contextmanager
def installed_ways() -> Iterator[list[Way[Any]]]:
    """Yield each installed solver by each way of posing and limiting; the core is the first.

    In the block, functions of the core, of DAQP and of numpy are watched by a `Stopwatch`.
    """
    with (
        _watched(core, "solve_qp") as in_core,
        _watched(daqp, "solve") as in_daqp,
        _watched(np.linalg, "solve") as in_solve,
        _watched(np.linalg, "svd") as in_svd,
    ):
        called = [
            Way("core", "box", "direct", _pose, _call(solve_by_core, in_core)),
            Way(
                "daqp without qpsolvers",
                "box",
                "direct",
                _pose,
                _call(solve_by_daqp, in_daqp),
            ),
            Way("linear solve", "clipped", "direct", _pose, _call(_clipped, in_solve)),
        ]
        eq_8 = Way("pseudoinverse", "clipped", "eq. (8)", _pose_eq_8, _by_eq_8(in_svd))
        names = sorted(qpsolvers.available_solvers)
        yield [
            *called[:2],
            *(Way(name, "box", "direct", _pose, _by_name(name)) for name in names),
            *(Way(name, "rows", "mink", pose_by_mink, _mink(name)) for name in names),
            called[2],
            eq_8,
        ]


@contextmanager
def _watched(owner: ModuleType, name: str) -> Iterator[Stopwatch]:
    """Let a stopwatch stand in place of a function of a module."""
    with patch.object(owner, name, new=Stopwatch(vars(owner)[name])) as watch:
        yield watch


def measure(
    ways: Sequence[Way[Any]],
    problems: Sequence[PosedProblem],
    repeats: int,
    done: Callable[[], None] = lambda: None,
) -> list[Measured]:
    """Let all ways solve all problems, in turns.

    Of the repeats of a problem the one counts that took least: other programs slow a call down, and
    never quicken it.

    Args:
        ways: The ways.
        problems: The problems.
        repeats: How often each way solves each problem.
        done: Called after each problem.
    """
    found = [Measured(way, [], []) for way in ways]
    for k, posed in enumerate(problems):
        timings: list[list[Timing]] = [[] for _ in ways]
        answers: list[Array | None] = [None for _ in ways]
        for repeat in range(repeats):
            # No way is always first.
            first = (k + repeat) % len(ways)
            for i in [*range(first, len(ways)), *range(first)]:
                # The first run does not count: the caches hold the way before.
                run(ways[i], posed)
                timing, answers[i] = run(ways[i], posed)
                timings[i].append(timing)
        for i, own in enumerate(found):
            own.times.append(min(timings[i], key=sum))
            own.answers.append(answers[i])
        done()
    return found


def run(way: Way[Any], posed: PosedProblem) -> tuple[Timing, Array | None]:
    """Pose and solve one problem."""
    posed.restore()
    started = time.perf_counter()
    cost = way.pose(posed)
    ready = time.perf_counter()
    try:
        x, inside = way.solve(posed, cost)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        # Solvers raise these where a matrix is not definite to them.
        x, inside = None, 0.0
    ended = time.perf_counter()
    if x is not None and not np.isfinite(x).all():
        x = None
    return Timing(ready - started, ended - ready - inside, inside), x


def row_of(
    measured: Measured,
    base: Measured,
    problems: Sequence[Problem],
    optima: Sequence[Array],
) -> dict[str, Any]:
    """Return the row of a way in the table.

    Args:
        measured: What the way has done.
        base: What the core has done with the same problems.
        problems: The problems.
        optima: Their minimisers, each of shape (n,).
    """
    times = np.array(measured.times)
    whole = times[:, 1:].sum(axis=1)
    of_core = whole / np.array(base.times)[:, 1:].sum(axis=1)
    off = []
    limits = rows = 0
    for x, problem, optimum in zip(measured.answers, problems, optima, strict=True):
        if x is None:
            continue
        off.append(float(np.abs(x - optimum).max()))
        limits += limit_violation(problem, x) > BROKEN
        rows += row_violation(problem, x) > BROKEN
    pose, wrapper, solver = 1e6 * np.median(times, axis=0)
    return {
        "solver": measured.way.solver,
        "limits": measured.way.limits,
        "posed by": measured.way.posed_by,
        "of core": float(np.median(of_core)),
        "solver_us": float(solver),
        "wrapper_us": float(wrapper),
        "pose_us": float(pose),
        "no answer": len(problems) - len(off),
        "wrong": sum(each > WRONG for each in off),
        "limit broken": limits,
        "contact broken": rows,
        "off_max": max(off, default=float("nan")),
    }


def _pose(posed: PosedProblem) -> Matrices:
    """Return H and c, posed over Pinocchio."""
    return direct_cost(posed.ik.gate, posed.ik.configuration, posed.goal)


def pose_by_mink(posed: PosedProblem) -> qpsolvers.Problem:
    """Return the problem that mink builds, of tasks and a limit of mink."""
    limits = [KeptLimits(posed.problem)]
    ik = posed.ik
    return build_problem(ik.gate, ik.configuration, posed.goal, limits=limits)


def _call(
    solve: Callable[..., Array | None], watch: Stopwatch
) -> Callable[[PosedProblem, Matrices], Solved]:
    """Return a way of solving by a function, which calls the watched one."""

    def solved(posed: PosedProblem, cost: Matrices) -> Solved:
        before = watch.seconds
        x = solve(*cost, *posed.problem[2:])
        return Solved(x, watch.seconds - before)

    return solved


def _clipped(
    H: Array, c: Array, lower: Array, upper: Array, rows: Rows | None
) -> Array | None:
    """Solve without limits, and clip the answer into the box; nothing holds the rows."""
    del rows
    return np.clip(np.linalg.solve(H, -c), lower, upper)


def _by_name(name: str) -> Callable[[PosedProblem, Matrices], Solved]:
    """Return a way of solving by qpsolvers, with the limits as its box."""

    def solved(posed: PosedProblem, cost: Matrices) -> Solved:
        _, _, lower, upper, rows = posed.problem
        G, h = rows or (None, None)
        return _solved(qpsolvers.Problem(*cost, G, h, lb=lower, ub=upper), name)

    return solved


def _mink(name: str) -> Callable[[PosedProblem, qpsolvers.Problem], Solved]:
    """Return a way of solving by qpsolvers what mink has built, as `mink.solve_ik` does."""
    return lambda posed, problem: _solved(problem, name)


def _solved(problem: qpsolvers.Problem, name: str) -> Solved:
    solution = solve_exactly(problem, name)
    return Solved(answer_in(solution, name), solution.solve_time or 0.0)


def _pose_eq_8(posed: PosedProblem) -> Matrices:
    """Return the weighted Jacobian and error of points and wrist."""
    ik = posed.ik
    wrists = posed.goal.wrists
    wrist = None if wrists is None else pin.SE3(wrists[0])
    points = posed.goal.points
    return weighted_task(ik.hand, ik.options, ik.configuration, points, wrist)


def _by_eq_8(watch: Stopwatch) -> Callable[[PosedProblem, Matrices], Solved]:
    """Return a way of solving by eq. (8), clipped into the box; nothing holds the rows."""

    def solved(posed: PosedProblem, cost: Matrices) -> Solved:
        before = watch.seconds
        hand = posed.ik.hand
        away = posed.goal.rest - posed.q[hand.q_indices]
        step = _eq_8(hand, posed.ik.options).resolve(*cost, away)
        _, _, lower, upper, _ = posed.problem
        return Solved(np.clip(step, lower, upper), watch.seconds - before)

    return solved


@lru_cache(maxsize=16)
def _eq_8(hand: Hand, options: IkOptions) -> PseudoinverseIk:
    return PseudoinverseIk(hand, options)
