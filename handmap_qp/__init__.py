"""Maps the motion of a human hand onto any robotic hand: homogeneous transformations and a QP.

from handmap_qp import HandMapper, load_hand

mapper = HandMapper(load_hand("human"), load_hand("three_finger"))
step = mapper.map_step(human_q, wrist_pose)
"""

from importlib.metadata import version

from handmap_qp.errors import (
    DegeneratePointsError,
    HandError,
    HandmapError,
    InvalidInputError,
    InvalidOptionsError,
    MissingExtraError,
    RecordingError,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.library import hand_names, load_hand
from handmap_qp.hands.spec import HandSpec, PointSpec
from handmap_qp.hands.synergies import load_synergies
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.decomposition import Decomposition, Primitives, decompose, primitives
from handmap_qp.mapping.estimation import MotionEstimate, estimate_motion
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.options import TELEMANIPULATION, MappingOptions
from handmap_qp.mapping.step import MapStep, RobotCommand
from handmap_qp.trackers.recording import Recording, read_recording

__version__ = version("handmap-qp")

__all__ = [
    "TELEMANIPULATION",
    "Decomposition",
    "DegeneratePointsError",
    "Hand",
    "HandError",
    "HandMapper",
    "HandSpec",
    "HandmapError",
    "HumanLengths",
    "IkOptions",
    "InvalidInputError",
    "InvalidOptionsError",
    "MapStep",
    "MappingOptions",
    "MissingExtraError",
    "MotionEstimate",
    "PointSpec",
    "Primitives",
    "Recording",
    "RecordingError",
    "RobotCommand",
    "decompose",
    "estimate_motion",
    "hand_names",
    "load_hand",
    "load_synergies",
    "primitives",
    "read_recording",
]
