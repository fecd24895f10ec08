"""`ContactYield`: how far the commanded links of a hand may overlap, so that the real ones press.

Position control of stiffness K presses on what stops a joint by `K (q_command - q)`. Links that are
commanded to overlap by d press on each other by the force f with

    d = A f,    A = G W G^T,

where the rows G are the derivatives of the distances by the joints, and W = 1 / K. For pairs that
touch at once, f may be larger than for one alone: a finger between thumb and palm gets the force of
both. With c_kj <= 0 the entries of A by which one pair raises the force of another, a pair k may
overlap by

    d_k = F_k max(0, A_kk + sum_{j != k} w_j c_kj),    c_kj = min(A_kj, 0),

and by no more than the links' shapes allow. The weight w_j is 1 for a pair that touches, and 0 from
a distance of 1 mm on. No pair that may yield then presses by more than the largest F, where the
pair with the largest force f_k has a sum above 0: `d_k = (A f)_k >= f_k (A_kk + sum c_kj)`, so
`f_k <= F_k`. Where that sum is not above 0, as in one of eleven random sets of contacts, there is
no bound.

The compiled core computes the overlaps (`handmap/pairs.hpp`).
"""

from collections.abc import Sequence

import numpy as np

from handmap_core.models import YieldModel
from handmap_core.se3 import Array


class ContactYield(YieldModel, frozen=True, kw_only=True):
    """How far pairs of shapes may overlap in commands."""


def common_yield(
    of: Sequence[tuple[ContactYield | None, Array]],
) -> ContactYield | None:
    """Return how pairs of all hands of one robot yield; None if none does.

    Args:
        of: Of each hand, how its own pairs yield, and which of them are the common ones, (k,).
    """
    known = [(own, order) for own, order in of if own is not None]
    if not known:
        return None
    return ContactYield(
        forces=np.max([own.forces[order] for own, order in known], axis=0),
        depths=np.max([own.depths[order] for own, order in known], axis=0),
        compliances=np.max([own.compliances for own, _ in known], axis=0),
        torques=np.min([own.torques for own, _ in known], axis=0),
    )
