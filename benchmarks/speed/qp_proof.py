"""Judge answers of QPs: certificates by duality, the reference, and the proof of the core."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import Any, NamedTuple, TypeGuard

import common
import numpy as np
from qp_problems import Problem
from scipy.optimize import nnls

from handmap_core.core import core
from handmap_core.ik.gate import Rows
from handmap_core.se3 import Array
from handmap_qp.reference.daqp_solver import solve_by_daqp

QpSolver = Callable[..., Array | None]
"""Takes H, c, lower and upper bounds, and rows; returns the answer, None for none."""
VERDICTS = ("equal", "core better", "core worse", "core failed", "other failed")
_EQUAL = 1e-9
_ACTIVE = (1e-9, 1e-12, 1e-15)
_CERTIFIED = 1e-6
"""Farthest that a reference may be from the optimum [rad or m]."""


class Reference(NamedTuple):
    """An answer, shape (n,), and a bound of its distance to the optimum [rad or m]."""

    x: Array
    radius: float


class Certificate(NamedTuple):
    """By how much at most an objective is above the optimum, and the multipliers that show it."""

    excess: float
    multipliers: Array


def certify(problem: Problem, x: Array) -> Certificate:
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
                found, rest = nnls(
                    normals[:, is_active], -slope / steepest, maxiter=1000
                )
            except RuntimeError:
                continue  # it cycles; another tolerance may do
            multipliers[is_active], left = steepest * found, steepest * rest
        excess = 0.5 * left**2 + multipliers[is_active] @ slack[is_active]
        best = min(best, Certificate(float(excess), multipliers), key=itemgetter(0))
    return best


def constraints(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return the normals of all constraints, shape (2 n + r, n), and their slacks at x."""
    eye = np.eye(len(x))
    G, h = problem.rows or (eye[:0], x[:0])
    slack = (x - problem.lower, problem.upper - x, h - G @ x)
    return np.vstack([-eye, eye, G]), np.concatenate(slack)


def reference_answer(problem: Problem) -> Reference:
    """Return the best answer of solvers that are exact, and how far at most it is off.

    The bound needs no solver: `certify` bounds the objective's excess, and the objective grows with
    the squared distance to the minimiser by half the least eigenvalue of H.

    Raises:
        RuntimeError: If no answer is certified.
    """
    best: Reference | None = None
    for solve in (solve_by_core, solve_by_daqp):
        x = solve(*problem)
        if not is_answer(x, problem):
            continue
        excess = max(certify(problem, x).excess, 0.0)
        least = float(np.linalg.eigvalsh(problem.H)[0])
        radius = float(np.sqrt(2.0 * excess / least))
        if best is None or radius < best.radius:
            best = Reference(x, radius)
    if best is None or not best.radius < _CERTIFIED:
        raise RuntimeError("no answer is certified as the optimum")
    return best


def objective(problem: Problem, x: Array) -> float:
    """Return the objective at x."""
    return float(0.5 * x @ problem.H @ x + problem.c @ x)


def verdict(problem: Problem, ours: Array | None, x: Array | None) -> str:
    """Say which of two answers is better; see `bench_solvers`.

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


def prove(
    problems: Sequence[Problem], others: Mapping[str, QpSolver]
) -> list[dict[str, Any]]:
    """Hold the core's answers against those of other solvers, and certify them.

    Args:
        problems: The problems.
        others: The other solvers by name.

    Returns:
        A row of each other solver: on how many problems both answers are equal, the core's is
        better or worse, or one of them fails. And the core's largest relative excess above the
        certified optimum, and its largest violation.
    """
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
        {"solver": name, **{what: count[what] for what in VERDICTS}}
        | {"gap_max": float(np.max(gaps)), "violation_max": float(np.max(violations))}
        for name, count in counts.items()
    ]


def is_answer(x: Array | None, problem: Problem) -> TypeGuard[Array]:
    """Whether a solver has an answer that holds all constraints."""
    return x is not None and violation_of(problem, x) <= _EQUAL


def violation_of(problem: Problem, x: Array) -> float:
    """Return the largest violation of a bound or a normalised row, over the largest step or 1."""
    worst = max(limit_violation(problem, x), row_violation(problem, x))
    worst = worst if np.isfinite(x).all() else np.inf
    return float(worst / max(1.0, np.abs(x).max()))


def limit_violation(problem: Problem, x: Array) -> float:
    """Return the largest violation of a bound [rad or m]; 0 for none."""
    return float(max(0.0, (problem.lower - x).max(), (x - problem.upper).max()))


def row_violation(problem: Problem, x: Array) -> float:
    """Return the largest violation of a row over the row's norm [rad or m]; 0 for none."""
    if problem.rows is None:
        return 0.0
    G, h = problem.rows
    lengths = np.linalg.norm(G, axis=1)
    # Shorter ones hold no coordinate: their numbers are rounding.
    excess, is_row = G @ x - h, lengths >= 1e-12
    return float((excess[is_row] / lengths[is_row]).max(initial=0.0))


def solve_by_core(
    H: Array,
    c: Array,
    lower: Array,
    upper: Array,
    rows: Rows | None = None,
) -> Array | None:
    """Solve by the compiled core; see `solve_by_daqp`."""
    is_found, x, _ = core.solve_qp(H, c, lower, upper, *(rows or (None, None)))
    return x if is_found else None
