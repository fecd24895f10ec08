"""Methods whose palm follows the human's: `PalmMethod`, `PalmMap`."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np

from handmap_core.core import core
from handmap_core.hands import Hand
from handmap_core.models import PalmFollowingModel, PalmModel, encode
from handmap_core.se3 import Array, affine, frozen, inverse_pose, transform_points
from .alignment import Alignment, rotation_of
from .targets import AnyPose, HumanPose, RobotPosture, TargetMap, without_core

_ORIGIN = frozen(np.zeros(3))


AnyHand = TypeVar("AnyHand", bound=Hand)


class PalmMethod(Generic[AnyHand]):
    """Base of methods for two hands whose wrist target is that of a `PalmMap`.

    See `BoundMethod`.

    Args:
        alignment: From the human's world to the robot's.
        human: The hand that leads.
        robot: The hand that follows.
        wrist_to_palm: Palm in the human's wrist, shape (4, 4); the human's own if omitted.
    """

    needs_wrist = "the pose of the palm"
    reference_needs_wrist = ""
    renews_reference = False
    map_type: Callable[..., TargetMap]
    """Its map, made of it and both hands at the reference; by `start`."""

    def __init__(
        self,
        alignment: Alignment,
        human: AnyHand,
        robot: AnyHand,
        wrist_to_palm: Array | None = None,
    ) -> None:
        self.alignment = alignment
        own = human.wrist_to_palm
        self.wrist_to_palm = own if wrist_to_palm is None else wrist_to_palm
        self.human = human
        self.robot = robot

    def palm_of(self, sample: AnyPose) -> Array:
        """Return the palm pose of a sample whose wrist was measured, shape (4, 4)."""
        assert sample.wrist is not None
        return sample.wrist @ self.wrist_to_palm

    def following(
        self,
        human_anchor: Array = _ORIGIN,
        robot_anchor: Array = _ORIGIN,
        scale: float = 1.0,
    ) -> PalmFollowingModel:
        """Return how the robot's palm follows the human's, whatever the reference.

        Args:
            human_anchor: The human's anchor in its palm [m], shape (3,); the origin if omitted.
            robot_anchor: The robot's, likewise.
            scale: Factor on the palm's translation.
        """
        return PalmFollowingModel(
            aligns_palms=self.alignment == "palm",
            alignment=rotation_of(self.alignment),
            scale=scale,
            human_wrist_to_palm=self.wrist_to_palm,
            robot_wrist_to_palm=self.robot.wrist_to_palm,
            is_still=not self.robot.has_moving_wrist,
            human_anchor=human_anchor,
            robot_anchor=robot_anchor,
        )

    def start_palm(self, sample: HumanPose) -> Array:
        """Return the human's palm in the robot's world; the origin where `palm` aligns them."""
        assert sample.wrist is not None
        return core.start_palm(encode(self.following()), sample.wrist)

    def start(self, sample: HumanPose, robot: RobotPosture) -> TargetMap:
        """Take both hands as they are for the reference; see `BoundMethod.start`."""
        return self.map_type(self, sample, robot)


def palm_of(sample: HumanPose, human: Hand) -> Array:
    """Return the palm pose of a sample whose wrist was measured, shape (4, 4)."""
    assert sample.wrist is not None
    return sample.wrist @ human.wrist_to_palm


class PalmMap:
    """Base of maps that move the robot's palm as the human's palm moves from a reference on.

    Both palms have the same rotation, and the same translation (or `scale` times it) in world axes,
    turned by the alignment; the translation is that of an anchor point on each palm. If anchors and
    axes coincide at the reference, they stay together. A robot with a fixed wrist keeps its palm.
    See `TargetMap`.

    Args:
        method: The method for two hands.
        sample: The human hand at the reference.
        posture: The robot hand at the reference.
        human_anchor: The human's anchor in its palm frame [m], shape (3,); the origin if omitted.
        robot_anchor: The robot's, likewise.
        scale: Factor on the translation.

    Attributes:
        rest: Joint positions that the QP's rest term pulls to, shape (n,).
        human_wrist_to_palm: Palm in the human's wrist, shape (4, 4).
        robot_palm_to_wrist: Wrist in the robot's palm, shape (4, 4).
        is_still: Whether the robot's wrist is fixed.
        start: The robot's palm at the reference, shape (4, 4).
        alignment: From the human's world to the robot's, shape (3, 3).
        rotation: The robot's palm seen from the human's, shape (3, 3).
        origin: Its origin there [m], shape (3,).
        offset: The rest of its place, in world axes [m], shape (3,).
        human_anchor: As given.
        robot_anchor: As given.
        human_start: The human's anchor at the reference [m], shape (3,).
        further: Scale of the translation beyond 1.
        robot_points: The robot's points at the reference, in palm axes [m], shape (n_r, 3).
    """

    def __init__(
        self,
        method: PalmMethod[AnyHand],
        sample: HumanPose,
        posture: RobotPosture,
        human_anchor: Array = _ORIGIN,
        robot_anchor: Array = _ORIGIN,
        scale: float = 1.0,
    ) -> None:
        assert sample.wrist is not None
        self._method = method
        robot = method.robot
        self.rest = robot.rest
        following = method.following(human_anchor, robot_anchor, scale)
        (
            self.start,
            self.alignment,
            self.rotation,
            self.origin,
            self.offset,
            self.human_start,
        ) = core.palm_of_reference(encode(following), sample.wrist, posture.wrist)
        self.human_wrist_to_palm = method.wrist_to_palm
        self.robot_palm_to_wrist = inverse_pose(robot.wrist_to_palm)
        self.is_still = following.is_still
        self.robot_points = transform_points(inverse_pose(self.start), posture.points)
        self.human_anchor = human_anchor
        self.robot_anchor = robot_anchor
        self.further = scale - 1.0

    @cached_property
    def core_palm(self) -> core.PalmMap:
        """How the palm follows, as the core has it, made at its first use."""
        return core.PalmMap(encode(self.palm_model()))

    def __getstate__(self) -> dict[str, object]:
        """Return the state of a copy."""
        return without_core(self)

    def palm_model(self) -> PalmModel:
        """Return what the core follows the palm by."""
        return PalmModel(
            human_wrist_to_palm=self.human_wrist_to_palm,
            robot_palm_to_wrist=self.robot_palm_to_wrist,
            is_still=self.is_still,
            start=self.start,
            alignment=self.alignment,
            rotation=self.rotation,
            origin=self.origin,
            offset=self.offset,
            human_anchor=self.human_anchor,
            robot_anchor=self.robot_anchor,
            human_start=self.human_start,
            further=self.further,
        )

    def follow(self, sample: HumanPose) -> tuple[Array, Array, Array]:
        """Move the robot's palm with a sample's.

        Returns:
            The human's palm and the target of the robot's palm, shape (4, 4) each; the human's
            points in palm axes [m], shape (n_h, 3).
        """
        human = self._method.palm_of(sample)
        points = transform_points(inverse_pose(human), sample.points)
        return human, self.core_palm.follow(human), points

    @property
    def world(self) -> Array:
        """The human's world in the robot's, where both anchors are one place, shape (4, 4).

        For palms that follow without a scale.
        """
        return affine(self.alignment, self.alignment @ self.offset)

    def person_at(self, sample: AnyPose) -> Array:
        """Return a sample's palm in the robot's world, about its anchor, shape (4, 4).

        Its place is times the scale.
        """
        assert sample.wrist is not None
        return self.core_palm.person_at(sample.wrist)

    def placed(self, palm: Array, points: Array) -> tuple[Array, Array]:
        """Return the targets of points in the robot's palm, and of its wrist.

        Args:
            palm: The robot's palm, shape (4, 4).
            points: In its axes [m], shape (n_r, 3).
        """
        return transform_points(palm, points), palm @ self.robot_palm_to_wrist
