"""Maps the motion of a human hand onto any robotic hand: homogeneous transformations and a QP.

from handmap_qp import HandMapper, load_hand

mapper = HandMapper(load_hand("human"), load_hand("three_finger"))
step = mapper.map_step(human_q, wrist_pose)
"""

from importlib.metadata import version

from handmap_qp.decomposition import Decomposition, Primitives, decompose, primitives
from handmap_qp.errors import (
    DegeneratePointsError,
    HandError,
    HandmapError,
    InvalidInputError,
    InvalidOptionsError,
    MissingExtraError,
    RecordingError,
)
from handmap_qp.estimation import MotionEstimate, estimate_motion
from handmap_qp.hand import Hand
from handmap_qp.hand_spec import HandSpec, PointSpec
from handmap_qp.human import HumanLengths, load_synergies
from handmap_qp.ik.options import IkOptions
from handmap_qp.library import hand_names, load_hand
from handmap_qp.mapping import HandMapper
from handmap_qp.options import TELEMANIPULATION, MappingOptions
from handmap_qp.recording import Recording, read_recording
from handmap_qp.samples import MapStep, RobotCommand

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
