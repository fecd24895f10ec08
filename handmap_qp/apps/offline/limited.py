"""Motions of others within the limits of the robot: `clip_motion`.

Libraries that do not know speed limits command motions that the robot cannot follow. Clipped, they
are what it could do at best without another mapping.
"""

from dataclasses import replace

import numpy as np

from handmap_core.se3 import Array
from handmap_qp.hands import clip_step
from .trajectory import RobotMotion


def clip_motion(motion: RobotMotion) -> RobotMotion:
    """Return a motion whose joints keep their limits of position and speed, sample by sample.

    Steps are limited by the instants of the samples. Nothing is known of the future, and links may
    overlap. The wrist is as it was.
    """
    rows: list[Array] = []
    last = None
    steps = np.diff(motion.time, prepend=motion.time[0])
    for wanted, dt in zip(motion.q, steps.tolist(), strict=True):
        last = clip_step(motion.robot, wanted, last, dt)
        rows.append(last)
    words = filter(None, (motion.about, "clipped by the joints' limits"))
    return replace(motion, q=np.array(rows), about=", ".join(words))
