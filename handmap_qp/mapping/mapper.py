"""`HandMapper`: the paper's loop (Fig. 3), from a human sample to a robot command.

`map` is the whole step: the method's targets (eqs. 5-7 for `Homogeneous`), then the QP in place of
eq. (8). `map_step` starts from joint angles (eq. 4), `map_points` from measured points, and
`map_landmarks` from the landmarks of a tracker. None of them judges a sample: `stream.follower`
decides which samples of a tracker the robot follows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from functools import cached_property
from itertools import compress
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike

from handmap_qp.errors import InvalidInputError, InvalidOptionsError, expect
from handmap_qp.hands import Hand, Names, Values
from handmap_qp.human import (
    LANDMARK_COUNT,
    LANDMARK_NAMES,
    PALM,
    landmarks_at_rest,
    palm_fit_weights,
)
from handmap_qp.ik import (
    BEHIND,
    LONGEST_STEP,
    IkOptions,
    IkResult,
    Instant,
    Motion,
    PointIk,
    Task,
    When,
    core_tree,
)
from handmap_qp.ik.core import core
from handmap_qp.models import LandmarkReaderModel, encode
from handmap_qp.se3 import (
    Array,
    PoseLike,
    QuatOrder,
    as_floats,
    as_points,
    check_pose,
    inverse_pose,
    is_real,
    rigid_fit,
    transform_points,
)
from .exclusive import WorkLock, exclusively
from .method import (
    BoundMethod,
    CoreMap,
    HumanPose,
    MapStep,
    Method,
    MethodOptions,
    RobotCommand,
    RobotPosture,
    Stages,
    TargetMap,
    Targets,
    core_pose,
    default_preset,
    get_preset,
    step_views,
)

_PLACING = "placing the robot at the reference (or give reset a robot_wrist)"


class Asked(NamedTuple):
    """What one hand of a person asks of the robot. The core has it, too, as `HandRequest`.

    Attributes:
        pose: The person's hand.
        targets: Of the robot's hand; of a `Leader`, before its palm is turned.
        rest: Joint positions that the QP's rest term pulls to, shape (n,).
        dt: Time since the last sample of this hand, which its own filters and turns count in [s].
            The robot's limits do not: see `When`.
        speed: Share of the speed limits at which the robot may move.
        map: What made the targets; None where the robot's hand stays.
    """

    pose: HumanPose
    targets: Targets
    rest: Array
    dt: float
    speed: float = 1.0
    map: Any = None


class Mover:
    """Base of what moves a robot by a solver, its `point_ik`.

    Attributes:
        work: Lets one thread at a time work on it; others get a `MapperBusyError`.
    """

    point_ik: PointIk
    core: Any
    work: WorkLock
    # The robot's clock minus the caller's [s]; None until the caller gives a first instant.
    _clock_offset: float | None = None
    # Whether no instant was given since the last reset.
    _was_reset = False
    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @property
    def ik(self) -> IkOptions:
        """Weights and settings of the QP."""
        return self.point_ik.options

    @exclusively
    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy continues from."""
        return vars(self).copy()

    @property
    @exclusively
    def motion(self) -> Motion:
        """How the robot moves. Set it where something else has moved the robot.

        That does not set the robot's clock back.
        """
        return self.point_ik.gate.motion

    @motion.setter
    @exclusively
    def motion(self, motion: Motion) -> None:
        now = self.motion.time
        if motion.time < now:
            motion = motion._replace(time=now)
        self.point_ik.gate.motion = motion
        self._was_moved()

    def _when(self, dt: When | None, time: float | None) -> When:
        """Return when a command is that a caller gives one of these times for, or none.

        Raises:
            InvalidInputError: If they cannot be used.
        """
        if time is None:
            return self._usual_dt if dt is None else check_when(dt)
        expect(dt is None, "time", "either a time or a dt", value=time)
        expect(is_real(time), "time", "an instant [s]", value=time)
        usual = self._usual_dt
        if self._clock_offset is None:
            return usual
        instant = time + self._clock_offset
        if self._was_reset and instant < self.motion.time - BEHIND:
            # Such as that of the next recording.
            return usual
        return Instant(instant, LONGEST_STEP * usual)

    @property
    def _usual_dt(self) -> float:
        """Usual time between commands [s], where a caller gives none."""
        raise NotImplementedError

    def _note_time(self, time: float | None, when: When) -> None:
        """Take the command just made to be at an instant of the caller's clock, if a first one.

        Args:
            time: The instant that the caller gave; None if it gave none.
            when: What `_when` returned for it: an `Instant` unless it is the first one of a clock.
        """
        if time is None:
            return
        self._was_reset = False
        if not isinstance(when, Instant):
            self._clock_offset = self.motion.time - time

    def _was_moved(self) -> None:
        """Go on from where something else has moved the robot."""

    def engage(self) -> None:
        """Engage the robot: the next sample is the reference; it continues from where it is."""
        raise NotImplementedError

    @exclusively
    def disengage(self) -> None:
        """Disengage the robot: it brakes and holds still until `engage`, whatever comes."""
        self._is_released = True
        self.core = None

    def clutch(self) -> None:
        """Engage the robot: the former name of `engage`."""
        self.engage()

    def release(self) -> None:
        """Disengage the robot: the former name of `disengage`."""
        self.disengage()


