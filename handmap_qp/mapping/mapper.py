"""`HandMapper`: the paper's loop (Fig. 3), from a human sample to a robot command.

`_map` is the whole step: the method's targets (eqs. 5-7 for `Homogeneous`), then the QP in place of
eq. (8). `map_step` starts from joint angles (eq. 4), `map_points` from measured points, and
`map_sample` from what a tracker sent: its guard decides which samples the robot follows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import Any, Literal, get_args

import msgspec
import numpy as np
import numpy.typing as npt

from handmap_qp.errors import HandmapError, InvalidInputError, InvalidOptionsError
from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.human.sample import HumanSample
from handmap_qp.ik.gate import Motion
from handmap_qp.ik.limits import SHORTEST_DT
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import PointIk
from handmap_qp.ik.tasks import Task
from handmap_qp.mapping.landmarks import LandmarkReader
from handmap_qp.mapping.method import (
    BoundMethod,
    ForesightMap,
    HumanPose,
    Method,
    MethodOptions,
    RobotPosture,
    TargetMap,
    Targets,
)
from handmap_qp.mapping.methods.homogeneous import Homogeneous
from handmap_qp.mapping.presets import default_preset, get_preset
from handmap_qp.mapping.rejoin import Rejoin, RejoinKind
from handmap_qp.mapping.smoothing import Smoothing, SmoothState, smooth_sample
from handmap_qp.mapping.step import MapStep, RobotCommand
from handmap_qp.se3 import (
    FARTHEST,
    PoseLike,
    QuatOrder,
    as_floats,
    check_pose,
    inverse_pose,
)
from handmap_qp.stream.guard import StreamGuard, Verdict
from handmap_qp.stream.recorded_motion import RecordedSamples


class HandMapper:
    """Turns the motion of a human hand into the motion of a robot hand.

    The first sample is the reference unless `reset` has given one. There the robot is at rest with
    its palm on the human's palm (at the origin of its own world with `alignment="palm"`). The
    human's motion is imposed from there.

    A copy (`copy.deepcopy`, `copy.copy` or pickle) continues from the same state on its own.

    Args:
        human: The hand that leads, with a floating wrist; its reference points are the method's
            input.
        robot: The hand that follows.
        method: How a sample becomes targets: a `Method`, or the name of a preset (`PRESETS`). If
            omitted, `teleoperation` where the robot's fingers have partners on the human hand, else
            `object`.
        ik: Weights and settings of the QP; those of the preset if omitted.
        tasks: Further terms of the QP's cost, in every sample.
        smoothing: How samples are smoothed before they are mapped; not at all if omitted.
        dt: Time between samples [s], where a step gives none of its own.
        quat_order: Order of the quaternion in wrist poses given as seven numbers.
        joint_tolerance: How far a human joint may be outside its limits before the sample is
            rejected [rad].
        rejoin: How the robot comes back to the human after `map_sample` held it: `glide` there, or
            stay where it is with its palm, as after a `clutch`.
        **options: Short form of `method`: options of the paper's method, as in
            `HandMapper(human, robot, rigid_from="wrist")`.

    Attributes:
        human: The hand that leads.
        dt: Time between samples [s].
        joint_tolerance: As given [rad].

    Raises:
        InvalidOptionsError: If choices contradict each other or the hands.
        InvalidInputError: If `dt` or `joint_tolerance` cannot be used.
    """

    def __init__(
        self,
        human: Hand,
        robot: Hand,
        method: Method | str | None = None,
        *,
        ik: IkOptions | None = None,
        tasks: Sequence[Task] = (),
        smoothing: Smoothing | None = None,
        dt: float = 1.0 / 60.0,
        quat_order: QuatOrder | None = None,
        joint_tolerance: float = 0.25,
        rejoin: RejoinKind = "glide",
        **options: Any,
    ) -> None:
        if not human.is_floating:
            raise InvalidOptionsError(
                option="human",
                problem=f"{human.name} has a fixed wrist, and its pose comes with each sample",
                advice="load it with mount='floating'",
            )
        self.human = human
        self.dt = _check_dt(dt)
        self.joint_tolerance = _check_tolerance(joint_tolerance)
        self.quat_order: QuatOrder | None = quat_order
        self._given_robot = robot
        if method is None and not options:
            method = default_preset(human, robot)
        chosen, weights = _method_of(method, options)
        bound = chosen.bind(human, robot)
        solver = PointIk(bound.robot, ik or weights, contacts=bound.contacts)
        self._plan = _Plan(chosen, bound, solver, tuple(tasks), smoothing)
        # The wrist stays at the origin; points move with it afterwards.
        self._human_vector = human.configuration_vector(human.rest)
        # Points with a 1 behind each, which a pose moves in one product.
        self._human_rows = np.ones((len(human.reference_points), 4))
        self._start: _Start | None = _Start(robot.rest, None)
        self._course: _Course | None = None
        self._smooth: SmoothState | None = None
        self._is_released = False
        self._rejoin = Rejoin(_check_rejoin(rejoin))

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @property
    def rejoin(self) -> RejoinKind:
        """How the robot comes back to the human after a hold."""
        return self._rejoin.kind

    @property
    def robot(self) -> Hand:
        """The hand that follows, with the reference points that the method moves."""
        return self._plan.bound.robot

    @property
    def method(self) -> Method:
        """The mapping method: turns a sample into targets."""
        return self._plan.method

    @property
    def smoothing(self) -> Smoothing | None:
        """The smoothing of samples before they are mapped; None for none."""
        return self._plan.smoothing

    @property
    def ik(self) -> IkOptions:
        """Weights and settings of the QP."""
        return self._plan.ik.options

    @property
    def point_ik(self) -> PointIk:
        """The robot's present posture and the QP. Read it only: changing it breaks the mapper."""
        return self._plan.ik

    @property
    def motion(self) -> Motion:
        """How the robot moves. Set it where something else has moved the robot."""
        return self._plan.ik.gate.motion

    @motion.setter
    def motion(self, motion: Motion) -> None:
        self._start = None
        self._plan.ik.move_on(motion)

    def map_step(
        self, human_q: npt.ArrayLike, wrist_pose: PoseLike, *, dt: float | None = None
    ) -> MapStep:
        """Map one sample of the human hand.

        Args:
            human_q: Joint angles in the order of `human.joint_names` [rad], shape (n,). Angles
                outside their limits by no more than `joint_tolerance` are used, and named in
                `MapStep.out_of_range`.
            wrist_pose: Pose of the human's wrist in its world: a (4, 4) matrix, a `pinocchio.SE3`,
                or 7 numbers if the mapper was given a `quat_order`.
            dt: Time since the last sample [s]; the mapper's own if omitted.

        Returns:
            Every stage of the step, `command` being what a robot takes.

        Raises:
            InvalidInputError: If the sample cannot be used; the mapper is then as it was before.
            DegeneratePointsError: If the sample becomes the reference and its points do not
                determine the motion.
        """
        started = perf_counter()
        wrist = check_pose(wrist_pose, "wrist_pose", self.quat_order)
        angles, out_of_range = self._check_joints(human_q)
        return self._map(self._human_sample(angles, wrist), dt, out_of_range, started)

    def map_points(
        self,
        points: npt.ArrayLike,
        wrist_pose: PoseLike | None = None,
        *,
        dt: float | None = None,
    ) -> MapStep:
        """Map one sample of measured reference points, without joint angles.

        Args:
            points: The human's reference points in its world [m], in the order of
                `human.reference_points`, shape (n_h, 3).
            wrist_pose: Pose of the wrist as in `map_step`; may be omitted where the method does not
                need it.
            dt: Time since the last sample [s]; the mapper's own if omitted.

        Returns:
            Every stage of the step.

        Raises:
            InvalidInputError: If the sample cannot be used; the mapper is then as it was before.
            DegeneratePointsError: If the sample becomes the reference and its points do not
                determine the motion.
        """
        started = perf_counter()
        wrist = (
            None if wrist_pose is None else check_pose(wrist_pose, "wrist_pose", self.quat_order)
        )
        if wrist is None and (needs := self._needs_wrist()):
            raise InvalidInputError(argument="wrist_pose", problem=f"needed for {needs}")
        return self._map(HumanPose(self._check_points(points), wrist), dt, (), started)

    def map_landmarks(
        self,
        landmarks: npt.ArrayLike,
        wrist_pose: PoseLike | None = None,
        *,
        dt: float | None = None,
    ) -> MapStep:
        """Map one sample of measured landmarks: no joint angles of the human are fitted.

        The reference points are the landmarks themselves. The palm is a rigid fit of its five
        landmarks, unless the tracker's own wrist pose is given. Scale the human to the person first
        (`measure_hand`): the fit and the ratios of reach need the person's lengths.

        Args:
            landmarks: The 21 landmarks in the human's world [m], in MediaPipe's order, (21, 3).
            wrist_pose: Pose of the human model's wrist frame, as in `map_step`; fitted if omitted.
            dt: Time since the last sample [s]; the mapper's own if omitted.

        Returns:
            Every stage of the step.

        Raises:
            InvalidInputError: If the sample cannot be used; the mapper is then as it was before.
            InvalidOptionsError: If a reference point of the human is not a landmark.
            DegeneratePointsError: If the sample becomes the reference and its points do not
                determine the motion.
        """
        started = perf_counter()
        wrist = (
            None if wrist_pose is None else check_pose(wrist_pose, "wrist_pose", self.quat_order)
        )
        return self._map(self._landmarks.read(landmarks, wrist), dt, (), started)

    def map_sample(
        self, sample: HumanSample, *, dt: float | None = None, arrival: float | None = None
    ) -> MapStep:
        """Map one sample of a tracker, if it makes sense; else hold.

        The guard judges the sample by named rules (`stream.guard.RULES`). The robot brakes and
        holds its posture while samples make no sense, and comes back to the human without a snap
        (`rejoin`).

        Args:
            sample: The sample. Its time stamps say how much time has passed.
            dt: Time that the step may account for [s]; that of the time stamps if omitted.
            arrival: When the sample arrived, on a monotonic clock [s], to check the rate of the
                time stamps; not checked if omitted.

        Returns:
            Every stage of the step; of a held one, targets and points are the robot's own.

        Raises:
            InvalidInputError: If the sample is of the other hand, or cannot be used; the mapper is
                then as it was before.
            InvalidOptionsError: If a reference point of the human is not a landmark.
            DegeneratePointsError: If the sample becomes the reference and its points do not
                determine the motion.
        """
        started = perf_counter()
        dt = None if dt is None else _check_dt(dt)
        reader, guard, before = self._landmarks, self._guard, self._guard.state
        verdict = guard.check(sample, arrival=arrival)
        if verdict.is_held:
            return self._held(verdict, sample.confidence, dt, started)
        try:
            pose = reader.read(sample.landmarks, sample.wrist)
            return self._follow(pose, verdict, sample.confidence, dt, started)
        except HandmapError:
            guard.state = before
            raise

    def map_recorded(self, recorded: RecordedSamples) -> Iterator[MapStep]:
        """Map the samples of a recording one after the other, as `map_sample` up to rounding.

        Verdicts, palms and targets are computed by column, so that a sample costs little more than
        its QP.

        Args:
            recorded: The samples.

        Yields:
            The step of each sample.

        Raises:
            InvalidInputError: If the recording is of the other hand, or cannot be used.
            InvalidOptionsError: If a reference point of the human is not a landmark.
            DegeneratePointsError: If the first sample's points do not determine the motion.
        """
        verdicts, confidence = recorded.judged(self.human), recorded.confidence.tolist()
        points, wrists = self._landmarks.read_all(recorded.landmarks)
        course, targets = None, None
        for i, verdict in enumerate(verdicts):
            started = perf_counter()
            if verdict.is_held:
                yield self._held(verdict, confidence[i], None, started)
                continue
            asked = targets[i] if targets and course is self._course else None
            pose = HumanPose(points[i], wrists[i])
            step = self._follow(pose, verdict, confidence[i], None, started, asked)
            if course is not self._course:
                course, targets = self._course, self._foreseen(points, wrists)
            yield step

    def _foreseen(self, points: np.ndarray, wrists: np.ndarray) -> Sequence[Targets] | None:
        """Return the targets of all samples from the present reference, where the method can."""
        course, plan = self._course, self._plan
        if course is None or plan.smoothing is not None or plan.bound.renews_reference:
            return None
        known = course.map
        return known.targets_of(points, wrists) if isinstance(known, ForesightMap) else None

    def _follow(
        self,
        pose: HumanPose,
        verdict: Verdict,
        confidence: float,
        dt: float | None,
        started: float,
        foreseen: Targets | None = None,
    ) -> MapStep:
        """Map a sample that makes sense; its targets may be known unless the robot comes back."""
        rejoin = self._rejoin.start(pose) if verdict.is_return else self._rejoin
        moved, rejoin = rejoin.advance(pose, verdict.dt)
        asked = foreseen if moved is pose else None
        step = self._map(moved, _granted(verdict, dt), (), started, asked, verdict.speed)
        self._rejoin = rejoin
        return msgspec.structs.replace(
            step, verdict=verdict, confidence=confidence, is_gliding=rejoin.is_fading
        )

    def _held(
        self, verdict: Verdict, confidence: float, dt: float | None, started: float
    ) -> MapStep:
        """Return a step in which the robot brakes and keeps its posture."""
        ik, robot, seen = self._plan.ik, self.robot, self._rejoin.seen
        start, held = self._start, ik.hold(_granted(verdict, dt))
        if start is None:
            vector = ik.configuration.q
        else:
            # Before the first sample, a floating robot has no place yet.
            wrist = np.eye(4) if start.wrist is None and robot.is_floating else start.wrist
            vector = robot.configuration_vector(start.q, wrist)
        posture = _posture(robot, vector)
        if seen is None:
            seen = HumanPose(np.full((len(self.human.reference_points), 3), np.nan), None)
        return MapStep(
            RobotCommand(robot.joint_names, posture.q, posture.wrist),
            seen.points,
            seen.wrist,
            Targets(posture.points, posture.wrist),
            msgspec.structs.replace(held, points=posture.points, targets=posture.points),
            (),
            perf_counter() - started,
            verdict,
            confidence,
        )

    @cached_property
    def _human(self) -> Configuration:
        """The workspace of `map_step`; streams of landmarks need none."""
        return self.human.configuration()

    @cached_property
    def _guard(self) -> StreamGuard:
        return StreamGuard(self.human)

    @cached_property
    def _landmarks(self) -> LandmarkReader:
        return LandmarkReader(self.human)

    def _map(
        self,
        sample: HumanPose,
        dt: float | None,
        out_of_range: tuple[str, ...],
        started: float,
        foreseen: Targets | None = None,
        speed: float = 1.0,
    ) -> MapStep:
        """Map one sample with known points: targets by the method, motion by the QP."""
        dt = self.dt if dt is None else _check_dt(dt)
        plan, smooth = self._plan, None
        if plan.smoothing is not None:
            sample, smooth = smooth_sample(plan.smoothing, self._smooth, sample, dt)
        course = self._course or self._course_from(sample)
        asked = course.map.targets(sample) if foreseen is None else foreseen
        if plan.bound.renews_reference:
            # Points that cannot be the next reference are rejected before the robot moves.
            plan.bound.start(sample, course.posture)
        if course is not self._course:
            self._begin(course)
        self._smooth = smooth
        if self._is_released:
            result = plan.ik.hold(dt)
        else:
            tasks = (*asked.tasks, *plan.tasks) if plan.tasks else asked.tasks
            result = plan.ik.solve(
                asked.points,
                asked.wrist,
                dt,
                rest=course.map.rest,
                tasks=tasks,
                margins=asked.margins,
                speed=speed,
            )
        configuration = plan.ik.configuration
        robot = plan.bound.robot
        command = RobotCommand(
            robot.joint_names,
            configuration.q[robot.q_indices],
            configuration.wrist.homogeneous,
        )
        if plan.bound.renews_reference:
            kept = _copied(sample)
            posture = RobotPosture(command.q.copy(), result.points.copy(), command.wrist.copy())
            self._course = _Course(kept, posture, plan.bound.start(kept, posture))
        duration = perf_counter() - started
        return MapStep(command, sample.points, sample.wrist, asked, result, out_of_range, duration)

    def reset(
        self,
        human_q: npt.ArrayLike | None = None,
        wrist_pose: PoseLike | None = None,
        *,
        robot_q: npt.ArrayLike | None = None,
        robot_wrist: PoseLike | None = None,
    ) -> None:
        """Start again: the robot at a given posture, the reference at a given or the next sample.

        Args:
            human_q: Joint angles of the reference sample [rad], shape (n,); the next sample is the
                reference if omitted.
            wrist_pose: Wrist pose of the reference sample; goes with `human_q`.
            robot_q: Joint angles of the robot there [rad], inside their limits; its rest posture if
                omitted.
            robot_wrist: Wrist pose of the robot there; by default its palm lies on the human's.

        Raises:
            InvalidInputError: If something cannot be used; the mapper is then as it was before.
            DegeneratePointsError: If the reference points do not determine the motion.
        """
        if (human_q is None) != (wrist_pose is None):
            raise InvalidInputError(
                argument="wrist_pose" if wrist_pose is None else "human_q",
                problem="human_q and wrist_pose go together",
                advice="give both or neither",
            )
        start = _Start(
            self.robot.rest if robot_q is None else self._check_robot(robot_q),
            None if robot_wrist is None else self._check_robot_wrist(robot_wrist),
        )
        course = None
        if human_q is not None and wrist_pose is not None:
            wrist = check_pose(wrist_pose, "wrist_pose", self.quat_order)
            sample = self._human_sample(self._check_joints(human_q)[0], wrist)
            course = self._course_from(sample, start)
        self._start, self._is_released = start, False
        self._course = self._smooth = None
        self._rejoin = Rejoin(self._rejoin.kind)
        if course is not None:
            self._begin(course)

    def release(self) -> None:
        """Release the robot: it brakes and holds still until `clutch`, whatever the human does."""
        self._is_released = True

    def clutch(self) -> None:
        """Make the next sample the reference; the robot continues from its present posture."""
        self._is_released = False
        self._course = None
        self._rejoin = Rejoin(self._rejoin.kind)

    def configure(
        self,
        method: Method | str | None = None,
        *,
        ik: IkOptions | None = None,
        tasks: Sequence[Task] | None = None,
        smoothing: Smoothing | Literal["none"] | None = None,
    ) -> None:
        """Change options between samples: reference and posture of the robot stay.

        A reference that was taken without a wrist pose is given up where the new method needs one;
        the next sample then takes its place.

        Args:
            method: How a sample becomes targets, as of `HandMapper`; as it is if omitted.
            ik: Weights and settings of the QP; as they are if omitted, or those of a preset that
                `method` names.
            tasks: Further terms of the QP's cost; as they are if omitted.
            smoothing: How samples are smoothed, `"none"` for not at all; as it is if omitted.

        Raises:
            InvalidOptionsError: If choices contradict each other or the hands; the mapper is then
                as it was before.
            DegeneratePointsError: If with them the reference points do not determine the motion;
                likewise.
        """
        plan, course = self._plan, self._course
        if method is not None:
            chosen, weights = _method_of(method, {})
            ik = weights if ik is None and isinstance(method, str) else ik
            bound = chosen.bind(self.human, self._given_robot)
            solver = plan.ik.on_hand(bound.robot, bound.contacts)
            plan = replace(plan, method=chosen, bound=bound, ik=solver)
            course = None if course is None else self._recounted(course, bound)
        if ik is not None:
            plan = replace(plan, ik=plan.ik.with_options(ik))
        if tasks is not None:
            plan = replace(plan, tasks=tuple(tasks))
        if smoothing is not None:
            plan = replace(plan, smoothing=None if smoothing == "none" else smoothing)
        self._plan, self._course = plan, course

    # -- the reference

    def _course_from(self, sample: HumanPose, start: _Start | None = None) -> _Course:
        """Count from this sample, with the robot at its start, or where it is if it has started."""
        start, bound = start or self._start, self._plan.bound
        if start is None:
            vector = self._plan.ik.configuration.q
        else:
            wrist = start.wrist
            if wrist is None and bound.robot.is_floating:
                wrist = bound.start_palm(sample) @ inverse_pose(bound.robot.wrist_to_palm)
            vector = bound.robot.configuration_vector(start.q, wrist)
        kept, posture = _copied(sample), _posture(bound.robot, vector)
        begins_at = None if start is None else vector.copy()
        return _Course(kept, posture, bound.start(kept, posture), begins_at)

    def _recounted(self, course: _Course, bound: BoundMethod) -> _Course | None:
        """Count from the same reference by another method; None if it lacks what that needs."""
        if (bound.needs_wrist or bound.reference_needs_wrist) and course.sample.wrist is None:
            return None
        robot, before = bound.robot, course.posture
        wrist = before.wrist if robot.is_floating else None
        posture = _posture(robot, robot.configuration_vector(before.q, wrist))
        return _Course(course.sample, posture, bound.start(course.sample, posture))

    def _begin(self, course: _Course) -> None:
        """Make a course the mapper's, and put the robot where it begins unless it is on its way."""
        if course.begins_at is not None:
            self._plan.ik.place(course.begins_at)
        self._start, self._course = None, course

    def _needs_wrist(self) -> str:
        """Return what the next sample's wrist pose is needed for; empty if for nothing."""
        bound = self._plan.bound
        if bound.needs_wrist:
            return bound.needs_wrist
        if self._course is not None and not bound.renews_reference:
            return ""
        if bound.reference_needs_wrist:
            return bound.reference_needs_wrist
        if self._start is not None and self._start.wrist is None and self.robot.is_floating:
            return "placing the robot at the reference (or give reset a robot_wrist)"
        return ""

    # -- checks of what comes in

    def _human_sample(self, angles: np.ndarray, wrist: np.ndarray) -> HumanPose:
        """Compute the human's reference points in its world (eq. 4)."""
        self.human.write_configuration(self._human_vector, angles)
        self._human.place_frames(self._human_vector)
        self._human_rows[:, :3] = self._human.points
        return HumanPose(self._human_rows.dot(wrist[:3].T), wrist)

    def _check_joints(self, human_q: npt.ArrayLike) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return joint angles as an array, and the names of those outside their limits."""
        angles, human = as_floats(human_q, "human_q"), self.human
        if angles.shape != human.lower_limits.shape:
            raise InvalidInputError(
                argument="human_q",
                expected=f"shape {human.lower_limits.shape}",
                got=f"{angles.shape}",
            )
        # `fmax` puts a limit in place of NaN, so NaN counts as outside. Bytes compare in a fifth of
        # the time of arrays.
        inside = np.fmin(np.fmax(angles, human.lower_limits), human.upper_limits)
        if inside.tobytes() == angles.tobytes():
            return angles, ()
        excess = np.abs(angles - inside)
        worst = excess.max()
        # `not worst <= tolerance` also rejects NaN.
        if not worst <= self.joint_tolerance:
            i = int(np.argmax(excess))
            raise InvalidInputError(
                argument="human_q",
                problem=f"{human.joint_names[i]} is {angles[i]:.6g} rad, expected within "
                f"{self.joint_tolerance:g} rad of "
                f"[{human.lower_limits[i]:.6g}, {human.upper_limits[i]:.6g}]",
                value=float(angles[i]),
            )
        return angles, tuple(
            name for name, by in zip(human.joint_names, excess, strict=True) if by > 0.0
        )

    def _check_points(self, points: npt.ArrayLike) -> np.ndarray:
        count = len(self.human.reference_points)
        measured = as_floats(points, "points").copy()
        if measured.shape != (count, 3):
            raise InvalidInputError(
                argument="points", expected=f"shape ({count}, 3)", got=f"{measured.shape}"
            )
        if not (np.abs(measured) <= FARTHEST).all():
            raise InvalidInputError(
                argument="points",
                expected=f"finite coordinates within {FARTHEST:g} m",
                value=measured.tolist(),
            )
        return measured

    def _check_robot(self, robot_q: npt.ArrayLike) -> np.ndarray:
        robot, angles = self.robot, as_floats(robot_q, "robot_q").copy()
        if angles.shape != robot.rest.shape:
            raise InvalidInputError(
                argument="robot_q", expected=f"shape {robot.rest.shape}", got=f"{angles.shape}"
            )
        outside = ~((angles >= robot.lower_limits) & (angles <= robot.upper_limits))
        if outside.any():
            i = int(np.argmax(outside))
            raise InvalidInputError(
                argument="robot_q",
                problem=f"{robot.joint_names[i]} is {angles[i]:.6g} rad, expected within "
                f"[{robot.lower_limits[i]:.6g}, {robot.upper_limits[i]:.6g}]",
                value=float(angles[i]),
            )
        return angles

    def _check_robot_wrist(self, robot_wrist: PoseLike) -> np.ndarray:
        if not self.robot.is_floating:
            raise InvalidInputError(
                argument="robot_wrist",
                problem=f"{self.robot.name} has a fixed wrist, which stays where it is",
                advice="leave it out",
            )
        return check_pose(robot_wrist, "robot_wrist", self.quat_order)


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """All that `configure` changes: the method, what it is for these hands, and the solver."""

    method: Method
    bound: BoundMethod
    ik: PointIk
    tasks: tuple[Task, ...]
    smoothing: Smoothing | None


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """Posture of the robot at the reference: joints (n,); wrist, None for the human's palm."""

    q: np.ndarray
    wrist: np.ndarray | None


