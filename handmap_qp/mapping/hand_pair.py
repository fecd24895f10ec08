"""Correspondence of a human and a robot hand: fingers, ratios of reach, the matched posture.

All of it is measured on the two models, once for each pair of hands.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import pinocchio as pin

from handmap_core.errors import InvalidOptionsError
from handmap_core.se3 import Array, frozen, lengths, mirror_sign, transform_points
from handmap_qp.hands import (
    FINGERS,
    THUMB,
    Finger,
    Hand,
    Pad,
    Place,
    PointSpec,
    ShapePairs,
    all_pairs,
    find_fingers,
    find_pads,
    partner_names,
)
from handmap_qp.human import LANDMARK_NAMES, finger_chains, landmarks_at_rest
from handmap_qp.ik import (
    AttachedPoints,
    IkOptions,
    PointDistances,
    PointIk,
)
from handmap_qp.ik.nearest_posture import nearest_posture
from .palm import point_indices, require_points

KNUCKLES, _SECONDS, LASTS, TIPS = (
    dict(zip(FINGERS, LANDMARK_NAMES[first::4], strict=True)) for first in range(1, 5)
)
"""Landmarks at the base, of the last joint and at the tip of each finger, by the finger's name."""
MIDDLES = _SECONDS | {THUMB: LASTS[THUMB]}
"""Landmark of the joint in the middle of each finger."""

_TABLES = TIPS, LASTS, MIDDLES, KNUCKLES
# Weight of a jaw's position errors. The gap to the thumb is all that a jaw can show.
_JAW_WEIGHT = 1e-4
# Weight of the joints' position errors against the fingertips' one.
_JOINT_WEIGHT = 0.5
# The thumb's share of the way from where it pinches, and its range against the fingers'. Thumbs
# oppose from different sides, so neither its own base nor the knuckles alone say where it belongs.
_THUMB_FROM_PINCH = 0.3
_THUMB_GAIN = 0.9
# The model's own resting thumb lies farther in front of the palm than any recorded one [rad].
_RESTING_THUMB = {
    "thumb_TM_abduction": 0.65,
    "thumb_TM_flexion": 0.45,
    "thumb_MCP_flexion": 0.1,
    "thumb_IP_flexion": -0.2,
}
# Weights of finger bases where palms are laid on each other; the little finger's moves with its
# metacarpal. Fewer than this say nothing about the palm.
_BASE_WEIGHTS = {"little": 0.1}
_FEWEST_BASES = 3.5
# Distance of finger bases after a similarity, relative to their extent: where palms are wholly
# alike, and where they are not at all.
_LIKE_BASES = 0.02, 0.05
# The same of the fingers' reaches: difference of their ratios from the palm's, as a logarithm.
_LIKE_REACHES = 0.1, 0.3
# Root mean square distance of a fingertip from its places, where a person rests and pinches,
# relative to its reach: up to here a finger is like the person's, and from there on it is not.
_REACHED = 0.14, 0.22
# Weight of the matched posture where places are searched for: it decides only what they leave open.
_PLACING_WEIGHT = 0.02
# Part of the rest posture's pull and of the damping that a hand like the person's does without.
_STEADIED = 0.97
# Weight of the rest posture in the matched one: it decides only where the points do not.
_REST_WEIGHT = 0.05
_OPENING = IkOptions(
    point_weight=0.0,
    wrist_position_weight=1e3,
    wrist_orientation_weight=1e3,
    rest_weight=0.3,
    error_damping=1.5,
    max_iterations=100,
    step_tolerance=1e-4,
    has_velocity_limits=False,
)
# One iteration at a time, until the pads touch: further ones slide them along each other towards
# the rest posture, far away from where people pinch.
_PINCHING = _OPENING.replaced(
    wrist_position_weight=1e2, wrist_orientation_weight=1e2, max_iterations=1
)
_PINCH_STEPS = 20  # at most
_TOUCHING = 0.0005  # m
_GAP_WEIGHT = 3.0
_UNHURRIED = 1e3  # s


def finger_landmarks(fingers: Iterable[str]) -> list[str]:
    """Return the landmarks that a pair of hands needs of each finger."""
    return [table[f] for f in fingers for table in _TABLES]