class HandMapper(Mover):
    """Turns the motion of a human hand into the motion of a robot hand.

    The first sample is the reference unless `reset` has given one. There the robot is at rest with
    its palm on the human's palm, as `alignment` takes it to the robot's world. The
    human's motion is imposed from there.

    A copy (`copy.deepcopy`, `copy.copy` or pickle) continues from the same state on its own.

    Args:
        human: The hand that leads, with a floating wrist; its reference points are the method's
            input.
        robot: The hand that follows.
        method: How a sample becomes targets: a `Method`, or the name of a preset. If it and
            `preset` are omitted, `teleoperation` where the robot's fingers have partners on the
            human hand, else `object`.
        preset: Name of a preset (`PRESETS`), in place of `method`: its method and its weights.
        ik: Weights and settings of the QP; those of the preset if omitted.
        tasks: Further terms of the QP's cost, in every sample.
        dt: Usual time between samples [s], where a step gives none of its own.
        quat_order: Order of the quaternion in wrist poses given as seven numbers.
        joint_tolerance: How far a human joint may be outside its limits before the sample is
            rejected [rad].
        **options: Options of the method of `preset`, as in
            `HandMapper(human, robot, preset="object", ridge=0.01)`; without `preset` those of the
            paper's method.

    Attributes:
        human: The hand that leads.
        method: The mapping method, which turns a sample into targets; `configure` changes it.
        bound: What the method is for these two hands.
        point_ik: The robot's present posture and the QP. Read it only: changing it breaks the
            mapper.
        dt: Time between samples [s].
        joint_tolerance: As given [rad].
        tasks: Further terms of the QP's cost; `configure` changes them.
        core: The compiled core's `HandMapper` from the present reference on; None where Python
            has to look at the next sample.

    Raises:
        InvalidOptionsError: If choices contradict each other or the hands.
        InvalidInputError: If `dt` or `joint_tolerance` cannot be used.

    One thread at a time works on a mapper: while it maps, other threads that enter get a
    `MapperBusyError`, and nothing changes.
    """

    def __init__(
        self,
        human: Hand,
        robot: Hand,
        method: Method | str | None = None,
        *,
        preset: str | None = None,
        ik: IkOptions | None = None,
        tasks: Sequence[Task] = (),
        dt: float = 1.0 / 60.0,
        quat_order: QuatOrder | None = None,
        joint_tolerance: float = 0.25,
        **options: Any,
    ) -> None:
        if not human.is_floating:
            raise InvalidOptionsError(
                f"{human.name} has a fixed wrist, and its pose comes with each sample",
                option="human",
                advice="load it with mount='floating'",
            )
        one = "one hand; `RobotMapper` takes a robot"
        expect(not robot.parts, "robot", one, value=robot.name)
        is_angle = isinstance(joint_tolerance, int | float) and joint_tolerance >= 0.0
        expect(is_angle, "joint_tolerance", "an angle >= 0 rad", value=joint_tolerance)
        self.work = WorkLock()
        self.human = human
        self.dt = check_dt(dt)
        self.joint_tolerance = joint_tolerance
        self.quat_order = quat_order
        self._given_robot = robot
        if method is None and preset is None and not options:
            preset = default_preset(human, robot)
        self.method, weights = _method_of(method, preset, options)
        self.bound = bound = self.method.bind(human, robot)
        self.point_ik = PointIk(bound.robot, ik or weights, contacts=bound.contacts)
        self.tasks = tuple(tasks)
        self.reset()

    @property
    def _usual_dt(self) -> float:
        return self.dt

    @property
    def robot(self) -> Hand:
        """The hand that follows, with the reference points that the method moves."""
        return self.bound.robot

    def _was_moved(self) -> None:
        self._awaits_palm = False

    @property
    def reference(self) -> HumanPose | None:
        """The human hand that motion is counted from; None if the next sample becomes it."""
        return self._reference and self._reference.sample

    @property
    def target_map(self) -> TargetMap | None:
        """What makes targets of samples from the reference on; None if the next becomes it."""
        return self._reference and self._reference.map

    @cached_property
    def landmarks(self) -> LandmarkReader:
        """Turns landmarks into samples of the human hand; errors are those of the reader."""
        return LandmarkReader(self.human, self.quat_order)

    @cached_property
    def _joints(self) -> JointReader:
        """Turns joint angles into samples; streams of landmarks need none."""
        return JointReader(self.human, self.joint_tolerance, self.quat_order)

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
        return self._mapped(self._joints, human_q, wrist_pose, dt, time)

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
        when = self._when(dt, time)
        wrist = None
        if wrist_pose is not None:
            wrist = check_pose(wrist_pose, "wrist_pose", self.quat_order)
        measured = as_points(points, "points", len(self.human.reference_points))
        step = self.map(HumanPose(measured.copy(), wrist), when)
        self._note_time(time, when)
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
        return self._mapped(self.landmarks, landmarks, wrist_pose, dt, time)

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
        when = self.dt if dt is None else check_when(dt)
        if sample.wrist is None:
            self._check_wrist()
        bound = self.bound
        reference = self._reference or self._reference_at(sample)
        target_map = reference.map
        own = None if sample.wrist is None else self._core_at(target_map)
        targets = None if own else target_map.targets(sample)
        if targets and self.tasks:
            targets = structs.replace(targets, tasks=(*targets.tasks, *self.tasks))
        if bound.renews_reference:
            # Points that cannot be the next reference are rejected before the robot moves.
            bound.start(sample, reference.posture)
        if reference is not self._reference:
            self._begin(reference)
        if own:
            stages = own.follow(core_pose(sample), when, speed)
        else:
            assert targets
            stages = self._moved(sample, targets, target_map, when, speed)
        self.core = own
        if bound.renews_reference:
            self.core = None
            self._reference = self._reference_at(sample)
        return MapStep(stages, (), perf_counter() - started)

    def _mapped(
        self,
        reader: JointReader | LandmarkReader,
        numbers: ArrayLike,
        wrist: PoseLike | None,
        dt: When | None,
        time: float | None = None,
    ) -> MapStep:
        """Map one sample as it comes in."""
        own = self.core
        when = self._when(dt, time)
        # `SampleReader::map_landmarks` or `map_joints` (core/mapper.hpp), by the kind of reader.
        # None for a sample that Python has to look at.
        timed = own and own.map(reader.core, numbers, wrist, when)
        if timed:
            stages, duration = timed
            step = MapStep(stages, (), duration)
        else:
            started = perf_counter()
            sample, outside = reader.read(numbers, wrist)
            step = self.map(sample, when)
            duration = perf_counter() - started
            step = structs.replace(step, out_of_range=outside, duration=duration)
        self._note_time(time, when)
        return step

    def _moved(
        self,
        pose: HumanPose,
        targets: Targets,
        target_map: TargetMap,
        when: When,
        speed: float,
    ) -> Stages:
        """Move the robot towards its targets in Python, or in the core by its QP alone."""
        if self._is_released:
            result = self.point_ik.hold(when)
        else:
            result = self.point_ik.solve(
                targets.points,
                targets.wrist,
                when,
                rest=target_map.rest,
                tasks=targets.tasks,
                margins=targets.margins,
                regularisation=targets.regularisation,
                speed=speed,
            )
            targets = structs.replace(targets, points=result.targets)
        return stages_of(pose, targets, result)

    def _core_at(self, target_map: TargetMap) -> core.SampleReader[Any] | None:
        """Return the core's mapper by the map of a reference; None if Python has to map."""
        ik = self.point_ik
        is_python = self._is_released or self.tasks or ik.options.tasks
        if is_python or not (ik.is_compiled and isinstance(target_map, CoreMap)):
            return None
        return self.core or self._new_core(target_map)

    def _new_core(self, target_map: CoreMap) -> core.SampleReader[Any]:
        """Return the core's mapper by a map."""
        views = self._views_by(target_map)
        return core.HandMapper(self.point_ik.core, target_map.make_core(), views)

    def _views_by(self, target_map: CoreMap) -> core.StepViews:
        links = self.point_ik.gate.links
        return step_views(target_map.asked, self.robot, links)

    @exclusively
    def hold(self, dt: When, seen: HumanPose | None = None) -> MapStep:
        """Brake, and keep the robot's posture.

        Args:
            dt: Time since the robot's last command [s], or the instant of this one on the robot's
                clock.
            seen: The sample that was mapped last; NaN stands for it if omitted.

        Returns:
            The step, whose targets and points are the robot's own.
        """
        started = perf_counter()
        held = self.point_ik.hold(check_when(dt))
        asked = Targets(held.points, held.wrist)
        stages = stages_of(seen or self._unseen, asked, held)
        return MapStep(stages, (), perf_counter() - started)

    @property
    def _unseen(self) -> HumanPose:
        """A human hand of which nothing is known."""
        return HumanPose(np.full((len(self.human.reference_points), 3), np.nan), None)

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
        awaits_palm = robot.is_floating and wrist is None
        reference = None
        if human_q is not None and wrist_pose is not None:
            sample, _ = self._joints.read(human_q, wrist_pose)
            reference = self._reference_from(start, awaits_palm, sample)
            start = reference.vector
            awaits_palm = False
        self.point_ik.place(start)
        self._was_reset = True
        if awaits_palm:
            # Like no other motion, so that whoever knows where the robot is will say so.
            self.motion = self.motion._replace(dt=np.inf)
        self._awaits_palm = awaits_palm
        self.engage()
        self._reference = reference

    @exclusively
    def engage(self) -> None:
        """Engage the robot: the next sample is the reference; it continues from where it is."""
        self._is_released = False
        self._reference = self.core = None

    @exclusively
    def configure(
        self,
        method: Method | str | None = None,
        *,
        preset: str | None = None,
        ik: IkOptions | None = None,
        tasks: Sequence[Task] | None = None,
    ) -> None:
        """Change options between samples: reference and posture of the robot stay.

        A reference that was taken without a wrist pose is given up where the new method needs one;
        the next sample then takes its place.

        Args:
            method: How a sample becomes targets, as of `HandMapper`; as it is if it and `preset`
                are omitted.
            preset: Name of a preset, as of `HandMapper`.
            ik: Weights and settings of the QP; as they are if omitted, or those of a preset that is
                named.
            tasks: Further terms of the QP's cost; as they are if omitted.

        Raises:
            InvalidOptionsError: If choices contradict each other or the hands; the mapper is then
                as it was before.
            DegeneratePointsError: If with them the reference points do not determine the motion;
                likewise.
        """
        is_new = method is not None or preset is not None
        if is_new or ik:
            chosen, weights = _method_of(
                method if is_new else self.method, preset, options={}
            )
            if preset is not None or isinstance(method, str):
                ik = ik or weights
            bound = chosen.bind(self.human, self._given_robot)
            solver = PointIk(
                bound.robot, ik or self.ik, self.motion, contacts=bound.contacts
            )
            self._reference = self._reference and _bound_again(self._reference, bound)
            self.method = chosen
            self.bound = bound
            self.point_ik = solver
        if tasks is not None:
            self.tasks = tuple(tasks)
        self.core = None

    # -- the reference

    def _reference_at(self, sample: HumanPose) -> _Reference:
        """Count from this sample, with the robot where it is."""
        return self._reference_from(self.motion.q, self._awaits_palm, sample)

    def _reference_from(
        self, vector: Array, awaits_palm: bool, sample: HumanPose
    ) -> _Reference:
        """Count from this sample, with the robot at a configuration (nq,), or on its palm."""
        bound = self.bound
        robot = bound.robot
        if awaits_palm:
            wrist = bound.start_palm(sample) @ inverse_pose(robot.wrist_to_palm)
            vector = robot.configuration_vector(vector[robot.q_indices], wrist)
        # The caller has the sample's arrays too, and may write into them.
        return _count_from(bound, deepcopy(sample), vector.copy())

    def _begin(self, reference: _Reference) -> None:
        """Take a reference, and put the robot on its palm unless it has a place."""
        if self._awaits_palm:
            self.point_ik.place(reference.vector)
        self._awaits_palm = False
        self._reference = reference

    def _check_wrist(self) -> None:
        """Reject the next sample, which has no wrist pose, if it needs one."""
        bound = self.bound
        needs = bound.needs_wrist
        if not self._reference or bound.renews_reference:
            needs = needs or bound.reference_needs_wrist
        needs = needs or (_PLACING if self._awaits_palm else "")
        if needs:
            raise InvalidInputError(f"needed for {needs}", argument="wrist_pose")


