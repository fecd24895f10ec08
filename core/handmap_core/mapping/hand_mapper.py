"""`HandMapper`: the paper's loop (Fig. 3), from a human sample to a robot command.

It has a `TargetSource`, whose method makes the targets (eqs. 5-7 for `Homogeneous`), and a
`MovingRobot`, whose QP is in place of eq. (8). `map` is the whole step. `map_step` starts from
joint angles (eq. 4), `map_points` from measured points, and `map_landmarks` from the landmarks of a
tracker. None of them judges a sample: `stream.follower` decides which samples of a tracker the
robot follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Generic, TypeVar

from msgspec import structs
from numpy.typing import ArrayLike

from handmap_core.core import core
from handmap_core.errors import InvalidInputError
from handmap_core.hands import Hand
from handmap_core.ik import Task, When
from handmap_core.se3 import PoseLike, QuatOrder, check_pose
from .bound_method import BoundMethod
from .command_time import check_when, own_time
from .exclusive import WorkLock, exclusively
from .mapper import Mapper
from .moving_robot import AnySolver, MovingRobot
from .readers import JointReader, LandmarkReader, check_joints
from .reference import Placement, Reference
from .step import AnyStages, MapStep, Stages
from .target_source import TargetSource
from .targets import (
    AnyPose,
    HumanPose,
    TargetMap,
    Targets,
    core_pose,
)

Source = TypeVar("Source", bound=TargetSource[Hand, BoundMethod])


class HandMapper(Mapper[core.HandMapper, AnySolver], Generic[Source, AnySolver]):
    """Turns the motion of a human hand into the motion of a robot hand.

    The first sample is the reference unless `reset` has given one. There the robot is at rest with
    its palm on the human's palm, as the method's alignment takes it to the robot's world. The
    human's motion is imposed from there.

    A copy (`copy.deepcopy`, `copy.copy` or pickle) continues from the same state on its own.

    Args:
        source: The human's side.
        solver: The QP that moves the robot.
        dt: Usual time between samples [s], where a step gives none of its own.

    Attributes:
        source: As given: the readers, the method for the two hands, and the reference.
        moving_robot: The robot's side.
        core: What maps the next sample in the compiled core; None where Python has to look at it.

    Raises:
        InvalidInputError: If `dt` cannot be used.

    One thread at a time works on a mapper: while it maps, other threads that enter get a
    `MapperBusyError`, and nothing changes. Mappers of their own do not disturb each other. Other
    threads of Python go on while a sample is mapped that takes long: the core then gives up the
    interpreter's lock. It keeps the lock while the samples before took less than 0.3 ms.
    """

    def __init__(self, source: Source, solver: AnySolver, dt: float) -> None:
        self.work = WorkLock()
        self.source = source
        self.moving_robot = MovingRobot(solver, dt)
        self.reset()

    @property
    def human(self) -> Hand:
        """The hand that leads."""
        return self.source.human

    @property
    def robot(self) -> Hand:
        """The hand that follows, with the reference points that the method moves."""
        return self.source.robot

    @property
    def tasks(self) -> tuple[Task, ...]:
        """Further terms of the QP's cost; `set_tasks` changes them."""
        return self.source.tasks

    @property
    def dt(self) -> float:
        """Usual time between samples [s]."""
        return self.moving_robot.usual_dt

    @property
    def joint_tolerance(self) -> float:
        """How far a human joint may be outside its limits [rad]."""
        return self.source.joint_tolerance

    @property
    def quat_order(self) -> QuatOrder | None:
        """Order of the quaternion in wrist poses given as seven numbers."""
        return self.source.quat_order

    @property
    def reference(self) -> HumanPose | None:
        """The human hand that motion is counted from; None if the next sample becomes it."""
        return self.source.reference

    @property
    def target_map(self) -> TargetMap | None:
        """What makes targets of samples from the reference on; None if the next becomes it."""
        return self.source.target_map

    @property
    def landmarks(self) -> LandmarkReader:
        """Turns landmarks into samples of the human hand; errors are those of the reader."""
        return self.source.landmarks

    # -- one sample

    @exclusively
    def map_step(
        self,
        human_q: ArrayLike,
        wrist_pose: PoseLike,
        *,
        dt: When | None = None,
        time: float | None = None,
    ) -> MapStep:
        """Map one sample of the human hand.

        The limits of speed and acceleration hold in the time since the robot's last command. Say it
        by `dt` or by `time`, not both.

        Args:
            human_q: Joint angles in the order of `human.joint_names` [rad], shape (n,). Angles
                outside their limits by no more than `joint_tolerance` are used, and named in
                `MapStep.out_of_range`.
            wrist_pose: Pose of the human's wrist in its world: a (4, 4) matrix, a `pinocchio.SE3`,
                or 7 numbers if the mapper was given a `quat_order`.
            dt: Time since the robot's last command [s]; the mapper's own if omitted. Or the
                `Instant` of this one, on the robot's clock (`mapper.motion.time`).
            time: Instant of the command on any clock that runs evenly [s]. After the first one, a
                command takes the time since the last, and at most three times the mapper's `dt`;
                one that is not later takes (nearly) none. After a `reset`, one that is more than
                1 s earlier begins another clock.

        Returns:
            Every stage of the step, `command` being what a robot takes.

        Raises:
            InvalidInputError: If the sample cannot be used; the mapper is then as it was before.
            DegeneratePointsError: If the sample becomes the reference and its points do not
                determine the motion.
        """
        return self._mapped(self.source.joints, human_q, wrist_pose, dt, time)

    @exclusively
    def map_points(
        self,
        points: ArrayLike,
        wrist_pose: PoseLike | None = None,
        *,
        dt: When | None = None,
        time: float | None = None,
    ) -> MapStep:
        """Map one sample of measured reference points, without joint angles.

        Result and errors are those of `map_step`.

        Args:
            points: The human's reference points in its world [m], in the order of
                `human.reference_points`, shape (n_h, 3).
            wrist_pose: Pose of the wrist as in `map_step`; may be omitted where the method does not
                need it.
            dt: As of `map_step` [s].
            time: Likewise.
        """
        robot = self.moving_robot
        when = robot.when(dt, time)
        step = self.map(self.source.read_points(points, wrist_pose), when)
        robot.note_time(time, when)
        return step

    @exclusively
    def map_landmarks(
        self,
        landmarks: ArrayLike,
        wrist_pose: PoseLike | None = None,
        *,
        dt: When | None = None,
        time: float | None = None,
    ) -> MapStep:
        """Map one sample of measured landmarks: no joint angles of the human are fitted.

        The reference points are the landmarks themselves. The palm is a rigid fit of its five
        landmarks, unless the tracker's own wrist pose is given. Scale the human to the person first
        (`measure_hand`): the fit and the ratios of reach need the person's lengths. Result and
        errors are those of `map_step`.

        Args:
            landmarks: The 21 landmarks in the human's world [m], in MediaPipe's order, (21, 3).
            wrist_pose: Pose of the human model's wrist frame, as in `map_step`; fitted if omitted.
            dt: As of `map_step` [s].
            time: Likewise.

        Raises:
            InvalidOptionsError: If a reference point of the human is not a landmark.
        """
        return self._mapped(self.source.landmarks, landmarks, wrist_pose, dt, time)

    @exclusively
    def map(
        self,
        sample: HumanPose,
        dt: When | None = None,
        *,
        speed: float = 1.0,
    ) -> MapStep:
        """Map one sample with known points: targets by the method, motion by the QP.

        Result and errors are those of `map_step`.

        Args:
            sample: The sample; not checked, but for a wrist that is needed.
            dt: As of `map_step` [s], or the instant of the command on the robot's clock.
            speed: Share of the speed limits at which the robot may move.
        """
        started = perf_counter()
        source = self.source
        robot = self.moving_robot
        when = robot.usual_dt if dt is None else check_when(dt)
        reference = source.prepare(sample, robot)
        in_core = self._core_at(sample, reference)
        if in_core is not None:
            robot.put_on_palm(reference.q)
            stages: AnyStages = in_core.follow(core_pose(sample), when, speed)
        else:
            request = source.request(sample, reference, own_time(when), speed)
            robot.put_on_palm(reference.q)
            stages = robot.move(request, when)
        source.take(reference)
        source.renew(sample, robot)
        # The core has the map of one reference.
        self.core = in_core if source.counted_from is reference else None
        return MapStep(stages, duration=perf_counter() - started)

    def _mapped(
        self,
        reader: JointReader | LandmarkReader,
        numbers: ArrayLike,
        wrist: PoseLike | None,
        dt: When | None,
        time: float | None,
    ) -> MapStep:
        """Map one sample as it comes in."""
        robot = self.moving_robot
        when = robot.when(dt, time)
        # `SampleReader::map_landmarks` or `map_joints` in the core, by the kind of reader.
        # None for a sample that Python has to look at.
        timed = None
        if self.core is not None:
            timed = self.core.map(reader.core, numbers, wrist, when)
        if timed is not None:
            stages, duration = timed
            step = MapStep(stages, duration=duration)
        else:
            started = perf_counter()
            sample, outside = reader.read(numbers, wrist)
            step = self.map(sample, when)
            duration = perf_counter() - started
            step = structs.replace(step, out_of_range=outside, duration=duration)
        robot.note_time(time, when)
        return step

    def _core_at(
        self, sample: HumanPose, reference: Reference
    ) -> core.HandMapper | None:
        """Return the core's mapper from a reference on; None if Python has to map a sample."""
        robot = self.moving_robot
        target_map = self.source.core_map(sample, reference)
        if target_map is None or not robot.moves_in_core:
            return None
        if self.core is not None:
            return self.core
        views = robot.views(target_map.targets_of, self.robot)
        return core.HandMapper(robot.point_ik.core, target_map.make_core(), views)

    @exclusively
    def hold(self, dt: When, seen: AnyPose | None = None) -> MapStep:
        """Brake, and keep the robot's posture.

        Args:
            dt: Time since the robot's last command [s], or the instant of this one on the robot's
                clock.
            seen: The sample that was mapped last; NaN stands for it if omitted.

        Returns:
            The step, whose targets and points are the robot's own.
        """
        started = perf_counter()
        held = self.moving_robot.hold(check_when(dt))
        targets = Targets(held.points, held.wrist)
        stages = Stages.of(seen or self.source.unseen, targets, held)
        return MapStep(stages, duration=perf_counter() - started)

    # -- between samples

    @exclusively
    def reset(
        self,
        human_q: ArrayLike | None = None,
        wrist_pose: PoseLike | None = None,
        *,
        robot_q: ArrayLike | None = None,
        robot_wrist: PoseLike | None = None,
    ) -> None:
        """Start again: the robot at a given posture, the reference at a given or the next sample.

        Args:
            human_q: Joint angles of the reference sample [rad], shape (n,); the next sample is the
                reference if omitted.
            wrist_pose: Wrist pose of the reference sample; goes with `human_q`.
            robot_q: Joint angles of the robot there [rad], inside their limits; its rest posture if
                omitted.
            robot_wrist: Wrist pose of the robot there; by default that of a first sample.

        Raises:
            InvalidInputError: If something cannot be used; the mapper is then as it was before.
            DegeneratePointsError: If the reference points do not determine the motion.
        """
        if (human_q is None) != (wrist_pose is None):
            raise InvalidInputError(
                "human_q and wrist_pose go together",
                argument="wrist_pose" if wrist_pose is None else "human_q",
                advice="give both or neither",
            )
        robot = self.robot
        q = robot.rest
        wrist = None
        if robot_q is not None:
            q, _ = check_joints(robot, robot_q, "robot_q")
        if robot_wrist is not None:
            if not robot.is_floating:
                raise InvalidInputError(
                    f"{robot.name} has a fixed wrist, which stays where it is",
                    argument="robot_wrist",
                    advice="leave it out",
                )
            wrist = check_pose(robot_wrist, "robot_wrist", self.quat_order)
        # A floating robot is at the origin until the human's palm is known.
        start = robot.configuration_vector(q, wrist)
        is_known = wrist is not None or not robot.is_floating
        placement = Placement.KNOWN if is_known else Placement.UNKNOWN
        reference = None
        if human_q is not None and wrist_pose is not None:
            sample, _ = self.source.joints.read(human_q, wrist_pose)
            reference = self.source.reference_at(sample, start, placement)
            start = reference.q
            placement = Placement.KNOWN
        self.moving_robot.reset(start, placement)
        self.engage()
        if reference is not None:
            self.source.take(reference)

    @exclusively
    def set_tasks(self, tasks: Sequence[Task]) -> None:
        """Change the further terms of the QP's cost."""
        self.source.tasks = tuple(tasks)
        self.core = None

    @exclusively
    def engage(self) -> None:
        """Engage the robot: the next sample is the reference; it continues from where it is."""
        self.moving_robot.is_released = False
        self.source.engage()
        self.core = None
