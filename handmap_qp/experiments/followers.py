"""Inverse kinematics of the robot in the experiments: eq. (8) and four alternatives.

| fingers | inverse kinematics |
|---|---|
| `pseudoinverse` | eq. (8) with `xi = 0`: wrist by T_rb, `dq = J# (p_f - p_rb)`, limits ignored |
| `clipped` | the same, each step clipped into the position limits of the joints |
| `damped` | `PseudoinverseIk`: the cost of the QP without its limits, clipped afterwards |
| `qp` | `PointIk`: the same cost within the limits |
| `frozen` | the wrist moves by T_rb, the fingers do not move |

`damped` and `qp` solve for wrist and fingers together. In both, the rest term is off
(`rest_weight = 0`), and there are no speed limits, because a step has no duration.
"""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.pseudoinverse import PseudoinverseIk
from handmap_qp.ik.qp import PointIk

FingerMode = Literal["pseudoinverse", "clipped", "damped", "qp", "frozen"]

IK = IkOptions(
    rest_weight=0.0,
    damping=0.01,
    error_damping=0.0,
    max_iterations=20,
    step_tolerance=1e-7,
    has_velocity_limits=False,
)
"""Options of the QP in the experiment: iterated to convergence, without a rest term."""

_STEP_TIME = 1.0


class Follower(Protocol):
    """A robot that follows targets step by step."""

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
        """Move by one step.

        Args:
            targets: Targets of the reference points [m], shape (m, 3).
            wrist_target: Target pose of the wrist, shape (4, 4).
        """
        ...


def make_follower(
    fingers: FingerMode, hand: Hand, q: np.ndarray, wrist: np.ndarray | None
) -> Follower:
    """Return a robot at its start configuration.

    Args:
        fingers: The inverse kinematics; see the table of this module.
        hand: The hand, with the reference points to be moved.
        q: Joint angles at the start [rad], shape (n,).
        wrist: Pose of the wrist at the start, shape (4, 4); None is the identity.

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
    """Eq. (8) of the paper, once per step: T_rb moves the wrist, the fingers do the rest."""

    def __init__(self, hand: Hand, q: np.ndarray, wrist: np.ndarray, fingers: FingerMode) -> None:
        self.q, self.wrist, self.points = q, wrist, hand.points(q, wrist)
        self._hand, self._fingers = hand, fingers

    def follow(self, targets: np.ndarray, wrist_target: np.ndarray) -> None:
        """Move by one step."""
        hand, q = self._hand, self.q
        if self._fingers != "frozen":
            # Use the Jacobian after T_rb, where the finger motion starts.
            displacement = (targets - hand.points(q, wrist_target)).ravel()
            q = q + np.linalg.pinv(hand.point_jacobian(q, wrist_target)) @ displacement
        if self._fingers == "clipped":
            q = np.clip(q, hand.lower_limits, hand.upper_limits)
        self.q, self.wrist, self.points = q, wrist_target, hand.points(q, wrist_target)


class IkFollower:
    """A solver of the library, for wrist and fingers together."""

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
        """Move by one step."""
        self._solver.solve(targets, wrist_target, _STEP_TIME)
