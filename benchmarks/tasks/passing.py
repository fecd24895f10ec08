"""Both hands of a person who passes an upright bar from the right hand to the left one.

Made from the human model; no person was recorded. The hands come together, thumbs up, the right one
above. The right hand takes the bar between the thumb and all fingers and lifts it, the left one
comes from the other side and takes it lower down, the right one lets go and leaves, and the left
one takes the bar away. `hand_over.py` lets a robot do it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from demo_recording import GESTURES, HAND_LENGTH

from handmap_core.human.sample import human_name
from handmap_qp import HumanLengths, load_hand
from handmap_qp.hands import Side
from handmap_qp.se3 import affine, smoothstep

RATE = 60.0
"""Samples per second."""
SIDES: tuple[Side, Side] = ("left", "right")
FINGERS = ("index", "middle", "ring", "little")
HELD_AT = 0.075
"""How far each hand holds it from its middle [m]."""
END = 10.0
"""Length of the recording [s]."""
HANGS = 4.95
"""When the bar has come to rest in the right hand [s]."""
CLOSING = {"right": (3.1, 3.7), "left": (6.2, 6.8)}
"""Instants between which each hand closes [s]."""
OPENING = {"right": (7.4, 8.0), "left": (np.inf, np.inf)}
"""Instants between which each hand opens [s]."""
_TOGETHER = 2.0  # when the hands have come together [s]
# Where the person pinches then, against where the hands meet: time [s], x forward, y left, z up
# [m]. A hand comes in with its fingertips a little back, so that the thumb does not touch the bar.
_WAYS = {
    "right": (
        (_TOGETHER, -0.02, -0.08, 0.0),
        (2.2, -0.02, -0.08, 0.0),
        (2.8, -0.02, 0.0, 0.0),
        (3.1, 0.0, 0.0, 0.0),
        (3.9, 0.0, 0.0, 0.0),
        (4.7, 0.0, 0.0, 0.05),
        (7.4, 0.0, 0.0, 0.05),
        (7.9, -0.012, 0.0, 0.05),
        (8.2, -0.012, 0.0, 0.05),
        (9.2, -0.012, -0.2, 0.05),
    ),
    "left": (
        (_TOGETHER, -0.02, 0.08, 0.0),
        (3.9, -0.02, 0.08, 0.0),
        (4.7, -0.02, 0.08, 0.05),
        (5.0, -0.02, 0.08, 0.05),
        (5.9, -0.02, 0.0, 0.05),
        (6.2, 0.0, 0.0, 0.05),
        (8.6, 0.0, 0.0, 0.05),
        (9.6, 0.0, 0.2, 0.05),
    ),
}
# Palms facing each other, thumbs up, fingers forward and by this angle outward [rad].
_OUTWARD = np.radians(20.0)
_POSTURES = {gesture.name: np.ravel(gesture.fingers) for gesture in GESTURES}
# Share of the way to the closed fingers at which the open hand waits.
_WAITING = 0.35


@dataclass
class Person:
    """A hand of a person that passes a bar, or takes it.

    Attributes:
        side: Which hand.
        start: Pose of the palm at the beginning, shape (4, 4).
        meeting: Where the hands meet [m], shape (3,).
        aim: By how much the hand is turned and moved where the hands meet, shape (4, 4).
        bend: What is added to the flexion of the four fingers when closed [rad], shape (4,).
    """

    side: Side
    start: np.ndarray
    meeting: np.ndarray
    aim: np.ndarray = field(default_factory=lambda: np.eye(4))
    bend: np.ndarray = field(default_factory=lambda: np.zeros(4))

    def __post_init__(self) -> None:
        sizes = HumanLengths.from_hand_length(HAND_LENGTH)
        name = human_name(self.side)
        self.hand = load_hand(name, points="landmarks", lengths=sizes)

    def landmarks(self) -> Iterator[np.ndarray]:
        """Yield the landmarks at every sample [m], shape (21, 3)."""
        human = self.hand
        # All fingertips in a line opposite the thumb's, as in pinches.
        closed = _POSTURES["pinch middle"].copy()
        for k, name in enumerate(FINGERS, 1):
            closed[4 * k :][:4] = _POSTURES[f"pinch {name}"][4 * k :][:4]
        closed[5::4] += self.bend
        waiting = _POSTURES["open"] + _WAITING * (closed - _POSTURES["open"])
        # Only fingers close; the thumb stays where they will come.
        waiting[:4] = closed[:4]
        pinch = human.points(closed, np.eye(4))[[4, 8, 12]].mean(axis=0)
        sign = 1.0 if self.side == "left" else -1.0
        facing = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, sign], [sign, 0.0, 0.0]])
        outward = pin.exp3(sign * _OUTWARD * np.array([0.0, 0.0, 1.0]))
        turn = self.aim[:3, :3] @ outward @ facing
        back = pin.log3(self.start[:3, :3] @ turn.T)
        centre = self.meeting + self.aim[:3, 3] - [0.0, 0.0, sign * HELD_AT]
        knots = np.array(_WAYS[self.side])
        for time in np.arange(0.0, END, 1.0 / RATE):
            share = progress(time, *CLOSING[self.side])
            share -= progress(time, *OPENING[self.side])
            after = np.searchsorted(knots[:, 0], time, "right")
            k = int(np.clip(after, 1, len(knots) - 1))
            part = progress(time, knots[k - 1, 0], knots[k, 0])
            place = centre + knots[k - 1, 1:] + part * (knots[k] - knots[k - 1])[1:]
            wrist = place - turn @ pinch
            far = 1.0 - progress(time, 0.0, _TOGETHER)
            wrist += far * (self.start[:3, 3] - wrist)
            pose = affine(pin.exp3(far * back) @ turn, wrist)
            yield human.points(waiting + share * (closed - waiting), pose)


def progress(time: float, start: float, end: float) -> float:
    """Return the share of a motion from one instant to another, smooth at both."""
    return float(smoothstep((time - start) / (end - start))) if start < np.inf else 0.0
