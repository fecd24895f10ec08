"""The paper's method: T of the human's points, split, and imposed on the robot's (eqs. 2-7).

    T          least squares with a ridge, from the reference to now       `MotionEstimator`
    T_def T_rb = T                                                         polar decomposition
    T_rb^r(s)  = Q R Q^T (s - c_r) + c_r + scale Q (T_rb(c_h) - c_h)
    T_def^r(s) = Q U Q^T (s - c_r') + c_r' + scale Q (T(c_h) - T_rb(c_h)),     c_r' = T_rb^r(c_r)

The targets of the points are `T_def^r T_rb^r s`, that of the wrist is `T_rb^r X`. `c_h` and `c_r`
are the pivots, `Q` the rotation from the human's world axes to the robot's.

This module prepares the formulas for a reference. The compiled core computes them for every sample
(`handmap/targets.hpp`); `handmap_qp.reference` has them to read, and to compare with.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from handmap_core.core import core
from handmap_core.errors import InvalidOptionsError
from handmap_core.models import HomogeneousModel, encode
from handmap_core.options import NotNegative, Share, number
from handmap_core.se3 import Array, affine, frozen, inverse_pose, transform_points
from .alignment import AlignedOptions, Row, rotation_of
from .estimation import MotionEstimator, about
from .palm import AnyHand, PalmMethod, palm_of
from .reference import posture_of
from .targets import CoreMap, HumanPose, RobotPosture, Targets

Partners = Sequence[tuple[int, int]]
"""Reference points that correspond: indices of the robot's and the human's."""


class HomogeneousOptions(AlignedOptions, frozen=True):
    """The paper's mapping, and the choices that it leaves open: how T is estimated, split, imposed.

    The defaults are the paper's, but for `ridge`: 0 is its least squares.

    Attributes:
        ridge: Pull of the estimated linear motion towards a rotation (eq. 6 with a ridge). 0 is the
            paper's least squares.
        rigid_from: Where the rigid part T_rb comes from. points: the polar factor of T (the paper).
            wrist: the measured displacement of the wrist. none: the robot's wrist stays, and the
            fingers take all of T.
        pivot: The point about which rotation and deformation act: the centroid of each hand's
            reference points, each hand's palm, a given point common to both worlds, or the origin
            of the world (the paper's literal reading).
        pivot_point: The point of pivot=point [m].
        scale: Factor on translations.
        reference: Configuration that T starts from. first: the sample that became the reference
            (the paper). rest: both hands' rest postures, placed at that sample's wrists, so that
            the posture of the first sample does not matter. previous: the sample before (Fig. 3).
        residual_gain: Part of each human point's residual to the imposed motion that its partner on
            the robot takes over; 0 is the paper.
        deformation_gain: Exponent g of the stretch, U^g. 1 is the paper; 0 leaves the fingers
            undeformed.
        stretch_min: Smallest stretch that is imposed.
        stretch_max: Largest stretch that is imposed.
    """

    ridge: NotNegative = 0.1
    rigid_from: Literal["points", "wrist", "none"] = "points"
    pivot: Literal["centroid", "palm", "point", "world"] = "centroid"
    pivot_point: Row | None = None
    scale: NotNegative = 1.0
    reference: Literal["first", "rest", "previous"] = "first"
    residual_gain: Share = 0.0
    # The bound is chosen so that stretch**gain cannot overflow.
    deformation_gain: Annotated[float, number(high=10.0)] = 1.0
    stretch_min: Share = 0.2
    stretch_max: Annotated[float, Meta(ge=1.0)] = 3.0

    def check(self) -> None:
        """Reject combinations without a meaning; see `Options.check`."""
        super().check()
        if (self.pivot == "point") != (self.pivot_point is not None):
            raise InvalidOptionsError(
                "goes together with pivot='point'",
                option="pivot_point",
                value=self.pivot_point,
                advice="give both or neither",
            )
        if self.deformation_gain != 1.0 and self.stretch_min == 0.0:
            raise InvalidOptionsError(
                "needs positive stretches",
                option="deformation_gain",
                value=self.deformation_gain,
                advice="give stretch_min > 0",
            )


class HomogeneousMap(CoreMap):
    """From samples to targets, counted from one reference of both hands; see `TargetMap`."""

    def __init__(
        self,
        method: BoundHomogeneous[AnyHand],
        sample: HumanPose,
        robot: RobotPosture,
    ) -> None:
        options = method.options
        human = method.human
        hand = method.robot
        self.options = options
        self.human_wrist = sample.wrist
        # A chain of references has no posture to come back to but the hand's own.
        self.rest = hand.rest if method.renews_reference else robot.q
        self.estimator = MotionEstimator(
            sample.points,
            weights=human.point_weights,
            ridge=options.ridge,
            has_prior=bool(method.needs_wrist),
        )
        robot_palm = robot.wrist @ hand.wrist_to_palm
        human_palm = None if sample.wrist is None else palm_of(sample, human)
        if options.pivot == "centroid":
            pivot = self.estimator.centroid
            robot_pivot = hand.point_weights @ robot.points / hand.point_weights.sum()
        elif options.pivot == "palm" and human_palm is not None:
            pivot = human_palm[:3, 3].copy()
            robot_pivot = robot_palm[:3, 3]
        else:
            pivot = robot_pivot = np.array(options.pivot_point or (0.0, 0.0, 0.0))
        self.pivot = frozen(pivot)
        self.alignment = Q = rotation_of(options.alignment, human_palm, robot_palm)
        # The origin of W, taken to V by shifts.
        self.origin = robot_pivot - options.scale * Q @ pivot
        self.human_offsets = sample.points - pivot
        self.robot_offsets = robot.points - robot_pivot
        self.robot_wrist = affine(robot.wrist[:3, :3], robot.wrist[:3, 3] - robot_pivot)
        # Residual gain of every pair, scaled by the ratio of sizes, shape (n_r, n_h).
        self.share = np.zeros((len(robot.points), len(sample.points)))
        if method.partners:
            pairs = tuple(np.array(method.partners).T)
            of_robot, of_human = robot.points[pairs[0]], sample.points[pairs[1]]
            robot_size, human_size = (
                np.linalg.norm(points - points.mean(axis=0))
                for points in (of_robot, of_human)
            )
            ratio = robot_size / human_size if human_size > 0.0 else 1.0
            self.share[pairs] = options.residual_gain * ratio

    def make_core(self) -> core.TargetMap:
        """Return this map as the core has it."""
        return core.HomogeneousMap(encode(self.model()))

    def model(self) -> HomogeneousModel:
        """Return what the core computes targets with."""
        options = self.options
        needs_wrist = options.rigid_from == "wrist"
        return HomogeneousModel(
            rigid_from=options.rigid_from,
            rest=self.rest,
            estimator=self.estimator.model(),
            stretch_min=options.stretch_min,
            stretch_max=options.stretch_max,
            deformation_gain=options.deformation_gain,
            scale=options.scale,
            pivot=self.pivot,
            origin=self.origin,
            alignment=self.alignment,
            human_wrist=self.human_wrist if needs_wrist else None,
            robot_wrist=self.robot_wrist,
            human_offsets=self.human_offsets,
            robot_offsets=self.robot_offsets,
            share=self.share,
        )

    def targets_of(self, parts: list[Array], is_clamped: bool) -> Targets:
        """Return the targets whose arrays were computed; T_def has clamping and gain.

        See `CoreMap.targets_of`.
        """
        points, wrist, *fit, linear, rotation, rigid_image, image, stretches = parts
        estimate = self.estimator.estimate_of(*fit)
        found = {
            "motion": estimate.motion,
            "motion_rigid": about(rotation, self.pivot, rigid_image),
            "motion_deformation": about(linear @ rotation.T, rigid_image, image),
            "residual_norms": estimate.residual_norms,
            "pivot_image": image,
            "stretches": stretches,
        }
        flags = ("stretch_clamped",) if is_clamped else ()
        return Targets(points, wrist, found, flags=flags)


_NEEDING_WRIST = [("pivot", "palm"), ("reference", "rest"), ("alignment", "palm")]
"""Choices that need the wrist of the reference sample."""


class BoundHomogeneous(PalmMethod[AnyHand]):
    """The method for two hands; see `BoundMethod`.

    Args:
        options: Its choices.
        human: The hand that leads.
        robot: The hand that follows.
        partners: The points that correspond; not used without `residual_gain`.

    Raises:
        InvalidOptionsError: If the choices contradict the hands.
    """

    def __init__(
        self,
        options: HomogeneousOptions,
        human: AnyHand,
        robot: AnyHand,
        partners: Partners = (),
    ) -> None:
        super().__init__(options.alignment, human, robot)
        self.options = options
        self.renews_reference = options.reference == "previous"
        self.needs_wrist = "rigid_from='wrist'" if options.rigid_from == "wrist" else ""
        needs = [
            f"{name}={value!r}"
            for name, value in _NEEDING_WRIST
            if getattr(options, name) == value
        ]
        self.reference_needs_wrist = " and ".join(needs)
        if options.rigid_from != "none" and not robot.has_moving_wrist:
            raise InvalidOptionsError(
                f"{options.rigid_from!r} moves the wrist; that of {robot.name} is fixed",
                option="rigid_from",
                value=options.rigid_from,
                advice="give rigid_from='none', or load the robot with mount='floating'",
            )
        count = len(human.reference_points)
        needed = 0 if self.needs_wrist else 3
        if options.ridge == 0.0:
            needed = 4
        if count < needed:
            raise InvalidOptionsError(
                f"{options.ridge:g} needs {needed} points; {human.name} has {count}",
                option="ridge",
                value=options.ridge,
                advice="choose more points, or ridge > 0 with rigid_from='wrist'",
            )
        self.partners = partners if options.residual_gain > 0.0 else ()

    def start(self, sample: HumanPose, robot: RobotPosture) -> HomogeneousMap:
        """Take both hands for the reference, as they are or at rest; see `BoundMethod.start`."""
        if self.options.reference == "rest":
            hand = self.robot
            points = self.human.points(self.human.rest, sample.wrist)
            sample = HumanPose(points, sample.wrist)
            at_rest = posture_of(hand, hand.configuration_vector(hand.rest))
            to_here = robot.wrist @ inverse_pose(at_rest.wrist)
            placed = transform_points(to_here, at_rest.points)
            robot = RobotPosture(hand.rest, placed, robot.wrist)
        return HomogeneousMap(self, sample, robot)
