"""Both hands at the start of the motion: the initial configuration of eqs. (5)-(7)."""

from __future__ import annotations

import msgspec
import numpy as np

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.fingers import partner_names
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.estimation import MotionEstimator
from handmap_qp.mapping.method import HumanPose, RobotPosture
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.transform import affine, frozen


class Reference(msgspec.Struct, frozen=True, eq=False):
    """Both hands at the start of the motion.

    Attributes:
        estimator: The human reference points there, factored for eq. (6).
        human_offsets: Human reference points from the pivot, `p_i - c_h` [m], shape (n_h, 3).
        human_wrist: Human wrist pose in W, shape (4, 4); None where it was not measured.
        human_pivot: c_h [m], shape (3,).
        robot_rows: Robot reference points from the pivot, `s_i - c_r` [m], and a 1 behind each,
            shape (n_r, 4).
        robot_wrist: Robot wrist pose in V axes, its translation from the pivot, shape (4, 4).
        robot_origin: `c_r - scale Q c_h`: the origin of W, taken to V by shifts [m], shape (3,).
        alignment: Q, from W axes to V axes, shape (3, 3); None where they agree.
        shift_map: `scale Q`, from shifts in W axes to V axes, shape (3, 3); None for the identity.
        residual_share: Part of each human point's residual that each robot point takes over, shape
            (n_r, n_h); None for nothing.
    """

    estimator: MotionEstimator
    human_offsets: np.ndarray
    human_wrist: np.ndarray | None
    human_pivot: np.ndarray
    robot_rows: np.ndarray
    robot_wrist: np.ndarray
    robot_origin: np.ndarray
    alignment: np.ndarray | None
    shift_map: np.ndarray | None
    residual_share: np.ndarray | None


def make_reference(
    human: Hand,
    robot: Hand,
    options: MappingOptions,
    estimator: MotionEstimator,
    sample: HumanPose,
    posture: RobotPosture,
    partners: list[tuple[int, int]],
) -> Reference:
    """Take both hands as they are for the reference.

    Args:
        human: The hand that leads.
        robot: The hand that follows.
        options: The mapping's choices.
        estimator: Made of the sample's points.
        sample: The human hand.
        posture: The robot hand.
        partners: The pairs of `partner_pairs`; empty to pass no residual on.

    Returns:
        The reference. Its arrays are copies, write-protected where results hand them out.
    """
    robot_palm = posture.wrist @ robot.wrist_to_palm
    human_palm = None if sample.wrist is None else sample.wrist @ human.wrist_to_palm
    if options.pivot == "centroid":
        human_pivot = estimator.centroid
        robot_pivot = robot.point_weights @ posture.points / robot.point_weights.sum()
    elif options.pivot == "palm" and human_palm is not None:
        human_pivot, robot_pivot = human_palm[:3, 3].copy(), robot_palm[:3, 3]
    else:
        human_pivot = robot_pivot = np.array(options.pivot_point or (0.0, 0.0, 0.0))
    alignment = _alignment(options, human_palm, robot_palm)
    shift_map = _shift_map(alignment, options.scale)
    start = human_pivot if shift_map is None else shift_map @ human_pivot
    return Reference(
        estimator=estimator,
        human_offsets=sample.points - human_pivot,
        human_wrist=None if sample.wrist is None else sample.wrist.copy(),
        human_pivot=frozen(human_pivot),
        robot_rows=np.column_stack([posture.points - robot_pivot, np.ones(len(posture.points))]),
        robot_wrist=affine(posture.wrist[:3, :3], posture.wrist[:3, 3] - robot_pivot),
        robot_origin=robot_pivot - start,
        alignment=alignment,
        shift_map=shift_map,
        residual_share=_residual_share(options, sample.points, posture.points, partners),
    )


def partner_pairs(human: Hand, robot: Hand) -> list[tuple[int, int]]:
    """Return the pairs of reference points that correspond on the two hands.

    `partner_names` has the rule.

    Returns:
        Pairs of indices (robot point, human point), in the order of the robot's points.
    """
    names = {point.name: k for k, point in enumerate(human.reference_points)}
    wanted = partner_names(robot, {point.name for point in human.spec.points})
    return [(j, names[partner]) for j, partner in enumerate(wanted) if partner in names]


def require_partners(
    human: Hand, robot: Hand, *, option: str, value: object = None, advice: str = ""
) -> list[tuple[int, int]]:
    """Return the pairs of `partner_pairs`; reject hands without any.

    Args:
        human: The hand that leads.
        robot: The hand that follows.
        option: The option that needs them.
        value: Its value.
        advice: Alternative to naming partners, appended to the message.

    Raises:
        InvalidOptionsError: If no robot point has a partner.
    """
    pairs = partner_pairs(human, robot)
    if not pairs:
        names = ", ".join(point.name for point in human.reference_points)
        raise InvalidOptionsError(
            option=option,
            problem=f"needs partner points, and no point of {robot.name} names one among {names}",
            value=value,
            advice=f"add `partner` to its points{advice}",
        )
    return pairs


def _alignment(
    options: MappingOptions, human_palm: np.ndarray | None, robot_palm: np.ndarray
) -> np.ndarray | None:
    """Return Q, or None if the axes of both worlds agree."""
    if not isinstance(options.alignment, str):
        return np.array(options.alignment)
    if options.alignment == "world" or human_palm is None:
        return None
    return robot_palm[:3, :3] @ human_palm[:3, :3].T


def _shift_map(alignment: np.ndarray | None, scale: float) -> np.ndarray | None:
    """Return `scale Q`, or None where it is the identity."""
    if alignment is None:
        return None if scale == 1.0 else scale * np.eye(3)
    return scale * alignment


def _residual_share(
    options: MappingOptions,
    human_points: np.ndarray,
    robot_points: np.ndarray,
    partners: list[tuple[int, int]],
) -> np.ndarray | None:
    """Return the residual gain of every pair, scaled by the ratio of the sizes of the hands."""
    if not partners:
        return None
    robot_indices, human_indices = np.array(partners).T
    robot_size, human_size = (
        np.linalg.norm(points - points.mean(axis=0))
        for points in (robot_points[robot_indices], human_points[human_indices])
    )
    share = np.zeros((len(robot_points), len(human_points)))
    share[robot_indices, human_indices] = options.residual_gain * (
        robot_size / human_size if human_size > 0.0 else 1.0
    )
    return share