class LandmarkReader:
    """Turns the 21 landmarks of a tracker into samples of a human hand.

    Args:
        human: The human hand, scaled to the person.
        quat_order: Order of the quaternion in wrist poses of seven numbers.

    Attributes:
        quat_order: As given.
        model: What the core reads by.
        core: The reader of the core.

    Raises:
        InvalidOptionsError: If a reference point of the hand is not a landmark.
    """

    def __init__(self, human: Hand, quat_order: QuatOrder | None = None) -> None:
        self.quat_order = quat_order
        names = [point.name for point in human.reference_points]
        if missing := [name for name in names if name not in LANDMARK_NAMES]:
            raise InvalidOptionsError(
                f"{', '.join(missing)} cannot be read from landmarks",
                option="human_points",
                advice="choose reference points among the landmarks, or call map_points",
            )
        self.model = LandmarkReaderModel(
            used=np.array([*map(LANDMARK_NAMES.index, names)]),
            palm=landmarks_at_rest(human)[PALM],
            weights=palm_fit_weights(human.palm_weights),
        )
        self.core = core.LandmarkReader(encode(self.model))

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy is made of."""
        return {"quat_order": self.quat_order, "model": self.model}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Read as another one does."""
        vars(self).update(state)
        self.core = core.LandmarkReader(encode(self.model))

    def read(
        self, landmarks: ArrayLike, wrist: PoseLike | None = None
    ) -> tuple[HumanPose, Names]:
        """Return a sample; landmarks have no limits that they could be outside.

        Args:
            landmarks: In MediaPipe's order, in the human's world [m], shape (21, 3).
            wrist: The tracker's own wrist pose; fitted to the landmarks of the palm (Kabsch 1976)
                if None.

        Raises:
            InvalidInputError: If a coordinate is not finite, or `wrist` is not a pose.
        """
        if self.core and (pose := self.core.read(landmarks, wrist)):
            return HumanPose.of_core(pose), ()
        points = as_points(landmarks, "landmarks", LANDMARK_COUNT)
        if wrist is None:
            wrist = rigid_fit(self.model.palm, points[PALM], self.model.weights)
        else:
            wrist = check_pose(wrist, "wrist_pose", self.quat_order)
        return HumanPose(points[self.model.used], wrist), ()


