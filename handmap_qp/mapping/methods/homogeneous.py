"""The paper's method: one homogeneous transformation T carries the human's motion to the robot.

T by least squares (eqs. 5-6), `T = T_def T_rb` (eqs. 2-3), imposed on the robot's points (eq. 7).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec
import numpy as np

from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs
from handmap_qp.mapping.estimation import MotionEstimate, MotionEstimator
from handmap_qp.mapping.method import HumanPose, RobotPosture, Targets
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.mapping.reference import Reference, make_reference, require_partners
from handmap_qp.mapping.rigid import RIGID_PARTS
from handmap_qp.mapping.transfer import Transfer, transfer_motion
from handmap_qp.transform import inverse_pose, transform_points

_PALM_OPTIONS = ("pivot", "alignment")


@dataclass(frozen=True)
class Homogeneous:
    """The paper's mapping method.

    Args:
        options: The choices that the paper leaves open.
    """

    options: MappingOptions = field(default_factory=MappingOptions)

    def bind(self, human: Hand, robot: Hand) -> BoundHomogeneous:
        """Check the options against two hands; see `Method.bind`."""
        return BoundHomogeneous(self.options, human, robot)


class HomogeneousDiagnostics(msgspec.Struct, frozen=True, eq=False):
    """Intermediate results for one sample.

    Attributes:
        estimate: T and how it fits (eqs. 5-6).
        transfer: T_rb, T_def and the robot's targets (eqs. 2-3, 7).
    """

    estimate: MotionEstimate
    transfer: Transfer


class BoundHomogeneous:
    """The method for two hands; see `BoundMethod`."""

    contacts: ShapePairs | None = None

    def __init__(self, options: MappingOptions, human: Hand, robot: Hand) -> None:
        self.options, self.human, self.robot = options, human, robot
        self.rigid = RIGID_PARTS[options.rigid_from]
        self.renews_reference = options.reference == "previous"
        self.needs_wrist = f"rigid_from={options.rigid_from!r}" if self.rigid.needs_wrist else ""
        needs = [f"{name}='palm'" for name in _PALM_OPTIONS if getattr(options, name) == "palm"]
        needs += ["reference='rest'"] if options.reference == "rest" else []
        self.reference_needs_wrist = " and ".join(needs)
        self._check_hands()
        self._partners = (
            require_partners(
                human,
                robot,
                option="residual_gain",
                value=options.residual_gain,
                advice=", or give residual_gain=0",
            )
            if options.residual_gain > 0.0
            else []
        )

    def start_palm(self, sample: HumanPose) -> np.ndarray:
        """Return the human's palm in the robot's world; its origin with `alignment="palm"`."""
        palm = np.eye(4)
        if self.options.alignment != "palm" and sample.wrist is not None:
            palm = sample.wrist @ self.human.wrist_to_palm
            if not isinstance(self.options.alignment, str):
                palm[:3] = np.array(self.options.alignment) @ palm[:3]
        return palm

    def start(self, sample: HumanPose, robot: RobotPosture) -> HomogeneousMap:
        """Take both hands for the reference, as they are or at rest; see `BoundMethod.start`."""
        if self.options.reference == "rest":
            sample, robot = self._at_rest(sample, robot)
        estimator = MotionEstimator(
            sample.points,
            weights=self.human.point_weights,
            ridge=self.options.ridge,
            has_prior=self.rigid.needs_wrist,
        )
        reference = make_reference(
            self.human, self.robot, self.options, estimator, sample, robot, self._partners
        )
        # A chain of references has no posture to come back to but the hand's own.
        return HomogeneousMap(
            self, reference, self.robot.rest if self.renews_reference else robot.q
        )

    def _at_rest(self, sample: HumanPose, robot: RobotPosture) -> tuple[HumanPose, RobotPosture]:
        """Put both hands' rest postures where their wrists are."""
        if sample.wrist is None:
            raise InvalidInputError(argument="wrist_pose", problem="needed for reference='rest'")
        points = self.human.points(self.human.rest, sample.wrist)
        hand = self.robot
        to_here = robot.wrist @ inverse_pose(hand.frame_pose("wrist", hand.rest))
        placed = transform_points(to_here, hand.points(hand.rest))
        return HumanPose(points, sample.wrist), RobotPosture(hand.rest, placed, robot.wrist)

    def _check_hands(self) -> None:
        """Reject choices that these two hands cannot carry out."""
        options, human, robot = self.options, self.human, self.robot
        if self.rigid.moves_wrist and not robot.has_moving_wrist:
            raise InvalidOptionsError(
                option="rigid_from",
                problem=f"{options.rigid_from!r} moves the wrist; that of {robot.name} is fixed",
                value=options.rigid_from,
                advice="give rigid_from='none', or load the robot with mount='floating'",
            )
        count, needed = len(human.reference_points), 4 if options.ridge == 0.0 else 3
        if count < needed and not (options.ridge > 0.0 and self.rigid.needs_wrist):
            raise InvalidOptionsError(
                option="ridge",
                problem=f"{options.ridge:g} needs {needed} points; {human.name} has {count}",
                value=options.ridge,
                advice="choose more points, or ridge > 0 with rigid_from='wrist'",
            )


class HomogeneousMap:
    """From samples to targets, counted from one reference; see `TargetMap`."""

    def __init__(self, method: BoundHomogeneous, reference: Reference, rest: np.ndarray) -> None:
        self.reference = reference
        self.rest = rest
        self._options, self._rigid = method.options, method.rigid

    def targets(self, sample: HumanPose) -> Targets:
        """Estimate T, split it, and carry it to the robot."""
        reference = self.reference
        prior = self._rigid.prior(reference.human_wrist, sample.wrist)
        estimate = reference.estimator.estimate(sample.points, prior)
        transfer = transfer_motion(estimate, reference, sample, self._options)
        return Targets(
            transfer.targets, transfer.wrist_target, HomogeneousDiagnostics(estimate, transfer)
        )
