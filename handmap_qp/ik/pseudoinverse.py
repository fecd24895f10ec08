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

from collections.abc import Sequence
from typing import Literal

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.costs import point_costs, wrist_costs
from handmap_qp.ik.limits import BoxLimits
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import End, IkResult
from handmap_qp.ik.tasks import Task

LimitHandling = Literal["none", "clip"]

RANK_TOLERANCE = 1e-10
"""Without damping, singular values below this share of the largest count as zero."""


class PseudoinverseIk:
    """Move a hand by eq. (8), with the interface of `handmap_qp.ik.qp.PointIk`.

    Args:
        hand: The hand.
        options: Weights and settings; `solver` and `error_damping` have no meaning here.
        limits: `none` ignores position and speed limits, `clip` clips every finished step into
            them.
        damping: 0 for the plain pseudoinverse, more for damped least squares; 1 is the
            regularisation of the QP.

    Attributes:
        hand: The hand.
        options: Weights and settings.
        configuration: The present posture; `place` puts the hand somewhere else.

    Raises:
        InvalidOptionsError: If the damping is negative or not a number, or the limit handling is
            unknown.
    """

    def __init__(
        self,
        hand: Hand,
        options: IkOptions,
        *,
        limits: LimitHandling = "none",
        damping: float = 0.0,
    ) -> None:
        if not 0.0 <= damping < np.inf:
            raise InvalidOptionsError(
                option="damping", expected="a finite number >= 0", value=damping
            )
        if limits not in ("none", "clip"):
            raise InvalidOptionsError(option="limits", expected="'none' or 'clip'", value=limits)
        self.hand = hand
        self.options = options
        self.configuration = hand.configuration()
        self._damping = damping
        self._rest = hand.rest
        self._box = (
            BoxLimits(hand, has_velocity_limits=options.has_velocity_limits)
            if limits == "clip"
            else None
        )
        nv = self.configuration.nv
        position, orientation = wrist_costs(options)
        self._costs = np.concatenate(
            [np.repeat(point_costs(hand, options), 3), [position] * 3, [orientation] * 3]
        )
        regularisation = np.full(nv, float(options.damping) ** 2)
        regularisation[hand.joint_columns] += options.rest_weight**2
        self._scale = 1.0 / np.sqrt(regularisation)
        self._rest_gain = options.rest_weight**2 * self._scale[hand.joint_columns]

    def place(self, q: np.ndarray) -> None:
        """Put the hand at a configuration.

        Args:
            q: Pinocchio configuration, shape (nq,).
        """
        self.configuration.place_with_jacobians(q)

    def step(self, point_targets: np.ndarray, wrist_target: np.ndarray | None) -> np.ndarray:
        """Return the step of eq. (8) at the present configuration.

        Args:
            point_targets: Targets of the reference points in the world [m], shape (m, 3).
            wrist_target: Target of the wrist frame, shape (4, 4); None leaves it free.

        Returns:
            Displacement before any clipping, shape (nv,).

        Raises:
            numpy.linalg.LinAlgError: If the singular values cannot be found: the inputs hold
                infinities or NaN.
        """
        A, b = self._weighted_task(point_targets, wrist_target)
        U, s, Vt = np.linalg.svd(A, full_matrices=False)
        if self._damping > 0.0:
            inverse = s / (s**2 + self._damping**2)
        else:
            is_kept = s > RANK_TOLERANCE * s[0]
            inverse = np.divide(1.0, s, out=np.zeros_like(s), where=is_kept)
        homogeneous = np.zeros(A.shape[1])
        homogeneous[self.hand.joint_columns] = self._rest_gain * (
            self._rest - self.configuration.q[self.hand.q_indices]
        )
        # In the basis of the right singular vectors N is diagonal: 1 - inverse s, and 1 outside
        # their span.
        along = Vt @ homogeneous
        return self._scale * (homogeneous + Vt.T @ (inverse * (U.T @ b) - inverse * s * along))

    def solve(
        self,
        point_targets: np.ndarray,
        wrist_target: np.ndarray | None,
        dt: float,
        *,
        rest: np.ndarray | None = None,
        tasks: Sequence[Task] = (),
        margins: np.ndarray | None = None,
        speed: float = 1.0,
    ) -> IkResult:
        """Move the hand towards its targets for one sample.

        Arguments and result as of `PointIk.solve`. Eq. (8) has neither further tasks nor distances
        between links, nor a share of the speed limits: omit `tasks`, `margins` and `speed`.
        """
        if tasks or margins is not None or speed != 1.0:
            problem = "eq. (8) has neither further tasks, margins nor a share of the speed"
            raise InvalidOptionsError(option="tasks", problem=problem)
        self._rest = self.hand.rest if rest is None else rest
        start, nv = self.configuration.q.copy(), self.configuration.nv
        lower, upper = self._bounds(start, dt)
        total, last_step, iterations = np.zeros(nv), np.inf, 0
        end: End = "solved"
        while last_step > self.options.step_tolerance and iterations < self.options.max_iterations:
            iterations += 1
            step = self._finite_step(point_targets, wrist_target)
            if step is None:
                total, last_step, end = np.zeros(nv), 0.0, "failed"
            else:
                total = np.clip(total + step, lower, upper)
                last_step = float(np.linalg.norm(step))
            self.configuration.displace(start, total)
        return self._result(end, point_targets, total, lower, upper, iterations, last_step)

    def hold(self, dt: float) -> IkResult:
        """Keep the hand where it is, without targets."""
        free = np.full(self.configuration.nv, np.inf)
        return self._result(
            "released",
            self.configuration.points,
            np.zeros(self.configuration.nv),
            -free,
            free,
            0,
            0.0,
        )

    def _result(
        self,
        end: End,
        point_targets: np.ndarray,
        total: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        iterations: int,
        last_step: float,
    ) -> IkResult:
        return IkResult(
            end=end,
            points=self.configuration.points.copy(),
            targets=point_targets,
            point_tolerance=self.options.point_tolerance,
            displacement=total,
            lower=lower,
            upper=upper,
            joint_columns=self.hand.joint_columns,
            iterations=iterations,
            last_step=last_step,
        )

    def _finite_step(
        self, point_targets: np.ndarray, wrist_target: np.ndarray | None
    ) -> np.ndarray | None:
        try:
            step = self.step(point_targets, wrist_target)
        except np.linalg.LinAlgError:
            return None
        return step if np.isfinite(step).all() else None

    def _bounds(self, q: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        if self._box is not None:
            return self._box.bounds(q, dt)
        return np.full(self.configuration.nv, -np.inf), np.full(self.configuration.nv, np.inf)

    def _weighted_task(
        self, point_targets: np.ndarray, wrist_target: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return `W J M^(-1/2)`, shape (k, nv), and `W e`, shape (k,)."""
        configuration = self.configuration
        error, jacobian = (
            (point_targets - configuration.points).ravel(),
            configuration.point_jacobian(),
        )
        if wrist_target is not None:
            offset = configuration.wrist.actInv(pin.SE3(wrist_target))
            error = np.concatenate([error, pin.log6(offset).vector])
            jacobian = np.vstack(
                [jacobian, configuration.wrist_jacobian(pin.Jlog6(offset.inverse()))]
            )
        costs = self._costs[: len(error)]
        return costs[:, None] * jacobian * self._scale, costs * error
