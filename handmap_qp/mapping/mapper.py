"""`HandMapper`: the paper's loop (Fig. 3), from a human sample to a robot command.

`_map` is the whole way on one screen: T (eqs. 5-6), `T = T_def T_rb` and the robot's targets (eqs.
2-3, 7), the QP in place of eq. (8). `map_step` comes to it from joint angles (eq. 4), `map_points`
from points that were measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.estimation import MotionEstimator
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.mapping.reference import Reference, make_reference, partner_pairs
from handmap_qp.mapping.step import MapStep, RobotCommand
from handmap_qp.mapping.transfer import transfer_motion, wrist_displacement
from handmap_qp.transform import FARTHEST, PoseLike, QuatOrder, check_pose


class HandMapper:
    """Turns the motion of a human hand into the motion of a robot hand.

    The first sample is the reference unless `reset` has given one. There the robot is at rest with
    its palm where the human's palm is (at the origin of its own world with `alignment="palm"`), and
    from there the human's motion is imposed.

    Args:
        human: The hand that leads, with a floating wrist; its reference points give T.
        robot: The hand that follows.
        options: The mapping's choices; defaults if omitted.
        ik: Weights and settings of the QP; defaults if omitted.
        dt: Time between samples [s], where a step gives none of its own.
        quat_order: Order of the quaternion in wrist poses given as seven numbers.
        **changes: Single choices, as fields of `MappingOptions`: `HandMapper(human, robot,
            rigid_from="wrist")`.

    Raises:
        InvalidOptionsError: If choices contradict each other or the hands.
    """

    def __init__(
        self,
        human: Hand,
        robot: Hand,
        options: MappingOptions | None = None,
        *,
        ik: IkOptions | None = None,
        dt: float = 1.0 / 60.0,
        quat_order: QuatOrder | None = None,
        **changes: Any,
    ) -> None:
        self.human = human
        self.robot = robot
        self.options = _with_changes(options or MappingOptions(), changes)
        self.dt = _check_dt(dt)
        self.quat_order: QuatOrder | None = quat_order
        _check_hands(human, robot, self.options)
        self._human = human.configuration()
        self._human_vector = np.zeros(human.model.nq)
        self._ik = PointIk(robot, ik or IkOptions())
        self._partners = partner_pairs(human, robot, self.options)
        self._start: _Start | None = _Start(robot.rest, None)
        self._reference: Reference | None = None
        self._is_released = False

    @property
    def ik(self) -> IkOptions:
        """Weights and settings of the QP."""
        return self._ik.options

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
                determine T.
        """
        started = perf_counter()
        wrist = check_pose(wrist_pose, "wrist_pose", self.quat_order)
        angles, out_of_range = self._check_joints(human_q)
        points = self._human_points(angles, wrist)
        return self._map(points, wrist, dt, out_of_range, started)

    def map_points(
        self, points: npt.ArrayLike, wrist_pose: PoseLike | None = None, *, dt: float | None = None
    ) -> MapStep:
        """Map one sample of measured reference points (markers, landmarks), without joint angles.

        Args:
            points: The human's reference points in its world [m], in the order of
                `human.reference_points`, shape (n_h, 3).
            wrist_pose: Pose of the wrist as in `map_step`; may be omitted where nothing needs it.
            dt: Time since the last sample [s]; the mapper's own if omitted.

        Returns:
            Every stage of the step.

        Raises:
            InvalidInputError: If the sample cannot be used; the mapper is then as it was before.
            DegeneratePointsError: If the sample becomes the reference and its points do not
                determine T.
        """
        started = perf_counter()
        wrist = (
            None if wrist_pose is None else check_pose(wrist_pose, "wrist_pose", self.quat_order)
        )
        if wrist is None and (needs := self._needs_wrist()):
            raise InvalidInputError(f"wrist_pose: needed for {needs}")
        return self._map(self._check_points(points), wrist, dt, (), started)

    def _map(
        self,
        human_points: np.ndarray,
        human_wrist: np.ndarray | None,
        dt: float | None,
        out_of_range: tuple[str, ...],
        started: float,
    ) -> MapStep:
        """Eqs. (5)-(8) for one sample whose human points are known."""
        dt = self.dt if dt is None else _check_dt(dt)
        reference = self._reference or self._take_reference(human_points, human_wrist)
        prior = (
            wrist_displacement(reference, human_wrist)[0]
            if self.options.rigid_from == "wrist"
            else None
        )
        estimate = reference.estimator.estimate(human_points, prior)
        transfer = transfer_motion(estimate, reference, human_wrist, self.options)
        # With reference="previous" these points are the next reference; if they cannot be, that is
        # said before the robot moves.
        following = self._estimator(human_points) if self.options.reference == "previous" else None
        result = (
            self._ik.hold()
            if self._is_released
            else self._ik.solve(transfer.targets, transfer.wrist_target, dt)
        )
        if following is not None:
            self._reference = self._reference_with(following, human_points, human_wrist)
        robot = self._ik.configuration
        command = RobotCommand(
            self.robot.joint_names, robot.q[self.robot.q_indices], robot.wrist.homogeneous
        )
        return MapStep(
            command,
            human_points,
            estimate,
            transfer,
            result,
            out_of_range,
            perf_counter() - started,
        )

    def reset(
        self,
        human_q: npt.ArrayLike | None = None,
        wrist_pose: PoseLike | None = None,
        *,
        robot_q: npt.ArrayLike | None = None,
        robot_wrist: PoseLike | None = None,
    ) -> None:
        """Start anew.

        The robot at a given posture, and the reference at a given sample or at the next one.

        Args:
            human_q: Joint angles of the reference sample [rad], shape (n,); the next sample is the
                reference if omitted.
            wrist_pose: Wrist pose of the reference sample; goes with `human_q`.
            robot_q: Joint angles of the robot there [rad], inside their limits; its rest posture if
                omitted.
            robot_wrist: Wrist pose of the robot there; by default its palm lies where the human's
                does.

        Raises:
            InvalidInputError: If something cannot be used; the mapper is then as it was before.
            DegeneratePointsError: If the reference points do not determine T.
        """
        if (human_q is None) != (wrist_pose is None):
            raise InvalidInputError(
                "reset: human_q and wrist_pose go together; give both or neither"
            )
        start = _Start(
            self.robot.rest if robot_q is None else self._check_robot(robot_q),
            None if robot_wrist is None else self._check_robot_wrist(robot_wrist),
        )
        if human_q is None or wrist_pose is None:
            self._start, self._reference, self._is_released = start, None, False
            return
        wrist = check_pose(wrist_pose, "wrist_pose", self.quat_order)
        points = self._human_points(self._check_joints(human_q)[0], wrist)
        before, self._start = self._start, start
        try:
            self._take_reference(points, wrist)
        except Exception:
            self._start = before
            raise
        self._is_released = False

    def release(self) -> None:
        """Let go: the robot holds still, whatever the human does, until `clutch`."""
        self._is_released = True

    def clutch(self) -> None:
        """Take hold (again).

        The next sample becomes the reference, and the robot goes on from where it is.
        """
        self._is_released = False
        self._reference = None

    def configure(
        self, options: MappingOptions | None = None, *, ik: IkOptions | None = None
    ) -> None:
        """Change options on the way.

        The reference stays what it was, and the robot goes on from where it is.

        A reference that was taken without a wrist pose cannot stay where the new options need one;
        the next sample then takes its place.

        Args:
            options: The mapping's choices; as they are if omitted.
            ik: Weights and settings of the QP; as they are if omitted.

        Raises:
            InvalidOptionsError: If choices contradict each other or the hands; the mapper is then
                as it was before.
            DegeneratePointsError: If with them the reference points do not determine T; likewise.
        """
        changed = HandMapper(self.human, self.robot, options or self.options, ik=ik or self.ik)
        changed._start = self._start
        if (before := self._reference) is not None and (
            before.human_wrist is not None or not changed._needs_wrist()
        ):
            changed._ik.place(before.robot_q)
            estimator = changed._estimator(before.human_points)
            changed._reference = changed._reference_with(
                estimator, before.human_points, before.human_wrist
            )
        changed._ik.take_over(self._ik)
        self.options, self._partners = changed.options, changed._partners
        self._ik, self._reference = changed._ik, changed._reference

    # -- checks at the door
    # -------------------------------------------------------------------------------------------

    def _check_joints(self, human_q: npt.ArrayLike) -> tuple[np.ndarray, tuple[str, ...]]:
        """Joint angles as an array, and the names of those outside their limits."""
        try:
            angles = np.asarray(human_q, dtype=float)
        except (TypeError, ValueError) as error:
            raise InvalidInputError(
                f"human_q: expected numbers, got {type(human_q).__name__}"
            ) from error
        human = self.human
        if angles.shape != human.lower_limits.shape:
            raise InvalidInputError(
                f"human_q: expected shape {human.lower_limits.shape}, got {angles.shape}"
            )
        excess = np.maximum(human.lower_limits - angles, angles - human.upper_limits)
        worst = np.maximum.reduce(excess)
        if worst <= 0.0:
            return angles, ()
        # A NaN is greater than nothing and fails this test too.
        if not worst <= self.options.joint_tolerance:
            i = int(np.argmax(excess))
            raise InvalidInputError(
                f"human_q: {human.joint_names[i]} is {angles[i]:.6g} rad, expected within {self.options.joint_tolerance:g} rad of "
                f"[{human.lower_limits[i]:.6g}, {human.upper_limits[i]:.6g}]",
                value=float(angles[i]),
            )
        return angles, tuple(
            name for name, by in zip(human.joint_names, excess, strict=True) if by > 0.0
        )

    def _check_points(self, points: npt.ArrayLike) -> np.ndarray:
        count = len(self.human.reference_points)
        try:
            measured = np.array(points, dtype=float)
        except (TypeError, ValueError) as error:
            raise InvalidInputError(
                f"points: expected numbers, got {type(points).__name__}"
            ) from error
        if measured.shape != (count, 3):
            raise InvalidInputError(f"points: expected shape ({count}, 3), got {measured.shape}")
        if not (np.abs(measured) <= FARTHEST).all():
            raise InvalidInputError(
                f"points: expected coordinates within {FARTHEST:g} m, got {measured.tolist()}"
            )
        return measured

    def _check_robot(self, robot_q: npt.ArrayLike) -> np.ndarray:
        robot = self.robot
        angles = np.array(robot_q, dtype=float)
        if angles.shape != robot.rest.shape:
            raise InvalidInputError(
                f"robot_q: expected shape {robot.rest.shape}, got {angles.shape}"
            )
        outside = ~((angles >= robot.lower_limits) & (angles <= robot.upper_limits))
        if outside.any():
            i = int(np.argmax(outside))
            limits = f"[{robot.lower_limits[i]:.6g}, {robot.upper_limits[i]:.6g}]"
            raise InvalidInputError(
                f"robot_q: {robot.joint_names[i]} is {angles[i]:.6g} rad, expected within {limits}"
            )
        return angles

    def _check_robot_wrist(self, robot_wrist: PoseLike) -> np.ndarray:
        if not self.robot.is_floating:
            raise InvalidInputError(
                f"robot_wrist: {self.robot.name} has a fixed wrist, which stays where it is"
            )
        return check_pose(robot_wrist, "robot_wrist", self.quat_order)

    def _needs_wrist(self) -> str:
        """What a wrist pose is needed for in the next sample; empty if for nothing."""
        if self.options.rigid_from == "wrist":
            return "rigid_from='wrist'"
        if self._reference is not None and self.options.reference == "initial":
            return ""
        if self.options.pivot == "palm" or self.options.alignment == "palm":
            return "pivot='palm' and alignment='palm'"
        if self._start is not None and self._start.wrist is None and self.robot.is_floating:
            return "placing the robot at the reference (or give reset a robot_wrist)"
        return ""

    # -- the reference
    # ------------------------------------------------------------------------------------------------

    def _human_points(self, angles: np.ndarray, wrist: np.ndarray) -> np.ndarray:
        """Human reference points in its world (eq. 4), shape (n_h, 3)."""
        self.human.write_configuration(self._human_vector, angles, wrist)
        self._human.place_frames(self._human_vector)
        return self._human.points.copy()

    def _estimator(self, human_points: np.ndarray) -> MotionEstimator:
        return MotionEstimator(
            human_points,
            weights=self.human.point_weights,
            ridge=self.options.ridge,
            has_prior=self.options.rigid_from == "wrist",
        )

    def _take_reference(
        self, human_points: np.ndarray, human_wrist: np.ndarray | None
    ) -> Reference:
        """Make this sample the reference, and put the robot at its start if it is not on its way already."""
        estimator = self._estimator(human_points)
        if self._start is not None:
            self._ik.place(
                self.robot.configuration_vector(
                    self._start.q, self._start_wrist(self._start, human_wrist)
                )
            )
            self._start = None
        self._reference = self._reference_with(estimator, human_points, human_wrist)
        return self._reference

    def _reference_with(
        self, estimator: MotionEstimator, human_points: np.ndarray, human_wrist: np.ndarray | None
    ) -> Reference:
        """Both hands as they are now, as the reference."""
        return make_reference(
            self.human,
            self.robot,
            self.options,
            estimator,
            human_points,
            human_wrist,
            self._ik.configuration,
            self._partners,
        )

    def _start_wrist(self, start: _Start, human_wrist: np.ndarray | None) -> np.ndarray | None:
        """Where the robot's wrist starts: as asked, or with its palm where the human's palm is."""
        if start.wrist is not None or not self.robot.is_floating:
            return start.wrist
        if self.options.alignment == "palm" or human_wrist is None:
            palm = np.eye(4)
        else:
            palm = human_wrist @ self.human.wrist_to_palm
            if not isinstance(self.options.alignment, str):
                palm[:3] = np.array(self.options.alignment) @ palm[:3]
        return palm @ np.linalg.inv(self.robot.wrist_to_palm)


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """Where the robot is put at the reference.

    Joint angles, shape (n,), and a wrist pose or None for the human's palm.
    """

    q: np.ndarray
    wrist: np.ndarray | None


