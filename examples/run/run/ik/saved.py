"""`PointIk` of a hand that was saved, with the pairs of shapes that are kept apart."""

from __future__ import annotations

from typing import Any

from handmap_core.ik.gate import IkGate
from handmap_core.ik.motion import Motion
from handmap_core.ik.options import IkOptions
from handmap_qp.ik import qp


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
        self.reference = None
        at_rest = Motion.at_rest(hand.model.neutral, len(hand.active_columns))
        self.gate = _SavedGate(hand, motion or at_rest, options, hand.collisions)
        self.core = self.gate.core
        if detours:
            self.core.go_on(detours)

    def __reduce__(self) -> tuple[Any, ...]:
        """Build a copy that continues the same motion."""
        return PointIk, super().__reduce__()[1]


class _SavedGate(IkGate):
    """The gate of a saved hand, whose pairs are saved as bytes."""

    def _pairs(self) -> Any:
        collisions: Any = self.collisions
        if collisions is None:
            return None, None
        return collisions.core, collisions.model
