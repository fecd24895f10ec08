"""The compiled core (`core/src`, C++), as Python sees it.

Written by hand; `.ci/core_stub.py` compares it with the module. Models cross as
their bytes (`handmap_core.models.encode`). Arrays are of float64 and C-contiguous unless another
type is named. What is taken as an `object` may be anything: where it is not plain numbers of the
right shape, the answer is None, and Python looks at it.

Raises:
    ValueError: Of every call, if sizes or indices do not go together.
    MapperBusyError: Of calls that work on an object on which another thread works.
"""

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from handmap_core.human.findings import FindingNumbers
from handmap_core.human.sample import VerdictNumbers
from handmap_core.ik.motion import When
from handmap_core.ik.result import IkResult, Status
from handmap_core.mapping.step import RobotCommand, StepSummary
from handmap_core.mapping.targets import CoreMap, Targets
from handmap_core.se3 import Array

_Made_co = TypeVar("_Made_co", covariant=True)

SOURCES: str
"""Fingerprint of the sources that it was compiled from."""

def raise_if_busy(error: type[Exception]) -> None:
    """Set what is raised where a thread enters an object on which another one works."""

def model_fields() -> dict[str, list[tuple[str, str]]]:
    """Return names and forms of the fields of each model."""

# -- hands

class Tree:
    """The kinematics of a hand; made of a `HandModel`."""

    def __init__(self, hand: bytes) -> None: ...
    def moved(self, joints: Sequence[str], origins: Array, rolls: Array) -> Tree: ...
    def points(self, q: Array) -> Array: ...
    def points_on_links(
        self, q: Array, links: Sequence[str], offsets: Array
    ) -> Array: ...
    def points_on_joints(
        self, q: Array, joints: Sequence[int], offsets: Array
    ) -> Array: ...
    def joint_poses(self, q: Array) -> Array: ...
    def posture(self, q: Array) -> tuple[Array, Array]: ...
    def nearest_posture(
        self, targets: Array, costs: Array, rest_cost: float, start: Array
    ) -> Array: ...
    def pinching_postures(
        self,
        usual: Ik,
        joints: Sequence[int],
        offsets: Array,
        distances: Array,
        weight: float,
        dt: float,
        samples: int,
        tolerance: float,
    ) -> Array: ...
    def smallest_distances(self, pairs: PairBounds, q: Array, most: float) -> Array: ...

class PairBounds:
    """Pairs of shapes that are kept apart; made of a `PairsModel`."""

    def __init__(self, pairs: bytes) -> None: ...

# -- the gate

def loosened(
    G: Array, h: Array, lower: Array, upper: Array, stopping: float, so_far: Array
) -> Array: ...

class Gate:
    """Admits the displacements of a robot; made of `BoxLimits` and a `CollisionModel`."""

    def __init__(
        self,
        tree: Tree,
        limits: bytes,
        pairs: PairBounds | None = None,
        collisions: bytes | None = None,
    ) -> None: ...
    @property
    def held_by(self) -> int: ...
    @property
    def stamp(self) -> int: ...
    @property
    def commands(self) -> int: ...
    @property
    def time(self) -> float: ...
    @property
    def motion(self) -> tuple[Array, Array, float, Array, float]: ...
    def set_motion(
        self,
        q: Array,
        displacement: Array,
        dt: float,
        stop_times: Array,
        time: float = 0.0,
    ) -> None: ...
    def follow(self, leader: Gate) -> None: ...
    def interval(self, when: When) -> tuple[float, float, float]: ...
    def bounds(self, when: When, share: float = 1.0) -> Array: ...
    def advance(
        self, goal: Array, when: When, share: float = 1.0, stops: bool = False
    ) -> bool: ...
    def admit(self, wanted: Array, first: Array, when: When) -> Array: ...
    def brake(self, when: When) -> Array: ...

class PosedRows:
    """Rows of the next command, of a QP that is posed and solved elsewhere."""

    def __init__(
        self,
        gate: Gate,
        when: When,
        lower: Array,
        upper: Array,
        margins: Array | None = None,
    ) -> None: ...
    def behind(self, so_far: Array) -> tuple[Array, Array]: ...
    def at_end(self, displacement: Array) -> tuple[Array, Array] | None: ...
    def admit(
        self,
        wanted: Array,
        first: Array,
        around: Callable[[tuple[Array, Array]], Array],
    ) -> Array: ...
    def pressed_pair(self, slope: Array, step: Array) -> int: ...

