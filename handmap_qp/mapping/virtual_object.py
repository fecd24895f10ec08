"""A virtual object between the fingertips: its motion on the human hand moves the robot's points.

The object encloses the human's fingertips at the reference, and another one encloses the robot's
(all reference points, where too few are fingertips). The human's object moves and deforms as its
points do, by least squares. All of the robot's points move with the robot's object. Everything is
in palm axes, and the robot's palm follows the human's. Points of the two hands are never paired, so
the hands may have any number of fingers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from handmap_qp.errors import DegeneratePointsError, InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS
from handmap_qp.mapping.landmarks import PalmFollower, PalmMethod, palm_of
from handmap_qp.mapping.method import (
    FOLLOWING,
    HumanPose,
    MethodOptions,
    Preset,
    RobotPosture,
    Targets,
)
from handmap_qp.se3 import inverse_pose, transform_points

# Points on a line leave the turn about it free: least ratio of their second singular value to the
# first.
_FLATTEST = 1e-3
# Fewest points that determine a rotation.
_FEWEST = 3


class ObjectMotion(NamedTuple):
    """Motion and deformation of an object since its reference.

    Attributes:
        shift: Displacement of its centre [m], shape (3,).
        linear: Rotation times stretch about the centre, shape (3, 3).
        ratios: Size now over size at the reference: one number for a sphere, shape (1,), one per
            principal axis of an ellipsoid, shape (3,).
    """

    shift: np.ndarray
    linear: np.ndarray
    ratios: np.ndarray


def to_compare(method: MethodOptions, what: str) -> Preset:
    """Return the preset of a virtual object, for comparisons."""
    return Preset(
        method,
        FOLLOWING,
        f"to compare: the {what} around the fingertips moves, turns and grows; no partners",
        "gestures: a virtual object cannot tell fingers apart",
    )


class VirtualObject(Protocol):
    """An object that encloses points at the reference.

    Attributes:
        centre: Its centre [m], shape (3,).
        size: A length that grows as the object does [m].
    """

    centre: np.ndarray
    size: float

    def motion_to(self, points: np.ndarray) -> ObjectMotion:
        """Return the motion that best carries the enclosed points to where they are now.

        Args:
            points: The points now [m], in the order in which they were enclosed, shape (n, 3).
        """
        ...


class BoundVirtualObject(PalmMethod):
    """A method of this kind for two hands; see `BoundMethod`.

    Args:
        enclose: Encloses points, shape (n, 3).
        scale: k; measured at the reference if None.
        human: The hand that leads.
        robot: The hand that follows.

    Raises:
        InvalidOptionsError: If the human has fewer than three points, or the robot fewer than two.
    """

    needs_wrist = "the motion of the fingertips in palm axes"

    def __init__(
        self,
        enclose: Callable[[np.ndarray], VirtualObject],
        scale: float | None,
        human: Hand,
        robot: Hand,
    ) -> None:
        self.enclose, self.scale = enclose, scale
        super().__init__(human, robot)
        self.human_points, self.robot_points = _tips(human, _FEWEST), _tips(robot, 2)

    def start(self, sample: HumanPose, robot: RobotPosture) -> VirtualObjectMap:
        """Enclose both hands' points as they are; see `BoundMethod.start`."""
        return VirtualObjectMap(self, sample, robot)


class VirtualObjectMap:
    """From samples to targets, counted from one reference; see `TargetMap`."""

    def __init__(
        self, method: BoundVirtualObject, sample: HumanPose, robot: RobotPosture
    ) -> None:
        self.rest = robot.q
        self._points = method.human_points
        self._follower = PalmFollower(method.human, method.robot, sample, robot)
        human_palm = palm_of(sample, method.human)
        before = transform_points(inverse_pose(human_palm), sample.points)[self._points]
        _check_shape(before)
        robot_palm = robot.wrist @ method.robot.wrist_to_palm
        robot_points = transform_points(inverse_pose(robot_palm), robot.points)
        self._object = method.enclose(before)
        follower = method.enclose(robot_points[method.robot_points])
        self._centre, self._offsets = follower.centre, robot_points - follower.centre
        self._ratio = method.scale or follower.size / self._object.size

    def targets(self, sample: HumanPose) -> Targets:
        """Move the robot's points with its object.

        The diagnostics are in palm axes: the centres of both objects at the reference, `size_ratio`
        (k), and how the human's object moved since then (`ObjectMotion`).
        """
        human_palm, palm = self._follower.palms(sample.wrist)
        now = (sample.points[self._points] - human_palm[:3, 3]).dot(human_palm[:3, :3])
        motion = self._object.motion_to(now)
        moved = self._offsets.dot(motion.linear.T) + (
            self._centre + self._ratio * motion.shift
        )
        return Targets(
            transform_points(palm, moved),
            self._follower.wrist(palm),
            {
                "human_centre": self._object.centre.copy(),
                "robot_centre": self._centre.copy(),
                "size_ratio": np.array(self._ratio),
                "shift": motion.shift,
                "linear": motion.linear,
                "ratios": motion.ratios,
            },
        )


def _tips(hand: Hand, fewest: int) -> np.ndarray:
    """Return the indices of the fingertips among a hand's points, or of all points if too few."""
    tips = {f"{finger}_tip" for finger in FINGERS}
    names = [point.partner or point.name for point in hand.reference_points]
    chosen = [k for k, name in enumerate(names) if name in tips]
    if len(names) < fewest:
        raise InvalidOptionsError(
            option="method",
            problem=f"a virtual object needs {fewest} points, and {hand.name} has {len(names)}",
            value=len(names),
            advice="choose more reference points",
        )
    # Landmarks of the palm would hide the motion of the fingers.
    return np.array(chosen if len(chosen) >= fewest else range(len(names)))


def _check_shape(points: np.ndarray) -> None:
    """Reject points that lie on a line or in one place."""
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if not values[1] > _FLATTEST * values[0]:
        raise DegeneratePointsError(
            "the points of a virtual object lie on a line", singular_values=values
        )
