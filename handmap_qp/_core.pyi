"""The compiled core (`core/`, C++). `.ci/core_stub.py` compares this file with the module.

Bytes are those of a model (`handmap_qp.models.encode`). Wrong sizes and indices raise ValueError,
and leave the state as it was. Joints of points count as Pinocchio's do: 0 is the world.
"""

from collections.abc import Callable, Sequence
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handmap_qp.ik.qp import IkResult, Status
from handmap_qp.mapping import method
from handmap_qp.mapping.method import RobotCommand, StepSummary, Targets

Array = NDArray[np.float64]
When = float | tuple[float, float]
"""Time since the last command [s], or an instant with the longest time that it may take [s]."""
Rows = tuple[Array, Array]
"""G, shape (r, k), and h, shape (r,), of `G x <= h`."""
MotionNumbers = tuple[Array, Array, float, Array, float]
"""q, displacement, dt, stop times and time, as of `ik.motion.Motion`."""
DetourNumbers = tuple[Array | None, Array, Array, float, float]
"""Of each hand: posture to pass, targets it was found for, errors where none was, times [s]."""
TaskRowsLike = tuple[ArrayLike, ArrayLike, ArrayLike]
"""Residual, Jacobian and damping, as of `ik.tasks.TaskRows`."""
FindingNumbers = tuple[str, str, float, int]
"""Rule, mistake, number and index, as of `human.findings.Finding`."""
VerdictNumbers = tuple[
    str, bool, bool, float, float, FindingNumbers | None, float, float
]
"""In the order of `human.sample.Verdict`."""

SOURCES: str

def raise_if_busy(error: type[Exception]) -> None: ...
def model_fields() -> dict[str, list[tuple[str, str]]]: ...

class Tree:
    """The kinematics of a hand, of the bytes of a `HandModel`.

    Points are in axes of the palm, for joint positions q, shape (n,) or (T, n).
    """

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
    def smallest_distances(
        self, pairs: PairBounds, q: Array, starts: Sequence[int], most: float
    ) -> Array: ...

class PairBounds:
    """Pairs of shapes of a hand, of the bytes of a `PairsModel`."""

    def __init__(self, pairs: bytes) -> None: ...

def loosened(
    G: Array, h: Array, lower: Array, upper: Array, stopping: float, so_far: Array
) -> Array: ...
def braking_displacement(distance: float, change: float) -> float: ...

class Gate:
    """Admits the displacements of a robot: see `ik.gate`, and `core/gate.hpp`.

    Of a tree, the bytes of `BoxLimits`, and the pairs that it keeps apart with the bytes of a
    `CollisionModel`.
    """

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
    def motion(self) -> MotionNumbers: ...
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
    """Rows of a QP that is posed and solved elsewhere: see `Gate.rows`."""

    def __init__(
        self,
        gate: Gate,
        when: When,
        lower: Array,
        upper: Array,
        margins: Array | None = None,
    ) -> None: ...
    def behind(self, so_far: Array) -> Rows: ...
    def at_end(self, displacement: Array) -> Rows | None: ...
    def admit(
        self, wanted: Array, first: Array, around: Callable[[Rows], Array]
    ) -> Array: ...
    def pressed_pair(self, slope: Array, step: Array) -> int: ...

STATUSES: tuple[Status, ...]

class Step:
    """A step of a robot: names and shapes are those of `ik.qp.IkResult`."""

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
    def held_by(self) -> int: ...

class PointDistances:
    """Pairs of points of which distances are kept, of the bytes of a `DistancesModel`."""

    def __init__(self, distances: bytes) -> None: ...

class Ik(Gate):
    """Moves a robot by QPs, through its gate; made of the bytes of an `IkModel`, too."""

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
    def detours(self) -> list[DetourNumbers]: ...
    def go_on(self, detours: Sequence[DetourNumbers]) -> None: ...
    def hold(self, when: When) -> Step: ...
    def solve(
        self,
        points: Array,
        wrists: Array | None,
        postures: Sequence[tuple[float | Array, Array]],
        when: When,
        margins: Array | None = None,
        speed: float = 1.0,
        damping_shares: Array | None = None,
        distances: Sequence[tuple[PointDistances, Array, Array]] = ...,
        offsets: Sequence[tuple[Sequence[int], Array, Array, float]] = ...,
        rows: Callable[[Array], Sequence[TaskRowsLike]] | None = None,
    ) -> Step: ...
    def solve_many(
        self,
        points: Array,
        wrists: Array | None,
        dt: Array,
        speed: Array,
        margins: Array | None,
        postures: Sequence[tuple[float | Array, Array]],
    ) -> Array: ...

