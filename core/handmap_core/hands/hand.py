"""`Hand`: what is read of a hand for every sample, whatever it was built from.

`handmap_qp.hands.Hand` has these attributes, built from a URDF. A saved hand has them, too.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Protocol

from numpy.typing import ArrayLike

from handmap_core.se3 import Array, PoseLike
from .configuration import Configuration, Frame, KinematicModel
from .names import Names, Side

if TYPE_CHECKING:
    from handmap_core import _core


_AT_LIMIT = 1e-6
"""Joints that are nearer to a limit are at it [rad or m]."""


def joints_at_limit(q: Array, limits: Array) -> Array:
    """Return which joints are at a position limit, shape (n,).

    Args:
        q: Joint positions [rad or m], shape (n,).
        limits: Their lower and upper limits [rad or m], shape (2, n).
    """
    lower, upper = limits
    return (q <= lower + _AT_LIMIT) | (q >= upper - _AT_LIMIT)


class Point(Protocol):
    """A reference point of a hand: a place on a link."""

    @property
    def name(self) -> str:
        """Its name, unique in the hand."""

    @property
    def link(self) -> str:
        """Link that carries it."""

    @property
    def xyz(self) -> tuple[float, float, float]:
        """Its place in the link's coordinates [m]."""


class Hand(Protocol):
    """A hand: the order of its joints, its limits, its reference points and its kinematics.

    It has n joints, k active coordinates (those of a floating wrist, then those of the joints), and
    m reference points. Its arrays are read-only.
    """

    def __hash__(self) -> int:
        """Two hands are equal only if they are the same one."""

    @property
    def name(self) -> str:
        """Short name."""

    @property
    def side(self) -> Side:
        """Side of the body that it belongs to."""

    @property
    def tree(self) -> _core.Tree:
        """The kinematics of the compiled core."""

    @property
    def model(self) -> KinematicModel:
        """Its tree of joints."""

    @property
    def point_frames(self) -> Sequence[Frame]:
        """Frames of the reference points."""

    @property
    def wrist_frame(self) -> Frame:
        """Frame of the wrist."""

    @property
    def palm_frame(self) -> Frame:
        """Frame of the palm."""

    @property
    def hands(self) -> Sequence[Hand]:
        """The hands of a robot that is moved as one; else this hand alone."""

    @property
    def parts(self) -> Sequence[Hand]:
        """The hands of a robot that is moved as one; else empty."""

    @property
    def unscaled(self) -> Hand | None:
        """Of a hand scaled to a person, the one that was scaled; else None."""

    @property
    def is_floating(self) -> bool:
        """Whether the wrist is free to move."""

    @property
    def joint_names(self) -> Names:
        """The n joints of every `q`, in its order."""

    @property
    def rules(self) -> Collection[str]:
        """Names of the joints that follow others."""

    @property
    def limits(self) -> Array:
        """Position limits [rad or m], shape (2, n)."""

    @property
    def lower_limits(self) -> Array:
        """The lower ones, shape (n,)."""

    @property
    def upper_limits(self) -> Array:
        """The upper ones, shape (n,)."""

    @property
    def velocity_limits(self) -> Array:
        """Speed limits [rad/s or m/s], shape (n,)."""

    @property
    def joint_weights(self) -> Array:
        """What the motion of each joint costs, 1 for a finger's, shape (n,)."""

    @property
    def rest(self) -> Array:
        """Rest posture [rad or m], shape (n,)."""

    @property
    def spread(self) -> Array:
        """From the active coordinates to those of the model, shape (nv, k)."""

    @property
    def active_columns(self) -> Array:
        """Indices of the active coordinates among those of the model, shape (k,)."""

    @property
    def joint_columns(self) -> Array:
        """Indices of the joints among the active coordinates, shape (n,)."""

    @property
    def q_indices(self) -> Array:
        """Indices of the joints in a configuration, shape (n,)."""

    @property
    def reference_points(self) -> Sequence[Point]:
        """The reference points in use."""

    @property
    def point_weights(self) -> Array:
        """Their weights, shape (m,)."""

    @property
    def palm_weights(self) -> Array:
        """Weights of the palm's points, by finger, shape (5,)."""

    @property
    def wrist_to_palm(self) -> Array:
        """Pose of the palm frame in the wrist frame, shape (4, 4)."""

    @property
    def wrist_speeds(self) -> tuple[float, float]:
        """Speed limits of a floating wrist [m/s, rad/s]."""

    @property
    def upright(self) -> str:
        """Axes of its world that are up and forward, such as `+z up, +x forward`."""

    @property
    def finger_joints(self) -> Array:
        """Which joints move points of each of its h hands, and no wrist, shape (h, n)."""

    @property
    def moves_wrist(self) -> Array:
        """Which joints move the wrist, shape (n,)."""

    @property
    def has_floating_base(self) -> bool:
        """Whether a robot walks or drives."""

    @property
    def has_moving_wrist(self) -> bool:
        """Whether free coordinates or joints of an arm move the wrist."""

    def configuration(self) -> Configuration:
        """Return a new workspace for this hand, for one user at a time."""

    def with_points(self, points: str) -> Hand:
        """Return the same hand with another set of reference points."""

    def configuration_vector(
        self, q: ArrayLike, wrist_pose: PoseLike | None = None
    ) -> Array:
        """Return the configuration of joint positions and a wrist pose, shape (nq,)."""

    def points(self, q: ArrayLike, wrist_pose: PoseLike | None = None) -> Array:
        """Return the reference points of a posture [m], shape (m, 3)."""

    def at_position_limit(self, q: Array) -> Array:
        """Return which joints are at a position limit, shape (n,)."""