@dataclass(frozen=True, slots=True, eq=False)
class _Course:
    """Both hands at the reference, what the method made of them, and where the robot is put."""

    sample: HumanPose
    posture: RobotPosture
    map: TargetMap
    begins_at: np.ndarray | None = None


def _method_of(method: Method | str | None, options: dict[str, Any]) -> tuple[Method, IkOptions]:
    """Return the method that the arguments of `HandMapper` ask for, and the QP weights with it."""
    if isinstance(method, str) and not options:
        preset = get_preset(method)
        return preset.method, preset.ik
    chosen = Homogeneous() if method is None else method
    if options and isinstance(chosen, MethodOptions):
        return chosen.replaced(**options), IkOptions()
    if isinstance(chosen, Method) and not options:
        return chosen, IkOptions()
    raise InvalidOptionsError(
        option="method",
        expected="a method, the name of a preset, or single options of the paper's method",
        value=method,
    )


def _posture(robot: Hand, vector: np.ndarray) -> RobotPosture:
    """Compute where a robot's points and its wrist are in a configuration."""
    placed = robot.configuration()
    placed.place_frames(vector)
    return RobotPosture(vector[robot.q_indices], placed.points.copy(), placed.wrist.homogeneous)


def _copied(sample: HumanPose) -> HumanPose:
    """Copy a sample that is kept: the caller has its arrays too, and may write into them."""
    return HumanPose(sample.points.copy(), None if sample.wrist is None else sample.wrist.copy())


def _check_dt(dt: float) -> float:
    if not (isinstance(dt, (int, float)) and 0.0 < dt < np.inf):
        raise InvalidInputError(argument="dt", expected="a time > 0 s", value=dt)
    return dt


def _granted(verdict: Verdict, dt: float | None) -> float:
    """Return the time that a sample accounts for: that of its time stamps if none is given [s]."""
    return max(verdict.dt, SHORTEST_DT) if dt is None else dt


def _check_rejoin(rejoin: RejoinKind) -> RejoinKind:
    if rejoin not in get_args(RejoinKind):
        raise InvalidOptionsError(
            option="rejoin", expected=f"one of {', '.join(get_args(RejoinKind))}", value=rejoin
        )
    return rejoin


def _check_tolerance(tolerance: float) -> float:
    if not (isinstance(tolerance, int | float) and tolerance >= 0.0):
        raise InvalidInputError(
            argument="joint_tolerance", expected="an angle >= 0 rad", value=tolerance
        )
    return tolerance
