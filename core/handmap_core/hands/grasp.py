"""`GraspFinger`: what a grip needs to know of a finger."""

from __future__ import annotations

from typing import NamedTuple

from handmap_core.se3 import Array
from .pad import Pad


class GraspFinger(NamedTuple):
    """A finger, or a jaw, that grips; the thumb is the first of a hand.

    Attributes:
        pad: Its pad.
        columns: Columns of q that move it, from the palm outwards, shape (c,).
        is_jaw: Whether all its joints slide.
    """

    pad: Pad
    columns: Array
    is_jaw: bool
