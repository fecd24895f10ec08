"""Every solver of `qpsolvers`, nearly as exact as DAQP, which `solve_by_daqp` calls by itself.

`qpsolvers` takes a second to import.
"""

import warnings
from collections.abc import Callable

import qpsolvers

from handmap_core.errors import InvalidOptionsError
from handmap_core.se3 import Array
from handmap_qp.hands import Values

# Settings for a solution nearly as exact as DAQP's; most defaults stop at 1e-3 to 1e-6. quadprog
# needs no setting. With smaller tolerances interior-point methods (clarabel, piqp) report failure,
# and OSQP often reaches its maximum number of iterations. ProxQP converges in some ten, or in its
# own 10,000 not either, which took half a minute on a hostile problem.
_EXACT: dict[str, Values] = {
    "clarabel": {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10},
    "daqp": {"primal_tol": 1e-12},
    "osqp": {"eps_abs": 1e-6, "eps_rel": 0.0, "max_iter": 50_000, "raise_error": False},
    "piqp": {
        "eps_abs": 1e-10,
        "eps_rel": 0.0,
        "eps_duality_gap_abs": 1e-10,
        "eps_duality_gap_rel": 0.0,
    },
    "proxqp": {"eps_abs": 1e-9, "eps_rel": 0.0, "max_iter": 100},
}


def solve_problem(problem: qpsolvers.Problem, solver: str = "daqp") -> Array | None:
    """Solve at a high accuracy.

    Args:
        problem: The QP.
        solver: Name in `qpsolvers.available_solvers`.

    Returns:
        The minimiser, shape (n,); None if the solver fails.
    """
    return answer_in(solve_exactly(problem, solver), solver)


def solve_exactly(problem: qpsolvers.Problem, solver: str) -> qpsolvers.Solution:
    """Solve at a high accuracy; return all that `qpsolvers` says, with the times that it took.

    Args:
        problem: The QP.
        solver: Name in `qpsolvers.available_solvers`.
    """
    with warnings.catch_warnings():
        # Some solvers want sparse matrices, and say so. OSQP calls its answers inaccurate where it
        # has used up its iterations; the box holds all the same, by clipping.
        warnings.simplefilter("ignore")
        return qpsolvers.solve_problem(problem, solver=solver, **_EXACT.get(solver, {}))


def answer_in(solution: qpsolvers.Solution, solver: str) -> Array | None:
    """Return the minimiser that a solver has found, shape (n,); None if it failed."""
    # What OSQP has after all its iterations is nearly right. ProxQP calls one in a hundred problems
    # with rows infeasible that are not, with an answer that is up to 0.3 rad off.
    return solution.x if solution.found or solver == "osqp" else None


def make_solver(name: str) -> Callable[..., Array | None]:
    """Return a solver with the arguments and the result of `solve_by_daqp`.

    Args:
        name: Name in `qpsolvers.available_solvers`.

    Raises:
        InvalidOptionsError: If no such solver is installed.
    """
    if name not in qpsolvers.available_solvers:
        known = ", ".join(sorted({"daqp", *qpsolvers.available_solvers}))
        raise InvalidOptionsError(
            option="solver", expected=f"one of {known}", value=name
        )

    return lambda H, c, lower, upper, rows=None: solve_problem(
        qpsolvers.Problem(H, c, *(rows or (None, None)), lb=lower, ub=upper), name
    )
