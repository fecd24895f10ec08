"""From samples of a human hand to targets and a command of a robot's: what every sample needs."""

from .alignment import (
    Row,
    alignment_from_gestures,
    rotation_of,
    rotation_onto,
)
from .command_time import (
    check_dt,
    check_when,
    own_time,
)
from .hand_request import HandRequest
from .moving_robot import MovingRobot
from .palm import PalmMap
from .readers import (
    JointReader,
    LandmarkReader,
    check_joints,
)
from .reference import (
    Placement,
    Reference,
)
from .robot_hand import RobotHand
from .robot_step import (
    RequestStep,
    RobotStep,
)
from .step import (
    MapStep,
    RobotCommand,
    SampleStep,
    Stages,
    arm_held_by,
)
from .targets import (
    AnyPose,
    CoreMap,
    HumanPose,
    RobotPosture,
    Targets,
    core_pose,
)

__all__ = [
    "AnyPose",
    "CoreMap",
    "HandRequest",
    "HumanPose",
    "JointReader",
    "LandmarkReader",
    "MapStep",
    "MovingRobot",
    "PalmMap",
    "Placement",
    "Reference",
    "RequestStep",
    "RobotCommand",
    "RobotHand",
    "RobotPosture",
    "RobotStep",
    "Row",
    "SampleStep",
    "Stages",
    "Targets",
    "alignment_from_gestures",
    "arm_held_by",
    "check_dt",
    "check_joints",
    "check_when",
    "core_pose",
    "own_time",
    "rotation_of",
    "rotation_onto",
]
