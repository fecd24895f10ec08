"""QP solvers behind one call: `min 1/2 x' H x + c' x  s.t.  lower <= x <= upper,  G x <= h`.

DAQP, the default, is called by itself. Any other solver is called through `qpsolvers`, which takes
a second to import.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import daqp
import numpy as np

from handmap_qp.errors import InvalidOptionsError

if TYPE_CHECKING:
    import qpsolvers

Rows = tuple[np.ndarray, np.ndarray]
"""G, shape (r, n), and h, shape (r,), of `G x <= h`."""

# At DAQP's default tolerance of 1e-6 a joint was left 4e-7 rad outside its limit. Beyond 1000
# iterations DAQP cycles, and scaling the problem ends the cycle. Of 90,000 hostile problems one
# took 450; with targets at 1e18 m it took its default of 10,000, in 12 ms.
_DAQP = {"primal_tol": 1e-9, "iter_limit": 1000}
# Settings for a solution nearly as exact as DAQP's; most defaults stop at 1e-3 to 1e-6. quadprog
# needs no setting. With smaller tolerances interior-point methods (clarabel, piqp) report failure,
# and OSQP often reaches its maximum number of iterations.
_EXACT: dict[str, dict[str, Any]] = {
    "clarabel": {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10},
    "daqp": {"primal_tol": 1e-12},
    "osqp": {"eps_abs": 1e-6, "eps_rel": 0.0, "max_iter": 50_000, "raise_error": False},
    "piqp": {
        "eps_abs": 1e-10,
        "eps_rel": 0.0,
        "eps_duality_gap_abs": 1e-10,
        "eps_duality_gap_rel": 0.0,
    },
    "proxqp": {"eps_abs": 1e-9, "eps_rel": 0.0},
}


class QpSolver(Protocol):
    """A solver of box-constrained problems."""

    def __call__(
        self,
        H: np.ndarray,
        c: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        rows: Rows | None = None,
    ) -> np.ndarray | None:
        """Return the minimiser, shape (n,), or None if the solver fails."""
        ...


def solve_by_daqp(
    H: np.ndarray,
    c: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    rows: Rows | None = None,
) -> np.ndarray | None:
    """Solve by DAQP, a dual active-set method: exact, and a warm start gains nothing."""
    G = np.zeros((0, len(c)))
    if rows is not None:
        # DAQP takes the box first and the rows behind it.
        G, h = rows
        upper = np.concatenate([upper, h])
        lower = np.concatenate([lower, np.full(len(h), -np.inf)])
    sense = np.zeros(len(upper), dtype=np.int32)
    x, _, flag, _ = daqp.solve(H, c, G, upper, lower, sense, **_DAQP)
    if flag <= 0:
        # With a Hessian of 1e11 (targets 1000 km away) it reports feasible problems as
        # infeasible. The solution does not depend on the cost's scale.
        scale = 1.0 / H.diagonal().max()
        x, _, flag, _ = daqp.solve(
            scale * H, scale * c, G, upper, lower, sense, **_DAQP
        )
    return x if flag > 0 else None


def solve_problem(
    problem: qpsolvers.Problem, solver: str = "daqp"
) -> np.ndarray | None:
    """Solve by any solver of qpsolvers, at a high accuracy.

    Args:
        problem: The QP.
        solver: Its name in `qpsolvers.available_solvers`.

    Returns:
        The minimiser, shape (n,); None if the solver fails.
    """
    import qpsolvers

    with warnings.catch_warnings():
        # Some solvers want sparse matrices, and say so. OSQP calls its answers inaccurate where it
        # has used up its iterations; the box holds all the same, by clipping.
        warnings.simplefilter("ignore")
        solution = qpsolvers.solve_problem(
            problem, solver=solver, **_EXACT.get(solver, {})
        )
    return solution.x


def _solve_by_qpsolvers(
    solver: str,
    H: np.ndarray,
    c: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    rows: Rows | None = None,
) -> np.ndarray | None:
    import qpsolvers

    G, h = (None, None) if rows is None else rows
    return solve_problem(qpsolvers.Problem(H, c, G, h, lb=lower, ub=upper), solver)


def make_solver(name: str) -> QpSolver:
    """Return a solver by name.

    Args:
        name: `daqp` (default everywhere), or any other that `qpsolvers` lists as available.

    Raises:
        InvalidOptionsError: If no such solver is installed.
    """
    if name == "daqp":
        return solve_by_daqp
    import qpsolvers

    if name not in qpsolvers.available_solvers:
        known = ", ".join(sorted({"daqp", *qpsolvers.available_solvers}))
        raise InvalidOptionsError(
            option="solver", expected=f"one of {known}", value=name
        )
    return partial(_solve_by_qpsolvers, name)
