"""Both hands at the instant from which the motion counts: what eqs.

(5)-(7) call the initial configuration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.estimation import MotionEstimator
from handmap_qp.mapping.options import MappingOptions


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Both hands at the instant from which the motion counts.

    Attributes:
        estimator: The human reference points there, factored for eq. (6).
        human_points: The same points in W [m], shape (n_h, 3).
        human_wrist: Human wrist pose in W, shape (4, 4); None where it was not measured.
        human_pivot: c_h [m], shape (3,).
        robot_q: The robot's Pinocchio configuration, shape (nq,).
        robot_arms: Robot reference points relative to the pivot, `s_i - c_r` [m], shape (n_r, 3).
        robot_wrist: Robot wrist pose in V, shape (4, 4).
        robot_pivot: c_r [m], shape (3,).
        alignment: Q, from W axes to V axes, shape (3, 3); None where they agree.
        misfit_share: What each robot point takes over of each human point's misfit to T, shape
            (n_r, n_h); None for nothing.
    """

    estimator: MotionEstimator
    human_points: np.ndarray
    human_wrist: np.ndarray | None
    human_pivot: np.ndarray
    robot_q: np.ndarray
    robot_arms: np.ndarray
    robot_wrist: np.ndarray
    robot_pivot: np.ndarray
    alignment: np.ndarray | None
    misfit_share: np.ndarray | None


def make_reference(
    human: Hand,
    robot: Hand,
    options: MappingOptions,
    estimator: MotionEstimator,
    human_points: np.ndarray,
    human_wrist: np.ndarray | None,
    robot_now: Configuration,
    partners: list[tuple[int, int]],
) -> Reference:
    """Take both hands as they are now for the reference.

    Args:
        human: The hand that leads.
        robot: The hand that follows.
        options: The mapping's choices.
        estimator: Made of the human's points now.
        human_points: The points themselves [m], shape (n_h, 3).
        human_wrist: The human's wrist pose now, shape (4, 4), or None where nothing needs it.
        robot_now: The robot's present configuration.
        partners: What `partner_pairs` found.

    Returns:
        The reference.
    """
    robot_points, robot_wrist = robot_now.points.copy(), robot_now.wrist.homogeneous
    robot_palm = robot_wrist @ robot.wrist_to_palm
    human_palm = None if human_wrist is None else human_wrist @ human.wrist_to_palm
    if options.pivot == "centroid":
        human_pivot = estimator.centroid
        robot_pivot = robot.point_weights @ robot_points / robot.point_weights.sum()
    elif options.pivot == "palm" and human_palm is not None:
        human_pivot, robot_pivot = human_palm[:3, 3], robot_palm[:3, 3]
    else:
        human_pivot = robot_pivot = np.array(options.pivot_point or (0.0, 0.0, 0.0))
    return Reference(
        estimator=estimator,
        human_points=human_points,
        # Copied: the caller may write its next sample into the same array.
        human_wrist=None if human_wrist is None else human_wrist.copy(),
        human_pivot=human_pivot,
        robot_q=robot_now.q.copy(),
        robot_arms=robot_points - robot_pivot,
        robot_wrist=robot_wrist,
        robot_pivot=robot_pivot,
        alignment=_alignment(options, human_palm, robot_palm),
        misfit_share=_misfit_share(options, human_points, robot_points, partners),
    )


def partner_pairs(human: Hand, robot: Hand, options: MappingOptions) -> list[tuple[int, int]]:
    """Which robot point takes over which human point's misfit.

    Args:
        human: The hand that leads.
        robot: The hand that follows; its points name their partners.
        options: The mapping's choices.

    Returns:
        Pairs of indices (robot point, human point); empty with `residual_gain = 0`.

    Raises:
        InvalidOptionsError: If misfits are to be passed on and there is no pair.
    """
    if options.residual_gain == 0.0:
        return []
    names = [point.name for point in human.reference_points]
    wanted = [(j, point.partner or point.name) for j, point in enumerate(robot.reference_points)]
    pairs = [(j, names.index(partner)) for j, partner in wanted if partner in names]
    if not pairs:
        raise InvalidOptionsError(
            f"residual_gain={options.residual_gain:g} needs partner points, and no point of {robot.name} names one among "
            f"{', '.join(names)}: add `partner` to its points, or give residual_gain=0"
        )
    return pairs


def _alignment(
    options: MappingOptions, human_palm: np.ndarray | None, robot_palm: np.ndarray
) -> np.ndarray | None:
    """Q, or None where both worlds' axes agree."""
    if not isinstance(options.alignment, str):
        return np.array(options.alignment)
    if options.alignment == "world" or human_palm is None:
        return None
    return robot_palm[:3, :3] @ human_palm[:3, :3].T


def _misfit_share(
    options: MappingOptions,
    human_points: np.ndarray,
    robot_points: np.ndarray,
    partners: list[tuple[int, int]],
) -> np.ndarray | None:
    """The residual gain for every pair, scaled by the ratio of the hands' sizes."""
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
