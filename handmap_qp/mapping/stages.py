"""T and its parts in the human's world, of a step of any method that estimates T."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_qp.mapping.decomposition import polar
from handmap_qp.mapping.methods.homogeneous import HomogeneousDiagnostics
from handmap_qp.mapping.methods.teleoperation import TeleoperationDiagnostics
from handmap_qp.mapping.step import MapStep
from handmap_qp.transform import inverse_pose


class MotionStages(NamedTuple):
    """T and its parts in the human's world.

    Attributes:
        motion: T (eqs. 5-6), shape (4, 4).
        motion_rigid: T_rb (eq. 2), shape (4, 4); of teleoperation, the motion of the palm.
        motion_deformation: T_def (eq. 2), shape (4, 4); of teleoperation, all the rest of T.
        stretches: Stretches of T before clamping, shape (3,).
        pivot: Image under T of the point that T_def acts about [m], shape (3,).
        residual_norms: Distance of every point from where T takes it [m], shape (n,).
    """

    motion: np.ndarray
    motion_rigid: np.ndarray
    motion_deformation: np.ndarray
    stretches: np.ndarray
    pivot: np.ndarray
    residual_norms: np.ndarray


def residual_norms(step: MapStep) -> np.ndarray:
    """Return each human point's distance from where T takes it [m], (n,); empty without T."""
    diagnostics = step.diagnostics
    if isinstance(diagnostics, HomogeneousDiagnostics | TeleoperationDiagnostics):
        return diagnostics.estimate.residual_norms
    return np.empty(0)


def motion_stages(step: MapStep) -> MotionStages | None:
    """Return T and its parts in the human's world; None if the method has no T.

    Teleoperation estimates T in palm axes, from the human's rest posture. In the world, that
    posture lies at the palm of the reference.
    """
    diagnostics = step.diagnostics
    if isinstance(diagnostics, HomogeneousDiagnostics):
        transfer = diagnostics.transfer
        return MotionStages(
            step.motion,
            transfer.motion_rigid,
            transfer.motion_deformation,
            transfer.stretches,
            transfer.image,
            diagnostics.estimate.residual_norms,
        )
    if isinstance(diagnostics, TeleoperationDiagnostics):
        estimate, palm = diagnostics.estimate, diagnostics.palm
        to_start = inverse_pose(diagnostics.palm_before)
        deformation = palm @ estimate.motion @ inverse_pose(palm)
        rigid = palm @ to_start
        return MotionStages(
            deformation @ rigid,
            rigid,
            deformation,
            polar(estimate.linear).stretches,
            palm[:3, :3] @ estimate.centroid_after + palm[:3, 3],
            estimate.residual_norms,
        )
    return None
