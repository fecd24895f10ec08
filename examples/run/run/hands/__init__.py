"""Hands that were saved: what the mapping needs of a `Hand`, without its URDF."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import accumulate
from typing import Any, Literal

import numpy as np

from handmap_qp.errors import expect
from handmap_qp.ik.core import Compiled, core
from handmap_qp.se3 import (
    Array,
    as_floats,
    check_pose,
    quat_wxyz_from_rotation,
    transform_points,
)

Names = tuple[str, ...]
Values = dict[str, Any]
Side = Literal["right", "left"]


class Record:
    """An object of the library that was saved: it has the same attributes, and no others."""


# Types of arguments, and what only describes a hand that is not saved yet.
Finger = PointSpec = ShapePairs = Record
load_hand = moved_by = named_pairs = pair_ends = yield_to = None


class Pose(Record):
    """A pose in place of Pinocchio's."""

    homogeneous: Array

    @property
    def translation(self) -> Array:
        return self.homogeneous[:3, 3].copy()

    def act(self, point: Array) -> Array:
        return transform_points(self.homogeneous, point)


class AttachedPoints(Record):
    """Points that are fixed to joints; see `hands.configuration`."""

    def __init__(self, hand: Hand, places: Sequence[tuple[int, Array]]) -> None:
        del hand
        joints, offsets = zip(*places, strict=True)
        self.joints = joints
        self.offsets = np.array(offsets)


class JointModel(Record):
    """A joint of a `Model`; `S` is its motion, linear first, shape (6,)."""

    def createData(self) -> JointModel:  # noqa: N802
        return self


class Convex(Record):
    """A convex shape; the others are plain records."""

    corners: Array

    def points(self) -> Array:
        return self.corners


class PairBounds(Compiled, Record):
    """Bounds of pairs of shapes, as of `ik.collision`."""


class CollisionLimit(Record):
    """Pairs of shapes that are kept apart, as of `ik.collision`."""

    # Files of former versions do not have it.
    yielding: Record | None = None


class Configuration:
    """A hand in one posture: its reference points and its wrist."""

    def __init__(self, hand: Hand) -> None:
        self._hand = hand
        ends = [*accumulate(len(each.reference_points) for each in hand.hands)]
        self.parts = [*map(slice, [0, *ends], ends)]

    def place(self, vector: Array) -> None:
        hand = self._hand
        frames = (*hand.point_frames, hand.wrist_frame)
        *points, wrist = hand.tree.poses(vector, frames)
        self.points = np.reshape([pose[:3, 3] for pose in points], (-1, 3))
        self.wrist = Pose()
        self.wrist.homogeneous = wrist


class Hand(Record):
    """A hand that was saved; attributes and methods are those of the library's."""

    name: str
    side: Side
    is_floating: bool
    landmarks: Array | None
    model: Any
    point_frames: tuple[Any, ...]
    reference_points: tuple[Any, ...]
    wrist_frame: Any
    lower_limits: Array
    upper_limits: Array
    rules: Names
    _wrist_to_root: Pose
    _moving_q: Array
    _motion: Array
    _shift: Array
    unscaled = None
    parts: tuple[Hand, ...] = ()
    whole: Hand
    has_floating_base = False

    @cached_property
    def tree(self) -> Any:
        """The core's kinematics."""
        return core.Tree(self)

    def __getstate__(self) -> Values:
        """Return all but the core's own, which a copy makes again."""
        return {name: value for name, value in vars(self).items() if name != "tree"}

    @property
    def hands(self) -> tuple[Hand, ...]:
        """The hands of a robot, else this one."""
        return self.parts or (self,)

    @property
    def by_side(self) -> dict[Side, Hand]:
        """The same by their side."""
        return {hand.side: hand for hand in self.hands}

    def configuration(self) -> Configuration:
        """Return a new workspace."""
        return Configuration(self)

    def configuration_vector(self, q: Any, wrist_pose: Any = None) -> Array:
        """Return the configuration of joint positions, shape (nq,)."""
        angles = as_floats(q, "q", shape=(self._motion.shape[1],), is_finite=True)
        pose = np.eye(4)
        if wrist_pose is not None:
            pose = check_pose(wrist_pose, "wrist_pose")
            expected = f"none: {self.name} has a fixed wrist"
            expect(self.is_floating, "wrist_pose", expected, value=wrist_pose)
        vector = np.zeros(self.model.nq)
        moving = self._motion @ angles + self._shift
        vector[self._moving_q] = moving[: len(self._moving_q)]
        if self.is_floating:
            root = pose @ self._wrist_to_root.homogeneous
            quat_xyzw = np.roll(quat_wxyz_from_rotation(root[:3, :3]), -1)
            vector[:7] = *root[:3, 3], *quat_xyzw
        return vector

    def points(self, q: Any, wrist_pose: Any = None) -> Array:
        """Return the reference points of a posture [m], shape (m, 3)."""
        return self._placed(q, wrist_pose).points

    def frame_pose(self, frame: str, q: Any) -> Array:
        """Return the pose of the wrist in a posture, shape (4, 4)."""
        expect(
            frame == "wrist", "frame", "wrist: a saved hand has no other", value=frame
        )
        return self._placed(q, None).wrist.homogeneous

    def _placed(self, q: Any, wrist_pose: Any) -> Configuration:
        placed = self.configuration()
        placed.place(self.configuration_vector(q, wrist_pose))
        return placed

    def with_points(self, points: str) -> Hand:
        """Return the human hand with its landmarks in place of its reference points."""
        expect(
            points == "landmarks" and self.landmarks is not None,
            "points",
            "landmarks: a saved hand keeps its points",
            value=points,
        )
        return _Landmarks(self)

    def at_position_limit(self, q: Array) -> Array:
        """Return which joints are within 1e-6 rad or m of a position limit, shape (n,)."""
        return (q <= self.lower_limits + 1e-6) | (q >= self.upper_limits - 1e-6)


class _Landmarks(Hand):
    """A human hand at rest, of which only the landmarks are asked for."""

    def __init__(self, hand: Hand) -> None:
        self.landmarks = hand.landmarks

    def points(self, q: Any, wrist_pose: Any = None) -> Array:
        """Return the landmarks at rest, in axes of the wrist [m], shape (21, 3)."""
        assert self.landmarks is not None
        return self.landmarks


def joined(name: str, *hands: Hand) -> Hand:
    """Return the robot that hands were saved with."""
    del name
    return hands[0].whole


def common_pairs(contacts: tuple[Any, ...]) -> tuple[bool, list[Any]]:
    """Return which pairs of each hand pinch: `joined` has all pairs."""
    return True, [*contacts]


KINDS = {
    kind.__name__: kind
    for kind in (
        Pose,
        AttachedPoints,
        CollisionLimit,
        JointModel,
        Convex,
        PairBounds,
        Hand,
    )
}
"""Kinds of records that do something, by name."""
# Constants of the tree follow: see `taken.py`.
