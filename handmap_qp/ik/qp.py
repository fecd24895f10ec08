"""`PointIk`: the QP of a hand that Pinocchio has, and the ways that options may ask for.

`handmap_core.ik.qp` has the QP, and solves it. Here it is made for a hand, with the pairs of shapes
that are kept apart. Where `IkOptions` ask for another formulation or solver, `handmap_qp.reference`
poses and solves it; that is loaded at its first use.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import pinocchio as pin

from handmap_core.errors import expect
from handmap_core.ik import qp
from handmap_core.ik.gate import IkGate
from handmap_core.ik.motion import Motion
from handmap_core.ik.options import IkOptions
from handmap_core.ik.result import IkResult
from handmap_core.ik.tasks import Goal, tasks_named
from handmap_qp.hands import Hand, PinocchioConfiguration
from .collision import CollisionLimit

if TYPE_CHECKING:
    from handmap_core import _core
    from handmap_qp.hands import ShapePairs
    from handmap_qp.reference.inverse_kinematics import ReferenceIk

# Leave out pairs of shapes that are farther apart than this beyond their margin [m].
_HORIZON = 0.012


class PointIk(qp.PointIk[CollisionLimit]):
    """Moves a hand's reference points and wrist towards their targets, within its limits.

    Args:
        hand: The hand.
        options: Weights and settings.
        motion: How the hand moves; at rest in its neutral configuration if omitted.
        contacts: Pairs of shapes that are kept apart, whatever `avoids_self_collision` says; those
            within 12 mm beyond their margin get a row, in short samples fewer.
        detours: Of each hand, as of the solver that this one is a copy of; none if omitted.

    Attributes:
        reference: Poses and solves the QP in the core's place; None unless `options` ask for it.

    Raises:
        InvalidInputError: If `options` are something else.
        InvalidOptionsError: If there is no such solver or task.
        HandError: If the core cannot move a joint of the hand.
    """

    def __init__(
        self,
        hand: Hand,
        options: IkOptions,
        motion: Motion | None = None,
        contacts: ShapePairs | None = None,
        detours: Sequence[_core.Detour] | None = None,
    ) -> None:
        expect(isinstance(options, IkOptions), "ik", "an IkOptions", value=options)
        collisions = None
        if contacts:
            collisions = CollisionLimit(hand, contacts, _HORIZON)
        elif options.avoids_self_collision:
            collisions = CollisionLimit(hand)
        self._hand = hand
        self._contacts = contacts
        tasks = tasks_named(options.tasks, hand)
        at_rest = Motion.at_rest(pin.neutral(hand.model), len(hand.active_columns))
        super().__init__(IkGate(hand, motion or at_rest, options, collisions), tasks)
        if detours:
            self.core.go_on(detours)
        self.reference: ReferenceIk | None = None
        if not options.is_compiled:
            # Loads Pinocchio's way, and other solvers, where an option asks for them.
            from handmap_qp.reference.inverse_kinematics import ReferenceIk

            self.reference = ReferenceIk(hand, self.gate)

    @property
    def hand(self) -> Hand:
        """The hand."""
        return self._hand

    @property
    def is_compiled(self) -> bool:
        """Whether the core solves the QP."""
        return self.reference is None

    def __reduce__(self) -> tuple[Any, ...]:
        """Build a copy with a workspace of its own that continues the same motion."""
        detours = self.core.detours
        motion = self.gate.motion
        return PointIk, (self.hand, self.options, motion, self._contacts, detours)

    @property
    def configuration(self) -> PinocchioConfiguration:
        """The present posture, by Pinocchio; `place` puts the hand somewhere else."""
        placed = super().configuration
        assert isinstance(placed, PinocchioConfiguration)
        return placed

    def _solved(self, goal: Goal) -> IkResult:
        """Move the hand towards the targets of one sample, in the way that options ask for."""
        if self.reference:
            return self.reference.solve(goal)
        return super()._solved(goal)
