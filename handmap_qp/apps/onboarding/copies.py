"""Fingers that are copies of each other, of which one's range says nothing: `find_copies`.

Many files give one finger its true range, and its mirrored copy a placeholder, as far to both
sides. A copy is as long as its original wherever both are flexed alike, so that it shows in which
sense it flexes, and where it is straight and closed.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array, lengths
from handmap_qp.hands import Finger, Flexion, PalmKinematics

# A range is even if its middle is nearer to zero than this share of it, and one-sided if less than
# this share of it is beyond zero.
_EVEN = 0.1
_BEYOND = 0.15
# Lengths are alike within this share, at so many places of the range.
_ALIKE = 0.01
_PLACES = 9


class Copy(NamedTuple):
    """A finger whose range says nothing, and the one that it is a copy of.

    Attributes:
        original: Index of the other finger.
        columns: The column of q that flexes the original, and that of the copy.
        sense: 1 if both flex alike in the same sense of their columns, else -1.
    """

    original: int
    columns: tuple[int, int]
    sense: float

    def position(self, q: Array) -> float:
        """Return where the copy is as the original is in a posture (n,) [rad or m]."""
        return self.sense * float(q[self.columns[0]])


def find_copies(
    view: PalmKinematics, fingers: Sequence[Finger], groups: Sequence[Flexion | None]
) -> dict[int, Copy]:
    """Return the fingers with an even range that are copies of one with a one-sided range.

    Only fingers that one joint curls, perhaps with followers, are compared.

    Args:
        view: The hand.
        fingers: Its fingers.
        groups: How each of them curls.

    Returns:
        Copies, by their index.
    """
    limits = view.hand.limits
    columns = dict[int, int]()
    for i, group in enumerate(groups):
        flexing = np.flatnonzero(group.signs) if group and group.curls else []
        if len(flexing) == 1:
            columns[i] = int(flexing[0])
    found = dict[int, Copy]()
    for i, column in columns.items():
        low, high = limits[:, column]
        if abs(low + high) > _EVEN * (high - low):
            continue
        for k, other in columns.items():
            if k == i or not _is_one_sided(*limits[:, other].tolist()):
                continue
            sense = _sense(view, (fingers[k], other), (fingers[i], column))
            if sense:
                found[i] = Copy(k, (other, column), sense)
                break
    return found


def _is_one_sided(low: float, high: float) -> bool:
    """Return whether nearly all of a range is on one side of zero."""
    return min(-low, high) < _BEYOND * (high - low)


def _sense(
    view: PalmKinematics, original: tuple[Finger, int], copy: tuple[Finger, int]
) -> float:
    """Return the sense in which a finger is as long as another one in all of the other's range.

    Args:
        view: The hand.
        original: The other finger, and its column.
        copy: The finger, and its column.

    Returns:
        1 or -1; 0 if it is in neither sense, or in both.
    """
    low, high = view.hand.limits[:, original[1]]
    places = np.linspace(low, high, _PLACES)
    true = _lengths_at(view, *original, places)
    fits = [
        sense
        for sense in (1.0, -1.0)
        if np.allclose(
            _lengths_at(view, *copy, sense * places), true, rtol=_ALIKE, atol=0.0
        )
    ]
    return fits[0] if len(fits) == 1 else 0.0


def _lengths_at(
    view: PalmKinematics, finger: Finger, column: int, places: Array
) -> Array:
    """Return how far a fingertip is from the origin of the first joint at places [m], (k,)."""
    postures = np.tile(view.hand.zero, (len(places), 1))
    postures[:, column] = places
    ends = view.points(postures, [finger.tip, (finger.joints[0], np.zeros(3))])
    return lengths(ends[:, 0] - ends[:, 1])
