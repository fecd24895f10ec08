"""Teleoperation: the robot's fingers do what the human's do, finger by finger.

The paper's T is estimated in palm axes, from the human's rest posture to now, and imposed on the
robot's matched posture. What T cannot express, each finger's residual, goes to the partner on the
robot in full, scaled by the ratio of reaches. Distance rows in the same QP show what positions
cannot: how far each finger is extended, and that thumb and finger touch. Contact rows keep links
apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import CONTACT_GAP, FINGERS, THUMB
from handmap_qp.ik.tasks import AttachedPoints, PointDistances
from handmap_qp.mapping.decomposition import polar
from handmap_qp.mapping.estimation import MotionEstimate, MotionEstimator
from handmap_qp.mapping.hand_pair import finger_landmarks, hand_pair
from handmap_qp.mapping.method import (
    FOLLOWING,
    Diagnostics,
    HumanPose,
    MethodOptions,
    Preset,
    RobotPosture,
    Targets,
)
from handmap_qp.mapping.palm import (
    PalmMap,
    PalmMethod,
    palm_of,
    point_indices,
    transform_point,
)
from handmap_qp.options import number, text
from handmap_qp.se3 import inverse_pose, lengths

# Thumb-finger gaps [m] at which a pinch row begins, and over which its weight rises to full.
_PINCH_FROM, _PINCH_OVER = 0.070, 0.050
# Pads of a closed pinch overlap by this, so that they press on each other [m].
_SQUEEZE = 0.003
# Margin between thumb and finger: least, per human gap beyond where it begins, most [m].
_CONTACT_MARGIN = 0.0005
_CONTACT_SLOPE = 0.25
_CONTACT_FROM = 0.018
_CONTACT_MOST = 0.005
# Levenberg-Marquardt factors of the distance rows: with less, gloves and coupled fingers shake.
_EXTENSION_DAMPING, _PINCH_DAMPING = 1.5, 3.0
# Margin between all other links [m].
_LINK_MARGIN = 0.001


class Teleoperation(MethodOptions, frozen=True):
    """Follow a tracked hand, finger by finger."""

    residual_gain: Annotated[
        float,
        number(
            "Part of each finger's residual to T that its partner takes over.", high=1.0
        ),
    ] = 1.0
    extension_weight: Annotated[
        float,
        number(
            "Weight of the fingers' extension, per 10 mm of knuckle-to-tip distance.",
            high=1e3,
        ),
    ] = 1.0
    thumb_extension_weight: Annotated[
        float,
        number(
            "The same of the thumb, whose position says less: thumbs oppose from different sides.",
            high=1e3,
        ),
    ] = 2.5
    pinch_weight: Annotated[
        float,
        number(
            "Weight of a pinch row, per 10 mm of distance between pads; 0 for none.",
            high=1e3,
        ),
    ] = 5.0
    contact_gap: Annotated[
        float,
        number(
            "Distance between the tracker's thumb and finger landmarks at skin contact [m]: 1 to 5 "
            "mm for gloves, 10 to 20 mm for cameras. `handmap map` measures it.",
            high=0.04,
        ),
    ] = CONTACT_GAP
    ridge: Annotated[
        float, number("Pull of T towards a rotation.", high=1e3, above=True)
    ] = 0.1
    scale: Annotated[
        float,
        number(
            "Factor on the palm's translation, for arms that reach less far than a person's.",
            high=1e3,
        ),
    ] = 1.0
    avoids_contact: Annotated[
        bool, text("Whether links of the robot are kept apart.")
    ] = True

    def fitted_to(self, human: Hand) -> Self:
        """Return these options with the contact gap of a person's hand."""
        return self.replaced(contact_gap=human.contact_gap)

    def bind(self, human: Hand, robot: Hand) -> BoundTeleoperation:
        """Measure both hands and match their postures; see `Method.bind`."""
        return BoundTeleoperation(self, human, robot)


