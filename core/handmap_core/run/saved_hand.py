"""`SavedHand`: a hand that was saved, with what `Hand` asks for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from handmap_core.core import core
from handmap_core.errors import InvalidInputError, expect
from handmap_core.hands import GraspFinger, Pad, Side, joints_at_limit
from handmap_core.hands.core_configuration import (
    CoreConfiguration,
    CoreFrame,
    CorePose,
    CoreTree,
)
from handmap_core.models import encode, unpacked
from handmap_core.se3 import (
    Array,
    PoseLike,
    as_floats,
    check_pose,
    frozen,
    inverse_pose,
    quat_wxyz_from_rotation,
)
from .records import FingerRecord, HandRecord, PointRecord

if TYPE_CHECKING:
    from handmap_core import _core


class SavedHand:
    """A hand that was saved; see `Hand`.

    Args:
        record: What was saved.
        parts: The hands of a robot that is moved as one; empty for one hand.

    Attributes:
        record: As given.
        parts: As given.
        hands: The same, or this hand alone.
        model: Its tree of joints.
        grasp: What grips, the thumb first; empty where nothing does.

    All others are those of `Hand`.
    """

    unscaled = None

    def __init__(self, record: HandRecord, parts: Sequence[SavedHand] = ()) -> None:
        self.record = record
        self.parts = tuple(parts)
        self.hands = self.parts or (self,)
        self.name = record.name
        self.side: Side = record.side
        self.upright = record.upright
        self.is_floating = record.is_floating
        self.has_floating_base = record.has_floating_base
        self.joint_names = record.joint_names
        self.rules = record.followers
        self.velocity_limits = record.velocity_limits
        self.wrist_speeds = record.wrist_speeds
        self.active_columns = record.active_columns
        self.moves_wrist = record.moves_wrist
        self.reference_points = record.points
        self.point_weights = record.point_weights
        self.palm_weights = record.palm_weights
        self.grasp = tuple(map(_grasp_finger, record.grasp))
        own = record.model
        self.model = CoreTree(own)
        self.limits = frozen(np.array([own.lower, own.upper]))
        self.lower_limits, self.upper_limits = self.limits
        self.rest = own.rest
        self.joint_weights = own.joint_weights
        self.spread = own.spread
        self.joint_columns = own.joint_columns
        self.q_indices = own.q_indices
        self.finger_joints = frozen(own.fingers > 0.0)
        self.wrist_frames = [CoreFrame.of(place) for place in own.wrists]
        self.wrist_frame = self.wrist_frames[0]
        self.has_moving_wrist = self.wrist_frame.parentJoint > 0
        self.palm_frame = CoreFrame.of(own.palm)
        self.point_frames = [
            CoreFrame(joint + 1, CorePose(_shifted(offset)))
            for joint, offset in zip(own.point_joints, own.point_offsets, strict=True)
        ]
        self._wrist_to_root = inverse_pose(own.wrists[0].placement)
        self.wrist_to_palm = frozen(self._wrist_to_root @ own.palm.placement)

    def __copy__(self) -> SavedHand:
        """Return itself: it never changes."""
        return self

    def __deepcopy__(self, memo: object) -> SavedHand:
        """Return itself: it never changes."""
        return self

    def __reduce__(self) -> tuple[object, ...]:
        """Make it again in another process, from bytes: arrays that are read are read-only."""
        return _made_again, (type(self), encode(self.record), self.parts)

    @cached_property
    def tree(self) -> _core.Tree:
        """The kinematics of the compiled core."""
        return core.Tree(encode(self.record.model))

    def configuration(self) -> CoreConfiguration:
        """Return a new workspace for this hand, for one user at a time."""
        start = self.record.model.configuration
        return CoreConfiguration(self, self.model, self.wrist_frames, start)

    def configuration_vector(
        self, q: ArrayLike, wrist_pose: PoseLike | None = None
    ) -> Array:
        """Return the configuration of joint positions and a wrist pose, shape (nq,).

        Raises:
            InvalidInputError: On a wrong shape, numbers that are not finite, or a wrong wrist pose.
        """
        own = self.record.model
        angles = as_floats(q, "q", shape=(len(self.joint_names),), is_finite=True)
        pose = np.eye(4)
        if wrist_pose is not None:
            pose = check_pose(wrist_pose, "wrist_pose")
            expected = f"none: {self.name} has a fixed wrist"
            expect(self.is_floating, "wrist_pose", expected, value=wrist_pose)
        vector = np.zeros(own.nq)
        moving = own.motion @ angles + own.shift
        vector[own.moving_q] = moving[: len(own.moving_q)]
        if self.is_floating:
            root = pose @ self._wrist_to_root
            quat_xyzw = np.roll(quat_wxyz_from_rotation(root[:3, :3]), -1)
            vector[:7] = *root[:3, 3], *quat_xyzw
        return vector

    def points(self, q: ArrayLike, wrist_pose: PoseLike | None = None) -> Array:
        """Return the reference points of a posture [m], shape (m, 3)."""
        points, _ = self.tree.posture(self.configuration_vector(q, wrist_pose))
        return points

    def with_points(self, points: str) -> Landmarks:
        """Return a person's hand with its landmarks in place of its reference points.

        Raises:
            InvalidInputError: If other points are asked for, or the hand has no landmarks.
        """
        if points != "landmarks" or not self.record.landmarks:
            raise InvalidInputError(
                argument="points",
                expected="landmarks: a saved hand keeps its points",
                value=points,
            )
        return Landmarks(self.record)

    def at_position_limit(self, q: Array) -> Array:
        """Return which joints are at a position limit, shape (n,)."""
        return joints_at_limit(q, self.limits)


class Landmarks(SavedHand):
    """A person's hand of which only its landmarks are asked for.

    Args:
        record: The hand.
        parts: As of `SavedHand`.
    """

    def __init__(self, record: HandRecord, parts: Sequence[SavedHand] = ()) -> None:
        super().__init__(record, parts)
        self.reference_points: tuple[PointRecord, ...] = record.landmarks


def _made_again(
    kind: type[SavedHand], record: bytes, parts: Sequence[SavedHand]
) -> SavedHand:
    """Return a hand from the bytes of its record."""
    decoded = msgspec.msgpack.decode(record, type=HandRecord, ext_hook=unpacked)
    return kind(decoded, parts)


def _grasp_finger(record: FingerRecord) -> GraspFinger:
    """Return a finger that grips, from its record."""
    pad = Pad(record.joint, record.offset, record.radius, record.cover)
    return GraspFinger(pad, record.columns, record.is_jaw)


def _shifted(offset: Array) -> Array:
    """Return the pose of a point [m], shape (3,), in the axes of what carries it."""
    pose = np.eye(4)
    pose[:3, 3] = offset
    return pose
