"""Eq. (8) as it stands: `dq = J# e + N xi`, the baseline that the QP replaces.

The paper leaves the pseudoinverse, `xi` and the handling of limits open. Here J# is weighted by the
cost of the tasks and by the regularisation M of the QP (rest and damping weights), and `N xi` pulls
to the rest posture:

    A = W J M^(-1/2),   dq = M^(-1/2) (A# W e + (I - A# A) M^(1/2) xi),   xi = M^(-1) w_q^2 (q_rest
    - q)

With singular values `s` of A, `A#` has `s / (s^2 + damping^2)`: eq. (8) for `damping = 0`, which is
the limit of the QP for slack limits and vanishing regularisation; damped least squares (Nakamura
and Hanafusa 1986, Wampler 1986) for `damping > 0`. At `damping = 1` it is the QP without its
limits. Limits are either ignored, or the finished step is clipped into them, which changes its
direction.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import pinocchio as pin

from handmap_core.ik.gate import IkGate, Rows
from handmap_core.ik.motion import Motion, When
from handmap_core.ik.options import IkOptions
from handmap_core.ik.tasks import Goal
from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands import PinocchioConfiguration
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.qp import PointIk
from handmap_qp.reference import ReferenceIk
from handmap_qp.reference.problem import point_rows, wrist_rows

RANK_TOLERANCE = 1e-10
"""Without damping, singular values below this share of the largest count as zero."""


def weighted_task(
    hand: Hand,
    options: IkOptions,
    configuration: PinocchioConfiguration,
    points: np.ndarray,
    wrist: pin.SE3 | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted Jacobian and error of all targets, (r, k) and (r,); 6 rows for a wrist."""
    parts = [point_rows(configuration, points, None)]
    if wrist is not None:
        parts.append(wrist_rows(configuration, wrist))
    error, jacobian = (np.concatenate(each) for each in zip(*parts, strict=True))
    costs = np.repeat([*options.point_costs(hand), *options.wrist_costs], 3)
    costs = costs[: len(error)]
    return costs[:, None] * jacobian, costs * error


class PseudoinverseIk(PointIk):
    """Move a hand by eq. (8), with the interface of `handmap_qp.ik.qp.PointIk`.

    Args:
        hand: The hand.
        options: Weights and settings; `solver` and `error_damping` have no meaning here.
        limits: `none` ignores position and speed limits, `clip` clips every finished step into
            them.
        damping: 0 for the plain pseudoinverse, more for damped least squares; 1 is the
            regularisation of the QP.

    Raises:
        InvalidOptionsError: If the damping is negative or not a number, or the limit handling is
            unknown.
    """

    def __init__(
        self,
        hand: Hand,
        options: IkOptions,
        *,
        limits: Literal["none", "clip"] = "none",
        damping: float = 0.0,
    ) -> None:
        if not 0.0 <= damping < np.inf:
            raise InvalidOptionsError(
                option="damping", expected="a finite number >= 0", value=damping
            )
        if limits not in ("none", "clip"):
            raise InvalidOptionsError(
                option="limits", expected="'none' or 'clip'", value=limits
            )
        super().__init__(hand, options)
        if limits == "none":
            self.gate = _NoLimits(hand, self.gate.motion, options)
            self.core = self.gate.core
        self.reference = self._eq_8 = _Eq8(hand, self.gate, damping)

    def place(self, q: np.ndarray) -> None:
        """Put the hand at a configuration (nq,), at rest, from where `step` steps."""
        super().place(q)
        self._eq_8.configuration.place(q)

    def step(self, goal: Goal) -> np.ndarray:
        """Return the step of eq. (8) where the hand was placed; see `_Eq8.displacement`."""
        return self._eq_8.displacement(goal)

    def resolve(self, A: np.ndarray, b: np.ndarray, away: np.ndarray) -> np.ndarray:
        """Return the step of eq. (8) of given tasks; see `_Eq8.resolve`."""
        return self._eq_8.resolve(A, b, away)


