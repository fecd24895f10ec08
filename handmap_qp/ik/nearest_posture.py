"""The posture in which a hand's reference points are nearest to their targets, by Newton's method.

    min   f(q) = 1/2 sum_j w_j^2 |p_j(q) - t_j|^2 + 1/2 w_q^2 |q - q_rest|^2
    s.t.  q_min <= q <= q_max

with the palm at rest. Targets may be out of reach, so the Hessian holds the curvature of the
points' paths too: the second derivative of a point by the joints i and j, i nearer to the palm, is
the axis of i times the point's derivative by j. Each step solves a QP with the joint limits. See
`handmap/posture.hpp`.
"""

from handmap_core.se3 import Array
from handmap_qp.hands import Hand


def nearest_posture(
    hand: Hand, targets: Array, costs: Array, rest_cost: float, start: Array
) -> Array:
    """Return the joint positions that bring a hand's points nearest to their targets.

    Joints that move the wrist (those of an arm) stay as in the rest posture.

    Args:
        hand: The hand.
        targets: Targets of its reference points, its wrist being where it is in the rest posture
            with the identity as wrist pose [m], shape (m, 3).
        costs: Cost of each point's error [1/m], shape (m,).
        rest_cost: Cost of leaving the rest posture [1/rad or 1/m].
        start: Joint positions to begin at, shape (n,); of several minima, the one nearby is found.

    Returns:
        Joint positions inside their limits [rad or m], shape (n,).
    """
    return hand.tree.nearest_posture(targets, costs, rest_cost, start)
