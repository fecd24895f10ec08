"""Maps the motion of a human hand onto any robotic hand: homogeneous transformations and a QP.

from handmap_qp import HandMapper, load_hand

mapper = HandMapper(load_hand("human"), load_hand("three_finger"))
step = mapper.map_step(human_q, wrist_pose)

A name is imported at its first use: `import handmap_qp` and the client of the service load none of
the libraries of a mapping, and the command loads no more than it needs. The imports below are for
editors and type checkers; `_HOMES` has the same names for Python, which a test compares.
"""

# ruff: isort: skip_file

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .apps.onboarding import (
        Clue as Clue,
        DescribedHand as DescribedHand,
        HandFinding as HandFinding,
        HandReport as HandReport,
        InitResult as InitResult,
        check_hand as check_hand,
        check_robot as check_robot,
        init_hands as init_hands,
    )
    from .errors import (
        DegeneratePointsError as DegeneratePointsError,
        HandError as HandError,
        HandmapError as HandmapError,
        InvalidInputError as InvalidInputError,
        InvalidOptionsError as InvalidOptionsError,
        MapperBusyError as MapperBusyError,
        MissingExtraError as MissingExtraError,
        MissingPackageError as MissingPackageError,
        RecordingError as RecordingError,
    )
    from .hands import (
        AttachedPoints as AttachedPoints,
        Hand as Hand,
        HandSpec as HandSpec,
        HumanLengths as HumanLengths,
        PointSpec as PointSpec,
        hand_names as hand_names,
        load_hand as load_hand,
        load_synergies as load_synergies,
    )
    from .human import (
        HumanSample as HumanSample,
        Recording as Recording,
        sample_columns as sample_columns,
        scaled_human as scaled_human,
    )
    from .ik import (
        IkOptions as IkOptions,
        PointDistances as PointDistances,
        Task as Task,
        TaskRows as TaskRows,
    )
    from .mapping import (
        PRESETS as PRESETS,
        CustomMethod as CustomMethod,
        HandMapper as HandMapper,
        JointFunction as JointFunction,
        MapStep as MapStep,
        Method as Method,
        MotionEstimate as MotionEstimate,
        RobotCommand as RobotCommand,
        parse_object as parse_object,
    )
    from .mapping.by_name import METHODS as METHODS
    from .mapping.methods.fingertip_vectors import FingertipVectors as FingertipVectors
    from .mapping.methods.homogeneous import (
        TELEMANIPULATION as TELEMANIPULATION,
        Homogeneous as Homogeneous,
        MappingOptions as MappingOptions,
    )
    from .mapping.methods.joint_to_joint import JointToJoint as JointToJoint
    from .mapping.methods.teleoperation import Teleoperation as Teleoperation
    from .mapping.methods.virtual_object import (
        VirtualEllipsoid as VirtualEllipsoid,
        VirtualSphere as VirtualSphere,
    )
    from .reference import (
        Decomposition as Decomposition,
        Primitives as Primitives,
        PublishedMethod as PublishedMethod,
        decompose as decompose,
        estimate_motion as estimate_motion,
        primitives as primitives,
    )
    from .stream import (
        Follower as Follower,
        FollowingCheck as FollowingCheck,
        GripFollower as GripFollower,
        GripOptions as GripOptions,
        ObjectFollower as ObjectFollower,
        ObjectOptions as ObjectOptions,
        Smoothing as Smoothing,
    )
    from .version import __version__ as __version__
    from .trackers import (
        InputCheck as InputCheck,
        Layout as Layout,
        load_layout as load_layout,
        read_recording as read_recording,
    )

_HOMES: dict[str, tuple[str, ...]] = {
    "apps.onboarding": (
        "Clue",
        "DescribedHand",
        "HandFinding",
        "HandReport",
        "InitResult",
        "check_hand",
        "check_robot",
        "init_hands",
    ),
    "errors": (
        "DegeneratePointsError",
        "HandError",
        "HandmapError",
        "InvalidInputError",
        "InvalidOptionsError",
        "MapperBusyError",
        "MissingExtraError",
        "MissingPackageError",
        "RecordingError",
    ),
    "hands": (
        "AttachedPoints",
        "Hand",
        "HandSpec",
        "HumanLengths",
        "PointSpec",
        "hand_names",
        "load_hand",
        "load_synergies",
    ),
    "human": (
        "HumanSample",
        "Recording",
        "sample_columns",
        "scaled_human",
    ),
    "ik": (
        "IkOptions",
        "PointDistances",
        "Task",
        "TaskRows",
    ),
    "mapping": (
        "PRESETS",
        "CustomMethod",
        "HandMapper",
        "JointFunction",
        "MapStep",
        "Method",
        "MotionEstimate",
        "RobotCommand",
        "parse_object",
    ),
    "mapping.by_name": ("METHODS",),
    "mapping.methods.fingertip_vectors": ("FingertipVectors",),
    "mapping.methods.homogeneous": (
        "TELEMANIPULATION",
        "Homogeneous",
        "MappingOptions",
    ),
    "mapping.methods.joint_to_joint": ("JointToJoint",),
    "mapping.methods.teleoperation": ("Teleoperation",),
    "mapping.methods.virtual_object": (
        "VirtualEllipsoid",
        "VirtualSphere",
    ),
    "reference": (
        "Decomposition",
        "Primitives",
        "PublishedMethod",
        "decompose",
        "estimate_motion",
        "primitives",
    ),
    "stream": (
        "Follower",
        "FollowingCheck",
        "GripFollower",
        "GripOptions",
        "ObjectFollower",
        "ObjectOptions",
        "Smoothing",
    ),
    "trackers": (
        "InputCheck",
        "Layout",
        "load_layout",
        "read_recording",
    ),
    "version": ("__version__",),
}
"""Public names by the module that has them."""

_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME_OF)


def __dir__() -> list[str]:
    return [*globals(), *__all__]


if not TYPE_CHECKING:
    # Checkers read the imports above instead, so that they know a name that does not exist.
    def __getattr__(name: str) -> object:
        if name not in _HOME_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
        # Found once, it is an attribute like any other.
        globals()[name] = value
        return value