def fingers_correspond(human: Hand, robot: Hand) -> bool:
    """Return whether a robot has fingers, and a human hand the points of theirs."""
    fingers = set(FINGERS) & {point.finger for point in robot.spec.points}
    return bool(fingers) and set(finger_landmarks(fingers)) <= set(point_indices(human))


PRESETS = {
    "teleoperation": Preset(
        Teleoperation(),
        FOLLOWING.replaced(rest_weight=0.05),
        "gestures and pinches of a tracked hand: each robot finger does what the human's does",
        "needs a tracked palm, and fingers with names; a grasped object's motion is not imposed",
        rank=0,
        suits=fingers_correspond,
    )
}


@dataclass(frozen=True, eq=False)
class TeleoperationDiagnostics(Diagnostics):
    """Results of one sample; see `Diagnostics`.

    T is estimated in palm axes, from the human's rest posture. In the world, that posture lies at
    the palm of the reference, and T_rb is the motion of the palm.

    Attributes:
        palm: The human's palm now, shape (4, 4).
        gaps: Human distance from the thumb tip to each finger's tip [m], shape (p,).
        pinching: Weight of each pinch row as a share of its full weight, shape (p,).
        extensions: Human knuckle-to-tip distance of each common finger as a share of its reach,
            shape (f,).
    """

    _estimate: MotionEstimate
    _palm_before: np.ndarray
    palm: np.ndarray
    gaps: np.ndarray
    pinching: np.ndarray
    extensions: np.ndarray

    @property
    def motion(self) -> np.ndarray:
        """T in the human's world, shape (4, 4)."""
        return self.motion_deformation @ self.motion_rigid

    @property
    def motion_rigid(self) -> np.ndarray:
        """The motion of the palm, shape (4, 4)."""
        return self.palm @ inverse_pose(self._palm_before)

    @property
    def motion_deformation(self) -> np.ndarray:
        """All the rest of T, shape (4, 4)."""
        return self.palm @ self._estimate.motion @ inverse_pose(self.palm)

    @property
    def stretches(self) -> np.ndarray:
        """Stretches of T, shape (3,)."""
        return polar(self._estimate.linear).stretches

    @property
    def pivot_image(self) -> np.ndarray:
        """Centroid of the points now [m], shape (3,)."""
        return transform_point(self.palm, self._estimate.centroid_after)

    @property
    def residual_norms(self) -> np.ndarray:
        """Distance of tips and middle joints from where T takes them [m], shape (n,)."""
        return self._estimate.residual_norms


