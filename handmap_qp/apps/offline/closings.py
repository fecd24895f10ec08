"""How quickly people close their fingers in a recording: `closing_times`."""

from itertools import pairwise

import numpy as np

from handmap_core.se3 import Array
from handmap_qp.human import Recording, by_parts
from .poses import CURLED, STRAIGHT, measure_posture
from .trajectory import stretches

# A finger closes from this share of its way to that one; the ends are slow and noisy.
_FROM, _TO = 0.1, 0.9
# The ends of its way are looked for in this time before and after [s].
_NEAR = 1.0


def closing_times(recording: Recording) -> Array:
    """Measure the time of each closing of a finger: index, middle, ring or little.

    A finger closes when it was straight (`poses.STRAIGHT`) and becomes curled (`poses.CURLED`).
    Its way goes from its least flexion in the second before to its largest in the second after.
    The time is that from 10 % to 90 % of this way, over 0.8: what a motor with the same mean speed
    would need for the whole way.

    Args:
        recording: Landmarks of a hand. Closings in which the hand is lost do not count.

    Returns:
        Times of k closings [s], shape (k,), finger by finger; none if nobody closes a finger.
    """
    found = []
    for seen in stretches(recording.valid):
        landmarks = recording.landmarks[seen]
        flexion = by_parts(lambda part: measure_posture(part).flexion, landmarks)
        for finger in flexion.T:
            # Landmarks that coincide have no angles.
            known = np.isfinite(finger)
            found += _closings(recording.time[seen][known], finger[known])
    return np.array(found)


def _closings(time: Array, flexion: Array) -> list[float]:
    """Return the times of the closings of one finger [s]; its flexion is in degrees."""
    is_straight = flexion < STRAIGHT
    is_curled = flexion > CURLED
    ends = np.flatnonzero(is_straight | is_curled)
    found = []
    for start, end in pairwise(ends):
        if is_straight[start] and is_curled[end]:
            found.append(_time_of(time, flexion, start, end))
    return found


def _time_of(time: Array, flexion: Array, start: int, end: int) -> float:
    """Return the time of the closing that is straight at one sample and curled at another [s]."""
    first = int(np.searchsorted(time, time[start] - _NEAR))
    last = int(np.searchsorted(time, time[end] + _NEAR))
    low = flexion[first : start + 1].min()
    way = flexion[end:last].max() - low
    # Between these two samples it passes both angles.
    begun = flexion[first:end] <= low + _FROM * way
    left = first + int(np.flatnonzero(begun)[-1])
    arrived = flexion[left:last] >= low + _TO * way
    right = left + int(np.argmax(arrived))
    times = [
        np.interp(low + share * way, flexion[[k, k + 1]], time[[k, k + 1]])
        for share, k in ((_FROM, left), (_TO, right - 1))
    ]
    return float(times[1] - times[0]) / (_TO - _FROM)
