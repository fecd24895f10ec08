"""Where the pads of thumb and index finger meet: `PadMotion` of a robot, and `PersonPads`."""

from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array, lengths, transform_points
from handmap_qp.apps.offline.comparison import Take
from handmap_qp.apps.offline.hand_trace import trace_robot
from handmap_qp.apps.tables import Row
from handmap_qp.hands import THUMB, Hand, PadPair, PalmKinematics, find_pads
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
        places: As in `Meeting`, at each instant, shape (T, 2, 3).
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


class PersonPads:
    """How the person's pads would close on a hand of the robot's size.

    Pads of the fitted human model are taken in its palm, and enlarged about the palm's origin by
    the ratio of the two hands' sizes. So the place depends on person and robot, and on no mapping.

    Args:
        take: The recording, prepared.
        window: When the human pinches.
        robot: The robot hand.

    Attributes:
        motion: The pads.

    Raises:
        InvalidInputError: If the robot has no finger with a human name.
    """

    def __init__(self, take: Take, window: PinchWindow, robot: Hand) -> None:
        ratio = _size(robot) / take.trace.size
        samples = slice(window.opened, window.end + 1)
        pads = find_pads(take.human)
        pair = [pads[name] for name in (THUMB, INDEX)]
        places = PalmKinematics(take.human).points(
            take.q[samples], [pad.place for pad in pair]
        )
        self._palm = take.trace.palm[samples]
        self.motion = PadMotion(
            take.recording.time[samples],
            transform_points(self._palm, ratio * places),
            PadPair(*(pad._replace(radius=ratio * pad.radius) for pad in pair)),
        )

    def offset(self, robot: PadMotion, width: float) -> Array:
        """Return where a robot's pads meet from where the person's do [m], shape (3,).

        Args:
            robot: The robot's pads.
            width: Width of the object that they meet [m].

        Returns:
            The vector in the axes of the person's palm: y distal, z dorsal.
        """
        person = self.motion
        met = person.meeting(width)
        theirs = person.pair.middle(met.places)
        apart = robot.pair.middle(robot.meeting(width).places) - theirs
        sample = int(np.argmin(np.abs(person.time - met.time)))
        return self._palm[sample, :3, :3].T @ apart


def meeting_row(name: str, offset: Array) -> Row:
    """Describe `PersonPads.offset` of a mapping in a row of a table."""
    x, y, z = (1e3 * offset).round(1).tolist()
    return {
        "mapping": name,
        "off mm": round(1e3 * float(lengths(offset)), 1),
        "across mm": x,
        "distal mm": y,
        "dorsal mm": z,
    }


def _size(robot: Hand) -> float:
    """Return the size of a robot's hand, as in `HandTrace.size` [m]."""
    wrist = np.eye(4)[None] if robot.is_floating else None
    return trace_robot(robot, robot.rest[None], wrist).size
