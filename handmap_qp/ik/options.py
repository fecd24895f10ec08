"""Weights and settings of the inverse kinematics."""

from typing import Annotated, Literal

import numpy as np

from handmap_qp.hands import Hand, Names
from handmap_qp.options import Options, number, text
from handmap_qp.se3 import Array

LENGTH_UNIT = 0.01
"""Length that counts as one in the cost [m]."""
ANGLE_UNIT = 0.1
"""Wrist rotation that counts as one in the cost [rad]."""


class IkOptions(Options, frozen=True):
    """Weights and settings of the QP.

    Weights are per unit of error: 10 mm, 0.1 rad of the wrist, 1 rad of a joint. `error_damping`
    stabilises a stretched hand or arm with unreachable targets, where the linearisation neglects a
    curvature of error times column norm. A step at the default `step_tolerance` is wrong by about
    0.1 mm, which the next sample corrects. With `avoids_self_collision` and `max_acceleration`,
    joints brake together, and approach their limits only as fast as the slowest of them can stop.
    """

    point_weight: Annotated[
        float,
        number(
            "Of the reference points' positions; each is multiplied by the root of its point's own "
            "weight."
        ),
    ] = 1.0
    wrist_position_weight: Annotated[
        float, number("Of the wrist frame's position.")
    ] = 3.0
    wrist_orientation_weight: Annotated[
        float, number("Of the wrist frame's orientation.")
    ] = 3.0
    rest_weight: Annotated[
        float,
        number(
            "Pull of every joint to its rest angle: the null-space term of eq. (8)."
        ),
    ] = 0.2
    damping: Annotated[
        float,
        number(
            "Cost of any motion; keeps the step short near singular postures.",
            above=True,
        ),
    ] = 0.1
    error_damping: Annotated[
        float,
        number(
            "Levenberg-Marquardt damping of every rotating coordinate, as squared cost per "
            "weighted error and per weighted norm of its Jacobian column. Below 0.5 the iterations "
            "can oscillate."
        ),
    ] = 0.7
    speed_weight: Annotated[
        float,
        number(
            "Cost of every joint's displacement within a sample; smooths at the price of lag."
        ),
    ] = 0.0
    acceleration_weight: Annotated[
        float,
        number(
            "Cost of every joint's change of speed from sample to sample, times the time of the "
            "sample; likewise."
        ),
    ] = 0.0
    formulation: Annotated[
        Literal["compiled", "direct", "mink"],
        text(
            "How the QP is posed. `compiled`: by the compiled core, with a solver of its own; "
            "where that is not built, or with another solver than DAQP, as by `direct`. `direct`: "
            "in Python, the readable reference. `mink`: by `mink.build_ik`, solved by `qpsolvers`. "
            "All have the same answers, in 1, 10 and 40 times the time."
        ),
    ] = "compiled"
    solver: Annotated[
        str, text("`daqp`, `proxqp`, or any other that `qpsolvers` finds.")
    ] = "daqp"
    max_iterations: Annotated[
        int, text("QPs of a sample, and three more where links would meet.", ge=1)
    ] = 3
    step_tolerance: Annotated[
        float,
        number(
            "A step shorter than this ends the iterations [rad or m, Euclidean norm]."
        ),
    ] = 0.1
    point_tolerance: Annotated[
        float,
        number(
            "Points, and a wrist that they go with, have arrived if they are nearer to their "
            "targets than this [m]; 0.1 rad of the wrist count as 10 mm.",
            above=True,
        ),
    ] = 1e-3
    has_velocity_limits: Annotated[
        bool, text("Whether speed limits hold; position limits always do.")
    ] = True
    max_acceleration: (
        Annotated[
            float,
            number(
                "Limit of every coordinate's acceleration [rad/s^2, m/s^2]; none if omitted.",
                high=float("inf"),
                above=True,
            ),
        ]
        | None
    ) = None
    avoids_self_collision: Annotated[
        bool,
        text(
            "Whether the pairs of links that the hand's `collision` names are kept apart."
        ),
    ] = False
    takes_detours: Annotated[
        bool,
        text(
            "Whether a hand whose points stay away from their targets looks for a way round, by "
            "another posture."
        ),
    ] = False
    points_follow_wrist: Annotated[
        bool,
        text(
            "Whether the points' targets go with the robot's own wrist where that is not at its "
            "target, so that the fingers do the same wherever an arm ends."
        ),
    ] = False
    tasks: Annotated[
        Names,
        text(
            "Further terms of the cost by name, of other packages (`handmap_qp.tasks`)."
        ),
    ] = ()

    def point_costs(self, hand: Hand) -> Array:
        """Return the cost of every reference point's error [cost]/[m], shape (m,)."""
        return self.point_weight / LENGTH_UNIT * np.sqrt(hand.point_weights)

    @property
    def wrist_costs(self) -> tuple[float, float]:
        """Costs of the wrist's position [cost]/[m] and orientation [cost]/[rad]."""
        return (
            self.wrist_position_weight / LENGTH_UNIT,
            self.wrist_orientation_weight / ANGLE_UNIT,
        )
