"""Teleoperation: the robot's fingers do what the human's do, finger by finger.

The paper's T is estimated in palm axes, from the human's rest posture to now, and imposed on the
robot's matched posture. What T cannot express, each finger's residual, goes to the partner on the
robot in full, scaled by the ratio of reaches. Away from a pinch, fingers are turned to point as the
human's do. Distance rows in the same QP show what positions cannot: how far each finger is
extended, and that thumb and finger touch. Contact rows keep links apart.

`TeleoperationModel` has what `handmap_qp` prepares of two hands. The compiled core computes the
targets of every sample by it (`handmap/targets.hpp`).
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from handmap_core.core import core
from handmap_core.ik import PointDistances
from handmap_core.models import PalmFollowingModel, TeleoperationModel, encode
from handmap_core.se3 import Array, inverse_pose, mirror_sign, transform_points
from .alignment import Alignment
from .estimation import MotionEstimator
from .palm import AnyHand, PalmMap, PalmMethod
from .targets import CoreMap, HumanPose, RobotPosture, Targets

_KNOWN = "palm", "gaps", "pinching", "extensions", "rest"
"""Results that targets are made with: the human's palm, (4, 4); gaps from the thumb's tip to each
finger's [m], and the share of each pinch row's weight, (p,) both; shares of reach, (f,); and the
joint positions that the rest term pulls to, (n,)."""


class PalmFollowing(NamedTuple):
    """How the robot's palm follows the human's.

    Attributes:
        alignment: From the human's world to the robot's.
        scale: Factor on the palm's translation.
        wrist_to_palm: Palm in the human's wrist, with the axes of the robot's, shape (4, 4).
        human_anchor: The human's anchor in its palm [m], shape (3,).
        robot_anchor: The robot's, likewise.
    """

    alignment: Alignment
    scale: float
    wrist_to_palm: Array
    human_anchor: Array
    robot_anchor: Array


class TeleoperationMap(CoreMap, PalmMap):
    """From samples to targets; see `TargetMap`. `model` has what they are computed with."""

    def __init__(
        self,
        method: BoundTeleoperation[AnyHand],
        sample: HumanPose,
        robot: RobotPosture,
    ) -> None:
        palm = method.palm
        anchors = palm.human_anchor, palm.robot_anchor
        super().__init__(method, sample, robot, *anchors, palm.scale)
        self.method = method
        self.model = method.model
        self.rest = method.model.rest
        self.palm_before = method.palm_of(sample)

    def make_core(self) -> core.TargetMap:
        """Return this map as the core has it."""
        return core.TeleoperationMap(self.method.model_bytes, encode(self.palm_model()))

    def targets_of(self, parts: list[Array], is_clamped: bool = False) -> Targets:
        """Return the targets whose arrays were computed; see `CoreMap.targets_of`.

        T is estimated in palm axes, from the human's rest posture. In the world, that posture lies
        at the palm of the reference, T_rb is the motion of the palm, and T_def all the rest.
        """
        del is_clamped
        points, wrist, aims, weights, margins, *rest = parts
        estimate = self.method.estimator.estimate_of(*rest[:3])
        known = dict(zip(_KNOWN, rest[3:], strict=True))
        palm = known["palm"]
        rigid = palm @ inverse_pose(self.palm_before)
        deformation = palm @ estimate.motion @ inverse_pose(palm)
        # The smallest one is negative where T mirrors.
        stretches = np.linalg.svd(estimate.linear, compute_uv=False)
        stretches[2] *= mirror_sign(estimate.linear)
        found = {
            "motion": deformation @ rigid,
            "motion_rigid": rigid,
            "motion_deformation": deformation,
            "stretches": stretches,
            "pivot_image": transform_points(palm, estimate.centroid_after),
            "residual_norms": estimate.residual_norms,
        }
        return Targets(
            points,
            wrist,
            found | known,
            (self.method.distances.aimed_at(aims, weights),),
            margins if self.method.keeps_apart else None,
            regularisation=self.model.regularisation,
            rest=known["rest"],
        )


class BoundTeleoperation(PalmMethod[AnyHand]):
    """The method for two hands; see `BoundMethod`.

    Args:
        human: The hand that leads.
        robot: The hand that follows.
        palm: How its palm follows.
        model: What targets are computed with, whatever the reference.
        estimator: Estimates T of the human's points.
        distances: The robot's distances that the model has rows of.
        keeps_apart: Whether links of the robot are kept apart.

    Attributes:
        palm: As given.
        model: As given.
        estimator: As given.
        distances: As given.
        keeps_apart: As given.
    """

    map_type = TeleoperationMap

    def __init__(
        self,
        human: AnyHand,
        robot: AnyHand,
        palm: PalmFollowing,
        model: TeleoperationModel,
        estimator: MotionEstimator,
        distances: PointDistances,
        *,
        keeps_apart: bool,
    ) -> None:
        super().__init__(palm.alignment, human, robot, palm.wrist_to_palm)
        self.palm = palm
        self.model = model
        self.estimator = estimator
        self.distances = distances
        self.keeps_apart = keeps_apart

    @cached_property
    def palm_model(self) -> PalmFollowingModel:
        """How the robot's palm follows, as the core has it."""
        palm = self.palm
        return self.following(palm.human_anchor, palm.robot_anchor, palm.scale)

    def start_palm(self, sample: HumanPose) -> Array:
        """Return the human's palm, moved so that the anchors of both hands have one place."""
        assert sample.wrist is not None
        return core.start_palm(encode(self.palm_model), sample.wrist)

    @cached_property
    def model_bytes(self) -> bytes:
        """The bytes of the model."""
        return encode(self.model)
