"""Which fingers are caught at the end of a pose, and why: `find_caught`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from arrivals import FingerMeter, FingerShapes, are_under_way, distances, shapes_of
from gesture_tours import CAUGHT, RATE, TourMotion

from handmap_qp import Hand
from handmap_qp.apps.offline.fidelity import angles_between
from handmap_qp.apps.offline.hand_trace import HandTrace
from handmap_qp.hands import THUMB

_POSTURES = 4000
"""How many random postures say what a finger can show."""
_LOOKED = 12
"""Samples at the end of a pose that say whether a finger is under way."""

OUT_OF_REACH = "no posture of it shows more"
ON_THE_WAY = "under way"
EVERYWHERE = "from rest too"
FROM_HERE = "after this pose"


class CaughtFinger(NamedTuple):
    """A finger that is caught at the end of a pose.

    Attributes:
        pose: Index of the pose in its order.
        finger: Its anatomical name.
        direction: Angle between human and robot, from knuckle to tip in palm axes [deg].
        bend: At the middle joint, robot's minus human's [deg].
        reason: One of the reasons of `find_caught`.
    """

    pose: int
    finger: str
    direction: float
    bend: float
    reason: str

    def __str__(self) -> str:
        """Return the finger, its errors and the reason."""
        return (
            f"{self.finger} {self.direction:.0f} off, bent {self.bend:+.0f}: "
            f"{self.reason}"
        )


def find_caught(
    human: HandTrace, motion: TourMotion, settled: np.ndarray
) -> list[CaughtFinger]:
    """Return the fingers that are caught, except for thumbs, with the first reason that holds.

    - `OUT_OF_REACH`: no posture of the robot brings the finger nearer than `CAUGHT`.
    - `ON_THE_WAY`: the finger still turns when the pose ends.
    - `EVERYWHERE`: it is caught too where the robot meets the pose at rest.
    - `FROM_HERE`: it is not, so that what came before keeps it from there.

    Args:
        human: The person at the end of each of the m poses.
        motion: The robot.
        settled: Joints of the robot that met each of these poses at rest, shape (m, n).
    """
    meter = FingerMeter(motion.robot)
    names = [n for n in human.names if n in meter.names and n != THUMB]
    every = np.arange(len(human.palm))
    wanted = shapes_of(human.part(every, names).local)
    chosen = [meter.names.index(name) for name in names]

    def seen(q: np.ndarray) -> FingerShapes:
        return FingerShapes(*(part[:, chosen] for part in meter.shapes(q)))

    shown = seen(motion.q)
    off = distances(wanted, shown)
    at_rest = distances(wanted, seen(settled))
    possible = seen(_random_postures(motion.robot))
    found = []
    for i, j in np.argwhere(off > CAUGHT).tolist():
        one = FingerShapes(wanted.aim[i, j], wanted.bend[i, j])
        any_posture = FingerShapes(possible.aim[:, j], possible.bend[:, j])
        held = motion.held[i][-_LOOKED:]
        time = np.arange(len(held)) / RATE
        if distances(one, any_posture).min() > CAUGHT:
            reason = OUT_OF_REACH
        elif are_under_way(time, seen(held))[j]:
            reason = ON_THE_WAY
        else:
            reason = EVERYWHERE if at_rest[i, j] > CAUGHT else FROM_HERE
        direction = float(angles_between(one.aim, shown.aim[i, j]))
        bend = float(shown.bend[i, j] - one.bend)
        found.append(CaughtFinger(i, names[j], direction, bend, reason))
    return found


def _random_postures(robot: Hand) -> np.ndarray:
    """Return joints within their limits [rad], shape (`_POSTURES`, n); the ends count too."""
    rng = np.random.default_rng(0)
    shares = rng.uniform(-0.1, 1.1, (_POSTURES, len(robot.joint_names))).clip(0.0, 1.0)
    low, high = robot.limits
    return low + shares * (high - low)
