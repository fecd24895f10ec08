"""Between the library's arrays and the plain values of messages."""

from __future__ import annotations

import numpy as np

from handmap_qp.hand import Hand
from handmap_qp.samples import MapStep
from handmap_qp.service.messages import Detail, Pose
from handmap_qp.transform import pose_from_xyz_quat, quat_wxyz_from_rotation


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
    w, x, y, z = quat_wxyz_from_rotation(matrix[:3, :3]).tolist()
    return Pose(tuple(matrix[:3, 3].tolist()), (x, y, z, w))


def to_matrix(pose: Pose | None) -> np.ndarray | None:
    """A pose of a message, its quaternion normalised, as (4, 4)."""
    return None if pose is None else pose_from_xyz_quat((*pose.position, *pose.quat_xyzw), "xyzw")


def name_joints(robot: Hand, chosen: np.ndarray) -> tuple[str, ...]:
    """Names of the joints that a mask (n,) chooses."""
    return tuple(name for name, is_chosen in zip(robot.joint_names, chosen.tolist(), strict=True) if is_chosen)


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
        targets=to_points(step.targets),
        points=to_points(step.points),
    )
