"""A hand in one posture, placed by the compiled core: `CoreConfiguration`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from handmap_core.models import HandModel, JointModel, PlaceModel
from handmap_core.se3 import Array, cross, frozen, transform_points
from .configuration import PlacedHand

if TYPE_CHECKING:
    from .hand import Hand


class CorePose(NamedTuple):
    """A pose, as a matrix.

    Attributes:
        homogeneous: Shape (4, 4).
    """

    homogeneous: Array

    @property
    def translation(self) -> Array:
        """Its origin [m], shape (3,)."""
        return self.homogeneous[:3, 3]

    def act(self, point: Array) -> Array:
        """Return a point that is given in its axes, shape (3,)."""
        return transform_points(self.homogeneous, point)


class CoreFrame(NamedTuple):
    """A frame on a joint; joints count from 1, and 0 is the world.

    Attributes:
        parentJoint: The joint.
        placement: The frame on it.
    """

    parentJoint: int  # noqa: N815
    placement: CorePose

    @classmethod
    def of(cls, place: PlaceModel) -> CoreFrame:
        """Return the frame of a model, whose joints count from 0."""
        return cls(place.joint + 1, CorePose(place.placement))


class CoreTree:
    """The tree of joints of a `HandModel`; the first one is the world, and no joint.

    Args:
        model: The model.

    Attributes:
        nq: Number of coordinates of a configuration.
        nv: Number of coordinates of its tangent space.
        njoints: Number of joints, with the world.
        parents: The joint that carries each joint.
        nvs: Number of tangent coordinates of each joint.
    """

    def __init__(self, model: HandModel) -> None:
        self.nq = model.nq
        self.nv = model.nv
        self.njoints = 1 + len(model.joints)
        self.parents = [0, *(joint.parent + 1 for joint in model.joints)]
        motions = [_motions(joint) for joint in model.joints]
        self.nvs = [0, *map(len, motions)]
        # What each coordinate does in the axes of its joint: linear, then angular, (nv, 2, 3).
        self._motions = np.vstack(motions).reshape(-1, 2, 3)
        self._owners = np.repeat(np.arange(self.njoints), self.nvs)

    def jacobian(self, poses: Array) -> Array:
        """Return the velocity at the world's origin per velocity, linear first, shape (6, nv).

        Args:
            poses: Pose of each joint, shape (njoints, 4, 4).
        """
        carriers = poses[self._owners]
        moved = self._motions @ carriers[:, :3, :3].swapaxes(-1, -2)
        linear, turning = moved.swapaxes(0, 1)
        return np.hstack([linear + cross(carriers[:, :3, 3], turning), turning]).T


def _motions(joint: JointModel) -> Array:
    """Return what each coordinate of a joint does in its own axes, linear first, shape (v, 6)."""
    if joint.kind == "floating":
        return np.eye(6)
    none = np.zeros(3)
    parts = (joint.axis, none) if joint.kind == "prismatic" else (none, joint.axis)
    return np.concatenate(parts)[None]


class CoreJoints:
    """Joints in one configuration.

    Args:
        tree: The tree.
        poses: Pose of each joint in the world, shape (njoints, 4, 4).

    Attributes:
        oMi: The same, one by one.
    """

    def __init__(self, tree: CoreTree, poses: Array) -> None:
        self._tree = tree
        self._poses = poses
        self.oMi: Sequence[CorePose] = [*map(CorePose, poses)]

    @cached_property
    def J(self) -> Array:  # noqa: N802
        """Velocity at the world's origin per velocity of the model, linear first, (6, nv)."""
        return self._tree.jacobian(self._poses)


class CoreConfiguration(PlacedHand[CoreJoints]):
    """One posture of a hand, placed by the core; see `Configuration`.

    Args:
        hand: The hand.
        tree: Its joints.
        wrists: Wrist frame of it, or of each hand of a robot.
        q: Where it is at first, shape (nq,).
    """

    def __init__(
        self, hand: Hand, tree: CoreTree, wrists: Sequence[CoreFrame], q: Array
    ) -> None:
        super().__init__(hand)
        self._tree = tree
        self._wrists = wrists
        self.place(q)

    def place(self, q: Array) -> None:
        """Put the hand at a configuration, shape (nq,)."""
        self.data = CoreJoints(self._tree, self._hand.tree.joint_poses(q))
        self.q = frozen(np.array(q))

    @property
    def wrists(self) -> list[CorePose]:
        """Wrist frame of each hand."""
        poses = self.data.oMi
        return [
            CorePose(poses[wrist.parentJoint].homogeneous @ wrist.placement.homogeneous)
            for wrist in self._wrists
        ]

    @property
    def wrist(self) -> CorePose:
        """Wrist frame of the hand, or of the first one of a robot."""
        return self.wrists[0]