class HumanPose:
    """Points of a human hand (m, 3) [m], and its wrist (4, 4).

    It takes the place of `mapping.method.HumanPose`, whose fields it has, where it is only read.
    """

    def __init__(self, points: Array, wrist: Array | None) -> None: ...
    @property
    def points(self) -> Array: ...
    @property
    def in_wrist(self) -> Array: ...
    @property
    def wrist(self) -> Array | None: ...

class TargetMap:
    """Makes targets of samples of a human hand, since a reference."""

class TeleoperationMap(TargetMap):
    def __init__(self, model: bytes, palm: bytes) -> None: ...

class HomogeneousMap(TargetMap):
    def __init__(self, model: bytes) -> None: ...

class LandmarkReader:
    """Turns landmarks (21, 3) [m] into samples; None for what Python has to look at."""

    def __init__(self, model: bytes) -> None: ...
    def read(
        self, landmarks: object | None, wrist: object | None
    ) -> method.HumanPose | None: ...

class JointReader:
    """Turns joint angles (n,) into samples; None for what Python has to look at."""

    def __init__(self, tree: Tree) -> None: ...
    def read(
        self, q: object | None, wrist: object | None
    ) -> method.HumanPose | None: ...

class StepViews:
    """Makes the objects of Python of a step, when they are asked for."""

    def __init__(
        self,
        targets: Callable[[list[Array], bool], Targets],
        ik: Callable[[Step], IkResult],
        command: Callable[[Array, Array], RobotCommand],
        summary: Callable[..., StepSummary],
    ) -> None: ...

class Stages(Step):
    """All stages of a step."""

    @property
    def pose(self) -> HumanPose: ...
    @property
    def summary(self) -> StepSummary: ...
    @property
    def asked(self) -> Targets: ...
    @property
    def ik(self) -> IkResult: ...
    @property
    def command(self) -> RobotCommand: ...

class SampleReader:
    """Maps samples after a reference; None for those that Python has to look at."""

    def __reduce__(self) -> tuple[object, ...]: ...
    def follow(self, pose: HumanPose, when: When, speed: float) -> object: ...
    @overload
    def map(
        self,
        reader: JointReader | None,
        q: object | None,
        wrist: object | None,
        when: When,
    ) -> tuple[object, float] | None: ...
    @overload
    def map(
        self,
        reader: LandmarkReader | None,
        landmarks: object | None,
        wrist: object | None,
        when: When,
    ) -> tuple[object, float] | None: ...
    def map_sample(
        self,
        guard: StreamGuard,
        smoother: Smoother,
        reader: LandmarkReader,
        time: float,
        landmarks: object,
        wrist: object | None,
        valid: bool,
        confidence: float,
        when: When | None,
        arrival: float | None,
        origin: float | None,
    ) -> tuple[VerdictNumbers, object, float] | None: ...

class SampleMapper(SampleReader):
    """Maps samples to `Stages` of one hand."""

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

class Asker(SampleReader):
    """Maps samples to an `Ask` of one hand of a robot."""

    def __init__(
        self, ik: Ik, target_map: TargetMap, views: StepViews, source: object
    ) -> None: ...

class Ask:
    """What one hand of a robot asks for."""

    @property
    def pose(self) -> HumanPose: ...
    @property
    def map(self) -> object: ...
    @property
    def dt(self) -> float: ...
    @property
    def speed(self) -> float: ...
    @property
    def rest(self) -> Array: ...
    @property
    def targets(self) -> Array: ...

class RobotMover:
    """Moves all hands of a robot at once."""

    def __init__(self, ik: Ik, model: bytes, views: StepViews) -> None: ...
    def __reduce__(self) -> tuple[object, ...]: ...
    def move(
        self,
        asks: Sequence[Ask],
        since: Sequence[float],
        worlds: Array | None,
        when: When,
    ) -> tuple[object, list[object]]: ...

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

