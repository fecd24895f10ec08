"""`PointIk` of a hand that was saved, with the pairs of shapes that are kept apart."""

from __future__ import annotations

from typing import Any

from handmap_qp.ik import qp
from handmap_qp.ik.core import core
from handmap_qp.ik.limits import Gate, Motion, When
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import IkResult


class PointIk(qp.PointIk):
    """Moves a saved hand by the compiled core; see `qp.PointIk`."""

    def __init__(
        self,
        hand: Any,
        options: IkOptions,
        motion: Motion | None = None,
        contacts: Any = None,
        detours: list[Any] | None = None,
    ) -> None:
        self.hand = hand
        self.options = options
        self._contacts = contacts
        self._tasks = []
        at_rest = Motion.at_rest(hand.model.neutral, len(hand.active_columns))
        self.gate = Gate(hand, motion or at_rest, options, hand.collisions)
        self.core = self._mover = core.Ik(hand.tree, hand, options, self.gate)
        if detours:
            self.core.go_on(detours)

    def __reduce__(self) -> tuple[Any, ...]:
        """Build a copy that continues the same motion."""
        return PointIk, super().__reduce__()[1]

    def hold(self, dt: When) -> IkResult:
        """Bring the hand to a stop within its acceleration limit, without targets."""
        return self.core.hold(dt)
