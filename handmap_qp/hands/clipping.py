"""A joint posture within the limits of a hand: `clip_step`."""

import numpy as np

from handmap_core.se3 import Array
from .hand import Hand


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
