"""Hands that were saved: what the mapping needs of a `Hand`, without its URDF."""

from __future__ import annotations

from functools import cached_property
from typing import Any, cast

import numpy as np

from handmap_core.core import core
from handmap_core.errors import expect
from handmap_core.hands import CONTACT_GAP as CONTACT_GAP
from handmap_core.hands import FINGERS as FINGERS
from handmap_core.hands import LINK_MARGIN as LINK_MARGIN
from handmap_core.hands import LONGEST_STOP as LONGEST_STOP
from handmap_core.hands import OTHER_SIDE as OTHER_SIDE
from handmap_core.hands import SLIDING_STIFFNESS as SLIDING_STIFFNESS
from handmap_core.hands import STIFFNESS as STIFFNESS
from handmap_core.hands import THUMB as THUMB
from handmap_core.hands import UPRIGHT as UPRIGHT
from handmap_core.hands import Names, Pad, Side, Values
from handmap_core.hands import PadPair as PadPair
from handmap_core.se3 import (
    Array,
    as_floats,
    check_pose,
    cross,
    frozen,
    quat_wxyz_from_rotation,
    transform_points,
)
from handmap_qp.hands import configuration
from handmap_qp.hands.configuration import AttachedPoints


class Record:
    """An object of the library that was saved: it has the same attributes, and no others."""


# Types of arguments, and what only describes a hand that is not saved yet.
ContactYield = Finger = PointSpec = ShapePairs = Record
body_models = load_hand = moved_by = named_pairs = pair_ends = yield_to = None


class Pose(Record):
    """A pose in place of Pinocchio's."""

    homogeneous: Array

    @classmethod
    def of(cls, homogeneous: Array) -> Pose:
        """Return the pose of a matrix, shape (4, 4)."""
        pose = cls()
        pose.homogeneous = homogeneous
        return pose

    @property
    def translation(self) -> Array:
        return self.homogeneous[:3, 3].copy()

    def act(self, point: Array) -> Array:
        return transform_points(self.homogeneous, point)

    def __mul__(self, other: Pose) -> Pose:
        """Return the pose of what is at another pose in this one's axes."""
        return Pose.of(self.homogeneous @ other.homogeneous)


class JointModel(Record):
    """A joint of a `Model`; `S` is its motion, linear first, shape (6,), None if it is free."""

    nv: int
    S: Array | None

    def createData(self) -> JointModel:  # noqa: N802
        return self

    @property
    def motions(self) -> Array:
        """What each of its coordinates does in its own axes, linear first, shape (nv, 6)."""
        return np.eye(6) if self.S is None else self.S[None]


class Model(Record):
    """A tree of joints in place of Pinocchio's; the first one is the world, and no joint."""

    joints: tuple[JointModel, ...]
    njoints: int

    @cached_property
    def nvs(self) -> list[int]:
        """Number of velocity coordinates of each joint."""
        return [0, *(joint.nv for joint in self.joints[1:])]

    @cached_property
    def owners(self) -> Array:
        """Joint of each velocity coordinate, shape (nv,)."""
        return np.repeat(np.arange(self.njoints), self.nvs)

    @cached_property
    def motions(self) -> Array:
        """What each of them does in the joint's axes: linear, then angular, (nv, 2, 3)."""
        moving = [joint.motions for joint in self.joints[1:]]
        return np.vstack(moving).reshape(-1, 2, 3)

    def createData(self) -> Data:  # noqa: N802
        return Data(self, np.zeros((0, 4, 4)))


class Data:
    """A model in one configuration, in place of Pinocchio's.

    Args:
        model: The model.
        poses: Poses of its joints in the world, shape (njoints, 4, 4).

    Attributes:
        oMi: The same.
    """

    def __init__(self, model: Model, poses: Array) -> None:
        self._model = model
        self._poses = poses
        self.oMi = [*map(Pose.of, poses)]

    @cached_property
    def J(self) -> Array:  # noqa: N802
        """Velocity at the world's origin per velocity of the model, linear first, (6, nv)."""
        poses = self._poses[self._model.owners]
        moved = self._model.motions @ poses[:, :3, :3].swapaxes(-1, -2)
        linear, turning = moved.swapaxes(0, 1)
        linear = linear + cross(poses[:, :3, 3], turning)
        return np.hstack([linear, turning]).T


class CollisionLimit(Record):
    """Pairs of shapes that are kept apart, as of `ik.collision`, and their bounds.

    Attributes:
        pairs: Bytes of the pairs.
        model: Bytes of how they are kept apart.
        links: Links of each pair.
        columns: Which active coordinates move shapes against each other.
    """

    pairs: bytes
    model: bytes
    links: tuple[Names, ...]
    columns: Array

    @property
    def bounds(self) -> CollisionLimit:
        return self

    @cached_property
    def core(self) -> Any:
        """The core's own pairs."""
        return core.PairBounds(self.pairs)

    def __getstate__(self) -> Values:
        """Return all but the core's own, which a copy makes again."""
        return {name: value for name, value in vars(self).items() if name != "core"}

    def moving_columns(self, spread: Array) -> Array:
        """Return which active coordinates move shapes against each other."""
        del spread
        return self.columns


class Configuration(configuration.PinocchioConfiguration):
    """A hand in one posture, placed by the core; see `hands.configuration`."""

    _hand: Hand

    def place(self, q: Array) -> None:
        """Put the hand at a configuration, shape (nq,)."""
        hand = self._hand
        poses = hand.tree.joint_poses(q)
        self.data = Data(self.model, poses)
        self.q = frozen(np.array(q))

    __setstate__ = place


PinocchioConfiguration = Configuration


class Grasp(Record):
    """Pads and joints of a hand's fingers, the thumb first; see `mapping.hand_pair`.

    Attributes:
        names: Names of the fingers.
        has_jaws: Whether they are jaws.
        pads: The pad of each finger.
        used: What moves each finger: `columns` of q, and whether it `is_jaw`.
    """

    names: Names = ()
    has_jaws: bool = False
    pads: dict[str, Pad]
    used: dict[str, Any]


class Hand(Record):
    """A hand that was saved; attributes and methods are those of the library's."""

    name: str
    side: Side
    is_floating: bool
    spec: Any
    # Of a human hand, its landmarks as points.
    landmarks: tuple[Any, ...] | None = None
    tree_model: bytes
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
    # Files from before grips have none.
    grasp = Grasp()

    @cached_property
    def tree(self) -> Any:
        """The core's kinematics."""
        return core.Tree(self.tree_model)

    def __getstate__(self) -> Values:
        """Return all but the core's own, which a copy makes again."""
        return {name: value for name, value in vars(self).items() if name != "tree"}

    @property
    def wrist_speeds(self) -> tuple[float, float]:
        """Speed limits of a floating wrist [m/s, rad/s]."""
        wrist = self.spec.wrist
        return wrist.max_linear_speed, wrist.max_angular_speed

    @property
    def upright(self) -> str:
        """Axes of its world that are up and forward."""
        return self.spec.upright

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
        return Configuration(cast("configuration.Hand", self))

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

    def with_points(self, points: str) -> _Landmarks:
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


class _Landmarks(Record):
    """A human hand of which only its landmarks are asked for."""

    def __init__(self, hand: Hand) -> None:
        self.reference_points = hand.landmarks


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
        Model,
        Grasp,
        Hand,
    )
}
"""Kinds of records that do something, by name."""
