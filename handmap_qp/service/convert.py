"""Conversion between the library's arrays and the plain values of messages."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.mapping.step import MapStep
from handmap_qp.se3 import pose_from_xyz_quat
from handmap_qp.service.messages import Detail, Lengths, Pose


def to_row(values: np.ndarray) -> tuple[float, ...]:
    """Convert an array (n,) to floats."""
    return tuple(values.tolist())


def to_rows(values: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """Convert an array (n, m) to rows of floats."""
    return tuple(map(tuple, values.tolist()))


def to_points(values: np.ndarray) -> tuple[tuple[float, float, float], ...]:
    """Convert an array (n, 3) to points."""
    return tuple((x, y, z) for x, y, z in values.tolist())


def to_pose(matrix: np.ndarray | None) -> Pose | None:
    """Convert a pose (4, 4) to position and quaternion xyzw."""
    if matrix is None:
        return None
    (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = matrix.tolist()
    # Divide by the largest of the four squares, which is never small (Shepperd 1978). Plain floats
    # are faster than numpy here, and every command has a pose.
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
    """Convert a pose of a message, with its quaternion normalised, to (4, 4)."""
    return None if pose is None else pose_from_xyz_quat((*pose.position, *pose.quat_xyzw), "xyzw")


def to_lengths(lengths: HumanLengths | None) -> Lengths | None:
    """Convert a measured hand to points."""
    if lengths is None:
        return None
    return msgspec.convert(
        {name: getattr(lengths, name).tolist() for name in Lengths.__struct_fields__}, Lengths
    )


def joints_where(robot: Hand, mask: np.ndarray) -> tuple[str, ...]:
    """Return the names of the joints where a mask (n,) is true."""
    return tuple(
        name for name, is_chosen in zip(robot.joint_names, mask.tolist(), strict=True) if is_chosen
    )


def to_detail(
    step: MapStep, human_q: np.ndarray | None, landmarks: np.ndarray | None
) -> Detail | None:
    """Convert every stage of a step; None if its method has no T.

    Args:
        step: The step.
        human_q: Joint angles of the human hand [rad], shape (n,); None if the sample had none.
        landmarks: Landmarks [m], shape (21, 3); None if the sample had none.
    """
    results = step.diagnostics
    if "motion" not in results:
        return None
    return Detail(
        human_points=to_points(step.human_points),
        human_q=None if human_q is None else to_row(human_q),
        human_wrist=to_pose(step.human_wrist),
        landmarks=None if landmarks is None else to_points(landmarks),
        motion=to_rows(results["motion"]),
        motion_rigid=to_rows(results["motion_rigid"]),
        motion_deformation=to_rows(results["motion_deformation"]),
        stretches=to_row(results["stretches"]),
        pivot=to_points(results["pivot_image"][None])[0],
        targets=to_points(step.targets),
        points=to_points(step.points),
    )