class SampleClock:
    """The clock of a stream: see `stream.guard`."""

    def __init__(self) -> None: ...
    def advance(self, stamp: float) -> SampleClock: ...
    def at(self, stamp: float) -> SampleClock: ...
    @property
    def period(self) -> float: ...
    @property
    def late_count(self) -> int: ...
    @property
    def rule(self) -> str: ...
    @property
    def elapsed(self) -> float: ...
    @property
    def dt(self) -> float: ...
    @property
    def passed(self) -> float: ...
    @property
    def is_idle(self) -> bool: ...
    @property
    def is_set_back(self) -> bool: ...
    @property
    def shortest(self) -> float: ...
    def __getstate__(self) -> bytes: ...
    def __setstate__(self, arg: bytes, /) -> None: ...

class ArrivalCredit:
    """Time that a stream has left, by the arrival of its samples."""

    def __init__(self) -> None: ...
    def spend(self, dt: float, arrival: float) -> tuple[ArrivalCredit, float]: ...
    def __getstate__(self) -> bytes: ...
    def __setstate__(self, arg: bytes, /) -> None: ...

class RateCheck:
    """Compares time stamps with arrivals."""

    def __init__(self) -> None: ...
    def grant(self, dt: float, arrival: float) -> float: ...
    def update(self, stamp: float, arrival: float) -> float | None: ...

class Track:
    """A hand that is followed from sample to sample."""

    def __init__(self, time: float, landmarks: Array) -> None: ...
    @property
    def velocity(self) -> Array: ...
    @property
    def turning(self) -> Array: ...
    @property
    def bending(self) -> Array: ...

class Change:
    """What has changed from one sample to the next."""

    @property
    def track(self) -> Track: ...
    @property
    def sizes(self) -> Array: ...
    @property
    def noise(self) -> float: ...
    @property
    def is_mirrored(self) -> bool: ...
    @property
    def is_alone(self) -> bool: ...

def change_between(track: Track, sample: Track, dt: float) -> Change: ...

class LandmarkOrders:
    """Orders that landmarks may come in."""

    def __init__(self, orders: Sequence[Sequence[int]]) -> None: ...

class Samples:
    """Samples of a recording: times (T,), landmarks (T, 21, 3), wrists (T, 4, 4)."""

    def __init__(
        self,
        time: Array,
        landmarks: Array,
        valid: NDArray[np.bool_],
        confidence: Array | None = None,
        wrist: Array | None = None,
    ) -> None: ...

class InputCheck:
    """Finds mistakes of an input: see `trackers.plausibility`."""

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
    """Judges the samples of a stream: see `stream.guard`."""

    def __init__(self, model: bytes, orders: LandmarkOrders) -> None: ...
    def save(self) -> tuple[bytes, bytes, bytes]: ...
    def restore(self, saved: tuple[bytes, bytes, bytes]) -> None: ...
    def forget(self) -> None: ...
    def check(
        self,
        time: float,
        landmarks: object,
        wrist: object | None,
        valid: bool,
        confidence: float,
        arrival: float | None,
    ) -> VerdictNumbers: ...
    def holds(self, samples: Samples) -> Array: ...

class Smoother:
    """Smooths samples: see `stream.follower.Smoothing`."""

    def __init__(self, acceleration: float | None, speed_gain: float) -> None: ...
    def save(self) -> tuple[int, bool, Array]: ...
    def restore(self, saved: tuple[int, bool, Array]) -> None: ...
    def smooth(self, pose: HumanPose, dt: float) -> HumanPose: ...
    def wait(self, dt: float) -> None: ...
    def restart(self) -> None: ...
    def forget(self) -> None: ...

def measure_shape(
    landmarks: Array, palm: Array, largest_roll: float
) -> tuple[Array, Array, float]: ...
def log3(rotation: Array) -> Array: ...
def exp3(turn: Array) -> Array: ...
def quat_xyzw(rotation: Array) -> Array: ...
def smallest_gap(
    time: Array, landmarks: Array, median_time: float, percentile: float
) -> float: ...
def log_size(landmarks: Array) -> float: ...
def misfit(landmarks: Array) -> float: ...
def palmar_evidence(landmarks: Array) -> Array: ...
def palm_axes(landmarks: Array, sign: float) -> Array: ...

WRIST_CONVENTIONS: Array

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
) -> tuple[float, tuple[float, float, float], tuple[float, float, float]]: ...