class JointReader:
    """Turns joint angles into samples of a human hand (eq. 4).

    Args:
        human: The human hand.
        tolerance: How far a joint may be outside its limits [rad].
        quat_order: Order of the quaternion in wrist poses of seven numbers.

    Attributes:
        core: The reader of the core; None for a hand with joints that follow others.
    """

    def __init__(
        self, human: Hand, tolerance: float, quat_order: QuatOrder | None
    ) -> None:
        self.human = human
        self.tolerance = tolerance
        self.quat_order = quat_order
        # The wrist is at the origin; points move with it afterwards.
        self._placed = human.configuration()
        self.core = None if human.rules else core.JointReader(core_tree(human))

    def __reduce__(self) -> tuple[Any, ...]:
        """Build a copy with a workspace of its own."""
        return JointReader, (self.human, self.tolerance, self.quat_order)

    def read(self, q: ArrayLike, wrist_pose: PoseLike) -> tuple[HumanPose, Names]:
        """Return a sample, and the names of the joints that are outside their limits.

        Args:
            q: Joint angles in the order of `human.joint_names` [rad], shape (n,).
            wrist_pose: Pose of the wrist in the human's world, as of `HandMapper.map_step`.

        Raises:
            InvalidInputError: If they cannot be used.
        """
        if self.core and (pose := self.core.read(q, wrist_pose)):
            return HumanPose.of_core(pose), ()
        human = self.human
        wrist = check_pose(wrist_pose, "wrist_pose", self.quat_order)
        angles, excess = check_joints(human, q, "human_q", self.tolerance)
        self._placed.place(human.configuration_vector(angles))
        outside = tuple(compress(human.joint_names, excess > 0.0))
        return HumanPose(transform_points(wrist, self._placed.points), wrist), outside


