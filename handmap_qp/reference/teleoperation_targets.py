"""The targets of `teleoperation`, by numpy: T in palm axes, and what T cannot express.

`TeleoperationMap` prepares what depends on two hands and a reference. Functions here take its
`TeleoperationModel`, as the compiled core does (`handmap/targets.hpp`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_core.mapping.teleoperation import TeleoperationMap
from handmap_core.models import PalmModel, TeleoperationModel
from handmap_core.se3 import (
    Array,
    affine,
    cross_matrices,
    inverse_pose,
    lengths,
    transform_points,
)
from handmap_qp.mapping import HumanPose, MotionEstimate, Targets
from .estimation import estimate

# Bones of a person are no nearer to each other [m].
_SKIN = 1e-3
# Least cosine of two directions of which one is turned onto the other.
_BACK = -0.9


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
        thumb = thumb_offsets(model, now)
        aims[:1] = thumb_aim(model, thumb, extensions[:1], aims[:1])
        points = pointed(model, moved_points(model, fit, now), now, pinching)
        points, lying = lying_thumb(model, points, now, thumb, gaps)
        weights = np.append(model.extension_weights, model.pinch_weight * pinching)
        weights[:1] *= 1.0 - (1.0 - model.lying_extension) * lying
        parts = [
            transform_points(palm, points),
            palm @ self._palm.robot_palm_to_wrist,
            aims,
            weights,
            contact_margins(model, gaps, lying),
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


class ThumbOffsets(NamedTuple):
    """Where the human's thumb tip is from each segment of the other fingers.

    Attributes:
        shares: Share of each segment at which it is nearest, shape (s,).
        vectors: From there to the tip [m], shape (s, 3).
    """

    shares: Array
    vectors: Array


def thumb_aim(
    model: TeleoperationModel, thumb: ThumbOffsets, extension: Array, aim: Array
) -> Array:
    """Return the wanted extension of a thumb, as straight as the person's where that is open.

    It is open where its tip is far from all segments of the other fingers.

    Args:
        model: The method for two hands.
        thumb: Where its tip is, of `thumb_offsets`.
        extension: The thumb's distance from knuckle to tip over its reach, shape (1,).
        aim: The distance that is wanted of the robot's otherwise [m], shape (1,).
    """
    if len(model.from_points) == len(model.human_reach):
        # Without pinches, the first finger need not be a thumb.
        return aim
    nearest = lengths(thumb.vectors).min()
    share = _smooth((nearest - model.open_from) / model.open_over)
    straight = model.largest_aims[:1] * np.minimum(extension, 1.0)
    return aim + share * (straight - aim)


def thumb_offsets(model: TeleoperationModel, now: Array) -> ThumbOffsets:
    """Return where the thumb's tip is from each segment of the human's fingers.

    Args:
        model: The method for two hands.
        now: The human's points in palm axes [m], shape (n_h, 3).
    """
    tip = now[model.to_points[0]]
    starts = now[model.segment_starts]
    along = now[model.segment_ends] - starts
    squares = np.maximum((along**2).sum(axis=1), np.finfo(float).tiny)
    shares = np.clip(((tip - starts) * along).sum(axis=1) / squares, 0.0, 1.0)
    return ThumbOffsets(shares, tip - starts - shares[:, None] * along)


def lying_thumb(
    model: TeleoperationModel,
    points: Array,
    now: Array,
    thumb: ThumbOffsets,
    gaps: Array,
) -> tuple[Array, float]:
    """Lay a thumb on the segment of a finger that the human's lies on.

    On the same side of it, at the same share of its length, and as far away as the robot's two
    fingers are thick. Segments count by the fourth power of their nearness.

    Args:
        model: The method for two hands.
        points: Points in the robot's palm axes [m], shape (m, 3).
        now: The human's points in palm axes [m], shape (n_h, 3).
        thumb: Where its tip is, of `thumb_offsets`.
        gaps: Gap of the thumb's tip and each finger's [m], shape (p,).

    Returns:
        The points, shape (m, 3), and how far the thumb lies on a segment, from 0 to 1.
    """
    if not len(gaps):
        return points, 0.0
    shares, offsets = thumb
    distances = lengths(offsets)
    near = _smooth((model.lying_from - distances) / model.lying_over)
    apart = _smooth((gaps.min() - model.tips_from) / model.tips_over)
    lying = float(model.lying_weight * near.max() * apart)
    if not lying > 0.0:
        return points, 0.0
    is_base = model.segment_from[:, None] < 0
    starts = np.where(is_base, model.segment_bases, points[model.segment_from])
    robots = points[model.segment_to] - starts
    humans = now[model.segment_ends] - now[model.segment_starts]
    wanted = model.segment_touching + np.maximum(distances - model.skin_gap, 0.0)
    turned = [
        least_rotation(human, robot) @ offset
        for human, robot, offset in zip(humans, robots, offsets, strict=True)
    ]
    # Across the segment, where noise decides the side, the way from it shrinks to nothing.
    scales = wanted / np.maximum(distances, max(0.5 * model.skin_gap, _SKIN))
    places = starts + shares[:, None] * robots + scales[:, None] * np.array(turned)
    weights = near / np.maximum(distances, _SKIN) ** 4
    place = weights @ places / weights.sum()
    is_thumb = (model.finger_of == 0)[:, None]
    return points + is_thumb * lying * (place - points[0]), lying


def least_rotation(human: Array, robot: Array) -> Array:
    """Return the least rotation of one direction onto another one, shape (3, 3).

    Beyond 154 degrees it shortens what it turns: opposite directions do not say which way to turn.
    """
    scale = lengths(human) * lengths(robot)
    if not scale > 0.0:
        return np.eye(3)
    K = cross_matrices(np.cross(human, robot) / scale)
    return np.eye(3) + K + K @ K / (1.0 + max(human @ robot / scale, _BACK))


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


def contact_margins(
    model: TeleoperationModel, gaps: Array, lying: float = 0.0
) -> Array:
    """Return the margin of every contact pair at the human's gaps [m], shape (k,).

    That between thumb and finger widens with the gap, so that nothing touches, unless the thumb
    lies on a finger.
    """
    wide = model.contact_slope * (gaps - model.contact_from)
    wide = (1.0 - lying) * np.clip(wide, 0.0, model.contact_most)
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
