"""Weights and settings of the inverse kinematics, as one checked value."""

from __future__ import annotations

import math
from dataclasses import dataclass

from handmap_qp.errors import InvalidOptionsError

LENGTH_UNIT = 0.01
"""Length that counts as one in the cost [m]."""
ANGLE_UNIT = 0.1
"""Wrist rotation that counts as one in the cost [rad]."""


@dataclass(frozen=True, slots=True)
class IkOptions:
    """Weights and settings of the QP.

    Weights are per unit of error: 10 mm, 0.1 rad of the wrist, 1 rad of a joint.

    Attributes:
        point_weight: Of the reference points' positions; each is multiplied by the root of its
            point's own weight.
        wrist_position_weight: Of the wrist frame's position.
        wrist_orientation_weight: Of the wrist frame's orientation.
        rest_weight: Pull of every joint to its rest angle: the null-space term of eq. (8).
        damping: Cost of any motion; keeps the step short near singular postures.
        error_damping: Levenberg-Marquardt damping of every rotating coordinate, as squared cost per
            weighted error and per weighted norm of its Jacobian column. It stabilises a stretched
            hand or arm with unreachable targets: there the linearisation neglects a curvature of
            error times column norm. Below 0.5 the iterations can oscillate.
        speed_weight: Cost of every joint's displacement within a sample; smooths at the price of
            lag.
        acceleration_weight: Cost of every joint's change of speed from sample to sample, times the
            time of the sample; likewise.
        solver: `daqp`, `proxqp`, or any other that `qpsolvers` finds.
        max_iterations: Linearisations per sample, at most.
        step_tolerance: A step shorter than this ends the iterations [rad or m, Euclidean norm]. At
            0.1 the linearisation is wrong by about 0.1 mm, and the next sample corrects it; only
            fast motions take a second iteration.
        point_tolerance: Points nearer to their targets than this have arrived [m].
        has_velocity_limits: Whether speed limits hold; position limits always do.
        max_acceleration: Limit of every coordinate's acceleration [rad/s^2, m/s^2]; none if
            omitted.
        avoids_self_collision: Whether the pairs of links that the hand's `collision` names are kept
            apart. With `max_acceleration`, joints then brake together, and approach their limits
            only as fast as the slowest of them can stop.
    """

    point_weight: float = 1.0
    wrist_position_weight: float = 3.0
    wrist_orientation_weight: float = 3.0
    rest_weight: float = 0.2
    damping: float = 0.1
    error_damping: float = 0.7
    speed_weight: float = 0.0
    acceleration_weight: float = 0.0
    solver: str = "daqp"
    max_iterations: int = 3
    step_tolerance: float = 0.1
    point_tolerance: float = 1e-3
    has_velocity_limits: bool = True
    max_acceleration: float | None = None
    avoids_self_collision: bool = False

    def __post_init__(self) -> None:
        """Reject values for which the problem has no unique solution.

        Raises:
            InvalidOptionsError: With the name and the value at fault.
        """
        for name in _NUMBERS:
            value = getattr(self, name)
            is_number = isinstance(value, int | float) and math.isfinite(value)
            if not is_number or value < 0.0 or (value == 0.0 and name in _POSITIVE):
                sign = "> 0" if name in _POSITIVE else ">= 0"
                raise InvalidOptionsError(
                    option=name, expected=f"a finite number {sign}", value=value
                )
        if not isinstance(self.max_iterations, int) or self.max_iterations < 1:
            raise InvalidOptionsError(
                option="max_iterations", expected="an integer >= 1", value=self.max_iterations
            )
        limit = self.max_acceleration
        if limit is not None and not (isinstance(limit, int | float) and limit > 0.0):
            raise InvalidOptionsError(
                option="max_acceleration", expected="a number > 0, or None", value=limit
            )
        if not isinstance(self.solver, str):
            raise InvalidOptionsError(
                option="solver", expected="the name of a solver", value=self.solver
            )


_POSITIVE = ("damping", "point_tolerance")
_NUMBERS = (
    "point_weight",
    "wrist_position_weight",
    "wrist_orientation_weight",
    "rest_weight",
    "damping",
    "error_damping",
    "speed_weight",
    "acceleration_weight",
    "step_tolerance",
    "point_tolerance",
)
