"""Middle joints of fingers: the PIP joint of a finger, the IP joint of a thumb."""

from __future__ import annotations

import numpy as np

from handmap_qp.onboarding.flexion import HandFlexion
from handmap_qp.onboarding.robot import Robot
from handmap_qp.onboarding.structure import Structure
from handmap_qp.transform import transform_points

# Joints flex a finger if their axes are as parallel as this to that of its last joint.
_PARALLEL = 0.85
# Place of the PIP joint between knuckle and tip on a person.
_PIP = 0.45
# A middle joint is at least, and at most, this share of the finger away from its knuckle.
_LEAST, _MOST = 0.15, 0.88


def middle_joint(
    robot: Robot, structure: Structure, flexion: HandFlexion, finger: int, *, is_thumb: bool
) -> tuple[str, np.ndarray] | None:
    """Find the PIP joint of a finger, or the IP joint of a thumb.

    A thumb's is its last flexing joint, a finger's the one next to the place of a person's joint
    among those beyond the knuckle. The point lies on the joint's axis, where the axis is nearest to
    the fingertip.

    Args:
        robot: The robot.
        structure: Its palm and fingers.
        flexion: How the fingers flex.
        finger: Index of the finger.
        is_thumb: Whether the finger is the thumb.

    Returns:
        Child link of the joint, and the point in its frame [m], shape (3,); None if the finger has
        no such joint.
    """
    chain, palm = structure.chains[finger], structure.palm
    robot.place(flexion.q_open)
    tip = transform_points(robot.pose_in(chain.tip.link, palm), chain.tip.xyz)
    links, points, axes = [], [], []
    for joint, link in zip(chain.joints, chain.links, strict=True):
        if robot.kinds[joint] == "prismatic":
            continue
        pose = robot.pose_in(link, palm)
        axis, origin = pose[:3, :3] @ robot.axes[joint], pose[:3, 3]
        links.append(link)
        axes.append(axis)
        points.append(origin + ((tip - origin) @ axis) * axis)
    flexing = [k for k in range(len(links)) if abs(axes[k] @ axes[-1]) > _PARALLEL]
    # A thumb's joint at its root counts as its knuckle, whatever its axis.
    line = flexing if len(flexing) > 1 or not is_thumb else [*{0, *flexing}]
    if len(line) < 2:
        return None
    places = np.array([*(points[k] for k in line), tip])
    ways = np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))
    if ways[-1] < 1e-6:
        return None
    shares = ways[:-1] / ways[-1]
    near = [k for k, share in enumerate(shares) if _LEAST < share < _MOST]
    if not near:
        return None
    best = near[-1] if is_thumb else min(near, key=lambda k: abs(shares[k] - _PIP))
    link = links[line[best + 1]]
    place = transform_points(np.linalg.inv(robot.pose_in(link, palm)), points[line[best + 1]])
    robot.place(robot.zero)
    return link, place
