"""The method: from a human sample to the targets and the command of a robot hand."""

from handmap_core.mapping.alignment import (
    Row,
    alignment_from_gestures,
    rotation_of,
    rotation_onto,
)
from handmap_core.mapping.command_time import check_dt, check_when, own_time
from handmap_core.mapping.estimation import MotionEstimate, MotionEstimator
from handmap_core.mapping.hand_request import HandRequest
from handmap_core.mapping.moving_robot import MovingRobot
from handmap_core.mapping.palm import PalmMap, palm_of
from handmap_core.mapping.readers import JointReader, LandmarkReader, check_joints
from handmap_core.mapping.reference import Placement, Reference
from handmap_core.mapping.robot_hand import RobotHand
from handmap_core.mapping.robot_step import RequestStep, RobotStep
from handmap_core.mapping.step import (
    MapStep,
    RobotCommand,
    SampleStep,
    Stages,
    arm_held_by,
)
from handmap_core.mapping.targets import (
    AnyPose,
    CoreMap,
    HumanPose,
    RobotPosture,
    Targets,
    core_pose,
)
from .alignment import AlignedOptions, find_alignment
from .assumed_speeds import ASSUMED_SHARE, AssumedSpeeds, assumed_joints, assumed_note
from .custom_method import (
    CustomMethod,
    JointAnswer,
    JointFunction,
    LandmarkFunction,
    joint_positions,
)
from .fist_time import PERSON_FIST_TIME, FistTime, fist_time, slow_note
from .hand_mapper import HandMapper
from .hand_pair import (
    KNUCKLES,
    HandPair,
    RobotFingers,
    bone_lengths,
    gap_task,
    points_in_palm,
    require_partners,
    resting_posture,
    robot_fingers,
    touching_distances,
)
from .method import FOLLOWING, PRESETS, Method, Preset, default_preset, get_preset
from .objects import (
    KINDS,
    Box,
    Cylinder,
    MeshShape,
    Shape,
    Sphere,
    distance,
    distances_to,
    geometry_of,
    nearest,
    parse_object,
    surface,
)
from .options_file import options_text, read_options
from .palm import PalmMethod, require_points
from .presets import (
    IK_NAMES,
    Choice,
    kept_options,
    known_options,
    possible_presets,
    preset_choice,
    preset_with,
)
from .robot_mapper import RobotMapper
from .target_source import TargetSource

__all__ = [
    "ASSUMED_SHARE",
    "FOLLOWING",
    "IK_NAMES",
    "KINDS",
    "KNUCKLES",
    "PERSON_FIST_TIME",
    "PRESETS",
    "AlignedOptions",
    "AnyPose",
    "AssumedSpeeds",
    "Box",
    "Choice",
    "CoreMap",
    "CustomMethod",
    "Cylinder",
    "FistTime",
    "HandMapper",
    "HandPair",
    "HandRequest",
    "HumanPose",
    "JointAnswer",
    "JointFunction",
    "JointReader",
    "LandmarkFunction",
    "LandmarkReader",
    "MapStep",
    "MeshShape",
    "Method",
    "MotionEstimate",
    "MotionEstimator",
    "MovingRobot",
    "PalmMap",
    "PalmMethod",
    "Placement",
    "Preset",
    "Reference",
    "RequestStep",
    "RobotCommand",
    "RobotFingers",
    "RobotHand",
    "RobotMapper",
    "RobotPosture",
    "RobotStep",
    "Row",
    "SampleStep",
    "Shape",
    "Sphere",
    "Stages",
    "TargetSource",
    "Targets",
    "alignment_from_gestures",
    "arm_held_by",
    "assumed_joints",
    "assumed_note",
    "bone_lengths",
    "check_dt",
    "check_joints",
    "check_when",
    "core_pose",
    "default_preset",
    "distance",
    "distances_to",
    "find_alignment",
    "fist_time",
    "gap_task",
    "geometry_of",
    "get_preset",
    "joint_positions",
    "kept_options",
    "known_options",
    "nearest",
    "options_text",
    "own_time",
    "palm_of",
    "parse_object",
    "points_in_palm",
    "possible_presets",
    "preset_choice",
    "preset_with",
    "read_options",
    "require_partners",
    "require_points",
    "resting_posture",
    "robot_fingers",
    "rotation_of",
    "rotation_onto",
    "slow_note",
    "surface",
    "touching_distances",
]
