"""The targets of `teleoperation`, by numpy: T in palm axes, and what T cannot express.

`TeleoperationMap` prepares what depends on two hands and a reference. Functions here take its
`TeleoperationModel`, as the compiled core does (`handmap/targets.hpp`).
"""

from __future__ import annotations

import numpy as np

from handmap_core.mapping.teleoperation import TeleoperationMap
from handmap_core.models import PalmModel, TeleoperationModel
from handmap_core.se3 import (
    Array,
    affine,
    inverse_pose,
    lengths,
    transform_points,
)
from handmap_qp.mapping import HumanPose, MotionEstimate, Targets
from .estimation import estimate


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
        extensions = extensions / model.human_reach
        pinching = pinch_shares(model, gaps, extensions[1 : len(gaps) + 1])
        aims = row_aims(model, distances)
        aims[:1] = thumb_aim(model, now, extensions[:1], aims[:1])
        points = pointed(model, moved_points(model, fit, now), now, pinching)
        parts = [
            transform_points(palm, points),
            palm @ self._palm.robot_palm_to_wrist,
            aims,
            np.append(model.extension_weights, model.pinch_weight * pinching),
            contact_margins(model, gaps),
            fit.linear,
            fit.centroid_after,
            shape,
            human_palm,
            gaps,
            pinching,
            extensions,
            rest_posture(model, gaps),
        ]
        return self._prepared.targets_of(parts)


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


def thumb_aim(
    model: TeleoperationModel, now: Array, extension: Array, aim: Array
) -> Array:
    """Return the wanted extension of a thumb, as straight as the person's where that is open.

    It is open where its tip is far from all bones of the other fingers.

    Args:
        model: The method for two hands.
        now: The human's points in palm axes [m], shape (n_h, 3).
        extension: The thumb's distance from knuckle to tip over its reach, shape (1,).
        aim: The distance that is wanted of the robot's otherwise [m], shape (1,).
    """
    if len(model.from_points) == len(model.human_reach):
        # Without pinches, the first finger need not be a thumb.
        return aim
    tip = now[model.to_points[0]]
    starts = now[model.bone_starts]
    bones = now[model.bone_ends] - starts
    squares = np.maximum((bones**2).sum(axis=1), np.finfo(float).tiny)
    shares = np.clip(((tip - starts) * bones).sum(axis=1) / squares, 0.0, 1.0)
    nearest = lengths(tip - starts - shares[:, None] * bones).min()
    share = _smooth((nearest - model.open_from) / model.open_over)
    straight = model.largest_aims[:1] * np.minimum(extension, 1.0)
    return aim + share * (straight - aim)


def rest_posture(model: TeleoperationModel, gaps: Array) -> Array:
    """Return the posture that the rest term pulls to at gaps of the pinches [m], shape (p,).

    As a pinch closes, the matched posture becomes the one that closes it, shape (n,).
    """
    shares = _smooth((model.rest_from - gaps) / model.rest_over)
    return model.rest + shares @ model.pinch_rests / max(shares.sum(), 1.0)


def pinch_shares(
    model: TeleoperationModel, gaps: Array, extensions: float | Array = 0.0
) -> Array:
    """Return the share of its weight that each pinch row has at a gap [m], shape (p,) both.

    It goes smoothly from 0 to 1 as thumb and finger come near, later if the finger is straight;
    jaws follow a gap of any size.

    Args:
        model: The method for two hands.
        gaps: Gap of the thumb and each finger [m], shape (p,).
        extensions: Share of its reach that each of these fingers has, shape (p,).
    """
    straight = np.asarray(extensions - model.straight_from) / model.straight_over
    less = model.straight_less * _smooth(straight)
    return _smooth((model.pinch_from - less - gaps) / (model.pinch_over - less))


def _smooth(share: Array) -> Array:
    """Go from 0 at 0 to 1 at 1 with no slope at either end."""
    # Written here as well: `se3.smoothstep` is the core's, which this is to be compared with.
    x = np.clip(share, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


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
