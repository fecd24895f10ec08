"""`StreamGuard`: which samples of a tracker make sense; see `handmap_core.stream.guard`."""

from __future__ import annotations

from handmap_core.hands import Hand
from handmap_core.ik import BEHIND as BEHIND
from handmap_core.stream import guard
from handmap_core.stream.guard import FROZEN_AFTER as FROZEN_AFTER
from handmap_core.stream.guard import GAP as GAP
from handmap_core.stream.guard import SETTLING as SETTLING
from handmap_core.stream.guard import ArrivalCredit as ArrivalCredit
from handmap_core.stream.guard import SampleClock as SampleClock
from handmap_qp.trackers import known_orders


class StreamGuard(guard.StreamGuard):
    """Judges the samples of one hand, one after the other; knows the orders of all layouts.

    Args:
        human: The human hand, scaled to the person.

    Raises:
        HandError: If the hand has no landmarks.
    """

    def __init__(self, human: Hand) -> None:
        super().__init__(human, known_orders())
