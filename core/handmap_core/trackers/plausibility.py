"""Tell wrong input from a human hand, in the first second and at every sample after it.

Landmarks in another order, the other hand, a mirrored world, millimetres, milliseconds, fingers
that bend backwards or a wrist quaternion in another order map without an error, to nonsense.
`InputCheck` measures what a human hand cannot do in small batches of samples, asks which mistake
explains it, and names it. The compiled core decides (`handmap/input.hpp`); `human.findings` has its
findings in words.

    check = InputCheck("right", KnownOrders())
    finding = check.update(time, landmarks, wrist)      # at every valid sample; None if plausible
"""

from typing import Any

from handmap_core.core import core
from handmap_core.hands import Side
from handmap_core.human import Finding, Recording, check_side
from handmap_core.human.findings import FindingNumbers
from handmap_core.se3 import Array
from .orders import KnownOrders


class InputCheck:
    """Checks one hand's samples as they come.

    Samples are collected into batches of 16, or of a quarter of a second for a slow tracker, and
    of twice as many once nothing changes any more. Two batches in a row must agree before the
    finding changes, so one bad sample changes nothing.

    Args:
        side: The hand that the samples are said to be of.
        orders: Orders that landmarks may be in.

    Attributes:
        side: As given.

    Raises:
        InvalidInputError: If the side is neither `right` nor `left`.
    """

    def __init__(self, side: Side, orders: KnownOrders) -> None:
        check_side(side)
        self.side: Side = side
        self._orders = orders
        self._core = self._new_core()

    def _new_core(self) -> core.InputCheck:
        return core.InputCheck(self.side, self._orders.core)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy continues from."""
        saved = self._core.save()
        return {"side": self.side, "orders": self._orders, "saved": saved}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue from the state of another one."""
        self.side = state["side"]
        self._orders = state["orders"]
        self._core = self._new_core()
        self._core.restore(state["saved"])

    @property
    def finding(self) -> Finding | None:
        """What is wrong with the input; None if it is plausible, or if too little was seen."""
        return self._finding_of(self._core.finding())

    @property
    def is_wrist_proven(self) -> bool:
        """Whether the wrist, in our axes, has followed a palm that turned by 12 degrees."""
        return self._core.is_wrist_proven()

    def update(
        self, time: float, landmarks: Array, wrist: Array | None = None
    ) -> Finding | None:
        """Take one sample in which the tracker saw the hand.

        Args:
            time: Its instant [s].
            landmarks: Its landmarks as they came, finite, shape (21, 3).
            wrist: The tracker's own wrist pose, shape (4, 4), if it has one.

        Returns:
            The finding so far (`finding`).

        Raises:
            MapperBusyError: If another thread works on the check.
        """
        return self._finding_of(self._core.update(time, landmarks, wrist))

    def alert(self) -> None:
        """Judge the next samples by themselves and soon: something has changed."""
        self._core.alert()

    def finish(self) -> Finding | None:
        """Judge what is left at the end of a recording, by one batch if there was no other."""
        return self._finding_of(self._core.finish())

    def examine(self, recording: Recording) -> Finding | None:
        """Take a whole recording; return what is wrong in a quarter of its samples or more."""
        samples = core.Samples(
            recording.time, recording.landmarks, recording.valid, wrist=recording.wrist
        )
        return self._finding_of(self._core.examine(samples))

    def _finding_of(self, numbers: FindingNumbers | None) -> Finding | None:
        """Return a finding that the core gives as numbers."""
        return Finding.of_core(numbers, self.side, self._orders.names)
