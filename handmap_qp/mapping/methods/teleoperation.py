"""Teleoperation: the robot's fingers do what the human's do, finger by finger.

The paper's T is estimated in palm axes, from the human's rest posture to now, and imposed on the
robot's matched posture. What T cannot express, each finger's residual, goes to the partner on the
robot in full, scaled by the ratio of reaches. Away from a pinch, fingers are turned to point as the
human's do. Distance rows in the same QP show what positions cannot: how far each finger is
extended, and that thumb and finger touch. Contact rows keep links apart.

This module prepares the formulas for two hands. `handmap_core.mapping.teleoperation` counts them
from a reference, and the compiled core computes them for every sample (`handmap/targets.hpp`);
`handmap_qp.reference` has them to read, and to compare with.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Self

import numpy as np

from handmap_core.errors import InvalidOptionsError
from handmap_core.mapping import teleoperation
from handmap_core.mapping.teleoperation import PalmFollowing
from handmap_core.models import TeleoperationModel
from handmap_core.options import Share, number
from handmap_core.se3 import Array, affine, lengths
from handmap_qp.hands import (
    CONTACT_GAP,
    FINGERS,
    LINK_MARGIN,
    SLIDING_STIFFNESS,
    STIFFNESS,
    THUMB,
    Hand,
    ShapePairs,
    yield_to,
)
from handmap_qp.ik import IkOptions
from handmap_qp.mapping import (
    FOLLOWING,
    AlignedOptions,
    MotionEstimator,
    Preset,
)
from handmap_qp.mapping.hand_pair import (
    finger_landmarks,
    hand_pair,
    touching_distances,
)
from handmap_qp.mapping.palm import point_indices

# Constants of pinch rows, at `picking` 0 and 1: thumb-finger gaps [m] at which a row begins, and
# over which its weight rises to full.
_PINCH_FROM = 0.070, 0.200
_PINCH_OVER = 0.050, 0.150
# Pads of a closed pinch overlap by this, so that they press on each other [m].
_PADS_OVERLAP = 0.003, 0.007
# Pads are to touch up to a gap this much above that of contact, because people's gaps drift while
# they hold something [m]. The margin between thumb and finger still parts them, by less than 3 mm.
_SLACK = 0.0, 0.012
# How much farther the robot opens than the person, so that objects fit between its thicker pads.
_OPENING = 1.0, 1.4
# Share of the weight of the thumb's extension: it says less where objects count.
_THUMB_EXTENSION = 1.0, 0.5
# Margin between thumb and finger: its rise with the human's gap, and where it begins and ends [m].
_CONTACT_SLOPE = 0.25
_CONTACT_FROM = 0.018
_CONTACT_MOST = 0.005
# Distances of the thumb's tip from all bones of the other fingers from which on it is open, and
# over which it comes to be wholly open [m].
_OPEN_FROM = 0.050
_OPEN_OVER = 0.040
# Shares of its reach from which on a finger is straight, and over which it comes to be wholly so;
# how much nearer the thumb and a straight finger are where the row of their pinch begins [m].
_STRAIGHT_FROM = 0.80
_STRAIGHT_OVER = 0.15
_STRAIGHT_LESS = 0.025
# Distances of the thumb's tip from a segment of a finger at which it begins to lie on that, and
# over which it comes to do so wholly [m].
_LYING_FROM = 0.028
_LYING_OVER = 0.013
# Share of the weight of the thumb's extension that is left there.
_LYING_EXTENSION = 0.3
# Gaps of the tips below which the thumb pinches instead, and over which it comes to lie [m].
_TIPS_FROM = 0.012
_TIPS_OVER = 0.016
# Gaps of thumb and finger at which the rest posture begins to become that of the pinch, and over
# which it does [m]: from farther away than the pinch row, so that joints turn before pads are in
# the way.
_REST_FROM = 0.100
_REST_OVER = 0.080
# Least margin between thumb and finger [m].
_CONTACT_MARGIN = 0.0005


class BoundTeleoperation(teleoperation.BoundTeleoperation[Hand]):
    """The method for two hands; see `BoundMethod`."""

    def __init__(self, choices: Teleoperation, human: Hand, robot: Hand) -> None:
        self.choices = choices
        self.pair = pair = hand_pair(human, robot)
        self.contacts = self._contacts() if choices.avoids_contact else None
        self.estimator = MotionEstimator(
            pair.human_rest[pair.shape_points], ridge=choices.ridge
        )
        # The thumb comes first.
        self.pinched = pair.fingers[1:] if THUMB in pair.fingers else ()
        self.pads = pair.measured.pinching
        super().__init__(
            human,
            pair.robot,
            PalmFollowing(
                alignment=choices.alignment,
                scale=choices.scale,
                wrist_to_palm=human.wrist_to_palm @ affine(pair.palms.turn.T),
                human_anchor=pair.human_knuckles,
                robot_anchor=pair.robot_knuckles,
            ),
            self._make_model(),
            self.estimator,
            pair.measured.distances,
            keeps_apart=self.contacts is not None,
        )

    def _contacts(self) -> ShapePairs:
        """Return the pairs that are kept apart, or may press on each other."""
        choices = self.choices
        contacts = self.pair.measured.contacts
        if choices.squeeze == 0.0:
            return contacts
        return yield_to(
            self.pair.robot,
            contacts,
            choices.squeeze,
            choices.stiffness,
            choices.sliding_stiffness,
        )

    def _make_model(self) -> TeleoperationModel:
        """Return what targets are computed with, whatever the reference."""
        choices = self.choices
        pair = self.pair
        likeness = pair.palms.likeness
        gain = choices.residual_gain * pair.finger_ratio
        partners = pair.human_rest[pair.partners] - self.estimator.centroid
        # A human distance from each tip to its knuckle, then to each pinched finger's tip from the
        # thumb's.
        count = len(self.pinched)
        return TeleoperationModel(
            human_points=len(pair.human_rest),
            rest=pair.matched,
            regularisation=pair.regularisation,
            estimator=self.estimator.model(),
            shape_points=pair.shape_points,
            from_points=np.concatenate([pair.knuckles, pair.tips[:1].repeat(count)]),
            to_points=np.concatenate([pair.tips, pair.tips[1 : 1 + count]]),
            partners=pair.partners,
            human_reach=pair.human_reach,
            **self._aims(),
            pinch_from=math.inf if pair.has_jaws else choices.picked(_PINCH_FROM),
            pinch_over=choices.picked(_PINCH_OVER),
            likeness=likeness,
            robot_centre=pair.robot_centre,
            offsets=pair.robot_rest - pair.robot_centre - gain * partners,
            ratio=pair.finger_ratio,
            gain=gain,
            finger_of=pair.finger_of,
            **self._directions(),
            **self._margins(),
            # Places keep the gaps of a hand like the person's by themselves.
            contact_slope=(1.0 - likeness) * _CONTACT_SLOPE,
            contact_from=_CONTACT_FROM,
            contact_most=_CONTACT_MOST,
            **self._shapes(),
            **self._segments(),
            pinch_rests=self._pinch_rests(),
            rest_from=_REST_FROM,
            rest_over=_REST_OVER,
            distances=pair.measured.distances.model(),
        )

    def _directions(self) -> dict[str, Array]:
        """Return how the person's vectors from the knuckles become the robot's, for each point.

        A finger that is like the person's is asked for places: the robot's knuckle plus the
        person's vector, times the ratio of reaches. Another finger is asked for changes from rest,
        where it is as in the matched posture, and another thumb only for the motion of the hand.
        Bases that a joint moves on the palm follow the person's, on hands that are alike.
        """
        pair = self.pair
        choices = self.choices
        finger = pair.finger_of
        starts = pair.knuckles[finger]
        at_start = pair.human_rest[starts]
        human = pair.human_rest[pair.partners] - at_start
        robot = pair.robot_rest - pair.robot_bases[finger]
        reaches = lengths(human)
        is_base = reaches == 0.0
        at_rest = lengths(robot) / np.where(is_base, 1.0, reaches)
        changed = pair.robot_rest - at_rest[:, None] * human
        is_thumb = np.array(pair.fingers)[finger] == THUMB
        like = pair.finger_likeness[finger]
        placed = np.where(is_thumb, 1.0, like)
        ratios = placed * pair.reach_ratios[finger] + (1.0 - placed) * at_rest
        bases = (
            placed[:, None] * pair.robot_bases[finger]
            + (1.0 - placed[:, None]) * changed
        )
        is_carried = pair.palms.likeness * pair.is_carried[finger]
        carried = is_carried * pair.reach_ratios[finger]
        moved = (pair.palms.bases - pair.robot_bases)[finger]
        bases += is_carried[:, None] * moved - carried[:, None] * at_start
        of_thumb = like * choices.thumb_direction
        directions = np.where(is_thumb, of_thumb, choices.finger_direction)
        exact = pair.palms.likeness
        return {
            "starts": starts,
            "directions": exact + (1.0 - exact) * directions,
            "bases": bases,
            "ratios": ratios,
            "carried": carried,
        }

    def _aims(self) -> dict[str, Any]:
        """Return the wanted distance of each row, a linear function of the human's within bounds.

        With the weights of the rows.
        """
        pair = self.pair
        choices = self.choices
        human = pair.human_rest
        at_rest = lengths(human[pair.tips] - human[pair.knuckles])
        is_thumb = np.array(pair.fingers) == THUMB
        # A thumb that reaches all places of a person is as straight as the person's there.
        is_there = is_thumb & pair.is_placed
        extension = pair.robot_distances - pair.reach_ratios * at_rest
        extension *= 1.0 - is_there * choices.thumb_direction
        # The robot's pads press on each other here.
        touching = touching_distances(self.pads) - choices.picked(_PADS_OVERLAP)
        # Jaws move as far as the human's fingers, because an object is as large for both.
        opening = choices.picked(_OPENING) * pair.reach_ratios.mean()
        ratio = 1.0 if pair.has_jaws else opening
        closed = choices.contact_gap + choices.picked(_SLACK)
        count = len(touching)
        thumb = choices.thumb_extension_weight * choices.picked(_THUMB_EXTENSION)
        by_finger = np.where(is_thumb, thumb, choices.extension_weight)
        # Corrections end where places agree: a hand like the person's needs none.
        corrected = 1.0 - pair.palms.likeness
        return {
            "aim_slopes": np.concatenate([pair.reach_ratios, [ratio] * count]),
            "aim_offsets": np.concatenate([extension, touching - ratio * closed]),
            "least_aims": np.concatenate([np.zeros(len(extension)), touching]),
            "largest_aims": np.concatenate([pair.robot_reach, [np.inf] * count]),
            "extension_weights": corrected * by_finger,
            "pinch_weight": corrected * choices.pinch_weight,
        }

    def _shapes(self) -> dict[str, float]:
        """Return when a thumb is open, when it lies on a finger, and when a finger is straight."""
        return {
            "open_from": _OPEN_FROM,
            "open_over": _OPEN_OVER,
            "straight_from": _STRAIGHT_FROM,
            "straight_over": _STRAIGHT_OVER,
            "straight_less": _STRAIGHT_LESS,
            # A hand like the person's comes to lie like it by places.
            "lying_weight": 1.0 - self.pair.palms.likeness,
            "lying_from": _LYING_FROM,
            "lying_over": _LYING_OVER,
            "lying_extension": _LYING_EXTENSION,
            "skin_gap": self.choices.contact_gap,
            "tips_from": _TIPS_FROM,
            "tips_over": _TIPS_OVER,
        }

    def _segments(self) -> dict[str, Array]:
        """Return the segments of the fingers that the thumb pinches with, on both hands.

        A robot's finger has one between two of its points, and one from its base to the first.
        """
        pair = self.pair
        touching = touching_distances(self.pads)
        ends = []
        fingers = []
        for pinch, finger in enumerate(self.pinched):
            own = np.flatnonzero(pair.finger_of == pair.fingers.index(finger))
            robots = dict(zip(pair.partners[own].tolist(), own.tolist(), strict=True))
            knuckle, *others = pair.bones[pinch].tolist()
            nodes = [(knuckle, -1), *((k, robots[k]) for k in others if k in robots)]
            ends += [(*a, *b) for a, b in pairwise(nodes)]
            fingers += [pinch] * (len(nodes) - 1)
        human_from, robot_from, human_to, robot_to = (
            np.array(ends, int).reshape(-1, 4).T
        )
        return {
            "segment_starts": human_from,
            "segment_ends": human_to,
            "segment_from": robot_from,
            "segment_to": robot_to,
            "segment_bases": pair.robot_bases[1:][fingers],
            "segment_touching": touching[fingers],
        }

    def _pinch_rests(self) -> Array:
        """Return what each pinch adds to the rest posture in its own two fingers, shape (p, n).

        Places lead a hand like the person's to a pinch by themselves.
        """
        pair = self.pair
        added = np.zeros((len(self.pinched), len(pair.matched)))
        if pair.has_jaws or not self.pinched:
            return added
        postures = pair.measured.pinches_by_finger
        unlike = 1.0 - pair.palms.likeness
        for row, finger in zip(added, self.pinched, strict=True):
            for name in (THUMB, finger):
                own = pair.chains[name].columns
                row[own] = unlike * (postures[finger] - pair.matched)[own]
        return added

    def _margins(self) -> dict[str, Array]:
        """Return the margins of contact pairs, and which of them belongs to which pinch."""
        fingers = self.contacts.fingers if self.contacts else ()
        pinch_of = {finger: pinch for pinch, finger in enumerate(self.pinched)}
        closing = [(k, pinch_of[f]) for k, f in enumerate(fingers) if f in pinch_of]
        pairs, pinches = np.array(closing, dtype=int).reshape(-1, 2).T
        covers = [self.pads[0].cover + pad.cover for pad in self.pads[1:]]
        return {
            "base_margins": np.full(len(fingers), LINK_MARGIN),
            "pinch_pairs": pairs,
            "pinch_of_pair": pinches,
            "pinch_margins": _CONTACT_MARGIN + np.array(covers).take(pinches),
        }


_Weight = Annotated[float, number(high=1e3)]


class Teleoperation(AlignedOptions, frozen=True):
    """Follow a tracked hand, finger by finger.

    Attributes:
        residual_gain: Part of each finger's residual to T that its partner takes over.
        extension_weight: Weight of the fingers' extension, per 10 mm of knuckle-to-tip distance.
        thumb_extension_weight: The same of the thumb, whose position says less: thumbs oppose from
            different sides.
        finger_direction: How far the targets of fingers are turned to the directions of the
            person's, from the knuckle; not where they pinch.
        thumb_direction: The same of a thumb that reaches the places where the person's is.
        pinch_weight: Weight of a pinch row, per 10 mm of distance between pads; 0 for none.
        picking: What counts more where a hand that is unlike the person's cannot have both:
            gestures (0), or objects between thumb and finger (1). Towards 1, pinch rows act from
            wider gaps on, the hand opens farther, and a pinch stays closed while the person's gap
            drifts.
        contact_gap: Distance between the tracker's thumb and finger landmarks at skin contact [m]:
            1 to 5 mm for gloves, 10 to 20 mm for cameras. `handmap retarget` measures it.
        ridge: Pull of T towards a rotation.
        scale: Factor on the palm's translation, for arms that reach less far than a person's.
        avoids_contact: Whether links of the robot are kept apart.
        squeeze: Force with which thumb, fingers and palm of the robot may press on each other [N]:
            commanded links overlap by as much as presses with it. 0 for commands without overlap.
        stiffness: Stiffness of the fingers' position control [N m/rad], for `squeeze`.
        sliding_stiffness: The same of joints that slide [N/m].
    """

    bound_type = BoundTeleoperation
    weights: ClassVar[IkOptions] = FOLLOWING.replaced(
        rest_weight=0.7, damping=2.0, takes_detours=True, points_follow_wrist=True
    )
    residual_gain: Share = 1.0
    extension_weight: _Weight = 1.0
    thumb_extension_weight: _Weight = 2.5
    finger_direction: Share = 0.75
    thumb_direction: Share = 1.0
    pinch_weight: _Weight = 5.0
    picking: Share = 0.0
    contact_gap: Annotated[float, number(high=0.04)] = CONTACT_GAP
    ridge: Annotated[float, number(high=1e3, above=True)] = 0.1
    scale: _Weight = 1.0
    avoids_contact: bool = True
    squeeze: Annotated[float, number(high=100.0)] = 0.0
    stiffness: Annotated[float, number(high=1e6, above=True)] = STIFFNESS
    sliding_stiffness: Annotated[float, number(high=1e9, above=True)] = (
        SLIDING_STIFFNESS
    )

    def check(self) -> None:
        """Reject a squeeze of links that nothing keeps apart; see `Options.check`."""
        super().check()
        if self.squeeze > 0.0 and not self.avoids_contact:
            raise InvalidOptionsError(
                option="squeeze",
                expected="0 where avoids_contact is off",
                value=self.squeeze,
                advice="only links that are kept apart yield to it",
            )

    def picked(self, ends: tuple[float, float]) -> float:
        """Return the value of a constant that is given for gestures and for objects."""
        gestures, objects = ends
        return gestures + self.picking * (objects - gestures)

    def fitted_to(self, human: Hand) -> Self:
        """Return these options with the contact gap of a person's hand."""
        return self.replaced(contact_gap=human.contact_gap)


def fingers_correspond(human: Hand, robot: Hand) -> bool:
    """Return whether a robot has fingers, and a human hand the points of theirs."""
    fingers = set(FINGERS) & {point.finger for point in robot.spec.points}
    return bool(fingers) and set(finger_landmarks(fingers)) <= set(point_indices(human))


PRESETS = {
    "teleoperation": Preset(
        Teleoperation(),
        Teleoperation.weights,
        "gestures and pinches of a tracked hand: each robot finger does what the human's does",
        "needs a tracked palm, and fingers with names; a grasped object's motion is not imposed",
        rank=0,
        suits=fingers_correspond,
    ),
    "picking": Preset(
        Teleoperation(picking=1.0),
        Teleoperation.weights,
        "objects between thumb and finger: the robot opens wider, and holds while a gap drifts",
        "needs what `teleoperation` needs; gestures show less than with it",
    ),
}