class HandPair:
    """A human and a robot hand, their common fingers, and the robot posture that matches rest.

    Args:
        human: The hand that leads; its reference points must hold the fingers' landmarks.
        robot: The hand that follows; its description must name fingers.

    Attributes:
        human: The hand that leads.
        measured: What is measured on the robot alone.
        robot: The hand that follows. Its reference points are the fingertips, middle and last
            joints of the common fingers, in the order of `partners`.
        fingers: Names of the common fingers, the thumb first where there is one.
        chains: The robot's fingers that have joints, by name, in the order of `fingers`.
        partners: Index of the human reference point that each robot reference point follows, (m,).
        finger_of: Index of the finger that each robot reference point is of, shape (m,).
        tips: Index of the human reference point at each common fingertip, shape (f,).
        knuckles: The same at the base of each common finger.
        bones: The same along each common finger but the thumb, from its base to its tip, shape
            (f - 1, 4), or (f, 4) without a thumb.
        reach_ratios: Robot's reach over the human's, of each common finger, shape (f,).
        finger_ratio: Their mean without the thumb's.
        has_jaws: True if the thumb and the other fingers are jaws: only their gap can follow.
        matched: The robot's joint positions that match the human's rest posture [rad or m], shape
            (n,): those of its description, else solved.
        human_rest: Human reference points at rest, in palm axes [m], shape (n_h, 3).
        robot_rest: Robot reference points in the matched posture, in palm axes [m], shape (m, 3).
        human_knuckles: Centre of the knuckles but the thumb's, in the human's palm axes [m], (3,).
        robot_knuckles: The same of the robot.
        robot_bases: Base of each robot finger there, in palm axes [m], shape (f, 3).
        robot_centre: Centre of the robot's tips and middle joints in the matched posture [m], (3,).
        palms: How the robot's palm lies on the human's.
        finger_likeness: 1 for a finger that reaches the places where the human's is, to 0 for one
            that cannot, such as a thumb that opposes from another side, shape (f,).
        is_placed: Whether a finger reaches all places of the package's own person, shape (f,), so
            that it does not depend on who leads.
        is_carried: Whether a joint of each finger moves its base as the person's, shape (f,).
        regularisation: Share of the rest posture's pull and of the damping of each joint, shape
            (n,).
        robot_distances: Knuckle-to-tip distance of each robot finger in the matched posture [m],
            shape (f,).

    Raises:
        InvalidOptionsError: If the hands have no finger in common, or the human's reference points
            lack a landmark of one.
    """

    def __init__(self, human: Hand, robot: Hand) -> None:
        self.human = human
        self.measured = measured = robot_fingers(robot)
        self.fingers = measured.names
        self.has_jaws = measured.has_jaws
        if not self.fingers:
            raise InvalidOptionsError(
                "this method needs fingers, and no point of the robot names one",
                option="method",
                advice="add `finger` to the points of its hand.yaml, or take the preset object",
            )
        needed = finger_landmarks(self.fingers)
        points = require_points(human, needed, "this method").reshape(-1, 4)
        self.tips = points[:, 0]
        self.knuckles = points[:, 3]
        is_other = np.array(self.fingers) != THUMB
        self.bones = points[is_other, ::-1]
        self.chains = measured.used
        names = point_indices(human)
        human_rest = points_in_palm(human, resting_posture(human))
        self.human_reach = bone_lengths(human, self.fingers)
        self.robot_reach = np.array([chain.reach for chain in self.chains.values()])
        self.reach_ratios = self.robot_reach / self.human_reach
        # The finger bases of both hands.
        self.palms = match_palms(
            human_rest[self.knuckles], measured.bases, self.fingers, self.reach_ratios
        )
        self.robot = measured.hand_with_points(self.palms.likeness)
        self.partners = np.array(
            [names[point.name] for point in self.robot.reference_points]
        )
        self.finger_of = np.array(
            [self.fingers.index(str(p.finger)) for p in self.robot.reference_points]
        )
        shape = [table[finger] for finger in FINGERS for table in (TIPS, MIDDLES)]
        self.shape_points = np.array([names[name] for name in shape if name in names])
        self.human_rest = frozen(human_rest @ self.palms.turn.T)
        chains = self.chains.values()
        self.is_carried = np.array(
            [self.palms.likeness > 0.0 and chain.carries_knuckle for chain in chains]
        )
        # All fingers but the thumb; a thumb alone stands for them.
        fingers = enumerate(self.fingers)
        self._others = [i for i, finger in fingers if finger != THUMB] or [0]
        self.finger_ratio = self.reach_ratios[self._others].mean()
        knuckles = self.human_rest[self.knuckles[self._others]]
        self.human_knuckles = frozen(knuckles.mean(axis=0))
        # With the package's own person, near whose matched posture all others' are.
        usual = human.unscaled
        self._usual = hand_pair(usual, robot) if usual else None
        given = robot.neutral_match
        self.matched = frozen(self.solve_matched() if given is None else given)
        self._measure_robot()
        self.finger_likeness = frozen(self._measure_likeness())
        of_usual = self._usual.finger_likeness if self._usual else self.finger_likeness
        self.is_placed = of_usual == 1.0
        # Points determine the joints of a hand like the person's: rest and damping only steady.
        regularisation = np.ones(len(self.matched))
        for chain in self.chains.values():
            regularisation[chain.columns] -= _STEADIED * self.palms.likeness
        self.regularisation = frozen(regularisation)

    def _measure_robot(self) -> None:
        """Find the robot's points in the matched posture, their centres and the knuckles'."""
        self.robot_rest = frozen(points_in_palm(self.robot, self.matched))
        places = [
            place
            for chain in self.chains.values()
            for place in (chain.knuckle, chain.tip, chain.middle)
        ]
        points = points_in_palm(self.robot, self.matched, places)
        knuckles, tips, middles = points.reshape(-1, 3, 3).swapaxes(0, 1)
        vectors = tips - knuckles
        self.robot_knuckles = frozen(knuckles[self._others].mean(axis=0))
        self.robot_bases = frozen(knuckles)
        self.robot_centre = frozen(0.5 * (tips + middles).mean(axis=0))
        self.robot_distances = frozen(lengths(vectors))

    def _measure_likeness(self) -> Array:
        """Return how far fingers reach the places of a person who rests and pinches, shape (f,).

        Pinches are where hands differ most: a thumb that opposes from another side meets the
        fingers elsewhere. Palms that are alike make all fingers alike. A description that gives
        the matched posture says where fingers are at rest, which may be elsewhere. See
        `finger_likeness`.
        """
        like = np.full(len(self.fingers), self.palms.likeness)
        is_given = self.robot.neutral_match is not None
        if THUMB not in self.fingers or self.has_jaws or is_given:
            return like
        human = self.human
        robot = self.robot
        shown = np.array([resting_posture(human), *robot_fingers(human).pinches])
        places = self.places_of(points_in_palm(human, shown) @ self.palms.turn.T)
        palm = self.measured.hand.frame_pose("palm", robot.rest)
        costs = IkOptions().point_costs(robot)
        nearest = [
            nearest_posture(robot, targets, costs, _PLACING_WEIGHT, self.matched)
            for targets in transform_points(palm, places)
        ]
        missed = lengths(points_in_palm(robot, np.array(nearest)) - places)
        # The tips come first.
        tips = missed[:, : len(like)] / self.robot_reach
        distance = np.sqrt((tips**2).mean(axis=0))
        return like + (1.0 - like) * np.interp(distance, _REACHED, (1.0, 0.0))

    def places_of(self, human: Array) -> Array:
        """Place the human's points on the robot: its knuckle, plus the scaled human vector.

        Args:
            human: The human's reference points in palm axes [m], shape (..., n_h, 3).

        Returns:
            Places of the robot's reference points in its palm axes [m], shape (..., m, 3).
        """
        of = self.finger_of
        vectors = human[..., self.partners, :] - human[..., self.knuckles[of], :]
        return self.measured.bases[of] + self.reach_ratios[of, None] * vectors

    def solve_matched(self) -> Array:
        """Solve the robot posture whose finger vectors are the resting human's, scaled.

        Jaws open as wide as the resting human's thumb and fingers.
        """
        if self.has_jaws:
            at_rest = self.human_rest[self.tips]
            gaps = lengths(at_rest[1:] - at_rest[0])
            task = gap_task(self.robot, self.measured.pinching, gaps)
            return approach(PointIk(self.robot, _OPENING), task)
        robot = self.robot
        in_palm = self.places_of(self.human_rest)
        if THUMB in self.fingers:
            of_thumb = self.finger_of == 0
            in_palm[of_thumb] = self._thumb_targets(
                self.measured.bases, self.human_rest[self.partners[of_thumb]]
            )
        palm = self.measured.hand.frame_pose("palm", robot.rest)
        targets = transform_points(palm, in_palm)
        costs = IkOptions().point_costs(robot)
        start = self._usual.matched if self._usual else robot.rest
        return nearest_posture(robot, targets, costs, _REST_WEIGHT, start)

    def _thumb_targets(self, knuckles: Array, human: Array) -> Array:
        """Place points of the thumb, (k, 3), between where it pinches and above the knuckles."""
        gain = _THUMB_GAIN * self.finger_ratio
        if self.fingers == (THUMB,):
            return knuckles[0] + gain * (human - self.human_rest[self.knuckles[0]])
        middle = knuckles[self._others].mean(axis=0)
        above = middle + gain * (human - self.human_knuckles)
        human_pinching = robot_fingers(self.human).pinching_thumb
        return (
            _THUMB_FROM_PINCH
            * (self.measured.pinching_thumb + gain * (human - human_pinching))
            + (1.0 - _THUMB_FROM_PINCH) * above
        )


