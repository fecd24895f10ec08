"""Tell wrong input from a human hand, in the first second and at every sample after it.

Landmarks in another order, the other hand, a mirrored world, millimetres, milliseconds, fingers
that bend backwards or a wrist quaternion in another order map without an error, to nonsense.
`InputCheck` measures what a human hand cannot do in small batches of samples, asks which mistake
explains it, and names it. `check_recording` does the same for a file. The compiled core decides
(`handmap/input.hpp`); `human.findings` has its findings in words.

    check = InputCheck("right")
    finding = check.update(time, landmarks, wrist)      # at every valid sample; None if plausible
"""

from functools import cache
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from handmap_core.core import core
from handmap_core.errors import InvalidInputError
from handmap_core.human.findings import FindingNumbers
from handmap_core.se3 import Array
from handmap_qp.hands import FINGERS, Names, Side
from handmap_qp.human import LANDMARK_COUNT, Finding, Recording, check_side
from .layouts import LAYOUTS


class InputCheck:
    """Checks one hand's samples as they come.

    Samples are collected into batches of 16, or of a quarter of a second for a slow tracker, and
    of twice as many once nothing changes any more. Two batches in a row must agree before the
    finding changes, so one bad sample changes nothing.

    Args:
        side: The hand that the samples are said to be of.

    Attributes:
        side: As given.

    Raises:
        InvalidInputError: If the side is neither `right` nor `left`.
    """

    def __init__(self, side: Side) -> None:
        check_side(side)
        self.side: Side = side
        self._core = self._new_core()

    def _new_core(self) -> core.InputCheck:
        return core.InputCheck(self.side, known_orders().core)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy continues from."""
        return {"side": self.side, "saved": self._core.save()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue from the state of another one."""
        self.side = state["side"]
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
        """Take a whole recording; see `examine_recording`."""
        samples = core.Samples(
            recording.time, recording.landmarks, recording.valid, wrist=recording.wrist
        )
        return self._finding_of(self._core.examine(samples))

    def _finding_of(self, numbers: FindingNumbers | None) -> Finding | None:
        """Return a finding that the core gives as numbers."""
        return Finding.of_core(numbers, self.side, known_orders().names)


def check_recording(recording: Recording, *, name: str = "") -> None:
    """Reject a recording that cannot be what it says.

    Args:
        recording: The recording.
        name: What to call the recording in an error; its own name if omitted.

    Raises:
        InvalidInputError: If something is wrong in a quarter of it or more.
    """
    finding = examine_recording(recording)
    if finding is not None:
        raise InvalidInputError(
            finding.problem, argument=name or recording.name, advice=finding.advice
        )


def examine_recording(recording: Recording) -> Finding | None:
    """Tell what is wrong with a recording.

    Args:
        recording: The recording; its wrist poses are examined too.

    Returns:
        What is wrong in a quarter of its valid samples or more; None if it is plausible. A tracker
        that confuses the hand for a moment is left to the guard (`stream.guard`).
    """
    return InputCheck(recording.side).examine(recording)


class KnownOrders(NamedTuple):
    """Orders in which landmarks may come: ours, which has no name, comes first.

    Attributes:
        names: Their names.
        indices: Indices of our landmarks among those that came, in each order, shape (21,).
        core: The orders as the core has them.
    """

    names: Names
    indices: tuple[Array, ...]
    core: Any


@cache
def known_orders() -> KnownOrders:
    """Return the known orders: those of layouts come behind ours, then all orders of fingers."""
    own = np.arange(LANDMARK_COUNT)
    known = {"": own}
    for name, layout in LAYOUTS.items():
        order = layout.order("right") if layout.shapes[0][0] == len(own) else None
        if order is not None and (order != own).any():
            known[f"that of the layout {name}"] = order
    known["one with the wrist last"] = np.roll(own, 1)
    # The first one is our own again, which is never better.
    for fingers in permutations(FINGERS):
        chains = own[1:].reshape(-1, 4)[[*map(fingers.index, FINGERS)]]
        name = f"one with the fingers {', '.join(fingers)}"
        known[name] = np.array([0, *chains.ravel()])
    orders = [order.tolist() for order in known.values()]
    return KnownOrders((*known,), (*known.values(),), core.LandmarkOrders(orders))
