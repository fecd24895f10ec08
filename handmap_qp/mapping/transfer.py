"""Carry a motion from the human's hand to the robot's (eq. 7).

From T to point targets and a wrist target.

    T_rb^r(s)  = Q R Q^T (s - c_r) + c_r + scale Q (T_rb(c_h) - c_h)
    T_def^r(s) = Q U Q^T (s - c_r') + c_r' + scale Q (T(c_h) - T_rb(c_h)),     c_r' = T_rb^r(c_r)

The points are to reach `T_def^r T_rb^r s`, the wrist `T_rb^r X`. What the two products have in
common is computed once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.mapping.decomposition import about, polar
from handmap_qp.mapping.estimation import MotionEstimate
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.mapping.reference import Reference
from handmap_qp.transform import affine

_IDENTITY = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class Transfer:
    """A motion split about its pivot, and what it asks of the robot.

    Attributes:
        linear: Linear part of the motion that is passed on, `U R` after clamping and gain, shape
            (3, 3).
        rotation: Rotation of T_rb, shape (3, 3).
        pivot: c_h [m], shape (3,).
        rigid_image: Where T_rb takes the pivot [m], shape (3,).
        image: Where T takes the pivot [m], shape (3,).
        stretches: Eigenvalues of the stretch U before clamping, shape (3,).
        is_clamped: Whether a stretch was outside its allowed range.
        targets: Where the robot's reference points should be (eq. 7) [m], shape (n_r, 3).
        wrist_target: Where its wrist should be, shape (4, 4).
    """

    linear: np.ndarray
    rotation: np.ndarray
    pivot: np.ndarray
    rigid_image: np.ndarray
    image: np.ndarray
    stretches: np.ndarray
    is_clamped: bool
    targets: np.ndarray
    wrist_target: np.ndarray

    @property
    def motion_rigid(self) -> np.ndarray:
        """T_rb (eq. 2), shape (4, 4)."""
        return about(self.rotation, self.pivot, self.rigid_image)

    @property
    def motion_deformation(self) -> np.ndarray:
        """T_def (eq. 2), after clamping and gain, shape (4, 4)."""
        return about(self.linear @ self.rotation.T, self.rigid_image, self.image)


def transfer_motion(
    estimate: MotionEstimate,
    reference: Reference,
    human_wrist: np.ndarray | None,
    options: MappingOptions,
) -> Transfer:
    """Split T about the pivot and impose both parts on the robot.

    Args:
        estimate: The human's motion T since the reference.
        reference: Both hands at the reference.
        human_wrist: The human's wrist pose now, shape (4, 4); needed with `rigid_from="wrist"`.
        options: The mapping's choices.

    Returns:
        The parts and the robot's targets.
    """
    linear, pivot = estimate.motion[:3, :3], reference.human_pivot
    image = linear.dot(pivot) + estimate.motion[:3, 3]
    factors = polar(linear)
    largest, middle, smallest = factors.stretches.tolist()
    low, high, gain = options.stretch_min, options.stretch_max, options.deformation_gain
    is_clamped = not (low <= smallest and largest <= high and low <= largest and smallest <= high)
    if is_clamped or gain != 1.0:
        stretches = [
            min(max(stretch, low), high) ** gain for stretch in (largest, middle, smallest)
        ]
        linear = factors.stretch(np.array(stretches)).dot(factors.rotation)
    if options.rigid_from == "points":
        rotation, rigid_image = factors.rotation, image
    elif options.rigid_from == "wrist":
        rotation, rigid_image = wrist_displacement(reference, human_wrist)
    else:
        rotation, rigid_image = _IDENTITY, pivot
    targets = _points_after(reference, linear, options.scale * (image - pivot))
    if reference.misfit_share is not None:
        share = reference.misfit_share.dot(estimate.misfit)
        targets += share if reference.alignment is None else share @ reference.alignment.T
    wrist_target = _wrist_after(reference, rotation, options.scale * (rigid_image - pivot))
    return Transfer(
        linear,
        rotation,
        pivot,
        rigid_image,
        image,
        factors.stretches,
        is_clamped,
        targets,
        wrist_target,
    )


def wrist_displacement(
    reference: Reference, human_wrist: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation of the measured wrist since the reference, and where its rigid motion takes the pivot; (3, 3) and (3,)."""
    if reference.human_wrist is None or human_wrist is None:
        raise InvalidInputError("wrist_pose: needed for rigid_from='wrist'")
    rotation = human_wrist[:3, :3] @ reference.human_wrist[:3, :3].T
    return rotation, rotation @ (
        reference.human_pivot - reference.human_wrist[:3, 3]
    ) + human_wrist[:3, 3]


def _points_after(reference: Reference, linear: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Robot points moved by a linear map about the pivot and a shift, both given in W axes.

    Shape (n_r, 3).
    """
    Q = reference.alignment
    if Q is not None:
        linear, shift = Q @ linear @ Q.T, Q @ shift
    return reference.robot_arms.dot(linear.T) + (reference.robot_pivot + shift)


def _wrist_after(reference: Reference, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Robot wrist moved by a rotation about the pivot and a shift, both given in W axes.

    Shape (4, 4).
    """
    Q, wrist, pivot = reference.alignment, reference.robot_wrist, reference.robot_pivot
    if Q is not None:
        rotation, shift = Q @ rotation @ Q.T, Q @ shift
    return affine(rotation.dot(wrist[:3, :3]), rotation.dot(wrist[:3, 3] - pivot) + (pivot + shift))
