from .apps.doctor import __version__ as __version__
from .apps.onboarding import Clue as Clue
from .apps.onboarding import DescribedHand as DescribedHand
from .apps.onboarding import HandFinding as HandFinding
from .apps.onboarding import HandReport as HandReport
from .apps.onboarding import InitResult as InitResult
from .apps.onboarding import check_hand as check_hand
from .apps.onboarding import check_robot as check_robot
from .apps.onboarding import init_hands as init_hands
from .errors import (
    DegeneratePointsError as DegeneratePointsError,
)
from .errors import (
    HandError as HandError,
)
from .errors import (
    HandmapError as HandmapError,
)
from .errors import (
    InvalidInputError as InvalidInputError,
)
from .errors import (
    InvalidOptionsError as InvalidOptionsError,
)
from .errors import (
    MapperBusyError as MapperBusyError,
)
from .errors import (
    MissingExtraError as MissingExtraError,
)
from .errors import (
    MissingPackageError as MissingPackageError,
)
from .errors import (
    RecordingError as RecordingError,
)
from .hands.configuration import AttachedPoints as AttachedPoints
from .hands.hand import Hand as Hand
from .hands.human import HumanLengths as HumanLengths
from .hands.library import (
    hand_names as hand_names,
)
from .hands.library import (
    load_hand as load_hand,
)
from .hands.spec import (
    HandSpec as HandSpec,
)
from .hands.spec import (
    PointSpec as PointSpec,
)
from .hands.synergies import load_synergies as load_synergies
from .human.measure import scaled_human as scaled_human
from .human.recording import Recording as Recording
from .human.recording import sample_columns as sample_columns
from .human.sample import HumanSample as HumanSample
from .ik.options import IkOptions as IkOptions
from .ik.tasks import (
    PointDistances as PointDistances,
)
from .ik.tasks import (
    Task as Task,
)
from .ik.tasks import (
    TaskRows as TaskRows,
)
from .mapping.by_name import METHODS as METHODS
from .mapping.decomposition import (
    Decomposition as Decomposition,
)
from .mapping.decomposition import (
    Primitives as Primitives,
)
from .mapping.decomposition import (
    decompose as decompose,
)
from .mapping.decomposition import (
    primitives as primitives,
)
from .mapping.estimation import (
    MotionEstimate as MotionEstimate,
)
from .mapping.estimation import (
    estimate_motion as estimate_motion,
)
from .mapping.mapper import HandMapper as HandMapper
from .mapping.method import PRESETS as PRESETS
from .mapping.method import (
    MapStep as MapStep,
)
from .mapping.method import Method as Method
from .mapping.method import (
    RobotCommand as RobotCommand,
)
from .mapping.methods.fingertip_vectors import FingertipVectors as FingertipVectors
from .mapping.methods.homogeneous import (
    TELEMANIPULATION as TELEMANIPULATION,
)
from .mapping.methods.homogeneous import (
    Homogeneous as Homogeneous,
)
from .mapping.methods.homogeneous import (
    MappingOptions as MappingOptions,
)
from .mapping.methods.joint_to_joint import JointToJoint as JointToJoint
from .mapping.methods.teleoperation import Teleoperation as Teleoperation
from .mapping.methods.virtual_object import (
    VirtualEllipsoid as VirtualEllipsoid,
)
from .mapping.methods.virtual_object import (
    VirtualSphere as VirtualSphere,
)
from .mapping.objects import parse_object as parse_object
from .stream.follower import Follower as Follower
from .stream.follower import Smoothing as Smoothing
from .stream.following import FollowingCheck as FollowingCheck
from .stream.grip import (
    GripFollower as GripFollower,
)
from .stream.hand_grip import GripOptions as GripOptions
from .stream.held_object import ObjectFollower as ObjectFollower
from .stream.held_object import ObjectOptions as ObjectOptions
from .trackers.formats import read_recording as read_recording
from .trackers.layouts.base import Layout as Layout
from .trackers.layouts.tables import load_layout as load_layout
from .trackers.plausibility import InputCheck as InputCheck

__all__: list[str]
