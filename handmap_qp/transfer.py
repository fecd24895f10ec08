"""Carry a motion from the human's hand to the robot's (eq. 7): from T to point targets and a wrist target.

    T_rb^r(s)  = Q R Q^T (s - c_r) + c_r + scale Q (T_rb(c_h) - c_h)
    T_def^r(s) = Q U Q^T (s - c_r') + c_r' + scale Q (T(c_h) - T_rb(c_h)),     c_r' = T_rb^r(c_r)

The points are to reach `T_def^r T_rb^r s`, the wrist `T_rb^r X`. What the two products have in common is computed once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.decomposition import about, polar
from handmap_qp.estimation import MotionEstimate
from handmap_qp.options import MappingOptions
from handmap_qp.reference import Reference
from handmap_qp.transform import affine

_IDENTITY = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class Transfer:
    """A motion, split, and what it asks of the robot. Attributes as in `MapStep`."""

    motion_rigid: np.ndarray
    motion_deformation: np.ndarray
    stretches: np.ndarray
    is_clamped: bool
    targets: np.ndarray
    wrist_target: np.ndarray


def transfer_motion(
    estimate: MotionEstimate, reference: Reference, human_wrist: np.ndarray | None, options: MappingOptions
) -> Transfer:
    """Split T about the pivot and impose both parts on the robot.

    Args:
        estimate: The human's motion T since the reference.
        reference: Both hands at the reference.
        human_wrist: The human's wrist pose now, shape (4, 4); needed with `rigid_from="wrist"`.
        options: The mapping's choices.

    Returns:
        T_rb, T_def and the robot's targets.
    """
    linear, pivot = estimate.motion[:3, :3], reference.human_pivot
    image = linear @ pivot + estimate.motion[:3, 3]
    factors = polar(linear)
    low, high, gain = options.stretch_min, options.stretch_max, options.deformation_gain
    stretches = factors.stretches.tolist()
    is_clamped = not (low <= stretches[2] and stretches[0] <= high and low <= stretches[0])
    if is_clamped or gain != 1.0:
        stretch = factors.stretch(np.array([min(max(value, low), high) ** gain for value in stretches]))
        linear = stretch @ factors.rotation
    if options.rigid_from == "points":
        rotation, rigid_image = factors.rotation, image
    elif options.rigid_from == "wrist":
        rotation, rigid_image = wrist_displacement(reference, human_wrist)
    else:
        rotation, rigid_image = _IDENTITY, pivot
    targets = _points_after(reference, linear, options.scale * (image - pivot))
    if reference.misfit_share is not None:
        share = reference.misfit_share @ estimate.misfit
        targets += share if reference.alignment is None else share @ reference.alignment.T
    return Transfer(
        motion_rigid=about(rotation, pivot, rigid_image),
        motion_deformation=about(linear @ rotation.T, rigid_image, image),
        stretches=factors.stretches,
        is_clamped=is_clamped,
        targets=targets,
        wrist_target=_wrist_after(reference, rotation, options.scale * (rigid_image - pivot)),
    )


def wrist_displacement(reference: Reference, human_wrist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation of the measured wrist since the reference, and where its rigid motion takes the pivot; (3, 3) and (3,)."""
    rotation = human_wrist[:3, :3] @ reference.human_wrist[:3, :3].T
    return rotation, rotation @ (reference.human_pivot - reference.human_wrist[:3, 3]) + human_wrist[:3, 3]


def _points_after(reference: Reference, linear: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Robot points moved by a linear map about the pivot and a shift, both given in W axes; shape (n_r, 3)."""
    Q = reference.alignment
    if Q is not None:
        linear, shift = Q @ linear @ Q.T, Q @ shift
    return reference.robot_arms @ linear.T + (reference.robot_pivot + shift)


def _wrist_after(reference: Reference, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Robot wrist moved by a rotation about the pivot and a shift, both given in W axes; shape (4, 4)."""
    Q, wrist, pivot = reference.alignment, reference.robot_wrist, reference.robot_pivot
    if Q is not None:
        rotation, shift = Q @ rotation @ Q.T, Q @ shift
    return affine(rotation @ wrist[:3, :3], rotation @ (wrist[:3, 3] - pivot) + pivot + shift)
