"""QP solvers behind one call: `min 1/2 x' H x + c' x  s.t.  lower <= x <= upper,  G x <= h`.

DAQP and ProxQP are called natively and keep their workspace and active set between calls. Any other
solver is called through `qpsolvers`, which is slower.
"""

from __future__ import annotations

import warnings
from typing import Any, Protocol

import daqp
import numpy as np

from handmap_qp.errors import InvalidOptionsError

Rows = tuple[np.ndarray, np.ndarray]
"""G, shape (k, n), and h, shape (k,)."""

# At DAQP's default tolerance of 1e-6 a joint was left 4e-7 rad outside its limit. Beyond 1000
# iterations DAQP cycles, and scaling the problem ends the cycle. Of 90,000 hostile problems one
# took 450; with targets at 1e18 m it took its default of 10,000, in 12 ms.
_SETTINGS = {"primal_tol": 1e-9, "iter_limit": 1000}
# Settings for a solution nearly as exact as DAQP's; most defaults stop at 1e-3 to 1e-6. quadprog
# needs no setting. Interior-point methods (clarabel, piqp) report failure with smaller
# tolerances.
EXACT: dict[str, dict[str, Any]] = {
    "clarabel": {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10},
    "daqp": {"primal_tol": 1e-12},
    "osqp": {"eps_abs": 1e-10, "eps_rel": 0.0, "max_iter": 200_000, "raise_error": False},
    "piqp": {
        "eps_abs": 1e-10,
        "eps_rel": 0.0,
        "eps_duality_gap_abs": 1e-10,
        "eps_duality_gap_rel": 0.0,
    },
    "proxqp": {"eps_abs": 1e-11, "eps_rel": 0.0},
}


# With a smaller tolerance OSQP often reaches its maximum number of iterations.
_EXACT_ENOUGH: dict[str, dict[str, Any]] = {
    "osqp": {"eps_abs": 1e-6, "eps_rel": 0.0, "max_iter": 50_000, "raise_error": False}
}


class QpSolver(Protocol):
    """A solver for problems of one size, which may warm-start from its last solution."""

    def solve(
        self,
        H: np.ndarray,
        c: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        rows: Rows | None = None,
    ) -> np.ndarray | None:
        """Return the minimiser, shape (n,), or None if the solver fails."""
        ...


class DaqpSolver:
    """DAQP, a dual active-set method: exact, and so quick that a warm start gains nothing.

    Args:
        size: Number of variables.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._no_rows = np.zeros((0, size))
        self._box_sense = np.zeros(size, dtype=np.int32)
        self._grow(0)

    def solve(
        self,
        H: np.ndarray,
        c: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        rows: Rows | None = None,
    ) -> np.ndarray | None:
        """See `QpSolver.solve`."""
        if rows is None or not len(rows[1]):
            G, sense = self._no_rows, self._box_sense
        else:
            # DAQP takes the box first and the rows behind it.
            (G, h), size = rows, self._size
            total = size + len(h)
            if total > len(self._sense):
                self._grow(2 * len(h))
            self._lower[:size], self._upper[:size], self._upper[size:total] = lower, upper, h
            lower, upper, sense = self._lower[:total], self._upper[:total], self._sense[:total]
        x, _, flag, _ = daqp.solve(H, c, G, upper, lower, sense, **_SETTINGS)
        if flag <= 0:
            # With a Hessian of 1e11 (targets 1000 km away) it reports feasible problems as
            # infeasible. The solution does not depend on the cost's scale.
            scale = 1.0 / H.diagonal().max()
            x, _, flag, _ = daqp.solve(scale * H, scale * c, G, upper, lower, sense, **_SETTINGS)
        return x if flag > 0 else None

    def _grow(self, row_count: int) -> None:
        total = self._size + row_count
        self._sense = np.zeros(total, dtype=np.int32)
        self._lower, self._upper = np.full(total, -np.inf), np.empty(total)


class ProxqpSolver:
    """ProxQP, an augmented-Lagrangian method, warm-started with its last result.

    Problems whose number of rows differs from the last one's start cold.

    Args:
        size: Number of variables.
        tolerance: Absolute accuracy; at 1e-6 a warm start can report a wrong active set as solved,
            at 1e-9 not.
    """

    def __init__(self, size: int, tolerance: float = 1e-9) -> None:
        from proxsuite import proxqp

        self._proxqp, self._size, self._tolerance = proxqp, size, tolerance
        self._resize(0)

    def solve(
        self,
        H: np.ndarray,
        c: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        rows: Rows | None = None,
    ) -> np.ndarray | None:
        """See `QpSolver.solve`."""
        count = 0 if rows is None else len(rows[1])
        if count != len(self._unbounded):
            self._resize(count)
        linear = {"C": rows[0], "l": self._unbounded, "u": rows[1]} if rows and count else {}
        if self._is_initialised:
            self._qp.update(H=H, g=c, l_box=lower, u_box=upper, **linear)
        else:
            self._qp.init(H=H, g=c, l_box=lower, u_box=upper, **linear)
        self._qp.solve()
        if not self._is_initialised:
            # ProxQP 0.8 crashes if a warm start is set before its first solution.
            warm = self._proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
            self._qp.settings.initial_guess = warm
            self._is_initialised = True
        if self._qp.results.info.status != self._proxqp.QPSolverOutput.PROXQP_SOLVED:
            return None
        return np.array(self._qp.results.x)

    def _resize(self, row_count: int) -> None:
        self._qp = self._proxqp.dense.QP(self._size, 0, row_count, True)
        self._qp.settings.eps_abs = self._tolerance
        self._qp.settings.eps_rel = 0.0
        self._unbounded = np.full(row_count, -1e20)
        self._is_initialised = False


class QpsolversSolver:
    """Any solver that `qpsolvers` finds, by its name there; without warm start.

    Args:
        name: Such as `osqp`, `quadprog`, `piqp`, `clarabel`.
        **settings: Settings of the solver. With its defaults OSQP is wrong by up to 0.04 rad.
    """

    def __init__(self, name: str, **settings: Any) -> None:
        import qpsolvers

        self._qpsolvers = qpsolvers
        self._name = name
        self._settings = settings

    def solve(
        self,
        H: np.ndarray,
        c: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        rows: Rows | None = None,
    ) -> np.ndarray | None:
        """See `QpSolver.solve`."""
        G, h = (None, None) if rows is None else rows
        with warnings.catch_warnings():
            # OSQP calls its answers inaccurate where it has used up its iterations; the box holds
            # all the same, by clipping.
            warnings.simplefilter("ignore", UserWarning)
            return self._qpsolvers.solve_qp(
                H, c, G, h, lb=lower, ub=upper, solver=self._name, **self._settings
            )


def make_solver(name: str, size: int) -> QpSolver:
    """Return a solver by name.

    Args:
        name: `daqp` (default everywhere), `proxqp`, or any other that `qpsolvers` lists as
            available.
        size: Number of variables.

    Returns:
        A solver for problems of that size.

    Raises:
        InvalidOptionsError: If no such solver is installed.
    """
    if name == "daqp":
        return DaqpSolver(size)
    if name == "proxqp":
        return ProxqpSolver(size)
    import qpsolvers

    if name not in qpsolvers.available_solvers:
        known = ", ".join(sorted({"daqp", "proxqp", *qpsolvers.available_solvers}))
        raise InvalidOptionsError(option="solver", expected=f"one of {known}", value=name)
    return QpsolversSolver(name, **{**EXACT, **_EXACT_ENOUGH}.get(name, {}))
