"""Where the pads of thumb and index finger meet: a robot's, or the person's (`PadMotion`)."""

from typing import NamedTuple

import numpy as np

from handmap_qp.apps.offline.comparison import Take
from handmap_qp.apps.offline.hand_trace import TIP, HandTrace, trace_robot
from handmap_qp.hands import THUMB, Hand, Pad, PadPair
from handmap_qp.se3 import Array, transform_points
from .commands import PinchWindow

INDEX = "index"


class Meeting(NamedTuple):
    """Where two pads are at an instant.

    Attributes:
        time: The instant [s].
        places: Middles of the pads of thumb and finger in the world [m], shape (2, 3).
    """

    time: Array
    places: Array


class PadMotion(NamedTuple):
    """Two pads that close with nothing between them.

    Attributes:
        time: Instants [s], shape (T,).
        places: As of `Meeting`, at each instant, shape (T, 2, 3).
        pair: The pads; their radii count.
    """

    time: Array
    places: Array
    pair: PadPair

    def meeting(self, width: float) -> Meeting:
        """Return the first instant at which the pads are as near as an object is wide.

        Args:
            width: Width of the object [m].

        Returns:
            The instant, or that of the smallest gap if the pads do not come near enough.
        """
        gaps = np.array([self.pair.gap(places) for places in self.places])
        # Never nearer, or never farther: where they are nearest.
        after = max(1, np.argmax(gaps <= width) or np.argmin(gaps))
        share = np.interp(width, (gaps[after], gaps[after - 1]), [1.0, 0.0])
        ends = (column[after - 1 : after + 1] for column in (self.time, self.places))
        return Meeting(*(start + share * (end - start) for start, end in ends))


def person_pads(take: Take, window: PinchWindow, robot: Hand) -> PadMotion:
    """Return how the person's pads would close on a hand of the robot's size.

    Fingertips are taken in the person's palm and enlarged about its origin by the ratio of the two
    hands' sizes. So the place depends on person and robot, and on no mapping.

    Args:
        take: The recording, prepared.
        window: When the human pinches.
        robot: The robot hand.

    Raises:
        InvalidInputError: If the robot has no finger with a human name.
    """
    human = take.trace
    ratio = _size(robot) / human.size
    fingers = [human.names.index(name) for name in (THUMB, INDEX)]
    samples = slice(window.opened, window.end + 1)
    tips = human.local[samples][:, fingers, TIP]
    places = transform_points(human.palm[samples][:, None], ratio * tips)
    # Skin touches skin where the landmarks are this far apart.
    radius = ratio * take.human.contact_gap / 2.0
    pad = Pad(0, np.zeros(3), radius)
    return PadMotion(take.recording.time[samples], places, PadPair(pad, pad))


def _size(robot: Hand) -> float:
    """Return the size of a robot's hand, as of `HandTrace.size` [m]."""
    wrist = np.eye(4)[None] if robot.is_floating else None
    trace: HandTrace = trace_robot(robot, robot.rest[None], wrist)
    return trace.size
