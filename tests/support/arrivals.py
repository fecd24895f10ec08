"""When the fingers of a robot are where they stay: `arrival_time`, `FingerMeter`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_qp import Hand
from handmap_qp.apps.offline.fidelity import angles_between
from handmap_qp.hands import PalmKinematics, find_fingers

ARRIVED = 15.0
"""A finger that is no farther than this from where it ends has arrived [deg]."""
UNDER_WAY = 10.0
"""A finger that turns faster than this has not come where it ends [deg/s]."""
_LAST = 0.1
"""Time at the end in which that is looked at [s]."""


class FingerShapes(NamedTuple):
    """Where fingers point and how they bend, in T samples.

    Attributes:
        aim: Vectors from knuckle to tip in palm axes [m], shape (T, k, 3).
        bend: Angles at the middle joints, 0 where a finger is straight [deg], shape (T, k).
    """

    aim: np.ndarray
    bend: np.ndarray


def shapes_of(points: np.ndarray) -> FingerShapes:
    """Return the shapes of fingers whose points are given.

    Args:
        points: Knuckle, middle joint and tip in palm axes [m], shape (T, k, 3, 3).
    """
    knuckle, middle, tip = np.moveaxis(points, 2, 0)
    return FingerShapes(tip - knuckle, angles_between(middle - knuckle, tip - middle))


def distances(a: FingerShapes, b: FingerShapes) -> np.ndarray:
    """Return the larger of the differences of direction and of bend [deg]; shapes broadcast."""
    return np.maximum(angles_between(a.aim, b.aim), np.abs(a.bend - b.bend))


class FingerMeter:
    """Measures the fingers of a robot as *caught* does: direction and bend.

    Args:
        robot: The robot hand.

    Attributes:
        names: Anatomical names of its k fingers.
    """

    def __init__(self, robot: Hand) -> None:
        fingers = find_fingers(robot)
        self.names = tuple(fingers)
        self._places = [
            place
            for finger in fingers.values()
            for place in (finger.knuckle, finger.middle, finger.tip)
        ]
        self._kinematics = PalmKinematics(robot)

    def shapes(self, q: np.ndarray) -> FingerShapes:
        """Measure at joints q [rad], shape (T, n)."""
        points = self._kinematics.points(q, self._places)
        return shapes_of(points.reshape(len(q), -1, 3, 3))


def arrival_time(time: np.ndarray, shapes: FingerShapes) -> float:
    """Return how long the last finger takes to come where it ends, and to stay there [s].

    A finger has arrived if its direction and its bend are within `ARRIVED` of those in the last
    sample, and are so in all samples that follow. The time is that of a sample: up to one period
    later than the crossing itself.

    Args:
        time: Instants from the person's last motion on, increasing [s], shape (T,).
        shapes: The fingers at these instants. The last one counts as the end.

    Returns:
        Time since `time[0]`; 0 if all fingers are there already; infinity if one is still under
        way at the end (`are_under_way`), because nothing shows where it will end.
    """
    if are_under_way(time, shapes).any():
        return float("inf")
    outside = np.flatnonzero((_to_end(shapes) > ARRIVED).any(axis=1))
    # The last sample is where it ends, so a later one exists.
    return float(time[outside[-1] + 1] - time[0]) if len(outside) else 0.0


def are_under_way(time: np.ndarray, shapes: FingerShapes) -> np.ndarray:
    """Return whether fingers turn by more than `UNDER_WAY` on average in the last `_LAST`.

    Args:
        time: Instants, increasing [s], shape (T,).
        shapes: The fingers at these instants.

    Returns:
        Shape (k,); False for all with a single sample.
    """
    start = int(np.searchsorted(time, time[-1] - _LAST - 1e-9))
    duration = time[-1] - time[start]
    return _to_end(shapes)[start] > UNDER_WAY * duration


def _to_end(shapes: FingerShapes) -> np.ndarray:
    """Return how far fingers are from where they end [deg], shape (T, k)."""
    return distances(shapes, FingerShapes(shapes.aim[-1], shapes.bend[-1]))
