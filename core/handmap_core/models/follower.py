"""A hand that follows a person's, as C++ alone follows with it: `FollowerModel`.

`handmap hands save` writes it into the file of a hand, beside what Python follows by. The library
in C++ makes its `Follower` of it (`handmap/follower.hpp`).
"""

from __future__ import annotations

from .encoding import Indices, Model, Point, Pose, Rotation
from .hand import HandModel
from .ik import IkModel
from .limits import BoxLimits
from .method import TeleoperationModel
from .person import GuardModel, LandmarkReaderModel
from .shapes import CollisionModel, PairsModel


class PalmFollowingModel(Model, frozen=True, kw_only=True):
    """How a robot's palm follows the human's, whatever the reference; see `PalmMap`.

    Attributes:
        aligns_palms: Whether the palms' axes at the reference are laid onto each other, instead of
            `alignment`.
        alignment: From the human's world to the robot's, shape (3, 3).
        scale: Factor on the palm's translation.
        human_wrist_to_palm: Palm in the human's wrist, with the axes of the robot's, shape (4, 4).
        robot_wrist_to_palm: Palm in the robot's wrist, shape (4, 4).
        is_still: Whether the robot's wrist is fixed.
        human_anchor: The human's anchor in its palm [m], shape (3,).
        robot_anchor: The robot's, likewise.
    """

    aligns_palms: bool
    alignment: Rotation
    scale: float
    human_wrist_to_palm: Pose
    robot_wrist_to_palm: Pose
    is_still: bool
    human_anchor: Point
    robot_anchor: Point


class FollowerModel(Model, frozen=True, kw_only=True):
    """A robot hand that follows a person's by teleoperation.

    Attributes:
        name: Short name of the robot hand.
        joint_names: Its n joints, in the order of commands.
        human_joint_names: The human's joints, in the order of its joint angles.
        dt: Usual time between samples [s].
        joint_tolerance: How far a human joint may be outside its limits [rad].
        human: The human's hand, scaled to the person, for joint angles.
        robot: The robot's hand.
        limits: Of its position, speed and acceleration.
        ik: Weights and settings of the QP.
        pairs: Pairs of shapes that it keeps apart; None for none.
        collisions: How it keeps them apart; goes with `pairs`.
        guard: The hand whose samples are judged.
        order_names: Names of `orders`.
        orders: Orders in which landmarks may come by mistake, shape (21,) each; ours comes first.
        landmarks: What reads landmarks.
        palm: How the palm follows.
        teleoperation: What targets are computed with.
    """

    name: str
    joint_names: tuple[str, ...]
    human_joint_names: tuple[str, ...]
    dt: float
    joint_tolerance: float
    human: HandModel
    robot: HandModel
    limits: BoxLimits
    ik: IkModel
    pairs: PairsModel | None
    collisions: CollisionModel | None
    guard: GuardModel
    order_names: tuple[str, ...]
    orders: tuple[Indices, ...]
    landmarks: LandmarkReaderModel
    palm: PalmFollowingModel
    teleoperation: TeleoperationModel
