"""Compare a robot's motion with the human motion that it was mapped from, for any mapping.

The point error only says how well the robot reaches the targets of its mapping, and a mapping that
never moves its targets scores best. So this module also compares the fingers (distance from tip to
palm over time: correlation and ratio of ranges), the displacements of the palms, and the smoothness
of the joint motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.apps.offline.trajectory import Trajectory, rms_derivative
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.fingers import finger_tips
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import PointSpec
from handmap_qp.human import HumanMotion

# Percentiles between which a range is taken; they exclude outliers of the tracker.
_RANGE = (2.0, 98.0)
# A fingertip whose distance to the palm varies by less than this is at rest [m].
_STILL = 1e-6


@dataclass(frozen=True, slots=True)
class FingerMatch:
    """Comparison of a robot's finger with the human's, by the distance from tip to palm.

    Attributes:
        finger: Anatomical name.
        correlation: Pearson's correlation over time, in [-1, 1]; 0 if either finger is at rest.
        human_range: Range of the human's distance, 2nd to 98th percentile [m].
        robot_range: Range of the robot's distance, likewise [m].
    """

    finger: str
    correlation: float
    human_range: float
    robot_range: float

    @property
    def range_ratio(self) -> float:
        """Robot's range over human's range; NaN if the human's finger is at rest."""
        return (
            self.robot_range / self.human_range
            if self.human_range > _STILL
            else float("nan")
        )


@dataclass(frozen=True, slots=True)
class MotionQuality:
    """Result of `assess_quality`.

    Attributes:
        fingers: One match for each finger that both hands have.
        correlation: Mean over the fingers, weighted by the human's range; NaN if none moved.
        range_ratio: Sum of the robot's ranges over the sum of the human's; NaN if none moved.
        wrist_distance: RMS difference of the palms' displacements since the first sample [m].
        wrist_angle: RMS angle between the palms' rotations since the first sample [rad].
        point_error_mean: Mean distance from the robot's reference points to their targets [m].
        point_error_p95: 95th percentile of that distance [m].
        share_at_limit: Share of the samples in which some joint is at a position limit, in [0, 1].
        speed: RMS joint speed of the robot [rad/s].
        jerk: RMS joint jerk of the robot [rad/s^3].
        human_speed: RMS joint speed of the human [rad/s].
        human_jerk: RMS joint jerk of the human, tracker noise included [rad/s^3].
    """

    fingers: tuple[FingerMatch, ...]
    correlation: float
    range_ratio: float
    wrist_distance: float
    wrist_angle: float
    point_error_mean: float
    point_error_p95: float
    share_at_limit: float
    speed: float
    jerk: float
    human_speed: float
    human_jerk: float


def assess_quality(motion: HumanMotion, trajectory: Trajectory) -> MotionQuality:
    """Compare a robot's motion with the human motion that it was mapped from.

    Args:
        motion: The human motion.
        trajectory: The robot's trajectory of the same samples.

    Returns:
        The comparison over the valid samples.

    Raises:
        InvalidInputError: If the two have different numbers of samples.
    """
    if len(motion.time) != len(trajectory.time):
        raise InvalidInputError(
            argument="trajectory",
            expected=f"{len(motion.time)} samples, as in motion",
            got=f"{len(trajectory.time)}",
        )
    human, robot, seen = motion.human, trajectory.robot, motion.valid
    fingers = match_fingers(
        finger_extensions(human, motion.q[seen]),
        finger_extensions(robot, trajectory.q[seen]),
    )
    distance, angle = palm_deviation(
        motion.wrist[seen] @ human.wrist_to_palm,
        trajectory.wrist[seen] @ robot.wrist_to_palm,
    )
    points = trajectory.point_error[seen]
    return MotionQuality(
        fingers=fingers,
        correlation=mean_correlation(fingers),
        range_ratio=total_range_ratio(fingers),
        wrist_distance=_rms(distance),
        wrist_angle=_rms(angle),
        point_error_mean=float(points.mean()),
        point_error_p95=float(np.percentile(points, 95)),
        share_at_limit=float(trajectory.at_limit[seen].any(axis=1).mean()),
        speed=rms_derivative(trajectory.q, motion.time, seen, order=1),
        jerk=rms_derivative(trajectory.q, motion.time, seen, order=3),
        human_speed=rms_derivative(motion.q, motion.time, seen, order=1),
        human_jerk=rms_derivative(motion.q, motion.time, seen, order=3),
    )