@dataclass(frozen=True, slots=True, eq=False)
class PalmMatch:
    """How the palm of a robot lies on a human's.

    The axes of both palms follow from different evidence: the person's from five landmarks, the
    robot's from the directions of its fingers. Where the finger bases of both hands lie alike, the
    bases themselves say how the palms lie on each other.

    Attributes:
        turn: Rotation from the human's palm axes to the robot's, shape (3, 3).
        bases: Where the human's finger bases are on the robot's palm [m], shape (f, 3).
        likeness: From 0 for hands that differ to 1 for a robot hand with the human's own palm.
    """

    turn: Array
    bases: Array
    likeness: float


class RobotFingers:
    """What is measured on a hand alone, a robot's or a person's: reading meshes takes longest."""

    def __init__(self, hand: Hand) -> None:
        self.hand = hand
        self.chains = find_fingers(hand)
        # In the order of FINGERS.
        self.used = {f: chain for f, chain in self.chains.items() if chain.joints}
        # So are two fingers that turn about one joint each, or about the same one.
        turning = len(self.used) == 2
        are_jaws = all(
            chain.is_jaw or (turning and len(chain.columns) == 1)
            for chain in self.used.values()
        )
        if THUMB in self.chains and 1 == len(self.used) < len(self.chains) == 2:
            # A jaw closes on a fixed one.
            are_jaws = True
            self.used = self.chains
        self.names = tuple(self.used)
        self.has_jaws = are_jaws and len(self.names) > 1 and THUMB in self.names

    @cached_property
    def pads(self) -> dict[str, Pad]:
        """The pads of the fingers, by name."""
        return find_pads(self.hand)

    @cached_property
    def bases(self) -> Array:
        """Bases of the fingers at rest, in palm axes [m], shape (f, 3)."""
        places = [chain.knuckle for chain in self.used.values()]
        return points_in_palm(self.hand, self.hand.rest, places)

    def hand_with_points(self, likeness: float) -> Hand:
        """Return the robot with its points, and where it is like a human hand, with all joints'.

        These are the bases of fingers that the palm carries by a joint, and the MCP joint of a
        thumb: without them, the joints of a hand like the person's are not determined.
        """
        robot = self.with_points
        if not likeness:
            return robot
        weight = likeness * _JOINT_WEIGHT**2
        points = [*robot.reference_points]
        for chain in self.used.values():
            if chain.carries_knuckle:
                points.append(
                    _point(chain, KNUCKLES[chain.name], chain.knuckle, weight)
                )
            if chain.name == THUMB and chain.between:
                points.append(_point(chain, _SECONDS[THUMB], chain.between, weight))
        return robot.with_points(points)

    @cached_property
    def with_points(self) -> Hand:
        """The robot with points at its fingertips, and at the joints that bend its fingers."""
        robot = self.hand
        chains = self.used.values()
        weight = _JAW_WEIGHT if self.has_jaws else 1.0
        points = [_point(each, TIPS[each.name], each.tip, weight) for each in chains]
        for chain in chains:
            joints = _joints_between(chain)
            places = [chain.knuckle, *joints.values()]
            knuckle, *ends = points_in_palm(robot, robot.rest, places)
            for (name, place), end in zip(joints.items(), ends, strict=True):
                if lengths(end - knuckle) > 0.1 * chain.reach:
                    # Weights count squared in the cost.
                    points.append(_point(chain, name, place, _JOINT_WEIGHT**2))
        return robot.with_points(points)

    @property
    def pinching(self) -> list[Pad]:
        """Pads of the thumb, which is the first finger, and of those that it pinches with."""
        return [self.pads[name] for name in self.names if THUMB in self.names[:-1]]

    @cached_property
    def distances(self) -> PointDistances:
        """Distance rows: extension of each finger, then a pinch with each finger."""
        chains = self.used.values()
        places = [place for chain in chains for place in (chain.knuckle, chain.tip)]
        first = len(places)
        pairs = [(k, k + 1) for k in range(0, first, 2)]
        places += [pad.place for pad in self.pinching]
        pairs += [(first, k) for k in range(first + 1, len(places))]
        points = AttachedPoints(self.with_points, places)
        return PointDistances(points, pairs, np.zeros(len(pairs)))

    @cached_property
    def pinches(self) -> Array:
        """Postures in which thumb and each other finger in turn come nearest, shape (f - 1, n)."""
        hand = self.hand
        # The thumb is the first finger.
        pads = [*self.pads.values()]
        usual = _pinching_ik(hand.unscaled or hand)
        return hand.tree.pinching_postures(
            usual.core,
            *_split(pad.place for pad in pads),
            touching_distances(pads),
            weight=_GAP_WEIGHT,
            dt=_UNHURRIED,
            samples=_PINCH_STEPS,
            tolerance=_TOUCHING,
        )

    @property
    def pinches_by_finger(self) -> dict[str, Array]:
        """The posture of `pinches` of each finger, by its name, shape (n,) each."""
        return dict(zip([*self.pads][1:], self.pinches, strict=True))

    @cached_property
    def pinching_thumb(self) -> Array:
        """Mean tip of the thumb where it pinches with each finger, in palm axes [m], shape (3,)."""
        tip = [self.chains[THUMB].tip]
        tips = points_in_palm(self.hand, self.pinches, tip)
        return frozen(tips.mean(axis=0)[0])

    @cached_property
    def contacts(self) -> ShapePairs:
        """All pairs of collision shapes that may collide."""
        return all_pairs(self.hand)


