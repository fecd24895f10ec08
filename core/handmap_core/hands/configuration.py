"""A hand in one posture, as the terms of the QP read it, and points that are fixed to its links."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, Generic, Protocol, Self, TypeVar

import numpy as np

from handmap_core.se3 import Array, cross_matrices, frozen

if TYPE_CHECKING:
    from handmap_core import _core
    from .hand import Hand


class Pose(Protocol):
    """A pose, of Pinocchio or of a saved hand."""

    @property
    def homogeneous(self) -> Array:
        """The same as a matrix, shape (4, 4)."""

    @property
    def translation(self) -> Array:
        """Its origin [m], shape (3,)."""

    def act(self, point: Array) -> Array:
        """Return a point that is given in its axes, shape (3,)."""


class Frame(Protocol):
    """A frame on a joint of a model."""

    @property
    def parentJoint(self) -> int:  # noqa: N802
        """Index of the joint; 0 for the world."""

    @property
    def placement(self) -> Pose:
        """The frame on it."""


class KinematicModel(Protocol):
    """A tree of joints; the first one is the world, and no joint."""

    @property
    def nq(self) -> int:
        """Number of coordinates of a configuration."""

    @property
    def nv(self) -> int:
        """Number of coordinates of its tangent space."""

    @property
    def njoints(self) -> int:
        """Number of joints, with the world."""

    @property
    def parents(self) -> Sequence[int]:
        """The joint that carries each joint."""

    @property
    def nvs(self) -> Sequence[int]:
        """Number of tangent coordinates of each joint."""


class PlacedJoints(Protocol):
    """A model in one configuration."""

    @property
    def oMi(self) -> Sequence[Pose]:  # noqa: N802
        """Pose of each joint in the world."""

    @property
    def J(self) -> Array:  # noqa: N802
        """Velocity at the world's origin per velocity of the model, linear first, (6, nv)."""


class PlacedModel(Protocol):
    """A hand in one posture, as far as points that are fixed to its links need it."""

    @property
    def data(self) -> PlacedJoints:
        """Where the joints are, and how they move; not to be changed."""

    def contracted(self, jacobian: Array) -> Array:
        """Take a Jacobian, shape (..., model.nv), to the active coordinates, shape (..., k)."""


class Configuration(PlacedModel, Protocol):
    """One posture of a hand, with its reference points; at first a neutral one."""

    @property
    def tree(self) -> _core.Tree:
        """The hand's kinematics, as the core has them."""

    @property
    def q(self) -> Array:
        """Configuration last placed, shape (nq,), read-only."""

    @property
    def nv(self) -> int:
        """Number of active velocity coordinates, k: the wrist's and those of joints that lead."""

    @property
    def points(self) -> Array:
        """Reference points in the world [m], shape (m, 3)."""

    @property
    def wrist(self) -> Pose:
        """Wrist frame of the hand, or of the first one of a robot."""

    @property
    def wrists(self) -> Sequence[Pose]:
        """Wrist frame of each hand."""

    def place(self, q: Array) -> None:
        """Put the hand at a configuration, shape (nq,); its values are not checked."""

    @property
    def parts(self) -> Sequence[slice]:
        """Where the points of each hand are among all."""

    def point_jacobian(self) -> Array:
        """Return the Jacobian of the points, rows x, y, z of each in turn, shape (3 m, k)."""


def moved_by(model: KinematicModel, joints: Sequence[int]) -> Array:
    """Return 1 for every velocity coordinate that moves a joint's frame.

    Args:
        model: The model.
        joints: Indices of k joints.

    Returns:
        Shape (k, model.nv).
    """
    # Parents have smaller indices than their children.
    is_support = np.eye(model.njoints)
    for joint, parent in enumerate([*model.parents][1:], start=1):
        is_support[joint] += is_support[parent]
    owners = np.repeat(np.arange(model.njoints), model.nvs)
    return is_support[[*joints]][:, owners]


class AttachedPoints:
    """Points that are fixed to links of a hand, with their derivatives.

    Args:
        hand: The hand.
        places: Joint of the model that carries each point, and the point's offset in the joint's
            frame [m].
    """

    def __init__(self, hand: Hand, places: Sequence[tuple[int, Array]]) -> None:
        self.joints = [joint for joint, _ in places]
        self.offsets = np.array([offset for _, offset in places], dtype=float).reshape(
            -1, 3
        )
        # Which coordinates of the model move each point, shape (n, 1, model.nv).
        self.moved = moved_by(hand.model, self.joints)[:, None]

    @classmethod
    def reference_points(cls, hand: Hand) -> Self:
        """Return the hand's reference points."""
        places = [(f.parentJoint, f.placement.translation) for f in hand.point_frames]
        return cls(hand, places)

    def __len__(self) -> int:
        return len(self.joints)

    def positions(self, hand: PlacedModel) -> Array:
        """Return the points in the world [m], shape (n, 3)."""
        placed = zip(self.joints, self.offsets, strict=True)
        points = [hand.data.oMi[joint].act(offset) for joint, offset in placed]
        return np.reshape(points, (-1, 3))

    def jacobians(self, hand: PlacedModel) -> Array:
        """Return the derivative of each point in the active coordinates, shape (n, 3, nv)."""
        return hand.contracted(self.velocities(hand))

    def velocities(self, hand: PlacedModel) -> Array:
        """Return the same in all coordinates of the model, shape (n, 3, model.nv)."""
        linear, angular = hand.data.J.reshape(2, 3, -1)
        # The velocity at the world's origin plus w x p, which is -p x w, is that of the point p.
        turning = cross_matrices(self.positions(hand)) @ angular
        return (linear - turning) * self.moved


Joints_co = TypeVar("Joints_co", bound=PlacedJoints, covariant=True)


class PlacedHand(Generic[Joints_co]):
    """Base of configurations: what follows from where the joints of a hand are.

    Args:
        hand: The hand, or the hands of a robot as one.

    Attributes:
        spread: `Hand.spread`.
        data: Where the joints are, and how they move: do not write to it.
        q: Configuration last placed, shape (nq,), read-only; a new array with every placement.
        parts: Where the points of each hand are among all.
    """

    data: Joints_co
    q: Array

    def __init__(self, hand: Hand) -> None:
        self._hand = hand
        self.spread = hand.spread
        self._points = AttachedPoints.reference_points(hand)
        ends = [*accumulate(len(each.reference_points) for each in hand.hands)]
        self.parts = [*map(slice, [0, *ends], ends)]

    @property
    def tree(self) -> _core.Tree:
        """The hand's kinematics, as the core has them."""
        return self._hand.tree

    @property
    def nv(self) -> int:
        """Number of active velocity coordinates, k: the wrist's and those of joints that lead."""
        return self.spread.shape[1]

    @property
    def points(self) -> Array:
        """Reference points in the world [m], shape (m, 3)."""
        return frozen(self._points.positions(self))

    def point_jacobian(self) -> Array:
        """Jacobian of the points in the active coordinates, in world axes [m per unit].

        Returns:
            Jacobian, rows x, y, z of each point in turn, shape (3 m, k); a new array.
        """
        return self._points.jacobians(self).reshape(-1, self.nv)

    def contracted(self, jacobian: Array) -> Array:
        """Take a Jacobian over the model's tangent space to the active coordinates.

        Args:
            jacobian: Shape (..., model.nv).

        Returns:
            Jacobian, shape (..., k).
        """
        return jacobian.dot(self.spread)
