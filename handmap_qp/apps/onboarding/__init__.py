"""A hand of one's own: from any URDF to a `hand.yaml`, and a look at whether it is right."""

from .check import check_hand, check_robot
from .findings import HandFinding, HandReport
from .init import DescribedHand, InitResult, init_hands
from .structure import Clue

__all__ = [
    "Clue",
    "DescribedHand",
    "HandFinding",
    "HandReport",
    "InitResult",
    "check_hand",
    "check_robot",
    "init_hands",
]