def match_palms(
    human: Array, robot: Array, fingers: Sequence[str], ratios: Array
) -> PalmMatch:
    """Lay the finger bases of a human hand on those of a robot hand by a similarity.

    Args:
        human: Bases of f common fingers in the human's palm axes [m], shape (f, 3).
        robot: The same of the robot in its palm axes.
        fingers: Names of the fingers.
        ratios: Robot's reach over the human's, shape (f,).
    """
    weights = np.array([_BASE_WEIGHTS.get(finger, 1.0) for finger in fingers])
    if weights.sum() < _FEWEST_BASES or THUMB not in fingers:
        return PalmMatch(np.eye(3), robot, 0.0)
    weights /= weights.sum()
    centre, robot_centre = weights @ human, weights @ robot
    arms, robot_arms = human - centre, robot - robot_centre
    left, stretches, right = np.linalg.svd(robot_arms.T @ (weights[:, None] * arms))
    mirror = np.array([1.0, 1.0, mirror_sign(left @ right)])
    turn = (left * mirror) @ right
    scale = stretches @ mirror / (weights @ (arms**2).sum(axis=1))
    places = scale * arms @ turn.T
    missed = weights @ ((robot_arms - places) ** 2).sum(axis=1)
    size = weights @ (robot_arms**2).sum(axis=1)
    uneven = np.abs(np.log(ratios / scale)).max()
    likeness = np.interp(np.sqrt(missed / size), _LIKE_BASES, (1.0, 0.0))
    likeness *= np.interp(uneven, _LIKE_REACHES, (1.0, 0.0))
    turn = pin.exp3(likeness * pin.log3(turn))
    return PalmMatch(turn, robot_centre + places, float(likeness))


