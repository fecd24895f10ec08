"""`TargetSource`: the human's side of one hand, from samples to targets of the robot's hand.

It has the readers, the method that is bound to two hands, and the reference. It does not move a
robot: `MovingRobot` does, and a mapper has one of each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike

from handmap_core.errors import InvalidInputError, InvalidOptionsError, expect
from handmap_core.hands import Hand
from handmap_core.ik import Task
from handmap_core.se3 import (
    Array,
    PoseLike,
    QuatOrder,
    as_points,
    check_pose,
    inverse_pose,
)
from .bound_method import BoundMethod
from .hand_request import HandRequest
from .readers import JointReader, LandmarkReader
from .reference import PlacedRobot, Placement, Reference
from .targets import CoreMap, HumanPose, TargetMap, Targets, check_targets

_PLACING = "placing the robot at the reference (or give reset a robot_wrist)"


Human_co = TypeVar("Human_co", bound=Hand, covariant=True)
Bound_co = TypeVar("Bound_co", bound=BoundMethod, covariant=True)


class TargetSource(Generic[Human_co, Bound_co]):
    """Turns the samples of a human hand into targets of a robot hand.

    Mapping a sample has two halves. `prepare` and `request` may raise, and change nothing. `take`
    and `renew` take the result, and do not fail.

    Args:
        human: The hand that leads, with a floating wrist.
        robot: The hand that follows.
        bind: Binds the method to both hands; called when they were checked.
        tasks: Further terms of the QP's cost, in every sample.
        quat_order: Order of the quaternion in wrist poses given as seven numbers.
        joint_tolerance: How far a human joint may be outside its limits [rad].

    Attributes:
        human: As given.
        bound: The method for the two hands.
        tasks: As given.
        quat_order: As given.
        joint_tolerance: As given [rad].
        counted_from: Both hands at the reference; None if the next sample becomes it.

    Raises:
        InvalidOptionsError: If choices contradict each other or the hands.
        InvalidInputError: If `robot` has several hands, or `joint_tolerance` cannot be used.
    """

    def __init__(
        self,
        human: Human_co,
        robot: Hand,
        bind: Callable[[], Bound_co],
        *,
        tasks: Sequence[Task] = (),
        quat_order: QuatOrder | None = None,
        joint_tolerance: float = 0.25,
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
        self.human = human
        self.quat_order = quat_order
        self.joint_tolerance = joint_tolerance
        self.tasks = tuple(tasks)
        self.bound = bind()
        self.counted_from: Reference | None = None

    @property
    def robot(self) -> Hand:
        """The hand that follows, with the reference points that the method moves."""
        return self.bound.robot

    @property
    def reference(self) -> HumanPose | None:
        """The human hand that motion is counted from; None if the next sample becomes it."""
        return self.counted_from and self.counted_from.sample

    @property
    def target_map(self) -> TargetMap | None:
        """What makes targets of samples from the reference on; None if the next becomes it."""
        return self.counted_from and self.counted_from.map

    @cached_property
    def landmarks(self) -> LandmarkReader:
        """Turns landmarks into samples of the human hand; errors are those of the reader."""
        return LandmarkReader(self.human, self.quat_order)

    @cached_property
    def joints(self) -> JointReader:
        """Turns joint angles into samples; streams of landmarks need none."""
        return JointReader(self.human, self.joint_tolerance, self.quat_order)

    @property
    def unseen(self) -> HumanPose:
        """A human hand of which nothing is known: its points are NaN."""
        points = np.full((len(self.human.reference_points), 3), np.nan)
        return HumanPose(points, None)

    def read_points(self, points: ArrayLike, wrist_pose: PoseLike | None) -> HumanPose:
        """Return a sample of measured reference points; see `HandMapper.map_points`.

        Raises:
            InvalidInputError: If they cannot be used.
        """
        wrist = None
        if wrist_pose is not None:
            wrist = check_pose(wrist_pose, "wrist_pose", self.quat_order)
        measured = as_points(points, "points", len(self.human.reference_points))
        return HumanPose(measured.copy(), wrist)

    # -- a sample: what may fail, and changes nothing

    def prepare(self, sample: HumanPose, robot: PlacedRobot) -> Reference:
        """Return the reference that a sample counts from.

        Args:
            sample: The sample.
            robot: Where the robot is, if the sample becomes the reference.

        Raises:
            InvalidInputError: If the sample has no wrist pose and needs one.
            DegeneratePointsError: If the sample becomes a reference and its points do not
                determine the motion.
        """
        if sample.wrist is None:
            self._check_wrist(robot.placement)
        reference = self.counted_from
        if reference is None:
            reference = self.reference_at(sample, robot.q, robot.placement)
        if self.bound.renews_reference:
            # Points that cannot be the next reference are rejected before the robot moves.
            self.bound.start(sample, reference.posture)
        return reference

    def reference_at(
        self, sample: HumanPose, q: Array, placement: Placement = Placement.KNOWN
    ) -> Reference:
        """Return the reference at a sample.

        Args:
            sample: The sample.
            q: The robot's configuration, shape (nq,).
            placement: Whether that is where the robot is. If it is not known, the robot's palm is
                put on the human's, as `alignment` takes it to the robot's world.

        Raises:
            DegeneratePointsError: If the sample's points do not determine the motion.
        """
        robot = self.robot
        if placement is Placement.UNKNOWN:
            palm = self.bound.start_palm(sample)
            wrist = palm @ inverse_pose(robot.wrist_to_palm)
            q = robot.configuration_vector(q[robot.q_indices], wrist)
        # The caller has the sample's arrays too, and may write into them.
        return Reference.at(self.bound, deepcopy(sample), q.copy())

    def core_map(self, sample: HumanPose, reference: Reference) -> CoreMap | None:
        """Return the map of a reference if the core makes the targets of a sample by it."""
        target_map = reference.map
        if self.tasks or sample.wrist is None or not isinstance(target_map, CoreMap):
            return None
        return target_map

    def request(
        self, sample: HumanPose, reference: Reference, dt: float, speed: float
    ) -> HandRequest:
        """Return what a sample asks of the robot.

        Args:
            sample: The sample.
            reference: What it counts from, as of `prepare`.
            dt: Time since the last sample of this hand [s].
            speed: Share of the speed limits at which the robot may move.

        Raises:
            InvalidOptionsError: If the method returns something else than targets.
        """
        target_map = reference.map
        targets = target_map.targets(sample)
        points = reference.posture.points
        # Compared in place, because a call for each sample takes time.
        is_right = (
            isinstance(targets, Targets)
            and isinstance(targets.points, np.ndarray)
            and isinstance(targets.wrist, np.ndarray)
            and targets.points.shape == points.shape
            and targets.wrist.shape == (4, 4)
        )
        if not is_right:
            check_targets(targets, len(points), target_map)
        if self.tasks:
            targets = structs.replace(targets, tasks=(*targets.tasks, *self.tasks))
        rest = target_map.rest if targets.rest is None else targets.rest
        return HandRequest(sample, targets, rest, dt, speed, target_map)

    # -- taking it, which does not fail

    def take(self, reference: Reference) -> None:
        """Count from a reference."""
        self.counted_from = reference

    def renew(self, sample: HumanPose, robot: PlacedRobot) -> None:
        """Count from the sample that was mapped last, if the method counts from sample to sample.

        Args:
            sample: The sample, which `prepare` has checked.
            robot: Where the robot is now.
        """
        if self.bound.renews_reference:
            self.counted_from = self.reference_at(sample, robot.q)

    def engage(self) -> None:
        """Make the next sample the reference."""
        self.counted_from = None

    def _check_wrist(self, placement: Placement) -> None:
        """Reject a sample without a wrist pose if it needs one."""
        bound = self.bound
        needs = bound.needs_wrist
        if self.counted_from is None or bound.renews_reference:
            needs = needs or bound.reference_needs_wrist
        if placement is Placement.UNKNOWN:
            needs = needs or _PLACING
        if needs:
            raise InvalidInputError(f"needed for {needs}", argument="wrist_pose")
