"""When a recorded human pinches: `find_pinch`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.human.recording import Recording

# The human pinches while thumb and index landmarks are nearer than the first, with interruptions
# below the second [m].
_CLOSED, _OPEN = 0.022, 0.035
# Shortest pinch that counts [s].
_SHORTEST = 0.5
# The simulation starts this long before the pinch [s].
_BEFORE = 0.25


class PinchWindow(NamedTuple):
    """When the human pinches.

    Attributes:
        finger: The finger that meets the thumb.
        start: Index of the first sample of the simulation.
        closed: Index of the sample at which the pinch has closed.
        end: Index of the last sample at which it is closed.
    """

    finger: str
    start: int
    closed: int
    end: int


def find_pinch(recording: Recording) -> PinchWindow:
    """Find the longest pinch of thumb and index finger in a recording.

    Raises:
        InvalidInputError: If there is no pinch of half a second.
    """
    gap = np.linalg.norm(recording.landmarks[:, 4] - recording.landmarks[:, 8], axis=1)
    best: tuple[float, int, int] | None = None
    start: int | None = None
    for i, value in enumerate(gap):
        if start is None and value < _CLOSED:
            start = i
        if start is not None and (value > _OPEN or i == len(gap) - 1):
            length = float(recording.time[i] - recording.time[start])
            if best is None or length > best[0]:
                shut = np.flatnonzero(gap[start:i] < _CLOSED)
                best = (length, start, start + int(shut[-1]))
            start = None
    if best is None or best[0] < _SHORTEST:
        raise InvalidInputError(
            argument=recording.name,
            problem=f"no pinch of thumb and index finger of {_SHORTEST:g} s",
        )
    _, closed, end = best
    first = int(np.searchsorted(recording.time, recording.time[closed] - _BEFORE))
    return PinchWindow("index", first, closed, end)