# -- inverse kinematics

class PointDistances:
    """Pairs of points whose distances are asked for; made of a `DistancesModel`."""

    def __init__(self, distances: bytes) -> None: ...

Distances = tuple[PointDistances, Array, Array]
"""Pairs of points, their wanted distances, and the weight of each."""

Offset = tuple[Sequence[int], Array, Array, float]
"""Joints and places of two points, the wanted offset, and its weight."""

def task_rows(
    tree: Tree, q: Array, task: Distances | Offset
) -> tuple[Array, Array, Array]:
    """Return residual, Jacobian and damping of a task in a configuration; see `TaskRows`."""

Detour = tuple[Array | None, Array | None, Array]
"""The detour of a hand, to go on with: its posture, its targets, and all of its numbers."""

class Ik(Gate):
    """Moves a robot by QPs, through its gate; made of an `IkModel` and as a `Gate` is."""

    def __init__(
        self,
        tree: Tree,
        options: bytes,
        limits: bytes,
        pairs: PairBounds | None = None,
        collisions: bytes | None = None,
    ) -> None: ...
    @property
    def costs(self) -> int: ...
    @property
    def queries(self) -> int: ...
    @property
    def detours(self) -> list[Detour]: ...
    def go_on(self, detours: Sequence[Detour]) -> None: ...
    def hold(self, when: When) -> Step: ...
    def solve(
        self,
        points: Array,
        wrists: Array | None,
        rest: Array,
        when: When,
        margins: Array | None = None,
        speed: float = 1.0,
        regularisation: Array | None = None,
        distances: Sequence[Distances] = [],
        offsets: Sequence[Offset] = [],
        rows: Callable[[Array], Sequence[tuple[Array, Array, Array | float]]]
        | None = None,
    ) -> Step:
        """Move the robot; see `Goal`.

        Args:
            points: Targets of the reference points, shape (m, 3).
            wrists: Targets of the wrists, shape (h, 4, 4).
            rest: Joint positions that the rest term pulls to, shape (n,).
            when: As of `Gate.interval`.
            margins: Of each pair of shapes.
            speed: Share of the speed limits.
            regularisation: Share of the weights of the rest term and of the damping, shape (n,).
            distances: Tasks of the cost.
            offsets: Likewise.
            rows: Returns residual, Jacobian and damping of each task of Python in a configuration.
        """

# -- samples of a human hand

def array_of_rows(rows: tuple[tuple[float, float, float], ...]) -> Array:
    """Return rows of three numbers as an array (n, 3)."""

def tip_gaps(landmarks: Array) -> list[float]:
    """Return the distances of landmarks (21, 3): from the thumb's tip to the other tips."""

class HumanPose:
    """A human hand at one instant; see `mapping.HumanPose`."""

    def __init__(self, points: Array, wrist: Array | None) -> None: ...
    @property
    def points(self) -> Array: ...
    @property
    def wrist(self) -> Array | None: ...

class Samples:
    """The columns of a recording of T samples."""

    def __init__(
        self,
        time: Array,
        landmarks: Array,
        valid: NDArray[np.bool_],
        confidence: Array | None = None,
        wrist: Array | None = None,
    ) -> None: ...

class LandmarkReader:
    """Turns landmarks into samples; made of a `LandmarkReaderModel`."""

    def __init__(self, model: bytes) -> None: ...
    def read(self, landmarks: object, wrist: object) -> HumanPose | None: ...
    def pose_of(self, landmarks: Array, wrist: Array | None) -> HumanPose:
        """Return the sample of numbers that are checked; without a wrist, it is fitted."""

class JointReader:
    """Turns joint angles into samples of a hand."""

    def __init__(self, tree: Tree) -> None: ...
    def read(self, q: object, wrist: object) -> HumanPose | None: ...
    def pose_of(self, q: Array, wrist: Array) -> HumanPose:
        """Return the sample of numbers that are checked, also beyond the joints' limits."""

# -- the return after a hold

FADING_SPEEDS: tuple[float, float, float]
"""Largest speeds that fading adds to a point and to the wrist [m/s], and to its turn [rad/s]."""

def minimum_jerk(share: float) -> float:
    """Go from 0 to 1 with no speed and no acceleration at either end (Flash and Hogan 1985)."""

