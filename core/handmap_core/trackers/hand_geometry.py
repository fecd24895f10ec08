"""Measures of 21 landmarks that tell a hand in the right order from anything else.

All of them are ratios or angles, so that they hold for every hand and in every unit of length. The
compiled core has them (`handmap/hand_geometry.hpp`).
"""

from typing import NamedTuple

from handmap_core.core import core
from handmap_core.se3 import Array

BONES: tuple[tuple[int, int], ...] = core.BONES
"""Landmarks at both ends of each bone, and from the wrist to each finger's first joint."""
NEIGHBOURS: tuple[tuple[int, int], ...] = core.NEIGHBOURS
"""Neighbouring MCP joints."""


class PalmarEvidence(NamedTuple):
    """Tells for each sample how surely the hand is a right one; of a left hand, all are negative.

    Attributes:
        total: From the thumb's base, the arch of the knuckles, the thumb's MCP joint and the
            fingers, from -5 to 5, shape (T,).
        fingers: From the bends of the fingers, from -2 to 2, shape (T,). PIP joints count in full
            at the limit of people's hyperextension, MCP joints from 0 there to full at 58 degrees.
    """

    total: Array
    fingers: Array


def palmar_evidence(landmarks: Array) -> PalmarEvidence:
    """Tell a right hand from a left one, by the side of the palm to which thumb and fingers bend.

    Args:
        landmarks: Finite landmarks in our order and any unit, shape (T, 21, 3).

    Returns:
        The evidence for a right hand, sample by sample; about 0 for a flat hand of a tracker
        without an arched palm.
    """
    return PalmarEvidence(*core.palmar_evidence(landmarks).T)


def misfit(landmarks: Array) -> float:
    """Tell how badly landmarks fit a hand in our order.

    Args:
        landmarks: Finite landmarks in any unit, shape (T, 21, 3).

    Returns:
        Root mean square deviation from the proportions of hands [half widths of their range], and
        from rigidity. Below 1.3 for hands, above 1.5 for orders that are wrong in more than the
        exchange of two similar fingers.
    """
    return core.misfit(landmarks)


def log_size(landmarks: Array) -> float:
    """Return the logarithm of a hand's size, by 26 distances that bones and palm keep.

    Args:
        landmarks: Finite landmarks [m], shape (T, 21, 3).
    """
    return core.log_size(landmarks)
