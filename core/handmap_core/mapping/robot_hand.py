"""`RobotHand`: one hand of a robot with several, and what it asks of the robot.

`RobotMapper` has one for each hand, and moves the robot once for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike

from handmap_core.core import core
from handmap_core.hands import Hand
from handmap_core.ik import Motion, Task, When
from handmap_core.se3 import Array, ArrayStruct, PoseLike, frozen
from .bound_method import BoundMethod
from .command_time import check_dt, own_time
from .exclusive import WorkLock, exclusively
from .hand_request import AnyRequest, HandRequest
from .moving_robot import AnySolver, MovingRobot
from .readers import JointReader, LandmarkReader
from .reference import Reference, posture_of
from .robot_step import RequestStep
from .target_source import TargetSource
from .targets import AnyPose, HumanPose, Targets, core_pose

HOME = frozen(np.eye(4))
"""Where a base is that nothing has moved; a copy of it takes longer, and is no different."""


class HandState(ArrayStruct, frozen=True, kw_only=True):
    """What changes of a `RobotHand` with its samples.

    Attributes:
        step: The last step: the hand goes on to its request until the next one.
        since: Time since the hand's reference [s].
        waited: Time that the robot has moved since the hand's last sample [s].
        base: Where the robot's base was at the reference, shape (4, 4).
    """

    step: RequestStep
    since: float = 0.0
    waited: float = 0.0
    base: Array = HOME


class HandSnapshot(NamedTuple):
    """State of a hand, its source in the core, and the reference of both."""

    state: HandState
    core: core.TargetSource | None
    counted_from: Reference | None


Source = TypeVar("Source", bound=TargetSource[Hand, BoundMethod])


class RobotHand(Generic[Source, AnySolver]):
    """One hand of a robot: the human's side of it, and its last request.

    It moves nothing. `RobotMapper.step` takes its requests, and moves the robot.

    Args:
        source: The human's side.
        robot: The robot, which all hands share.
        work: That of the robot's mapper: to work on a hand is to work on the robot.

    Attributes:
        source: As given.
        moving_robot: The robot.
        work: As given.
        state: What changes with its samples.
        core: What makes a request of the next sample in the compiled core; None where Python has
            to look at it.
    """

    def __init__(
        self, source: Source, robot: MovingRobot[AnySolver], work: WorkLock
    ) -> None:
        self.source = source
        self.moving_robot = robot
        self.work = work
        self.core: core.TargetSource | None = None
        self.state = HandState(step=RequestStep(self._request_to_stay(None)))

    @property
    def robot(self) -> Hand:
        """The robot's hand, with the reference points that the method moves."""
        return self.source.robot

    @property
    def motion(self) -> Motion:
        """How the robot moves."""
        return self.moving_robot.motion

    @property
    def request(self) -> AnyRequest:
        """What the hand asks of the robot."""
        return self.state.step.request

    @property
    def is_staying(self) -> bool:
        """Whether the hand is to stay where it is."""
        return self.request.map is None

    # -- one sample

    @exclusively
    def map(
        self, sample: HumanPose, dt: When | None = None, *, speed: float = 1.0
    ) -> RequestStep:
        """Return what a sample asks of the robot; errors are those of `HandMapper.map`.

        Args:
            sample: As of `HandMapper.map`.
            dt: Time since the last sample of this hand [s].
            speed: As of `HandMapper.map`.
        """
        started = perf_counter()
        source = self.source
        robot = self.moving_robot
        granted = robot.usual_dt if dt is None else check_dt(own_time(dt))
        reference = source.prepare(sample, robot)
        in_core = self._core_at(sample, reference)
        if in_core is not None:
            request: AnyRequest = in_core.follow(core_pose(sample), granted, speed)
        else:
            request = source.request(sample, reference, granted, speed)
        source.take(reference)
        source.renew(sample, robot)
        # The core has the map of one reference.
        self.core = in_core if source.counted_from is reference else None
        return RequestStep(request, duration=perf_counter() - started)

    @exclusively
    def read(
        self,
        reader: JointReader | LandmarkReader,
        numbers: ArrayLike,
        wrist: PoseLike | None,
        dt: float,
    ) -> RequestStep:
        """Return what a sample asks of the robot as it comes in.

        Args:
            reader: Reads it; one of the source's.
            numbers: Joint angles or landmarks, as of `reader`.
            wrist: Pose of the wrist, likewise.
            dt: Time since the last sample of this hand [s].

        Raises:
            InvalidInputError: If the sample cannot be used.
            DegeneratePointsError: As of `HandMapper.map`.
        """
        timed = None
        if self.core is not None:
            timed = self.core.map(reader.core, numbers, wrist, dt)
        if timed is not None:
            request, duration = timed
            return RequestStep(request, duration=duration)
        sample, outside = reader.read(numbers, wrist)
        return structs.replace(self.map(sample, dt), out_of_range=outside)

    @exclusively
    def hold(self, dt: When, seen: AnyPose | None = None) -> RequestStep:
        """Return a request by which the hand stays where it is.

        Args:
            dt: Time since the last sample of this hand [s].
            seen: As of `HandMapper.hold`.
        """
        granted = check_dt(own_time(dt))
        request = self.request
        # One that stays already keeps its place, and does not drift with the robot.
        if not isinstance(request, HandRequest) or request.map is not None:
            request = self._request_to_stay(request.targets.margins)
        pose = seen or request.pose
        return RequestStep(structs.replace(request, pose=pose, dt=granted))

    def _core_at(
        self, sample: HumanPose, reference: Reference
    ) -> core.TargetSource | None:
        """Return the core's source from a reference on; None if Python has to map a sample."""
        robot = self.moving_robot
        target_map = self.source.core_map(sample, reference)
        if target_map is None or not robot.moves_in_core:
            return None
        if self.core is not None:
            return self.core
        views = robot.views(target_map.targets_of, self.robot)
        core_map = target_map.make_core()
        return core.TargetSource(robot.point_ik.core, core_map, views, target_map)

    # -- between samples

    @exclusively
    def set_tasks(self, tasks: Sequence[Task]) -> None:
        """Change the further terms of the QP's cost."""
        self.source.tasks = tuple(tasks)
        self.core = None

    @exclusively
    def engage(self) -> None:
        """Make the next sample of this hand its reference; it goes on to its last request."""
        self.source.engage()
        self.core = None
        self.state = HandState(step=RequestStep(self.request), base=self.state.base)

    @exclusively
    def clutch(self) -> None:
        """Make the next sample of this hand its reference: the former name of `engage`."""
        self.engage()

    @exclusively
    def stay(self) -> None:
        """Let the hand stay where it is now."""
        request = self._request_to_stay(self.request.targets.margins)
        step = structs.replace(self.state.step, request=request)
        self.state = structs.replace(self.state, step=step)

    def _request_to_stay(self, margins: Array | None) -> HandRequest:
        """Return a request by which the hand stays where it is now."""
        at = posture_of(self.robot, self.moving_robot.q)
        targets = Targets(at.points, at.wrist, margins=margins)
        return HandRequest(
            self.source.unseen, targets, at.q, self.moving_robot.usual_dt
        )

    # -- for the robot's mapper

    def snapshot(self) -> HandSnapshot:
        """Return what `restore` takes to take back what is done from now on."""
        return HandSnapshot(self.state, self.core, self.source.counted_from)

    def restore(self, snapshot: HandSnapshot) -> None:
        """Take back what was done since `snapshot`."""
        self.state, self.core, self.source.counted_from = snapshot

    def advance(self, step: RequestStep, base: Array) -> None:
        """Take a step that the robot is to be moved for.

        Args:
            step: The step.
            base: Where the robot's base is, shape (4, 4).
        """
        if step.request.map is None:
            self.state = structs.replace(self.state, step=step)
            return
        since = self.state.since
        self.state = structs.replace(
            self.state,
            step=step,
            base=self.state.base if since else base,
            since=since + step.request.dt,
        )
