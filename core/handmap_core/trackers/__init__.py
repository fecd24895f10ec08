"""What is known of trackers: the axes of their wrists, and the shape of the hands they show."""

from .hand_geometry import (
    BONES,
    NEIGHBOURS,
)
from .orders import KnownOrders
from .plausibility import InputCheck

__all__ = [
    "BONES",
    "NEIGHBOURS",
    "InputCheck",
    "KnownOrders",
]
