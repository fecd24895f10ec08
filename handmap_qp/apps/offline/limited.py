"""Motions of others within the limits of the robot: `clip_motion`, `clip_step`.

Libraries that do not know speed limits command motions that the robot cannot follow. Clipped, they
are what it could do at best without another mapping.
"""

from dataclasses import replace

import numpy as np

from handmap_core.se3 import Array
from handmap_qp.hands import Hand
from .trajectory import RobotMotion

LIMITS = "+limits"
"""Ending of a peer's name whose joints are to be clipped."""


def clip_step(robot: Hand, wanted: Array, last: Array | None, dt: float) -> Array:
    """Return the posture nearest to a wanted one, joint by joint, that the limits allow.

    Args:
        robot: The robot hand.
        wanted: Joint angles in the order of `robot.joint_names` [rad or m], shape (n,).
        last: Those of the sample before, inside the limits of position; None in the first sample,
            which is limited in position alone.
        dt: Time since then, at least 0 [s].
    """
    q = np.clip(wanted, *robot.limits)
    if last is None:
        return q
    step = robot.velocity_limits * dt
    return np.clip(q, last - step, last + step)


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
