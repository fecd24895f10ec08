"""Weights and settings of the inverse kinematics."""

from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from handmap_core.hands import Hand, Names
from handmap_core.models import IkModel
from handmap_core.options import NotNegative, Options, Positive, number
from handmap_core.se3 import Array

LENGTH_UNIT = 0.01
"""Length that counts as one in the cost [m]."""
ANGLE_UNIT = 0.1
"""Wrist rotation that counts as one in the cost [rad]."""
_MOST = 1e6  # of a weight, whose square the QP must hold beside those of others
_Weight = Annotated[float, number(high=_MOST)]


class IkOptions(Options, frozen=True):
    """Weights and settings of the QP.

    Weights are per unit of error: 10 mm, 0.1 rad of the wrist, 1 rad of a joint. `error_damping`
    stabilises a stretched hand or arm with unreachable targets, where the linearisation neglects a
    curvature of error times column norm. A step at the default `step_tolerance` is wrong by about
    0.1 mm, which the next sample corrects. With `avoids_self_collision` and `max_acceleration`,
    joints brake together, and approach their limits only as fast as the slowest of them can stop.

    Attributes:
        point_weight: Of the reference points' positions; each is multiplied by the root of its
            point's own weight.
        wrist_position_weight: Of the wrist frame's position.
        wrist_orientation_weight: Of the wrist frame's orientation.
        rest_weight: Pull of every joint to its rest angle: the null-space term of eq. (8).
        damping: Cost of any motion; keeps the step short near singular postures.
        error_damping: Levenberg-Marquardt damping of every rotating coordinate, as squared cost per
            weighted error and per weighted norm of its Jacobian column. Below 0.5 the iterations
            can oscillate.
        speed_weight: Cost of every joint's displacement within a sample; smooths at the price of
            lag.
        acceleration_weight: Cost of every joint's change of speed from sample to sample, times the
            time of the sample; likewise.
        formulation: How the QP is posed. `compiled`: by the compiled core, with a solver of its
            own; with another solver than DAQP, as by `direct`. `direct`: over Pinocchio, as the
            published method (`handmap_qp.reference`). `mink`: likewise, by `mink.build_ik`. All
            have the same answers, in 1, 10 and 40 times the time, but that the core alone takes
            detours.
        solver: `daqp`, `osqp`, `proxqp`, or any other that `qpsolvers` finds.
        max_iterations: QPs of a sample, and three more where links would meet.
        step_tolerance: A step shorter than this ends the iterations [rad or m, Euclidean norm].
        point_tolerance: Points, and a wrist that they go with, have arrived if they are nearer to
            their targets than this [m]; 0.1 rad of the wrist count as 10 mm.
        has_velocity_limits: Whether speed limits hold; position limits always do.
        max_acceleration: Limit of every coordinate's acceleration [rad/s^2, m/s^2]; none if
            omitted.
        avoids_self_collision: Whether the pairs of links that the hand's `collision` names are kept
            apart.
        takes_detours: Whether a hand whose points stay away from their targets, or whose pinches
            stay open, looks for a way round, by another posture.
        points_follow_wrist: Whether the points' targets go with the robot's own wrist where that is
            not at its target, so that the fingers do the same wherever an arm ends.
        tasks: Further terms of the cost by name, of other packages (`handmap_qp.tasks`).
    """

    point_weight: _Weight = 1.0
    wrist_position_weight: _Weight = 3.0
    wrist_orientation_weight: _Weight = 3.0
    rest_weight: _Weight = 0.2
    damping: Annotated[float, number(high=_MOST, above=True)] = 0.1
    error_damping: _Weight = 0.7
    speed_weight: _Weight = 0.0
    acceleration_weight: _Weight = 0.0
    formulation: Literal["compiled", "direct", "mink"] = "compiled"
    solver: str = "daqp"
    max_iterations: Annotated[int, Meta(ge=1)] = 3
    step_tolerance: NotNegative = 0.1
    point_tolerance: Positive = 1e-3
    has_velocity_limits: bool = True
    max_acceleration: Annotated[float, Meta(gt=0.0)] | None = None
    avoids_self_collision: bool = False
    takes_detours: bool = False
    points_follow_wrist: bool = False
    tasks: Names = ()

    def point_costs(self, hand: Hand) -> Array:
        """Return the cost of every reference point's error [cost]/[m], shape (m,)."""
        return self.point_weight / LENGTH_UNIT * np.sqrt(hand.point_weights)

    @property
    def is_compiled(self) -> bool:
        """Whether the compiled core poses and solves the QP."""
        return self.formulation == "compiled" and self.solver == "daqp"

    @property
    def wrist_costs(self) -> tuple[float, float]:
        """Costs of the wrist's position [cost]/[m] and orientation [cost]/[rad]."""
        return (
            self.wrist_position_weight / LENGTH_UNIT,
            self.wrist_orientation_weight / ANGLE_UNIT,
        )


@lru_cache(maxsize=32)
def ik_model(hand: Hand, options: IkOptions) -> IkModel:
    """Return the weights and settings of a hand, as the core has them; people share them."""
    position, orientation = options.wrist_costs
    return IkModel(
        point_costs=options.point_costs(hand),
        wrist_position_cost=position,
        wrist_orientation_cost=orientation,
        damping=options.damping,
        error_damping=options.error_damping,
        rest_weight=options.rest_weight,
        speed_weight=options.speed_weight,
        acceleration_weight=options.acceleration_weight,
        max_iterations=options.max_iterations,
        step_tolerance=options.step_tolerance,
        point_tolerance=options.point_tolerance,
        points_follow_wrist=options.points_follow_wrist,
        takes_detours=options.takes_detours,
    )
