"""The contact gap: what a tracker measures between thumb and finger where the skin touches.

It depends on person and tracker: 1 to 5 mm for gloves, 10 to 20 mm for cameras and headsets. A
touch is a minimum of the smallest gap in time, so it is found by time and not by chance: gaps are
medians over 0.1 s first, which single outliers and noise hardly move.
"""

import math
from collections import deque

import numpy as np

from handmap_core.core import core
from handmap_core.human.recording import Recording
from handmap_core.human.sample import TIPS
from handmap_core.se3 import Array, lengths
from .measure import seen_landmarks

CONTACT_GAPS = (0.012, 0.020)
"""Least and largest contact gap that is measured [m]."""
TOUCH_GAP = 0.025
"""Tips that come nearer than this may touch [m]."""
OPEN_GAP = 0.070
"""A live measurement changes only while tips are farther apart than this [m].

Rows of pinches have no weight there with `picking=0`. With more, they begin at wider gaps.
"""
_MEDIAN_TIME = 0.1
"""Time over which gaps are medians [s]."""
_PERCENTILE = 1.0
"""Percentile of the smallest gap of a recording that is taken for a touch."""
_RELEASE = 0.010
"""A touch ends when the gap has risen by this above its least [m]."""
_TOUCHES = (3, 12)
"""Least number of touches that a live measurement needs, and how many it remembers."""
_LOW = 10.0
"""Percentile of the touches that is taken: objects between the fingers make gaps larger."""
_STEP = 0.001
"""Largest change of a live measurement at once [m]."""


def tip_gaps(landmarks: Array) -> Array:
    """Return the distances from the thumb's tip to the other tips [m], shape (..., 4).

    Args:
        landmarks: Landmarks [m], shape (..., 21, 3).
    """
    return lengths(landmarks[..., TIPS[1:], :] - landmarks[..., TIPS[:1], :])


def smallest_gap(time: Array, landmarks: Array) -> float:
    """Return the 1st percentile of the smallest gap, of gaps that are medians over 0.1 s [m].

    Args:
        time: Instants [s], shape (T,).
        landmarks: Landmarks of samples in which the hand was seen [m], shape (T, 21, 3).
    """
    return core.smallest_gap(time, landmarks, _MEDIAN_TIME, _PERCENTILE)


def measure_contact_gap(recording: Recording) -> float:
    """Measure the contact gap in a recording.

    People touch thumb and finger now and then, so the 1st percentile of the smallest gap is taken.
    A person who never does gives a large number, so it is bounded.

    Args:
        recording: The recording.

    Returns:
        The contact gap of tracker and person, from 12 to 20 mm [m].
    """
    time = recording.time[recording.valid]
    return clipped_gap(smallest_gap(time, seen_landmarks(recording)))


def clipped_gap(gap: float) -> float:
    """Return a gap within `CONTACT_GAPS` [m]."""
    return float(np.clip(gap, *CONTACT_GAPS))


class ContactGapMeter:
    """Measures the contact gap of a person while they work, touch by touch.

    After three touches it begins to follow the 10th percentile of the last twelve. It changes by
    at most 1 mm a touch, and only while all tips are more than `OPEN_GAP` apart. With `picking=0`,
    no row of a pinch has weight there. With `picking=1`, the robot's pads move by some millimetres.

    Args:
        gap: The contact gap to begin with [m].

    Attributes:
        gap: The contact gap so far [m].
    """

    def __init__(self, gap: float) -> None:
        self.gap = gap
        # The instants of recent samples, their gaps, and whether tips may touch in each.
        self._recent: deque[tuple[float, list[float], bool]] = deque()
        self._touches: deque[float] = deque(maxlen=_TOUCHES[1])
        # Number of the recent samples in which tips may touch.
        self._near = 0
        self._least = math.inf
        self._is_due = False

    def add(self, time: float, landmarks: Array) -> bool:
        """Take one sample that the robot follows.

        Args:
            time: Its instant [s]; later than that of the sample before.
            landmarks: Its landmarks [m], shape (21, 3).

        Returns:
            Whether `gap` has changed.
        """
        gaps = core.tip_gaps(landmarks)
        is_near = min(gaps) < TOUCH_GAP
        self._near += is_near
        recent = self._recent
        recent.append((time, gaps, is_near))
        while not 0.0 <= time - recent[0][0] <= _MEDIAN_TIME:
            self._near -= recent.popleft()[2]
        if len(recent) < 3:
            return False
        is_waiting = self._least == math.inf and not self._is_due
        if is_waiting and not self._near:
            # No median is below the least number, so no touch begins.
            return False
        _, rows, _ = zip(*recent, strict=True)
        columns = map(sorted, zip(*rows, strict=True))
        half = len(rows) // 2
        smallest = min([0.5 * (gaps[half] + gaps[~half]) for gaps in columns])
        if smallest < TOUCH_GAP:
            self._least = min(self._least, smallest)
        if smallest > self._least + _RELEASE:
            self._touches.append(self._least)
            self._least = math.inf
            self._is_due = True
        if not self._is_due or smallest < OPEN_GAP or len(self._touches) < _TOUCHES[0]:
            return False
        self._is_due = False
        wanted = clipped_gap(np.percentile(self._touches, _LOW))
        change = min(max(wanted - self.gap, -_STEP), _STEP)
        self.gap += change
        return change != 0.0
