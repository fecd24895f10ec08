"""Where an arm points: along the axis of the joint that turns the hand about its own length."""

from collections.abc import Sequence

import numpy as np

from handmap_core.se3 import Array, inverse_pose, transform_points, unit
from handmap_qp.hands import PalmKinematics
from .robot import Robot
from .vectors import UNKNOWN

# So many joints of a wrist turn the hand, the forearm among them.
_WRIST_JOINTS = 3
# A joint turns the hand about its length if the cosine between its axis and the way from its origin
# to the fingers is larger: grippers may be mounted beside that axis, but a yaw is none.
_ALONG = 0.75


def arm_direction(robot: Robot, palm: str, fingers: Sequence[str]) -> Array:
    """Return the direction in which the arm of a hand points.

    An arm carries the hand on joints of a wrist. Nearly always one of them is a roll, whose axis is
    along the hand.

    Args:
        robot: The robot with the arm.
        palm: The palm's link.
        fingers: First links of the fingers.

    Returns:
        A unit vector in the palm link's coordinates, shape (3,); zero without such a joint.
    """
    if palm not in robot.frames or not fingers:
        return UNKNOWN
    carrying = [*robot.model.supports[robot.frames[palm].parentJoint]][1:]
    wrist = carrying[::-1][:_WRIST_JOINTS]
    if not wrist:
        return UNKNOWN
    turns, places = PalmKinematics(robot).axes(robot.rest, wrist)
    (link,) = robot.link_poses([palm], robot.rest)
    pose = inverse_pose(link) @ robot.frame_pose("palm", robot.rest)
    turns = turns @ pose[:3, :3].T
    places = transform_points(pose, places)
    starts = [robot.pose_in(link, palm)[:3, 3] for link in fingers]
    ways = unit(np.mean(starts, axis=0) - places)
    cosines = np.vecdot(turns, ways)
    for turn, cosine in zip(turns, cosines.tolist(), strict=True):
        if abs(cosine) > _ALONG:
            return np.copysign(1.0, cosine) * turn
    return UNKNOWN