class BoundTeleoperation(PalmMethod):
    """The method for two hands; see `BoundMethod`."""

    def __init__(self, choices: Teleoperation, human: Hand, robot: Hand) -> None:
        self.choices = choices
        self.pair = hand_pair(human, robot)
        pair = self.pair
        super().__init__(human, pair.robot)
        self.contacts = pair.contacts if choices.avoids_contact else None
        self.estimator = MotionEstimator(
            pair.human_rest[pair.shape_points], ridge=choices.ridge
        )
        # The thumb comes first.
        self.pinched = pair.fingers[1:] if THUMB in pair.fingers else ()
        self.pads = [pair.pads[f] for f in (THUMB, *self.pinched) if self.pinched]
        self._prepare_distances()
        self._prepare_margins()

    def start_palm(self, sample: HumanPose) -> np.ndarray:
        """Return the human's palm, moved so that the knuckles of both hands have one centre."""
        palm = super().start_palm(sample)
        palm[:3, 3] += palm[:3, :3] @ (
            self.pair.human_knuckles - self.pair.robot_knuckles
        )
        return palm

    def start(self, sample: HumanPose, robot: RobotPosture) -> TeleoperationMap:
        """Count the palm's displacement from here; the fingers start from the matched posture."""
        return TeleoperationMap(self, sample, robot)

    def _prepare_distances(self) -> None:
        """Lay out the distance rows: extension of each finger, then a pinch with each finger."""
        pair = self.pair
        chains = [pair.chains[finger] for finger in pair.fingers]
        places = [place for chain in chains for place in (chain.knuckle, chain.tip)]
        first = len(places)
        pairs = [(k, k + 1) for k in range(0, first, 2)]
        pairs += [(first, first + k) for k in range(1, len(self.pads))]
        places += [(pad.joint, pad.offset) for pad in self.pads]
        counts = [len(chains), len(self.pinched)]
        self.distances = PointDistances(
            AttachedPoints(pair.robot, places),
            pairs,
            np.zeros(len(pairs)),
            damping=np.repeat([_EXTENSION_DAMPING, _PINCH_DAMPING], counts),
        )
        self._prepare_aims()

    def _prepare_aims(self) -> None:
        """Make the wanted distance of each row a linear function of the human's, within bounds."""
        pair = self.pair
        choices = self.choices
        human = self.pair.human_rest
        at_rest = np.linalg.norm(human[pair.tips] - human[pair.knuckles], axis=1)
        posture = pair.robot_extension - at_rest / pair.human_reach
        # The robot's pads press on each other here.
        touching = np.array(
            [self.pads[0].radius + pad.radius - _SQUEEZE for pad in self.pads[1:]]
        )
        # Between jaws, an object is as large as between the human's fingers.
        ratio = 1.0 if pair.has_jaws else float(pair.reach_ratios.mean())
        many = np.ones(len(pair.fingers))
        few = np.ones(len(touching))
        self.aim_slopes = np.concatenate([pair.reach_ratios, ratio * few])
        self.aim_offsets = np.concatenate(
            [pair.robot_reach * posture, touching - ratio * choices.contact_gap]
        )
        self.least_aims = np.concatenate([0.0 * many, touching])
        self.largest_aims = np.concatenate([pair.robot_reach, np.inf * few])
        weights = {THUMB: choices.thumb_extension_weight}
        self.extension_weights = np.array(
            [weights.get(finger, choices.extension_weight) for finger in pair.fingers]
        )

    def aims(self, distances: np.ndarray) -> np.ndarray:
        """Return the wanted distance of each row for the human's, shape (..., k) both."""
        aims = self.aim_slopes * distances + self.aim_offsets
        return np.minimum(np.maximum(aims, self.least_aims), self.largest_aims)

    def pinching(self, gaps: np.ndarray) -> np.ndarray:
        """Return the share of its weight that each pinch row has at a gap, shape (..., p) both.

        It goes smoothly from 0 to 1 as thumb and finger come near; jaws follow a gap of any size.
        """
        far = np.inf if self.pair.has_jaws else _PINCH_FROM
        return smoothstep((far - gaps) / _PINCH_OVER)

    def _prepare_margins(self) -> None:
        """Say which contact pair belongs to which pinch."""
        fingers = () if self.contacts is None else self.contacts.fingers
        self.base_margins = np.full(len(fingers), _LINK_MARGIN)
        closing = [
            (k, self.pinched.index(f))
            for k, f in enumerate(fingers)
            if f in self.pinched
        ]
        self.pinch_pairs, self.pinch_of_pair = (
            np.array(closing, dtype=int).reshape(-1, 2).T
        )
        covers = [self.pads[0].cover + pad.cover for pad in self.pads[1:]]
        self.pinch_margins = _CONTACT_MARGIN + np.array(covers).take(self.pinch_of_pair)


