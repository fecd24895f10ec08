"""Carry a motion from the human's hand to the robot's (eq. 7): from T to point and wrist targets.

    T_rb^r(s)  = Q R Q^T (s - c_r) + c_r + scale Q (T_rb(c_h) - c_h)
    T_def^r(s) = Q U Q^T (s - c_r') + c_r' + scale Q (T(c_h) - T_rb(c_h)),     c_r' = T_rb^r(c_r)

The targets of the points are `T_def^r T_rb^r s`, that of the wrist is `T_rb^r X`. Terms that both
products share are computed once.
"""

from __future__ import annotations

import msgspec
import numpy as np

from handmap_qp.mapping.decomposition import about, polar
from handmap_qp.mapping.estimation import MotionEstimate
from handmap_qp.mapping.method import HumanPose
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.mapping.reference import Reference
from handmap_qp.mapping.rigid import RIGID_PARTS, Displacement
from handmap_qp.transform import affine, moved_rows


class Transfer(msgspec.Struct, frozen=True, eq=False):
    """A motion split about its pivot, and the targets that follow from it.

    Attributes:
        linear: Linear part of the imposed motion, `U R` after clamping and gain, shape (3, 3).
        rotation: Rotation of T_rb, shape (3, 3).
        pivot: c_h [m], shape (3,).
        rigid_image: Where T_rb takes the pivot [m], shape (3,).
        image: Where T takes the pivot [m], shape (3,).
        stretches: Eigenvalues of the stretch U before clamping, shape (3,).
        is_clamped: Whether a stretch was outside its allowed range.
        targets: Targets of the robot's reference points (eq. 7) [m], shape (n_r, 3).
        wrist_target: Target of its wrist, shape (4, 4).
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
    estimate: MotionEstimate, reference: Reference, sample: HumanPose, options: MappingOptions
) -> Transfer:
    """Split T about the pivot and impose both parts on the robot.

    Args:
        estimate: The human's motion T since the reference.
        reference: Both hands at the reference.
        sample: The human hand now.
        options: The mapping's choices.

    Returns:
        The parts and the robot's targets.

    Raises:
        InvalidInputError: If `rigid_from` needs a wrist pose that was not measured.
    """
    pivot = reference.human_pivot
    linear, image = estimate.linear, estimate.image(pivot)
    factors = polar(linear)
    largest, middle, smallest = factors.stretches.tolist()
    low, high, gain = options.stretch_min, options.stretch_max, options.deformation_gain
    is_clamped = not (low <= smallest and largest <= high and low <= largest and smallest <= high)
    if is_clamped or gain != 1.0:
        stretches = [
            min(max(stretch, low), high) ** gain for stretch in (largest, middle, smallest)
        ]
        linear = factors.stretch(np.array(stretches)).dot(factors.rotation)
    rigid = RIGID_PARTS[options.rigid_from].part(
        Displacement(factors.rotation, image), pivot, reference.human_wrist, sample.wrist
    )
    centre = _in_robot_world(reference, image)
    rotation, rigid_image = rigid.rotation, rigid.image
    placed, turned = linear, rotation
    if (Q := reference.alignment) is not None:
        placed, turned = Q @ linear @ Q.T, Q @ rotation @ Q.T
    points = moved_rows(reference.robot_rows, placed, centre)
    if reference.residual_share is not None:
        # The residual refers to the imposed motion, so it makes up for clamping and gain.
        residual = sample.points - (reference.human_offsets.dot(linear.T) + image)
        share = reference.residual_share.dot(residual)
        points += share if Q is None else share @ Q.T
    if rigid_image is not image:
        centre = _in_robot_world(reference, rigid_image)
    wrist = affine(turned, centre).dot(reference.robot_wrist)
    return Transfer(
        linear, rotation, pivot, rigid_image, image, factors.stretches, is_clamped, points, wrist
    )


def _in_robot_world(reference: Reference, image: np.ndarray) -> np.ndarray:
    """Return the image of the robot's pivot [m], shape (3,), given that of the human's."""
    scaled = reference.shift_map
    return reference.robot_origin + (image if scaled is None else scaled.dot(image))
