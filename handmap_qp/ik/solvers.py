"""QP solvers behind one call, for problems with a box: `min 1/2 x' H x + c' x  s.t.  lower <= x <= upper`.

DAQP and ProxQP are spoken to natively and keep their workspace and active set from call to call. Any other solver goes through
`qpsolvers`, which is convenient and slower.
"""

from __future__ import annotations

from typing import Protocol

import daqp
import numpy as np

from handmap_qp.errors import InvalidOptionsError

# At DAQP's default of 1e-6 a joint was left 4e-7 rad outside its limit.
_PRIMAL_TOLERANCE = 1e-9


class BoxSolver(Protocol):
    """A solver of one size of problem, which may start from its last solution."""

    def solve(self, H: np.ndarray, c: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        """The minimiser, shape (n,), or None where the solver found none."""
        ...


class DaqpSolver:
    """DAQP, a dual active-set method: exact, allocation-free, warm-started with the last active set.

    Args:
        size: Number of variables.
    """

    def __init__(self, size: int) -> None:
        self._rows = np.zeros((0, size))
        self._sense = np.zeros(size, dtype=np.int32)
        self._model = daqp.Model()
        self._is_set_up = False

    def solve(self, H: np.ndarray, c: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        """See `BoxSolver.solve`."""
        if self._is_set_up and self._model.update(H=H, f=c, bupper=upper, blower=lower) == 0:
            x, _, flag, _ = self._model.solve()
            if flag > 0:
                return x
        # The first problem, or one that could not be solved from the last one's active set.
        self._model = daqp.Model()
        self._model.settings = {"primal_tol": _PRIMAL_TOLERANCE}
        flag, _ = self._model.setup(H, c, self._rows, upper, lower, self._sense)
        self._is_set_up = flag > 0
        if self._is_set_up:
            x, _, flag, _ = self._model.solve()
            if flag > 0:
                return x
        return None


class ProxqpSolver:
    """ProxQP, an augmented-Lagrangian method, warm-started with its last result.

    Args:
        size: Number of variables.
        tolerance: Absolute accuracy; at 1e-6 a warm start can report a wrong active set as solved, at 1e-9 not.
    """

    def __init__(self, size: int, tolerance: float = 1e-9) -> None:
        from proxsuite import proxqp

        self._proxqp = proxqp
        self._qp = proxqp.dense.QP(size, 0, 0, True)
        self._qp.settings.eps_abs = tolerance
        self._qp.settings.eps_rel = 0.0
        self._is_initialised = False

    def solve(self, H: np.ndarray, c: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        """See `BoxSolver.solve`."""
        if self._is_initialised:
            self._qp.update(H=H, g=c, l_box=lower, u_box=upper)
        else:
            self._qp.init(H=H, g=c, l_box=lower, u_box=upper)
        self._qp.solve()
        if not self._is_initialised:
            # Only now: ProxQP 0.8 crashes if it is told to start warm before its first solution.
            self._qp.settings.initial_guess = self._proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
            self._is_initialised = True
        if self._qp.results.info.status != self._proxqp.QPSolverOutput.PROXQP_SOLVED:
            return None
        return np.array(self._qp.results.x)


class QpsolversSolver:
    """Any solver that `qpsolvers` finds, by its name there; always cold.

    Args:
        name: Such as `osqp`, `quadprog`, `piqp`, `clarabel`.
    """

    def __init__(self, name: str) -> None:
        import qpsolvers

        self._qpsolvers = qpsolvers
        self._name = name

    def solve(self, H: np.ndarray, c: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        """See `BoxSolver.solve`."""
        return self._qpsolvers.solve_qp(H, c, lb=lower, ub=upper, solver=self._name)


def make_solver(name: str, size: int) -> BoxSolver:
    """A solver by name.

    Args:
        name: `daqp` (default everywhere), `proxqp`, or any other that `qpsolvers` lists as available.
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
        raise InvalidOptionsError(f"solver: expected one of {known}; got {name!r}")
    return QpsolversSolver(name)
