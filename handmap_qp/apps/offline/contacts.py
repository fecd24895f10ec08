"""Contacts with the object that a person holds: whether a robot touches, slips on and carries it.

The robot's object is where the person's is, because the robot's wrist is in the person's world. For
a hand on an arm or a stand, both palms lay it in the robot's world at the first valid sample.
"""

import numpy as np

from handmap_core.se3 import Array, inverse_pose, lengths, transform_points
from handmap_qp.hands import (
    Values,
    distal_shapes,
    find_fingers,
    read_collision_shapes,
)
from handmap_qp.human import Recording
from handmap_qp.mapping import Shape, distances_to, nearest
from .fidelity import SETTLING
from .hand_trace import TIP, HandTrace
from .trajectory import RobotMotion

SKIN = 0.01
"""A person's fingertip touches where its landmark, inside the finger, is as near as this [m]."""
TOUCHING = 0.002
"""A robot's fingertip touches within this distance of its surface [m]."""
_MOVED = 0.002  # What moves less stays where it is [m].


def contact_metrics(
    human: HandTrace,
    robot: HandTrace,
    recording: Recording,
    shape: Shape,
    motion: RobotMotion,
) -> Values:
    """Measure contacts of the fingers that both hands have.

    Args:
        human: The person's motion.
        robot: The robot's, of the same samples.
        recording: The recording, with an object.
        shape: The object's shape.
        motion: The robot's, with its joints.

    Returns:
        The metrics of the group `Object in the hand` whose question arises.

    Raises:
        HandError: If a collision shape cannot be read.
    """
    poses = np.asarray(recording.object_pose)
    time = recording.time
    counts = recording.valid & np.isfinite(poses).all(axis=(1, 2))
    counts &= time >= time[0] + SETTLING
    there = poses = poses[counts]
    if not motion.robot.is_floating:
        start = recording.valid.argmax()
        there = robot.palm[start] @ inverse_pose(human.palm[start]) @ poses
    names = [name for name in human.names if name in robot.names]
    human, robot = human.part(counts, names), robot.part(counts, names)
    ends = transform_points(inverse_pose(poses), human.points[..., TIP, :])
    touches = np.array([nearest(shape, points).distances for points in ends]) <= SKIN
    if not touches.any():
        return {}
    touched, deepest = _touched(motion, np.flatnonzero(counts), there, shape, names)
    both = (touches & touched).sum()
    # The first sample of each touch.
    begins = np.diff(touches, axis=0, prepend=False) & touches
    rows = np.arange(len(poses))[:, None] * begins
    first = np.maximum.accumulate(rows, axis=0), np.arange(len(names))

    def since(places: Array) -> Array:
        """Return how far places have moved since each touch began, shape (T, k, 3)."""
        return places - places[first]

    here = transform_points(inverse_pose(there), robot.points[..., TIP, :])
    slips = lengths(since(here - ends))[touches]
    # What moves with fingers that stay at their places is carried.
    stays = touches & (lengths(since(ends)) < _MOVED)
    in_palm = inverse_pose(human.palm) @ poses
    carried = transform_points(in_palm, ends[first])
    wanted = (carried - human.local[..., TIP, :][first])[stays]
    made = since(robot.local[..., TIP, :])[stays]
    size = (wanted**2).sum()
    is_moved = size > _MOVED**2 * len(wanted)
    return {
        "contact_precision": both / max(touched.sum(), 1),
        "contact_recall": both / touches.sum(),
        "object_depth_mm": 1e3 * deepest,
        "contact_slip_mm": 1e3 * slips.mean(),
        "object_carried": (made * wanted).sum() / size if is_moved else np.nan,
    }


def _touched(
    motion: RobotMotion, samples: Array, poses: Array, shape: Shape, names: list[str]
) -> tuple[Array, float]:
    """Return which fingers touch an object, (T, k), and how deep the deepest link is in it [m]."""
    hand = motion.robot
    links = read_collision_shapes(hand)
    own = [distal_shapes(find_fingers(hand)[name], links) for name in names]
    placed = hand.configuration()
    gaps = []
    for i, pose in zip(samples, poses, strict=True):
        placed.place(motion.at(i))
        gaps.append([gap for gap, _ in distances_to(shape, pose, placed, links)])
    rows = np.array(gaps)
    nearest_links = [rows[:, shapes].min(axis=1, initial=np.inf) for shapes in own]
    return np.column_stack(nearest_links) <= TOUCHING, -rows.min(initial=0.0)
