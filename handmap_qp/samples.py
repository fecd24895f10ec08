"""What goes in and what comes out, as values: one human sample, one robot command, one step of the mapping with all its stages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.ik.qp import Status


@dataclass(frozen=True, slots=True, eq=False)
class RobotCommand:
    """What a robot driver takes.

    Attributes:
        joint_names: Names of the joints, in the order of `q`.
        q: Joint angles [rad], shape (n,), inside their limits.
        wrist: Pose of the wrist frame in the robot's world, shape (4, 4).
    """

    joint_names: tuple[str, ...]
    q: np.ndarray
    wrist: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class MapStep:
    """One step of the mapping, stage by stage.

    Attributes:
        command: The robot's next joint angles and wrist pose.
        human_points: Human reference points in the human's world [m], shape (n_h, 3).
        motion: T from the reference configuration to now (eqs. 5-6), shape (4, 4).
        motion_rigid: T_rb (eq. 2), shape (4, 4).
        motion_deformation: T_def (eq. 2), after clamping and gain; with neither, `motion_deformation @ motion_rigid == motion`,
            shape (4, 4).
        residuals: Distance of each human point from where T takes it [m], shape (n_h,).
        stretches: Eigenvalues of the stretch U before clamping, shape (3,).
        is_clamped: Whether a stretch was outside its allowed range.
        targets: Where the robot's reference points should be (eq. 7) [m], shape (n_r, 3).
        wrist_target: Where its wrist should be, shape (4, 4).
        points: Where its reference points are [m], shape (n_r, 3).
        point_error: Distance between the two [m], shape (n_r,).
        at_limit: Joints that a position or speed limit holds in this step, in the order of `command.q`, shape (n,).
        out_of_range: Names of human joints that were outside their limits, within the tolerance, and used all the same.
        status: How the inverse kinematics ended; see `handmap_qp.ik.qp.IkResult`.
        iterations: QPs solved.
        duration: Wall time of the step [s].
    """

    command: RobotCommand
    human_points: np.ndarray
    motion: np.ndarray
    motion_rigid: np.ndarray
    motion_deformation: np.ndarray
    residuals: np.ndarray
    stretches: np.ndarray
    is_clamped: bool
    targets: np.ndarray
    wrist_target: np.ndarray
    points: np.ndarray
    point_error: np.ndarray
    at_limit: np.ndarray
    out_of_range: tuple[str, ...]
    status: Status
    iterations: int
    duration: float
