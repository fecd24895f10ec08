"""Ways in which the robot follows its targets: eq.

(8) as the paper has it, or clipped, damped, as the QP, or not at all.

| fingers | what |
|---|---|
| `pseudoinverse` | eq. (8) with `xi = 0`: the wrist goes where T_rb takes it, `dq = J# (p_f -
p_rb)`; limits are not looked at | | `clipped` | the same, every step clipped into the joints'
position limits | | `damped` | `PseudoinverseIk`: wrist and fingers together, the QP's own cost
without its limits, clipped into them afterwards | | `qp` | `PointIk`: the same cost within the
limits | | `frozen` | the wrist alone |

In `damped` and `qp` the null-space term is off too (`rest_weight = 0`), and so are speed limits, as
a step has no duration.
"""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.pseudoinverse import PseudoinverseIk
from handmap_qp.ik.qp import PointIk

Fingers = Literal["pseudoinverse", "clipped", "damped", "qp", "frozen"]

IK = IkOptions(
    rest_weight=0.0,
    damping=0.01,
    error_damping=0.0,
    max_iterations=20,
    step_tolerance=1e-7,
    has_velocity_limits=False,
)
"""Settings of the QP in the experiment.

Steps are solved to the end, and nothing pulls the joints anywhere.
"""

_STEP_TIME = 1.0


class Follower(Protocol):
    """A robot on its way."""

    @property
    def q(self) -> np.ndarray:
        """Joint angles [rad], shape (n,)."""
        ...

    @property
    def wrist(self) -> np.ndarray:
        """Wrist pose, shape (4, 4)."""
        ...

    @property
    def points(self) -> np.ndarray:
        """Reference points [m], shape (m, 3)."""
        ...

    def follow(self, targets: np.ndarray, wrist_target: np.ndarray) -> None:
        """Go one step.

        Args:
            targets: Where the reference points shall be [m], shape (m, 3).
            wrist_target: Where the wrist shall be, shape (4, 4).
        """
        ...


def make_follower(
    fingers: Fingers, hand: Hand, q: np.ndarray, wrist: np.ndarray | None
) -> Follower:
    """A robot at its start.

    Args:
        fingers: How it follows.
        hand: The hand, its reference points those to be moved.
        q: Joint angles at the start [rad], shape (n,).
        wrist: Wrist pose there, shape (4, 4); the identity if omitted.

    Returns:
        The follower.
    """
    pose = np.eye(4) if wrist is None else wrist
    if fingers == "qp":
        return IkFollower(PointIk(hand, IK), q, pose)
    if fingers == "damped":
        return IkFollower(PseudoinverseIk(hand, IK, limits="clip", damping=1.0), q, pose)
    return PseudoinverseFollower(hand, q, pose, fingers)


class PseudoinverseFollower:
    """The paper's eq. (8), once a step: the rigid part to the wrist, the rest to the fingers."""

    def __init__(self, hand: Hand, q: np.ndarray, wrist: np.ndarray, fingers: Fingers) -> None:
        self.q, self.wrist, self.points = q, wrist, hand.points(q, wrist)
        self._hand, self._fingers = hand, fingers

    def follow(self, targets: np.ndarray, wrist_target: np.ndarray) -> None:
        """Go one step."""
        hand, q = self._hand, self.q
        if self._fingers != "frozen":
            # The Jacobian after the rigid part, where the finger motion starts.
            displacement = (targets - hand.points(q, wrist_target)).ravel()
            q = q + np.linalg.pinv(hand.point_jacobian(q, wrist_target)) @ displacement
        if self._fingers == "clipped":
            q = np.clip(q, hand.lower_limits, hand.upper_limits)
        self.q, self.wrist, self.points = q, wrist_target, hand.points(q, wrist_target)


class IkFollower:
    """One of the library's solvers, wrist and fingers together."""

    def __init__(self, solver: PointIk | PseudoinverseIk, q: np.ndarray, wrist: np.ndarray) -> None:
        self._solver = solver
        solver.place(solver.hand.configuration_vector(q, wrist))

    @property
    def q(self) -> np.ndarray:
        """Joint angles."""
        return self._solver.configuration.q[self._solver.hand.q_indices]

    @property
    def wrist(self) -> np.ndarray:
        """Wrist pose."""
        return self._solver.configuration.wrist.homogeneous

    @property
    def points(self) -> np.ndarray:
        """Reference points."""
        return self._solver.configuration.points.copy()

    def follow(self, targets: np.ndarray, wrist_target: np.ndarray) -> None:
        """Go one step."""
        self._solver.solve(targets, wrist_target, _STEP_TIME)
