"""Records: what the file of a saved hand has, as typed structs.

A `HandFile` is one robot hand, a `RobotFile` a robot with two. Both have all that the compiled core
needs, and the Python that follows samples: no URDF, no mesh, no Pinocchio.
"""

from __future__ import annotations

from handmap_core.hands import Names, Side
from handmap_core.ik import IkOptions
from handmap_core.mapping.alignment import Alignment
from handmap_core.mapping.homogeneous import HomogeneousOptions
from handmap_core.models import (
    CollisionModel,
    Flags,
    HandModel,
    Indices,
    Model,
    PairsModel,
    Point,
    Pose,
    TeleoperationModel,
    Vector,
)
from handmap_core.se3 import QuatOrder


class PointRecord(Model, frozen=True, kw_only=True):
    """A point on a link of a hand.

    Attributes:
        name: Its name.
        link: The link.
        xyz: Its place on it [m].
    """

    name: str
    link: str
    xyz: tuple[float, float, float]


class FingerRecord(Model, frozen=True, kw_only=True):
    """A finger or a jaw that grips; see `GraspFinger` and `Pad`.

    Attributes:
        joint: Joint that carries its pad.
        offset: Middle of the pad there [m], shape (3,).
        radius: Radius of the pad [m].
        cover: How far it rises above the collision shapes [m].
        columns: Columns of q that move the finger, shape (c,).
        is_jaw: Whether all its joints slide.
    """

    joint: int
    offset: Point
    radius: float
    cover: float
    columns: Indices
    is_jaw: bool


class HandRecord(Model, frozen=True, kw_only=True):
    """A hand, of a person or of a robot, or the hands of a robot as one; see `Hand`.

    Attributes:
        name: Short name.
        side: Side of the body that it belongs to.
        upright: Axes of its world that are up and forward.
        is_floating: Whether the wrist is free to move.
        has_floating_base: Whether a robot walks or drives.
        joint_names: The n joints of every `q`, in its order.
        followers: Joints that follow others.
        velocity_limits: Speed limits of the n joints [rad/s or m/s], shape (n,).
        wrist_speeds: Speed limits of a floating wrist [m/s, rad/s].
        active_columns: Indices of the active coordinates among all, shape (k,).
        moves_wrist: Which joints move the wrist, shape (n,).
        points: The m reference points.
        point_weights: Their weights, shape (m,).
        palm_weights: Weights of the palm's points, by finger, shape (5,).
        landmarks: Of a person's hand, its landmarks; else empty.
        grasp: What grips, the thumb first; empty where nothing does.
        model: All that the core has of it.
    """

    name: str
    side: Side
    upright: str
    is_floating: bool
    has_floating_base: bool
    joint_names: Names
    followers: Names
    velocity_limits: Vector
    wrist_speeds: tuple[float, float]
    active_columns: Indices
    moves_wrist: Flags
    points: tuple[PointRecord, ...]
    point_weights: Vector
    palm_weights: Vector
    landmarks: tuple[PointRecord, ...]
    grasp: tuple[FingerRecord, ...]
    model: HandModel


class CollisionsRecord(Model, frozen=True, kw_only=True):
    """Pairs of shapes that a robot keeps apart, and how.

    Attributes:
        pairs: The pairs.
        model: How they are kept apart.
        links: Links of each pair; at -1, there are none.
    """

    pairs: PairsModel
    model: CollisionModel
    links: tuple[Names, ...]


class HomogeneousRecord(Model, frozen=True, kw_only=True, tag="homogeneous"):
    """The paper's method for two hands.

    Attributes:
        options: Its choices.
        partners: Reference points that correspond: indices of the robot's and the human's.
    """

    options: HomogeneousOptions
    partners: tuple[tuple[int, int], ...]


class TeleoperationRecord(Model, frozen=True, kw_only=True, tag="teleoperation"):
    """Teleoperation for two hands; see `BoundTeleoperation` and `PalmFollowing`.

    Attributes:
        alignment: From the human's world to the robot's.
        scale: Factor on the palm's translation.
        wrist_to_palm: Palm in the human's wrist, with the axes of the robot's, shape (4, 4).
        human_anchor: The human's anchor in its palm [m], shape (3,).
        robot_anchor: The robot's, likewise.
        model: What targets are computed with.
        singular_values: Of the points that T is estimated from [m], shape (3,).
        keeps_apart: Whether links of the robot are kept apart.
    """

    alignment: Alignment
    scale: float
    wrist_to_palm: Pose
    human_anchor: Point
    robot_anchor: Point
    model: TeleoperationModel
    singular_values: Vector
    keeps_apart: bool


MethodRecord = HomogeneousRecord | TeleoperationRecord


class SettingsRecord(Model, frozen=True, kw_only=True):
    """How a robot follows, whatever its hands.

    Attributes:
        ik: Weights and settings of the QP.
        dt: Usual time between samples [s].
        joint_tolerance: How far a human joint may be outside its limits [rad].
        quat_order: Order of quaternions of wrist poses.
        orders: Orders in which landmarks may come by mistake, shape (21,), by their layout.
    """

    ik: IkOptions
    dt: float
    joint_tolerance: float
    quat_order: QuatOrder | None
    orders: dict[str, Indices]


class HandFile(Model, frozen=True, kw_only=True):
    """A robot hand that follows a person's.

    Attributes:
        human: The person's hand.
        robot: The robot's.
        method: How the one follows the other.
        collisions: What the robot keeps apart; None for nothing.
        settings: How it follows.
    """

    human: HandRecord
    robot: HandRecord
    method: MethodRecord
    collisions: CollisionsRecord | None
    settings: SettingsRecord


class SideRecord(Model, frozen=True, kw_only=True):
    """One hand of a robot with two.

    Attributes:
        human: The person's hand.
        robot: The robot's, whose `q` has all joints of the robot.
        method: How the one follows the other.
    """

    human: HandRecord
    robot: HandRecord
    method: MethodRecord


class PinchingRecord(Model, frozen=True, kw_only=True):
    """Pairs of shapes of the thumb and the fingers of one hand.

    Attributes:
        of_robot: Their indices among the pairs of the robot, shape (r,).
        of_hand: Their indices among the pairs of the hand, shape (r,).
    """

    of_robot: Indices
    of_hand: Indices


class RobotFile(Model, frozen=True, kw_only=True):
    """A robot with two hands that follow a person's.

    Attributes:
        robot: The robot as one hand.
        hands: Its hands, in the order of their sides.
        pinching: What pinches, of each hand; empty if no method keeps links apart.
        collisions: What it keeps apart; None for nothing.
        turns_in: Time after a reference until palms have the person's directions [s].
        settings: How it follows.
    """

    robot: HandRecord
    hands: tuple[SideRecord, ...]
    pinching: tuple[PinchingRecord, ...]
    collisions: CollisionsRecord | None
    turns_in: float
    settings: SettingsRecord
