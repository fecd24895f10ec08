"""The targets of the published method (eq. 7), by numpy.

    mapper = HandMapper(human, robot, PublishedMethod(MappingOptions()))

The maps of `handmap_qp.mapping.methods` prepare what depends on two hands and a reference. The maps
here compute the same targets as the compiled core does (`handmap/targets.hpp`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_core.errors import InvalidOptionsError
from handmap_core.mapping.homogeneous import HomogeneousMap
from handmap_core.mapping.teleoperation import TeleoperationMap
from handmap_core.se3 import (
    Array,
    affine,
    inverse_pose,
    transform_points,
)
from handmap_qp.hands import Hand
from handmap_qp.mapping import HumanPose, RobotPosture, Targets
from handmap_qp.mapping.method import BoundMethod, TargetMap
from handmap_qp.mapping.methods.homogeneous import Homogeneous
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from .decomposition import polar
from .estimation import estimate
from .teleoperation_targets import PublishedTeleoperation


class PublishedMethod(NamedTuple):
    """A method of T whose targets are computed here, and not by the core; see `Method`.

    Attributes:
        choices: Its options: `MappingOptions()` are those of the preset `paper`.
    """

    choices: Homogeneous | Teleoperation

    def bind(self, human: Hand, robot: Hand) -> BoundPublished:
        """Check the method against two hands; see `Method.bind`.

        Raises:
            InvalidOptionsError: If the choices are of another method, or contradict the hands.
        """
        if not isinstance(self.choices, Homogeneous | Teleoperation):
            raise InvalidOptionsError(
                option="method",
                expected="options of Homogeneous or Teleoperation",
                value=self.choices,
            )
        return BoundPublished(self.choices.bind(human, robot))


class BoundPublished:
    """The method for two hands; see `BoundMethod`."""

    def __init__(self, bound: BoundMethod) -> None:
        self._bound = bound
        self.robot = bound.robot
        self.contacts = bound.contacts
        self.needs_wrist = bound.needs_wrist
        self.reference_needs_wrist = bound.reference_needs_wrist
        self.renews_reference = bound.renews_reference

    def start_palm(self, sample: HumanPose) -> Array:
        """Return where a floating robot's palm is put; see `BoundMethod.start_palm`."""
        return self._bound.start_palm(sample)

    def start(self, sample: HumanPose, robot: RobotPosture) -> TargetMap:
        """Take both hands for the reference; see `BoundMethod.start`."""
        prepared = self._bound.start(sample, robot)
        if isinstance(prepared, TeleoperationMap):
            return PublishedTeleoperation(prepared)
        assert isinstance(prepared, HomogeneousMap)
        return PublishedHomogeneous(prepared)


class PublishedHomogeneous:
    """The paper's targets from one reference on (eqs. 2-7); see `TargetMap`.

    Args:
        prepared: What does not depend on the sample.
    """

    def __init__(self, prepared: HomogeneousMap) -> None:
        self.rest = prepared.rest
        self._prepared = prepared
        self._model = prepared.model()

    def targets(self, sample: HumanPose) -> Targets:
        """Estimate T, split it about the pivot, and impose both parts on the robot."""
        model = self._model
        Q = model.alignment
        moved = None
        if model.human_wrist is not None:
            assert sample.wrist is not None
            moved = sample.wrist @ inverse_pose(model.human_wrist)
        prior = None if moved is None else moved[:3, :3]
        fit = estimate(self._prepared.estimator, sample.points, prior)
        image = fit.image(model.pivot)
        factors = polar(fit.linear)
        stretches = np.clip(factors.stretches, model.stretch_min, model.stretch_max)
        is_clamped = not np.array_equal(stretches, factors.stretches)
        linear = factors.stretch(stretches**model.deformation_gain) @ factors.rotation
        if model.rigid_from == "none":
            moved = np.eye(4)
        rotation = factors.rotation if moved is None else moved[:3, :3]
        rigid_image = image if moved is None else transform_points(moved, model.pivot)
        points = model.robot_offsets @ (Q @ linear @ Q.T).T + self._placed(image)
        # The residual refers to the imposed motion, so it makes up for clamping and gain.
        residual = sample.points - (model.human_offsets @ linear.T + image)
        points += model.share @ residual @ Q.T
        turn = affine(Q @ rotation @ Q.T, self._placed(rigid_image))
        parts = [
            points,
            turn @ model.robot_wrist,
            fit.linear,
            fit.centroid_after,
            sample.points,
            linear,
            rotation,
            rigid_image,
            image,
            factors.stretches,
        ]
        return self._prepared.targets_of(parts, is_clamped)

    def _placed(self, image: Array) -> Array:
        """Return the image of the robot's pivot [m], shape (3,), given that of the human's."""
        model = self._model
        return model.origin + model.scale * (model.alignment @ image)