class TeleoperationMap(PalmMap):
    """From samples to targets; see `TargetMap`."""

    def __init__(
        self, method: BoundTeleoperation, sample: HumanPose, robot: RobotPosture
    ) -> None:
        pair = method.pair
        scale = method.choices.scale
        anchors = pair.human_knuckles, pair.robot_knuckles
        super().__init__(method, sample, robot, *anchors, scale)
        self.rest = pair.matched
        self._method = method
        self._pair = pair
        self._palm_before = palm_of(sample, method.human)
        # A human distance from each tip to its knuckle, then to each pinched finger's tip from the
        # thumb's.
        count = len(method.pinched)
        self._from = np.append(pair.knuckles, pair.tips[:1].repeat(count))
        self._to = np.append(pair.tips, pair.tips[1 : 1 + count])

    def targets(self, sample: HumanPose) -> Targets:
        """Impose T and the fingers' residuals in palm axes; add extension, pinches and contacts."""
        wrist = None if sample.wrist is None else sample.wrist[None]
        return self.targets_of(HumanPose(sample.points[None], wrist))[0]

    def targets_of(self, samples: HumanPose) -> list[Targets]:
        """Return the targets of many samples along a leading axis; see `TargetMap`."""
        method = self._method
        pair = self._pair
        count = len(self._pair.fingers)
        human_palms, palms, now = self.follow(samples)
        estimate = method.estimator.estimate(now[:, pair.shape_points])
        distances = lengths(now[:, self._to] - now[:, self._from])
        extensions = distances[:, :count] / pair.human_reach
        gaps = distances[:, count:]
        aims = method.aims(distances)
        pinching = method.pinching(gaps)
        points, wrists = self.placed(palms, self._moved(estimate, now))
        extending = np.broadcast_to(method.extension_weights, extensions.shape)
        weights = np.hstack([extending, method.choices.pinch_weight * pinching])
        margins = self._margins(gaps)
        return [
            Targets(
                points[i],
                wrists[i],
                TeleoperationDiagnostics(
                    estimate[i],
                    self._palm_before,
                    human_palms[i],
                    gaps[i],
                    pinching[i],
                    extensions[i],
                ),
                (method.distances.aimed_at(aims[i], weights[i]),),
                None if margins is None else margins[i],
            )
            for i in range(len(points))
        ]

    def _moved(self, estimate: MotionEstimate, now: np.ndarray) -> np.ndarray:
        """Move the matched points by T, and add each finger's residual; palm axes, (..., m, 3).

        With s the robot's points and c_r their centre, x and y the human partners at rest and now,
        c and c' the centroids, k the ratio of reaches and g the gain:
        `A (s - c_r) + c_r + k (c' - c) + g k (y - A (x - c) - c')`.
        """
        pair = self._pair
        ratio = self._pair.finger_ratio
        gain = self._method.choices.residual_gain * ratio
        centroid = estimate.centroid_before
        shift = estimate.centroid_after[..., None, :]
        offsets = (
            pair.robot_rest
            - pair.robot_centre
            - gain * (pair.human_rest[pair.partners] - centroid)
        )
        followed = offsets @ estimate.linear.swapaxes(-1, -2) + pair.robot_centre
        return (
            followed
            + ratio * (shift - centroid)
            + gain * (now[..., pair.partners, :] - shift)
        )

    def _margins(self, gaps: np.ndarray) -> np.ndarray | None:
        """Widen the margin between thumb and finger with the human's gap: nothing may touch.

        Args:
            gaps: In one sample or in many [m], shape (..., p).

        Returns:
            Margins [m], shape (..., k); None if links are not kept apart.
        """
        method = self._method
        if method.contacts is None:
            return None
        wide = np.minimum(
            np.maximum(_CONTACT_SLOPE * (gaps - _CONTACT_FROM), 0.0), _CONTACT_MOST
        )
        margins = np.empty((*gaps.shape[:-1], len(method.base_margins)))
        margins[:] = method.base_margins
        margins[..., method.pinch_pairs] = (
            method.pinch_margins + wide[..., method.pinch_of_pair]
        )
        return margins


def smoothstep(x: np.ndarray) -> np.ndarray:
    """Go smoothly from 0 at 0 to 1 at 1."""
    x = np.minimum(np.maximum(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)
