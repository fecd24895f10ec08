"""What the inverse kinematics makes of the targets of one sample."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from handmap_core.core import core
from handmap_core.hands import Hand, Names
from handmap_core.se3 import Array, ArrayStruct, lengths

WRIST_LEVERS = np.array([1.0, 0.1])
"""How many metres a metre and a radian of the wrist's error count."""

Status = Literal[
    "converged", "limited", "unreachable", "unsettled", "failed", "released"
]


class IkResult(ArrayStruct, frozen=True):
    """Result of the iterations of one sample.

    Attributes:
        status: `converged`: all points have arrived, and the wrist if they go with it; `limited`:
            joints or wrist at a limit keep some away; `unreachable`: no limit does and the hand
            does not move any more; `unsettled`: it is still on its way; `failed`: the solver found
            no answer, and the hand stays where it was, or comes back into its limits; `released`:
            it had no targets.
        points: Reference points [m], shape (m, 3).
        targets: Their targets [m], shape (m, 3); on the wrist where it is if they go with it.
        q: Pinocchio configuration reached, shape (nq,).
        wrists: Wrist frame of each hand there, shape (h, 4, 4).
        displacement: From the sample before to this one, in the active coordinates (wrist, and
            joints that follow no other), shape (k,), read-only.
        active: -1 where it is at its lower bound from position and speed limits, +1 at the upper
            one, 0 between, shape (k,), read-only.
        hand: The hand; `hand.joint_columns` says where in those its joints are.
        iterations: QPs solved.
        last_step: Euclidean norm of the last iteration's step [rad or m].
        held_by: Links of the pair of shapes that holds the hand back most; empty if none does.
    """

    status: Status
    points: Array
    targets: Array
    q: Array
    wrists: Array
    displacement: Array
    active: Array
    hand: Hand
    iterations: int
    last_step: float
    held_by: Names = ()

    @property
    def wrist(self) -> Array:
        """Wrist frame of the hand, or of the first one of a robot, shape (4, 4)."""
        return self.wrists[0]

    @property
    def errors(self) -> Array:
        """Target minus point [m], shape (m, 3)."""
        return self.targets - self.points


def result_of(step: core.Step, hand: Hand, links: Sequence[Names]) -> IkResult:
    """Return the result of a step of the core.

    Args:
        step: The step, as the core has it.
        hand: The hand.
        links: Links of each pair of shapes that its gate keeps apart; at -1, there are none.
    """
    return IkResult(
        step.status,
        step.points,
        step.targets,
        step.q,
        step.wrists,
        step.displacement,
        step.active,
        hand,
        step.iterations,
        step.last_step,
        links[step.held_by],
    )


def wrist_error(wrist: Array, target: Array) -> Array:
    """Return how far a pose of the wrist is from its target [m, rad], shape (2,)."""
    turn = core.log3(target[:3, :3].T @ wrist[:3, :3])
    return lengths(np.array([wrist[:3, 3] - target[:3, 3], turn]))
