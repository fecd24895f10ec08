"""What a mapping commands over time, and when the human pinches: `map_commands`, `find_pinch`."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from handmap_qp.apps.offline.comparison import (
    ComparedMethod,
    Take,
    outside_methods,
    own_method,
    own_methods,
)
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands import Hand
from handmap_qp.human.recording import Recording
from handmap_qp.se3 import Array, lengths

# The human pinches while thumb and index landmarks are nearer than the first, with interruptions
# below the second [m].
_CLOSED, _OPEN = 0.022, 0.035
# Shortest pinch that counts, and time before it at which the simulation starts [s].
_SHORTEST, _BEFORE = 0.5, 0.25


class Commands(NamedTuple):
    """What a mapping commands over time.

    Attributes:
        hand: The robot hand.
        time: Instants [s], shape (T,).
        q: Joint angles [rad], shape (T, n).
        wrist: Wrist poses, shape (T, 4, 4).
    """

    hand: Hand
    time: Array
    q: Array
    wrist: Array

    def at(self, i: int) -> tuple[Array, Array | None]:
        """Return joint angles and wrist pose of a sample; no wrist if the hand does not float."""
        return self.q[i], self.wrist[i] if self.hand.is_floating else None


class PinchWindow(NamedTuple):
    """When the human pinches thumb and index finger.

    Attributes:
        start: Index of the first sample of the simulation.
        closed: Index of the sample at which the pinch has closed.
        end: Index of the last sample at which it is closed.
    """

    start: int
    closed: int
    end: int


def chosen_methods(
    names: tuple[str, ...], peers: Path | None, robot: str
) -> list[ComparedMethod]:
    """Return mappings by name, of this package and of an outside program; one preset if none.

    Raises:
        InvalidInputError: If there is no such mapping.
    """
    found = [] if peers is None else outside_methods(peers, robot)
    outside = {method.name: method for method in found}
    names = names or own_methods()[:1]
    return [outside.get(name) or own_method(name) for name in names]


def map_commands(method: ComparedMethod, take: Take, hand: Hand) -> Commands:
    """Map a recording by one mapping.

    A mapping that moves no wrist has the robot's palm on the human's, as in `handmap compare`.

    Args:
        method: The mapping.
        take: The recording, prepared.
        hand: The robot hand.
    """
    motion = method.map_take(take, hand)
    return Commands(hand, take.recording.time, motion.q, motion.wrist_in(take, hand))


def find_pinch(recording: Recording) -> PinchWindow:
    """Find the longest pinch of thumb and index finger in a recording.

    Raises:
        InvalidInputError: If there is no pinch of half a second.
    """
    time = recording.time
    landmarks = recording.landmarks
    gap = lengths(landmarks[:, 4] - landmarks[:, 8])
    # Samples without landmarks interrupt nothing.
    runs, _ = ndimage.label(~(gap > _OPEN))
    pinches = [(0.0, 0, 0)]
    for (run,) in ndimage.find_objects(runs):
        shut = run.start + np.flatnonzero(gap[run] < _CLOSED)
        if len(shut):
            opened = time[min(run.stop, len(time) - 1)]
            pinches.append((opened - time[shut[0]], int(shut[0]), int(shut[-1])))
    length, closed, end = max(pinches)
    if length < _SHORTEST:
        raise InvalidInputError(
            f"no pinch of thumb and index finger of {_SHORTEST:g} s",
            argument=recording.name,
        )
    return PinchWindow(int(np.searchsorted(time, time[closed] - _BEFORE)), closed, end)