class _Eq8(ReferenceIk):
    """Steps by eq. (8) in place of the QP.

    Args:
        hand: The hand.
        gate: Its gate.
        damping: As of `PseudoinverseIk`.
    """

    def __init__(self, hand: Hand, gate: IkGate, damping: float) -> None:
        super().__init__(hand, gate)
        self._damping = damping
        options = self.options
        regularisation = np.full(self.configuration.nv, options.damping**2)
        regularisation[hand.joint_columns] += options.rest_weight**2
        self._scale = 1.0 / np.sqrt(regularisation)

    def displacement(self, goal: Goal) -> np.ndarray:
        """Return the step of eq. (8) at the present configuration.

        Args:
            goal: Targets, and the posture to rest in.

        Returns:
            Displacement before any clipping, shape (nv,).

        Raises:
            numpy.linalg.LinAlgError: If the singular values cannot be found: the inputs hold
                infinities or NaN.
        """
        hand = self.hand
        configuration = self.configuration
        wrist = None if goal.wrists is None else pin.SE3(goal.wrists[0])
        A, b = weighted_task(hand, self.options, configuration, goal.points, wrist)
        return self.resolve(A, b, goal.rest - configuration.q[hand.q_indices])

    def resolve(self, A: np.ndarray, b: np.ndarray, away: np.ndarray) -> np.ndarray:
        """Return the step of eq. (8) of given tasks.

        Args:
            A: Weighted Jacobian, shape (r, nv).
            b: Weighted error, shape (r,).
            away: Posture to rest in minus the present one, shape (n,).

        Returns:
            Displacement before any clipping, shape (nv,).

        Raises:
            numpy.linalg.LinAlgError: As `displacement`.
        """
        U, s, Vt = np.linalg.svd(A * self._scale, full_matrices=False)
        if self._damping > 0.0:
            inverse = s / (s**2 + self._damping**2)
        else:
            is_kept = s > RANK_TOLERANCE * s[0]
            inverse = np.divide(1.0, s, out=np.zeros_like(s), where=is_kept)
        joints = self.hand.joint_columns
        homogeneous = np.zeros(A.shape[1])
        homogeneous[joints] = self.options.rest_weight**2 * self._scale[joints] * away
        # In the basis of the right singular vectors N is diagonal: 1 - inverse s, and 1 outside
        # their span.
        along = inverse * (U.T @ b + s * (Vt @ homogeneous))
        return self._scale * (homogeneous - Vt.T @ along)

    def step(
        self, goal: Goal, lower: np.ndarray, upper: np.ndarray, rows: Rows | None
    ) -> tuple[np.ndarray | None, np.ndarray]:
        """Return the step and no slope; see `ReferenceIk.step`."""
        if goal.tasks:
            raise InvalidOptionsError(
                option="tasks", problem="eq. (8) has no further tasks"
            )
        still = np.zeros(len(lower))
        try:
            step = self.displacement(goal)
        except np.linalg.LinAlgError:
            return None, still
        return step if np.isfinite(step).all() else None, still


class _NoLimits(IkGate):
    """Admits every displacement."""

    def bounds(self, when: When, share: float = 1.0) -> np.ndarray:
        """Return infinite bounds."""
        free = np.full(len(self.motion.displacement), np.inf)
        return np.array([-free, free])

    def admit(
        self,
        wanted: np.ndarray,
        first: np.ndarray,
        when: When,
        rows: object = None,
        around: object = None,
    ) -> np.ndarray:
        """Move the robot by a displacement, whatever it is."""
        placed = self.hand.configuration()
        assert isinstance(placed, PinocchioConfiguration)
        placed.displace(self.motion.q, wanted)
        dt, _, time = self.interval(when)
        self.motion = Motion(placed.q.copy(), wanted, dt, np.zeros(len(wanted)), time)
        return wanted
