"""The targets of the published method, and of what `teleoperation` adds to it, by numpy.

    mapper = HandMapper(human, robot, PublishedMethod(MappingOptions()))

The maps of `handmap_qp.mapping.methods` prepare what depends on two hands and a reference. The maps
here compute the same targets as the compiled core does (`handmap/targets.hpp`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_core.errors import InvalidOptionsError
from handmap_core.models import PalmModel, TeleoperationModel
from handmap_core.se3 import (
    Array,
    affine,
    inverse_pose,
    lengths,
    smoothstep,
    transform_points,
)
from handmap_qp.hands import Hand
from handmap_qp.mapping import HumanPose, MotionEstimate, RobotPosture, Targets
from handmap_qp.mapping.method import BoundMethod, TargetMap
from handmap_qp.mapping.methods.homogeneous import Homogeneous, HomogeneousMap
from handmap_qp.mapping.methods.teleoperation import Teleoperation, TeleoperationMap
from .decomposition import polar
from .estimation import estimate


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
        return self._prepared.asked(parts, is_clamped)

    def _placed(self, image: Array) -> Array:
        """Return the image of the robot's pivot [m], shape (3,), given that of the human's."""
        model = self._model
        return model.origin + model.scale * (model.alignment @ image)


class PublishedTeleoperation:
    """The targets of `teleoperation` from one reference on; see `TargetMap`.

    Args:
        prepared: What does not depend on the sample.
    """

    def __init__(self, prepared: TeleoperationMap) -> None:
        self.rest = prepared.rest
        self._prepared = prepared
        self._model = prepared.model
        self._palm = prepared.palm_model()

    def targets(self, sample: HumanPose) -> Targets:
        """Impose T and the fingers' residuals in palm axes; add extension, pinches and contacts."""
        model = self._model
        assert sample.wrist is not None
        human_palm = sample.wrist @ self._palm.human_wrist_to_palm
        palm = moved_palm(self._palm, human_palm)
        now = transform_points(inverse_pose(human_palm), sample.points)
        shape = now[model.shape_points]
        fit = estimate(self._prepared.method.estimator, shape)
        distances = lengths(now[model.to_points] - now[model.from_points])
        extensions, gaps = np.split(distances, [len(model.human_reach)])
        pinching = pinch_shares(model, gaps)
        points = pointed(model, moved_points(model, fit, now), now, pinching)
        parts = [
            transform_points(palm, points),
            palm @ self._palm.robot_palm_to_wrist,
            row_aims(model, distances),
            np.append(model.extension_weights, model.pinch_weight * pinching),
            contact_margins(model, gaps),
            fit.linear,
            fit.centroid_after,
            shape,
            human_palm,
            gaps,
            pinching,
            extensions / model.human_reach,
        ]
        return self._prepared.asked(parts)


def moved_palm(model: PalmModel, human: Array) -> Array:
    """Return the target of the robot's palm for the human's, shape (4, 4) both.

    Both have the same rotation from the reference on, and the same translation, or a multiple of
    it, of a point on each palm.
    """
    if model.is_still:
        return model.start
    Q = model.alignment
    moved = transform_points(human, model.human_anchor) - model.human_start
    origin = transform_points(human, model.origin) + model.offset
    origin += model.further * moved
    return affine(Q @ human[:3, :3] @ model.rotation, Q @ origin)


def row_aims(model: TeleoperationModel, distances: Array) -> Array:
    """Return the wanted distance of each row for the human's [m], shape (k,) both."""
    aims = model.aim_slopes * distances + model.aim_offsets
    return np.clip(aims, model.least_aims, model.largest_aims)


def pinch_shares(model: TeleoperationModel, gaps: Array) -> Array:
    """Return the share of its weight that each pinch row has at a gap [m], shape (p,) both.

    It goes smoothly from 0 to 1 as thumb and finger come near; jaws follow a gap of any size.
    """
    return smoothstep((model.pinch_from - gaps) / model.pinch_over)


def contact_margins(model: TeleoperationModel, gaps: Array) -> Array:
    """Return the margin of every contact pair at the human's gaps [m], shape (k,).

    That between thumb and finger widens with the gap, so that nothing touches.
    """
    wide = model.contact_slope * (gaps - model.contact_from)
    wide = np.clip(wide, 0.0, model.contact_most)
    margins = model.base_margins.copy()
    margins[model.pinch_pairs] = model.pinch_margins + wide[model.pinch_of_pair]
    return margins


def moved_points(model: TeleoperationModel, fit: MotionEstimate, now: Array) -> Array:
    """Move the matched points by T, and add each finger's residual.

    With s the robot's points and c_r their centre, x and y the human partners at rest and now, c
    and c' the centroids, k the ratio of reaches and g the gain:
    `A (s - c_r) + c_r + k (c' - c) + g k (y - A (x - c) - c')`.

    Args:
        model: The method for two hands.
        fit: T of the human's points in palm axes.
        now: The human's points in palm axes [m], shape (n_h, 3).

    Returns:
        Points in the robot's palm axes [m], shape (m, 3).
    """
    shift = fit.centroid_after
    followed = model.offsets @ fit.linear.T + model.robot_centre
    return (
        followed
        + model.ratio * (shift - fit.centroid_before)
        + model.gain * (now[model.partners] - shift)
    )


def pointed(
    model: TeleoperationModel, points: Array, now: Array, pinching: Array
) -> Array:
    """Turn points to where the human's fingers point, except where they pinch.

    Args:
        model: The method for two hands.
        points: Points in the robot's palm axes [m], shape (m, 3).
        now: The human's points in palm axes [m], shape (n_h, 3).
        pinching: As of `pinch_shares`, shape (p,).

    Returns:
        The points, shape (m, 3).
    """
    # The thumb pinches with the finger that is nearest to it.
    closing = np.append(pinching.max(initial=0.0), pinching)
    closing = closing.take(model.finger_of, mode="clip")
    shares = model.directions * (1.0 - (1.0 - model.likeness) * closing)
    vectors = now[model.partners] - now[model.starts]
    directed = model.bases + model.ratios[:, None] * vectors
    directed += model.carried[:, None] * now[model.starts]
    return points + shares[:, None] * (directed - points)
