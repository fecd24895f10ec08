"""Maps the motion of a human hand onto any robotic hand: homogeneous transformations and a QP.

from handmap_qp import HandMapper, load_hand

mapper = HandMapper(load_hand("human"), load_hand("three_finger"))
step = mapper.map_step(human_q, wrist_pose)

Public names are imported at their first use: `import handmap_qp` and the command line load no more
than they need.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from handmap_qp.errors import (
        DegeneratePointsError,
        HandError,
        HandmapError,
        InvalidInputError,
        InvalidOptionsError,
        MissingExtraError,
        MissingPackageError,
        RecordingError,
    )
    from handmap_qp.hands.hand import Hand
    from handmap_qp.hands.human import HumanLengths
    from handmap_qp.hands.library import hand_names, load_hand
    from handmap_qp.hands.spec import HandSpec, PointSpec
    from handmap_qp.hands.synergies import load_synergies
    from handmap_qp.human.recording import Recording
    from handmap_qp.human.sample import HumanSample
    from handmap_qp.ik.options import IkOptions
    from handmap_qp.ik.tasks import AttachedPoints, PointDistances, Task, TaskRows
    from handmap_qp.mapping.by_name import METHODS
    from handmap_qp.mapping.decomposition import (
        Decomposition,
        Primitives,
        decompose,
        primitives,
    )
    from handmap_qp.mapping.estimation import MotionEstimate, estimate_motion
    from handmap_qp.mapping.mapper import HandMapper
    from handmap_qp.mapping.method import Method
    from handmap_qp.mapping.methods.fingertip_vectors import FingertipVectors
    from handmap_qp.mapping.methods.homogeneous import (
        TELEMANIPULATION,
        Homogeneous,
        MappingOptions,
    )
    from handmap_qp.mapping.methods.joint_to_joint import JointToJoint
    from handmap_qp.mapping.methods.teleoperation import Teleoperation
    from handmap_qp.mapping.methods.virtual_object import (
        VirtualEllipsoid,
        VirtualSphere,
    )
    from handmap_qp.mapping.presets import PRESETS
    from handmap_qp.mapping.step import MapStep, RobotCommand
    from handmap_qp.stream.follower import Follower
    from handmap_qp.stream.smoothing import Smoothing
    from handmap_qp.trackers.formats import read_recording
    from handmap_qp.trackers.layouts.base import Layout
    from handmap_qp.trackers.layouts.tables import load_layout
    from handmap_qp.trackers.plausibility import InputCheck

__all__ = [
    "METHODS",
    "PRESETS",
    "TELEMANIPULATION",
    "AttachedPoints",
    "Decomposition",
    "DegeneratePointsError",
    "FingertipVectors",
    "Follower",
    "Hand",
    "HandError",
    "HandMapper",
    "HandSpec",
    "HandmapError",
    "Homogeneous",
    "HumanLengths",
    "HumanSample",
    "IkOptions",
    "InputCheck",
    "InvalidInputError",
    "InvalidOptionsError",
    "JointToJoint",
    "Layout",
    "MapStep",
    "MappingOptions",
    "Method",
    "MissingExtraError",
    "MissingPackageError",
    "MotionEstimate",
    "PointDistances",
    "PointSpec",
    "Primitives",
    "Recording",
    "RecordingError",
    "RobotCommand",
    "Smoothing",
    "Task",
    "TaskRows",
    "Teleoperation",
    "VirtualEllipsoid",
    "VirtualSphere",
    "decompose",
    "estimate_motion",
    "hand_names",
    "load_hand",
    "load_layout",
    "load_synergies",
    "primitives",
    "read_recording",
]

# Public names by the module that has them.
_NAMES = {
    "errors": "DegeneratePointsError HandError HandmapError InvalidInputError InvalidOptionsError "
    "MissingExtraError MissingPackageError RecordingError",
    "hands.hand": "Hand",
    "hands.human": "HumanLengths",
    "hands.library": "hand_names load_hand",
    "hands.spec": "HandSpec PointSpec",
    "hands.synergies": "load_synergies",
    "ik.options": "IkOptions",
    "ik.tasks": "AttachedPoints PointDistances Task TaskRows",
    "mapping.decomposition": "Decomposition Primitives decompose primitives",
    "mapping.estimation": "MotionEstimate estimate_motion",
    "mapping.mapper": "HandMapper",
    "mapping.method": "Method",
    "mapping.by_name": "METHODS",
    "mapping.methods.fingertip_vectors": "FingertipVectors",
    "mapping.methods.homogeneous": "Homogeneous MappingOptions TELEMANIPULATION",
    "mapping.methods.joint_to_joint": "JointToJoint",
    "mapping.methods.teleoperation": "Teleoperation",
    "mapping.methods.virtual_object": "VirtualEllipsoid VirtualSphere",
    "mapping.presets": "PRESETS",
    "mapping.step": "MapStep RobotCommand",
    "trackers.layouts.base": "Layout",
    "trackers.layouts.tables": "load_layout",
    "trackers.plausibility": "InputCheck",
    "human.recording": "Recording",
    "stream.follower": "Follower",
    "stream.smoothing": "Smoothing",
    "trackers.formats": "read_recording",
    "human.sample": "HumanSample",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("handmap-qp")
    elif name in _MODULES:
        value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__, "__version__"]
