"""What is known of trackers: the axes of their wrists, and the shape of the hands they show."""

from .hand_geometry import (
    BONES,
    NEIGHBOURS,
)

__all__ = [
    "BONES",
    "NEIGHBOURS",
]