def finger_extensions(hand: Hand, q: np.ndarray) -> dict[str, np.ndarray]:
    """Distance from each fingertip to the origin of the palm frame.

    Args:
        hand: The hand.
        q: Joint angles over time [rad], shape (T, n).

    Returns:
        Distances by finger [m], shape (T,) each.

    Raises:
        InvalidInputError: If a sample of `q` has the wrong shape or is not finite.
    """
    tips = finger_tips(hand)
    return dict(zip(tips, _tip_distances(hand, tuple(tips.values()), q).T, strict=True))


def match_fingers(
    human: dict[str, np.ndarray], robot: dict[str, np.ndarray]
) -> tuple[FingerMatch, ...]:
    """Compare the fingers that both hands have, by name.

    Args:
        human: The human's distances from tip to palm by finger [m], shape (T,) each.
        robot: The robot's distances, likewise.

    Returns:
        One match per finger, in the human's order.
    """
    return tuple(
        _match(finger, human[finger], robot[finger])
        for finger in human
        if finger in robot
    )


def mean_correlation(fingers: Sequence[FingerMatch]) -> float:
    """Mean correlation, weighted by the human's range; matches may be of several recordings."""
    weight = sum(match.human_range for match in fingers)
    return (
        sum(match.human_range * match.correlation for match in fingers) / weight
        if weight > 0.0
        else float("nan")
    )


def total_range_ratio(fingers: Sequence[FingerMatch]) -> float:
    """Sum of the robot's ranges over the sum of the human's; NaN if no finger moved."""
    human = sum(match.human_range for match in fingers)
    return (
        sum(match.robot_range for match in fingers) / human
        if human > 0.0
        else float("nan")
    )


def palm_deviation(
    human_palm: np.ndarray, robot_palm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Difference between the palms' displacements since the first sample.

    Each displacement is expressed in the palm's own axes at the first sample, so it does not depend
    on the worlds' frames. A mapping that reproduces the palm motion exactly scores zero.

    Args:
        human_palm: Palm poses in the human's world, shape (T, 4, 4).
        robot_palm: Palm poses in the robot's world, shape (T, 4, 4).

    Returns:
        Distance [m] and angle [rad], shape (T,) each.
    """
    human, robot = (
        np.linalg.inv(human_palm[0]) @ human_palm,
        np.linalg.inv(robot_palm[0]) @ robot_palm,
    )
    distance = np.linalg.norm(robot[:, :3, 3] - human[:, :3, 3], axis=1)
    turn = human[:, :3, :3].transpose(0, 2, 1) @ robot[:, :3, :3]
    return distance, Rotation.from_matrix(turn).magnitude()


def _match(finger: str, human: np.ndarray, robot: np.ndarray) -> FingerMatch:
    spread = [
        float(np.diff(np.percentile(values, _RANGE))[0]) for values in (human, robot)
    ]
    # np.corrcoef of a constant is NaN and warns; count it as no correlation.
    is_still = min(np.ptp(human), np.ptp(robot)) <= _STILL
    return FingerMatch(
        finger, 0.0 if is_still else float(np.corrcoef(human, robot)[0, 1]), *spread
    )


def _tip_distances(
    hand: Hand, points: tuple[PointSpec, ...], q: np.ndarray
) -> np.ndarray:
    """Distance from points to the origin of the palm frame [m], shape (T, k)."""
    placed = hand.with_points(points)
    palm = hand.wrist_to_palm[:3, 3]
    return np.array(
        [np.linalg.norm(placed.points(angles) - palm, axis=1) for angles in q]
    ).reshape(len(q), len(points))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
