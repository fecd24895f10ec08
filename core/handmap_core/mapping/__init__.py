"""From samples of a human hand to targets and a command of a robot's: what every sample needs."""

from .command_time import (
    check_dt,
    check_when,
    own_time,
)
from .hand_request import HandRequest
from .readers import (
    JointReader,
    LandmarkReader,
    check_joints,
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
    "RobotCommand",
    "RobotPosture",
    "SampleStep",
    "Stages",
    "Targets",
    "arm_held_by",
    "check_dt",
    "check_joints",
    "check_when",
    "core_pose",
    "own_time",
]