def _with_changes(options: MappingOptions, changes: dict[str, Any]) -> MappingOptions:
    unknown = set(changes) - set(MappingOptions.__slots__)
    if unknown:
        raise InvalidOptionsError(
            f"no option {', '.join(sorted(unknown))}; there are {', '.join(MappingOptions.__slots__)}"
        )
    return replace(options, **changes)


def _check_dt(dt: float) -> float:
    if not 0.0 < dt < np.inf:
        raise InvalidInputError(f"dt: expected a time > 0 s, got {dt}", value=dt)
    return dt


def _check_hands(human: Hand, robot: Hand, options: MappingOptions) -> None:
    """Refuse choices that these two hands cannot carry out."""
    if not human.is_floating:
        raise InvalidOptionsError(
            f"human: {human.name} has a fixed wrist; load it with mount='floating', since its pose comes with each sample"
        )
    if not robot.has_moving_wrist and options.rigid_from != "none":
        raise InvalidOptionsError(
            f"rigid_from={options.rigid_from!r} moves the wrist, and {robot.name}'s is fixed: give rigid_from='none', "
            "or load the robot with mount='floating'"
        )
    count = len(human.reference_points)
    needed = 4 if options.ridge == 0.0 else 3
    if count < needed and not (options.ridge > 0.0 and options.rigid_from == "wrist"):
        raise InvalidOptionsError(
            f"{human.name} has {count} reference points and ridge={options.ridge:g} needs {needed}: choose more points, "
            "or ridge > 0 with rigid_from='wrist'"
        )