robot_fingers = lru_cache(maxsize=32)(RobotFingers)
"""What is measured on a hand, found once; argument as of `RobotFingers`."""


def require_partners(
    human: Hand, robot: Hand, *, option: str, value: object = None, advice: str = ""
) -> list[tuple[int, int]]:
    """Return the pairs of reference points that correspond on two hands (`partner_names`).

    Args:
        human: The hand that leads.
        robot: The hand that follows.
        option: The option that needs them.
        value: Its value.
        advice: Alternative to naming partners, appended to the message.

    Returns:
        Pairs of indices (robot point, human point), in the order of the robot's points.

    Raises:
        InvalidOptionsError: If no robot point has a partner.
    """
    names = point_indices(human)
    wanted = partner_names(robot, {point.name for point in human.spec.points})
    pairs = [
        (j, names[partner]) for j, partner in enumerate(wanted) if partner in names
    ]
    if not pairs:
        raise InvalidOptionsError(
            f"needs partner points, and no point of {robot.name} names one among "
            f"{', '.join(names)}",
            option=option,
            value=value,
            advice=f"add `partner` to its points{advice}",
        )
    return pairs


hand_pair = lru_cache(maxsize=16)(HandPair)
"""The pair of two hands, solved once; arguments as of `HandPair`."""


