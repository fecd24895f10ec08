"""Between the library's arrays and the plain values of messages."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.mapping.step import MapStep
from handmap_qp.service.messages import Detail, Lengths, Pose
from handmap_qp.transform import pose_from_xyz_quat


def to_row(values: np.ndarray) -> tuple[float, ...]:
    """An array (n,) as plain floats."""
    return tuple(values.tolist())


def to_rows(values: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """An array (n, m) as plain floats, row by row."""
    return tuple(map(tuple, values.tolist()))


def to_points(values: np.ndarray) -> tuple[tuple[float, float, float], ...]:
    """An array (n, 3) as plain points."""
    return tuple((x, y, z) for x, y, z in values.tolist())


def to_pose(matrix: np.ndarray | None) -> Pose | None:
    """A pose (4, 4) as position and quaternion xyzw."""
    if matrix is None:
        return None
    (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = matrix.tolist()
    # The largest of the four squares is divided by: never a small one (Shepperd 1978). In plain
    # floats, for every command has one.
    squares = (1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i, 1.0 + a + e + i)
    largest = max(squares)
    if largest == squares[3]:
        quat = (h - f, c - g, d - b, largest)
    elif largest == squares[0]:
        quat = (largest, b + d, c + g, h - f)
    elif largest == squares[1]:
        quat = (b + d, largest, f + h, c - g)
    else:
        quat = (c + g, f + h, largest, d - b)
    norm = math.hypot(*quat)
    return Pose((x, y, z), (quat[0] / norm, quat[1] / norm, quat[2] / norm, quat[3] / norm))


def to_matrix(pose: Pose | None) -> np.ndarray | None:
    """A pose of a message, its quaternion normalised, as (4, 4)."""
    return None if pose is None else pose_from_xyz_quat((*pose.position, *pose.quat_xyzw), "xyzw")


def to_lengths(lengths: HumanLengths | None) -> Lengths | None:
    """A measured hand as plain points."""
    if lengths is None:
        return None
    return msgspec.convert(
        {"bases": lengths.bases.tolist(), "segments": lengths.segments.tolist()}, Lengths
    )


def joints_where(robot: Hand, chosen: np.ndarray) -> tuple[str, ...]:
    """Names of the joints that a mask (n,) chooses."""
    return tuple(
        name
        for name, is_chosen in zip(robot.joint_names, chosen.tolist(), strict=True)
        if is_chosen
    )


def to_detail(step: MapStep, human_q: np.ndarray | None, human_wrist: np.ndarray | None) -> Detail:
    """Every stage of a step, for those who watch."""
    return Detail(
        human_points=to_points(step.human_points),
        human_q=None if human_q is None else to_row(human_q),
        human_wrist=to_pose(human_wrist),
        motion=to_rows(step.motion),
        motion_rigid=to_rows(step.motion_rigid),
        motion_deformation=to_rows(step.motion_deformation),
        stretches=to_row(step.stretches),
        pivot=to_points(step.transfer.image[None])[0],
        targets=to_points(step.targets),
        points=to_points(step.points),
    )
