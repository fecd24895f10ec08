"""A hand as the core has it: joints, frames, reference points; see `handmap/hand_model.hpp`."""

from __future__ import annotations

from typing import Literal

from .encoding import Indices, Matrix, Model, Point, Points, Pose, Vector


class JointModel(Model, frozen=True, kw_only=True):
    """A joint that moves.

    Attributes:
        kind: What it is; a floating one has a quaternion, xyzw, behind its position.
        parent: Index of the joint that carries it; -1 for the world.
        axis: Unit axis in its own frame, shape (3,); not used for a floating joint.
        placement: Its frame in the parent's, at zero, shape (4, 4).
        q: Its first index in configurations.
        v: Its first index in the tangent space.
    """

    kind: Literal["revolute", "prismatic", "floating"]
    parent: int
    axis: Point
    placement: Pose
    q: int
    v: int


class FrameModel(Model, frozen=True, kw_only=True):
    """A frame of the URDF.

    Attributes:
        name: Name of the joint or link.
        kind: What it is the frame of.
        joint: Index of the joint that carries it; -1 for the world.
        parent: Index of the frame before it.
        placement: The frame on its joint, shape (4, 4).
    """

    name: str
    kind: Literal["joint", "fixed_joint", "link", "other"]
    joint: int
    parent: int
    placement: Pose


class PlaceModel(Model, frozen=True, kw_only=True):
    """A frame on a joint.

    Attributes:
        joint: Index of the joint; -1 for the world.
        placement: The frame on it, shape (4, 4).
    """

    joint: int
    placement: Pose


class HandModel(Model, frozen=True, kw_only=True):
    """A hand, or the hands of a robot as one.

    Attributes:
        nq: Number of coordinates of a configuration.
        nv: Number of coordinates of its tangent space.
        joints: The joints, each behind the one that carries it.
        frames: The frames, each behind the one that carries it.
        spread: From the k active tangent coordinates to all, shape (nv, k).
        q_indices: Where its n joints are in a configuration, in the user's order, shape (n,).
        joint_columns: Where they are in the active coordinates, shape (n,).
        configuration: Configuration at rest with the wrist at the origin, shape (nq,).
        moving_q: Coordinates that positions of the n joints set, shape (r,).
        motion: How: positions of all joints that move, then locked ones, per position of the n
            joints, shape (at least r, n).
        shift: Positions of all of them at zero.
        rest: Positions of the n joints at rest [rad or m], shape (n,).
        lower: Their lower limits, shape (n,).
        upper: Their upper limits, shape (n,).
        joint_weights: What their motion costs, and leaving their rest, shape (n,); 1 for a finger.
        wrists: Wrist frame of each hand.
        palm: Palm frame of the hand, or of the first one.
        point_counts: Number of reference points of each hand.
        point_joints: Joint of each of m reference points, shape (m,); -1 for the world.
        point_offsets: Where each of them is on it [m], shape (m, 3).
        point_frames: Frame of the link of each of them, shape (m,).
        fingers: Of each hand, 1 for each joint of its fingers, shape (h, n).
    """

    nq: int
    nv: int
    joints: tuple[JointModel, ...]
    frames: tuple[FrameModel, ...]
    spread: Matrix
    q_indices: Indices
    joint_columns: Indices
    configuration: Vector
    moving_q: Indices
    motion: Matrix
    shift: Vector
    rest: Vector
    lower: Vector
    upper: Vector
    joint_weights: Vector
    wrists: tuple[PlaceModel, ...]
    palm: PlaceModel
    point_counts: Indices
    point_joints: Indices
    point_offsets: Points
    point_frames: Indices
    fingers: Matrix