class _Reference(NamedTuple):
    """Both hands at the reference, the robot as a configuration (nq,), too."""

    sample: HumanPose
    posture: RobotPosture
    map: TargetMap
    vector: Array


def _count_from(bound: BoundMethod, sample: HumanPose, vector: Array) -> _Reference:
    """Count from a sample and a configuration (nq,) of the robot."""
    posture = posture_of(bound.robot, vector)
    return _Reference(sample, posture, bound.start(sample, posture), vector)


def _bound_again(reference: _Reference, bound: BoundMethod) -> _Reference | None:
    """Count from the same reference by another method; None if it lacks what that needs."""
    sample = reference.sample
    if (bound.needs_wrist or bound.reference_needs_wrist) and sample.wrist is None:
        return None
    return _count_from(bound, sample, reference.vector)


def _method_of(
    method: Method | str | None, preset: str | None, options: Values
) -> tuple[Method, IkOptions]:
    """Return the method that the arguments of `HandMapper` name, and the QP weights with it.

    Raises:
        InvalidOptionsError: If they contradict each other, or there is no such preset.
    """
    if preset is not None and method is not None:
        raise InvalidOptionsError(
            "a method is given, too", option="preset", advice="leave one of them out"
        )
    if isinstance(method, str) and not options:
        preset = method
    if preset is not None:
        chosen_preset = get_preset(preset)
        own = chosen_preset.method
        return own.replaced(**options) if options else own, chosen_preset.ik
    chosen: Any = get_preset("paper").method if method is None else method
    needed = "replaced" if options else "bind"
    if hasattr(chosen, needed) and not isinstance(chosen, type):
        weights = chosen.weights if isinstance(chosen, MethodOptions) else IkOptions()
        return chosen.replaced(**options) if options else chosen, weights
    raise InvalidOptionsError(
        option="method",
        expected="a method, the name of a preset, or single options of the paper's method",
        value=method,
    )


