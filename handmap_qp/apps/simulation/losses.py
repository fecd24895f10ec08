"""Why an object was not held, by forces and places: `Loss`, `loss_in_try`.

One classification for all simulated picks. A pick notes one `Touch` for each instant, and the order
of touches, the displacement and the force say what went wrong.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

PRESSED = 0.2
"""Force with which a finger counts as pressing [N]."""
AWAY = 0.01
"""Displacement between first and second touch that counts as pushing away [m]."""
AT_ONCE = 0.2
"""Time of a grip below which the object was squeezed out at once [s]."""
BESIDE = 0.015
"""Distance of the object's middle from the line of the pads that counts as beside [m]."""
LIFTED = 0.01
"""Height above its place from which an object counts as lifted [m]."""
_PAUSE = 0.1  # time without touch that ends a try [s]


class Loss(StrEnum):
    """Why an object was not held, in the words of tables."""

    UNTOUCHED = "never touched"
    PUSHED_BY_THUMB = "the thumb pushed it away"
    PUSHED_BY_FINGER = "a finger pushed it away"
    NO_FINGER = "no finger arrived"
    ONE_SIDE = "touched by one side"
    SQUEEZED_OUT = "squeezed out at once"
    BESIDE = "pads pressed beside the middle"
    SLIPPED = "gripped, then slipped out"
    TOO_LATE = "gripped only as the hand opened"


@dataclass(frozen=True, slots=True)
class Touch:
    """How a hand touches an object at one instant.

    Attributes:
        time: The instant [s].
        thumb: Normal force of the thumb's links [N].
        others: Normal force of all other links [N].
        beside: Distance of the object's middle from the line through both pads [m].
        moved: Distance of the object from where the attempt began [m]; on a table in its plane.
        height: Height of the object above its place [m].
    """

    time: float
    thumb: float
    others: float
    beside: float
    moved: float
    height: float

    @property
    def is_touched(self) -> bool:
        """Whether any link touches."""
        return self.thumb > 0.0 or self.others > 0.0

    @property
    def is_pinched(self) -> bool:
        """Whether thumb and another link press."""
        return min(self.thumb, self.others) > PRESSED

    @property
    def is_lifted(self) -> bool:
        """Whether it is pinched and off its place."""
        return self.is_pinched and self.height > LIFTED


def loss_in_try(course: Sequence[Touch]) -> Loss | None:
    """Return why one try brought no grip; None if it brought one.

    Args:
        course: The instants of the try, in order and at even steps; without a touch, if there was
            none.
    """
    touched = [one for one in course if one.is_touched]
    if not touched:
        return Loss.UNTOUCHED
    first = touched[0]
    thumb = next((one for one in touched if one.thumb > 0.0), None)
    other = next((one for one in touched if one.others > 0.0), None)
    if thumb is None or other is None:
        pushed = max(one.moved for one in touched) - first.moved
        if thumb is None:
            return Loss.PUSHED_BY_FINGER if pushed > AWAY else Loss.ONE_SIDE
        return Loss.PUSHED_BY_THUMB if pushed > AWAY else Loss.NO_FINGER
    second = max(thumb, other, key=lambda one: one.time)
    if abs(second.moved - first.moved) > AWAY:
        is_thumb_first = thumb.time < other.time
        return Loss.PUSHED_BY_THUMB if is_thumb_first else Loss.PUSHED_BY_FINGER
    grip = [one for one in touched if one.is_pinched]
    # Half a step more, so that rounding of times does not decide.
    if (len(grip) + 0.5) * _time_step(course) < AT_ONCE:
        return Loss.SQUEEZED_OUT
    if np.median([one.beside for one in grip]) > BESIDE:
        return Loss.BESIDE
    return None


def tries(course: Sequence[Touch]) -> list[list[Touch]]:
    """Return the stretches in which the object is touched, with short breaks left out."""
    found: list[list[Touch]] = []
    last = -np.inf
    for one in course:
        if not one.is_touched:
            continue
        if one.time - last > _PAUSE:
            found.append([])
        found[-1].append(one)
        last = one.time
    return found


def _time_step(course: Sequence[Touch]) -> float:
    """Return the usual time between two instants [s]; zero for one instant."""
    times = [one.time for one in course]
    return float(np.median(np.diff(times))) if len(times) > 1 else 0.0