def offset_of_return(
    pose: HumanPose, seen: HumanPose, palm_fades: bool, lost: float
) -> tuple[Array, float]:
    """Return what is added to samples, shape (n + 2, 3), and the time in which it fades [s]."""

def pose_with_offset(
    pose: HumanPose, offset: Array, left: float, palm_fades: bool
) -> HumanPose:
    """Return a pose with the part of an offset that is left."""

# -- targets of a robot

def palm_of_reference(
    following: bytes, human_wrist: Array, robot_wrist: Array
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Return `start`, `alignment`, `rotation`, `origin`, `offset`, `human_start` of a `PalmMap`.

    Args:
        following: A `PalmFollowingModel`.
        human_wrist: The human's wrist at the reference, shape (4, 4).
        robot_wrist: The robot's, likewise.
    """

def start_palm(following: bytes, human_wrist: Array) -> Array:
    """Return where a robot without a place has its palm at a reference, shape (4, 4)."""

class PalmMap:
    """How a robot's palm follows the human's; made of a `PalmModel`."""

    def __init__(self, model: bytes) -> None: ...
    def follow(self, human: Array) -> Array:
        """Return the target of the robot's palm for the human's, shape (4, 4) both."""

    def person_at(self, wrist: Array) -> Array:
        """Return the palm of a human's wrist in the robot's world, shape (4, 4) both."""

class LedPalm:
    """A robot's palm, and the person's that leads it."""

    def __init__(self, map: PalmMap, person: Array) -> None:
        """Take a map, and the person's palm in the robot's world, shape (4, 4)."""

    def turn(self, wrist: Array, share: float) -> Array:
        """Return the motion that turns the target of a wrist to the person's axes.

        Args:
            wrist: The target, shape (4, 4).
            share: Share of the turn, from 0 to 1.
        """
    def meeting(
        self,
        wrist: Array,
        other: LedPalm,
        other_wrist: Array,
        near: float,
        together: float,
    ) -> tuple[Array, Array, Array, float] | None:
        """Return how this palm and another one are seen from each other as the person's.

        Args:
            wrist: Target of the wrist, shape (4, 4).
            other: The other palm.
            other_wrist: Target of its wrist.
            near: Distance of the person's palms at which the robot's begin to go by it [m].
            together: Distance at which they wholly do [m].

        Returns:
            The motions of both hands' targets, shape (4, 4); offset of the other palm's anchor from
            this one's [m], shape (3,), and the share of its weight. None for palms that are not
            near, or go by different alignments.
        """

class TargetMap:
    """Turns samples into targets, from a reference on."""

    def targets(self, pose: HumanPose) -> tuple[list[Array], bool]:
        """Return the arrays of a sample's targets, and whether a stretch is clamped.

        Raises:
            ValueError: If the pose has another number of points, or lacks a wrist that is needed.
        """

class TeleoperationMap(TargetMap):
    """Made of a `TeleoperationModel`, and of the `PalmModel` of a reference."""

    def __init__(self, model: bytes, palm: bytes) -> None: ...

class HomogeneousMap(TargetMap):
    """Made of a `HomogeneousModel`."""

    def __init__(self, model: bytes) -> None: ...

# -- steps

class Step:
    """Where a robot has moved in one sample; see `IkResult`."""

    @property
    def status(self) -> Status: ...
    @property
    def points(self) -> Array: ...
    @property
    def targets(self) -> Array: ...
    @property
    def q(self) -> Array: ...
    @property
    def wrists(self) -> Array: ...
    @property
    def displacement(self) -> Array: ...
    @property
    def active(self) -> NDArray[np.int8]: ...
    @property
    def iterations(self) -> int: ...
    @property
    def last_step(self) -> float: ...
    @property
    def held_by(self) -> int:
        """The pair of shapes that holds the robot back; -1 for none."""

class StepViews:
    """Makes the objects of a step that are asked for."""

    def __init__(
        self,
        targets: Callable[[list[Array], bool], Targets],
        ik: Callable[[Stages], IkResult],
        command: Callable[[Array, Array], RobotCommand],
        summary: Callable[
            [list[float], tuple[float, float], list[bool], float, tuple[str, ...]],
            StepSummary,
        ],
    ) -> None: ...

class Stages(Step):
    """The stages of a step; see `mapping.Stages`."""

    @property
    def pose(self) -> HumanPose: ...
    @property
    def asked(self) -> Targets: ...
    @property
    def ik(self) -> IkResult: ...
    @property
    def command(self) -> RobotCommand: ...
    @property
    def summary(self) -> StepSummary: ...

class SampleReader(Generic[_Made_co]):
    """Reads the samples after a reference; makes `Stages` of each, or a `HandRequest`."""

    def follow(self, pose: HumanPose, when: When, speed: float) -> _Made_co: ...
    @overload
    def map(
        self, reader: JointReader | None, q: object, wrist: object, when: object
    ) -> tuple[_Made_co, float] | None: ...
    @overload
    def map(
        self,
        reader: LandmarkReader | None,
        landmarks: object,
        wrist: object,
        when: object,
    ) -> tuple[_Made_co, float] | None: ...
    def map_sample(
        self,
        guard: StreamGuard,
        smoother: Smoother,
        reader: LandmarkReader,
        time: float,
        landmarks: object,
        wrist: object,
        valid: bool,
        confidence: float,
        when: object,
        arrival: float | None,
        origin: float | None,
    ) -> tuple[VerdictNumbers, _Made_co | None, float] | None: ...

class HandMapper(SampleReader[Stages]):
    """Maps the samples after a reference to commands; see `mapping.HandMapper`."""

    def __init__(self, ik: Ik, target_map: TargetMap, views: StepViews) -> None: ...
    def run(
        self,
        guard: StreamGuard,
        smoother: Smoother,
        reader: LandmarkReader,
        origin: float,
        samples: Samples,
        first: int,
        last: int,
        rows: Array,
    ) -> tuple[int, VerdictNumbers | None, HumanPose | None]: ...

class HandRequest:
    """What one hand of a person asks of a robot; see `mapping.HandRequest`."""

    @property
    def pose(self) -> HumanPose: ...
    @property
    def map(self) -> CoreMap: ...
    @property
    def dt(self) -> float: ...
    @property
    def speed(self) -> float: ...
    @property
    def rest(self) -> Array: ...
    @property
    def targets(self) -> Targets: ...

class TargetSource(SampleReader[HandRequest]):
    """Makes a request of each sample after a reference; see `mapping.TargetSource`."""

    def __init__(
        self, ik: Ik, target_map: TargetMap, views: StepViews, python_map: CoreMap
    ) -> None: ...

class RobotMapper:
    """Moves a robot for the requests of its hands; made of a `RobotModel`."""

    def __init__(self, ik: Ik, model: bytes, views: StepViews) -> None: ...
    def move(
        self,
        requests: Sequence[HandRequest],
        since: Sequence[float],
        worlds: Array | None,
        when: When,
    ) -> tuple[Stages, list[Stages]]: ...

# -- what judges and smooths a stream

RULES: tuple[str, ...]
MISTAKES: tuple[str, ...]
BONES: tuple[tuple[int, int], ...]
NEIGHBOURS: tuple[tuple[int, int], ...]
LONGEST_STEP: float
BEHIND: float
GAP: float
FROZEN_AFTER: float
SETTLE_TIME: float
UNPROVEN_SPEED: float
PALM_RATIOS: tuple[float, float]
HAND_LENGTHS: tuple[float, float]
SAMPLE_STEPS: tuple[float, float]
BACKWARDS: float
SURE_SIDE: float
RESIZED: float
FIRST_SIZES: int
SMOOTHING: tuple[float, float]
"""Acceleration that a point at rest may have [m/s^2], and its rise with speed [1/s]."""
WRIST_CONVENTIONS: Array

class SampleClock:
    """State of a stream's clock after a sample."""

    def __init__(self) -> None: ...
    def advance(self, stamp: float) -> SampleClock: ...
    def at(self, stamp: float) -> SampleClock: ...
    @property
    def period(self) -> float: ...
    @property
    def rule(self) -> str: ...
    @property
    def elapsed(self) -> float: ...
    @property
    def dt(self) -> float: ...
    @property
    def is_idle(self) -> bool: ...
    @property
    def is_set_back(self) -> bool: ...
    @property
    def shortest(self) -> float: ...

class ArrivalCredit:
    """Time that the next samples may account for, by the times at which they arrive."""

    def __init__(self) -> None: ...
    def spend(self, dt: float, arrival: float) -> tuple[ArrivalCredit, float]: ...

class RateCheck:
    """Compares the time of a stream with the time at which its samples arrive."""

    def __init__(self) -> None: ...
    def grant(self, dt: float, arrival: float) -> float: ...
    def update(self, stamp: float, arrival: float) -> float | None: ...

class Track:
    """A sample, and the motion that led to it."""

    def __init__(self, time: float, landmarks: Array) -> None: ...
    @property
    def velocity(self) -> Array: ...
    @property
    def turning(self) -> Array: ...
    @property
    def bending(self) -> Array: ...

class Change:
    """The motion from a track to a sample."""

    @property
    def track(self) -> Track: ...
    @property
    def sizes(self) -> Array: ...
    @property
    def noise(self) -> float: ...
    @property
    def is_mirrored(self) -> bool: ...

def change_between(track: Track, sample: Track, dt: float) -> Change: ...

class LandmarkOrders:
    """Orders in which landmarks may come; ours comes first."""

    def __init__(self, orders: Sequence[Sequence[int]]) -> None: ...

class InputCheck:
    """Tells wrong input from a human hand."""

    def __init__(self, side: str, orders: LandmarkOrders) -> None: ...
    def save(self) -> bytes: ...
    def restore(self, saved: bytes) -> None: ...
    def update(
        self, time: float, landmarks: Array, wrist: Array | None = None
    ) -> FindingNumbers | None: ...
    def alert(self) -> None: ...
    def finish(self) -> FindingNumbers | None: ...
    def examine(self, samples: Samples) -> FindingNumbers | None: ...
    def finding(self) -> FindingNumbers | None: ...
    def is_wrist_proven(self) -> bool: ...

class StreamGuard:
    """Judges the samples of one hand; made of a `GuardModel`."""

    def __init__(self, model: bytes, orders: LandmarkOrders) -> None: ...
    def save(self) -> tuple[bytes, bytes, bytes]: ...
    def restore(self, saved: tuple[bytes, bytes, bytes]) -> None: ...
    def forget(self) -> None: ...
    def check(
        self,
        time: float,
        landmarks: Array,
        wrist: Array | None,
        valid: bool,
        confidence: float,
        arrival: float | None,
    ) -> VerdictNumbers: ...
    def holds(self, samples: Samples) -> NDArray[np.bool_]: ...

class Smoother:
    """Smooths the samples of one hand as much as they are noisy."""

    def __init__(self, acceleration: float | None, speed_gain: float) -> None: ...
    def save(self) -> tuple[int, bool, Array]: ...
    def restore(self, saved: tuple[int, bool, Array]) -> None: ...
    def smooth(self, pose: HumanPose, dt: float) -> HumanPose: ...
    def wait(self, dt: float) -> None: ...
    def restart(self) -> None: ...
    def forget(self) -> None: ...

# -- measures

def measure_shape(
    landmarks: Array, palm: Array, largest_roll: float
) -> tuple[Array, Array, float]: ...
def log3(rotation: Array) -> Array: ...
def exp3(turn: Array) -> Array: ...
def quat_xyzw(rotation: Array) -> Array: ...
def smoothstep(x: Array) -> Array:
    """Go from 0 at 0 to 1 at 1 with no slope at either end, shape (n,)."""

def smallest_gap(
    time: Array, landmarks: Array, median_time: float, percentile: float
) -> float: ...
def log_size(landmarks: Array) -> float: ...
def misfit(landmarks: Array) -> float: ...
def palmar_evidence(landmarks: Array) -> Array: ...
def palm_axes(landmarks: Array, sign: float) -> Array: ...
def measure_episode(
    samples: Samples,
    followed: NDArray[np.bool_],
    point_error: Array,
    at_limit: NDArray[np.bool_],
    at_speed_limit: NDArray[np.bool_],
    q: Array,
) -> dict[str, float]: ...
def solve_qp(
    H: Array,
    c: Array,
    lower: Array,
    upper: Array,
    G: Array | None = None,
    h: Array | None = None,
) -> tuple[bool, Array, int]: ...
def measure_shapes(
    a: bytes, pose_a: Array, b: bytes, pose_b: Array
) -> tuple[float, tuple[float, float, float], tuple[float, float, float]]:
    """Return distance, normal, and the nearest point of the first of two `ShapeModel`."""
