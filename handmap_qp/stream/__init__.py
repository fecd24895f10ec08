"""Which samples of a tracker the robot follows."""

from handmap_core.stream.following import FollowingCheck
from handmap_core.stream.hand_grip import GripOptions
from handmap_core.stream.smoothing import SMOOTH_IK, Smoothing
from handmap_core.stream.step_table import RULE_NAMES, STATUS_NAMES, StepTable
from .follower import Follower
from .grasp import can_grip, gripping_presets, has_grasp
from .grip import GripFollower, RobotGripFollower, gripping
from .guard import BEHIND, StreamGuard
from .held_object import ObjectFollower, ObjectOptions, follow_recording
from .measurement import measure_person
from .robot_follower import RobotFollower, paired, paired_parts

__all__ = [
    "BEHIND",
    "RULE_NAMES",
    "SMOOTH_IK",
    "STATUS_NAMES",
    "Follower",
    "FollowingCheck",
    "GripFollower",
    "GripOptions",
    "ObjectFollower",
    "ObjectOptions",
    "RobotFollower",
    "RobotGripFollower",
    "Smoothing",
    "StepTable",
    "StreamGuard",
    "can_grip",
    "follow_recording",
    "gripping",
    "gripping_presets",
    "has_grasp",
    "measure_person",
    "paired",
    "paired_parts",
]