def _joints_between(chain: Finger) -> dict[str, Place]:
    """Return the joints of a finger that say how it bends, by their landmarks."""
    if len(chain.joints) < 2 or chain.is_jaw:
        return {}
    # Where joints are coupled, more points only outvote the fingertip and the pinch.
    is_free = len(chain.columns) > 2
    joints = {}
    if chain.name != THUMB or is_free:
        joints[MIDDLES[chain.name]] = chain.middle
    if is_free and len(chain.bending) > 2:
        joints[LASTS[chain.name]] = chain.last
    return joints


def _point(chain: Finger, name: str, place: Place, weight: float) -> PointSpec:
    """Describe a point of a finger, on a joint of the model, as one on a link of the URDF."""
    joint, offset = place
    frame = next(f for f in chain.hand.frames.values() if f.parentJoint == joint)
    x, y, z = frame.placement.actInv(offset).tolist()
    return PointSpec(name, frame.name, (x, y, z), chain.name, weight, name)


def points_in_palm(
    hand: Hand, q: Array, places: Sequence[Place] | None = None
) -> Array:
    """Return k points of a hand in palm axes [m], shape (..., k, 3).

    Args:
        hand: The hand.
        q: Its joint positions [rad or m], shape (n,), or of several postures, shape (..., n).
        places: Points on joints; the hand's reference points if omitted.
    """
    shape = (*q.shape[:-1], -1, 3)
    if places is None:
        return hand.tree.points(q).reshape(shape)
    return hand.tree.points_on_joints(q, *_split(places)).reshape(shape)


def _split(places: Iterable[Place]) -> tuple[list[int], Array]:
    """Return the joints of k places, and their offsets [m], shape (k, 3)."""
    joints, offsets = zip(*places, strict=True)
    return [*joints], np.array(offsets)


@lru_cache(maxsize=16)
def _pinching_ik(hand: Hand) -> PointIk:
    """Return what lets a hand pinch, or a person's hand that it is scaled to."""
    return PointIk(hand, _PINCHING)


def resting_posture(human: Hand) -> Array:
    """Return the human's rest posture with the thumb where recorded thumbs are at rest, (n,)."""
    own = zip(human.joint_names, human.rest, strict=True)
    return np.array([_RESTING_THUMB.get(joint, angle) for joint, angle in own])


def bone_lengths(human: Hand, fingers: Sequence[str]) -> Array:
    """Return the sum of the bones of human fingers, which is their reach [m], shape (f,)."""
    joints = finger_chains(landmarks_at_rest(human))
    reaches = lengths(np.diff(joints, axis=1)).sum(axis=1)
    return reaches[[FINGERS.index(finger) for finger in fingers]]


def gap_task(
    hand: Hand, pads: Sequence[Pad], gaps: Array | float = 0.0
) -> PointDistances:
    """Return the task of giving the first pad, the thumb's, gaps to p others [m], shape (p,)."""
    points = AttachedPoints(hand, [pad.place for pad in pads])
    pairs = [(0, k) for k in range(1, len(points))]
    return PointDistances(points, pairs, touching_distances(pads) + gaps, _GAP_WEIGHT)


def touching_distances(pads: Sequence[Pad]) -> Array:
    """Return the distances at which p pads touch the first one, the thumb's [m], shape (p,)."""
    return np.array([pads[0].radius + pad.radius for pad in pads[1:]])


def approach(ik: PointIk, task: PointDistances) -> Array:
    """Move a hand from rest for a task, by one solution of the QP.

    Args:
        ik: The hand and weights of the QP.
        task: The task.

    Returns:
        Joint positions there [rad or m], shape (n,).
    """
    hand = ik.hand
    ik.place(hand.configuration_vector(hand.rest))
    placed = ik.configuration
    wrist = placed.wrist.homogeneous
    ik.solve(placed.points, wrist, _UNHURRIED, tasks=[task])
    return ik.gate.motion.q[hand.q_indices]