def posture_of(robot: Hand, vector: Array) -> RobotPosture:
    """Compute where a robot's points and its wrist are in a configuration."""
    points, wrists = core_tree(robot).posture(vector)
    return RobotPosture(vector[robot.q_indices], points, wrists[0])


def stages_of(pose: HumanPose, asked: Targets, result: IkResult) -> Stages:
    """Return the stages of a step whose robot has moved."""
    hand = result.hand
    q = result.q[hand.q_indices]
    return Stages(pose, asked, result, RobotCommand(hand.joint_names, q, result.wrist))


def check_joints(
    hand: Hand, q: ArrayLike, name: str, tolerance: float = 0.0
) -> tuple[Array, Array]:
    """Return joint positions, and how far each is outside its limits, at most a tolerance."""
    lower, upper = hand.limits
    angles = as_floats(q, name, shape=lower.shape)
    excess = np.maximum(lower - angles, angles - upper)
    # `<=` is also false for NaN.
    if not (excess <= tolerance).all():
        i = np.argmax(excess)
        raise InvalidInputError(
            f"{hand.joint_names[i]} is {angles[i]:.6g} rad, expected within "
            f"[{lower[i] - tolerance:.6g}, {upper[i] + tolerance:.6g}]",
            argument=f"{name}[{i}]",
            value=float(angles[i]),
        )
    return angles, excess


def own_time(when: When) -> float:
    """Return the longest time that a command may take, in which filters of a hand count [s]."""
    return when.longest if isinstance(when, Instant) else when


def check_when(when: When) -> When:
    """Reject a time since the robot's last command that is not positive and finite.

    Likewise an instant that is not finite, or a longest time that is not positive.

    Raises:
        InvalidInputError: With the argument `dt`.
    """
    if not isinstance(when, Instant):
        return check_dt(when)
    time, longest = when
    is_time = is_real(longest) or longest == math.inf
    expect(
        is_real(time) and is_time and longest > 0.0,
        "dt",
        "an instant that is finite, and a longest time > 0 s",
        value=when,
    )
    return when


def check_dt(dt: float) -> float:
    """Reject a time that is not positive and finite.

    Raises:
        InvalidInputError: With the argument `dt`.
    """
    if not (is_real(dt) and dt > 0.0):
        raise InvalidInputError(argument="dt", expected="a time > 0 s", value=dt)
    return dt
