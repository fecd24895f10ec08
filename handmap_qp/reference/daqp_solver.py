"""DAQP, a dual active-set solver for QPs, called without qpsolvers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import daqp
import numpy as np

from handmap_core.se3 import Array

if TYPE_CHECKING:
    from handmap_core.ik.gate import Rows

# At DAQP's default tolerance of 1e-6 a joint was left 4e-7 rad outside its limit. Beyond 1000
# iterations DAQP cycles, and scaling the problem ends the cycle. Of 90,000 hostile problems one
# took 450; with targets at 1e18 m it took its default of 10,000, in 12 ms.
_DAQP = {"primal_tol": 1e-9, "iter_limit": 1000}


def solve_by_daqp(
    H: Array, c: Array, lower: Array, upper: Array, rows: Rows | None = None
) -> Array | None:
    """Solve `min 1/2 x^T H x + c^T x` by DAQP: exact, and a warm start gains nothing.

    Args:
        H: Hessian, symmetric and positive definite, shape (n, n).
        c: Slope at zero, shape (n,).
        lower: Lower bounds, shape (n,).
        upper: Upper bounds, shape (n,).
        rows: G, shape (r, n), and h, shape (r,), of `G x <= h`; none if omitted.

    Returns:
        The minimiser, shape (n,); None if the solver fails.
    """
    G = np.zeros((0, len(c)))
    if rows:
        # DAQP takes the box first and the rows behind it.
        G, h = rows
        upper = np.append(upper, h)
        lower = np.append(lower, np.full(len(h), -np.inf))
    sense = np.zeros(len(upper), dtype=np.int32)
    # With a Hessian of 1e11 (targets 1000 km away) it reports feasible problems as infeasible. The
    # solution does not depend on the cost's scale.
    for scale in (1.0, 1.0 / H.diagonal().max()):
        cost = scale * H, scale * c
        x, _, flag, _ = daqp.solve(*cost, G, upper, lower, sense, **_DAQP)
        if flag > 0:
            return x
    return None
