"""Measure a hand: reach, size, fist, pinches, self-collisions, and a standard motion."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.apps.onboarding.anatomy import angle_between
from handmap_qp.errors import HandmapError
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.fingers import (
    THUMB,
    Finger,
    PalmKinematics,
    Place,
    find_fingers,
    zero_posture,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.pads import Pad, find_pads
from handmap_qp.mapping.mapper import HandMapper

HUMAN_LENGTH = 0.19
"""Length of a person's hand, from the wrist crease to the middle fingertip [m]."""
# Least singular value of a fingertip's Jacobian that counts as a direction of motion [m/rad].
_LEAST_MOTION = 0.003
# Links of a compact joint are shorter than this and overlap when it bends [m].
_SHORT = 0.025
_SAMPLES = 200
# Random postures of an arm, directions in which its reach is measured, and cosine of their cones.
_ARM_SAMPLES = 1500
_DIRECTIONS = np.array(
    [
        v / np.linalg.norm(v)
        for i in np.ndindex(3, 3, 3)
        if (v := np.array(i) - 1.0).any()
    ]
)
_CONE = np.cos(np.radians(25.0))
_DT = 1.0 / 60.0
# The fingers' planes have a common normal if the mean of these unit vectors is this long.
_COMMON = 0.8
# Search for a pinch: iterations, damping [m/rad], and random starts.
_ITERATIONS, _DAMPING, _STARTS = 40, 0.01, 6
# Surfaces that come this near touch [m].
_TOUCHING = 0.002
# Radius of a pad without shapes [m].
_RADIUS = 0.006


class FingerReach(NamedTuple):
    """How one fingertip moves.

    Attributes:
        point: Name of the reference point.
        finger: Its finger.
        span: Largest distance between two positions that it reaches [m].
        directions: Number of directions in which it can move at rest, 0 to 3.
        slowest: Smallest singular value of its Jacobian among these directions [m/rad].
        manipulability: Yoshikawa's measure at rest, the product of these singular values
            [(m/rad)^directions].
    """

    point: str
    finger: str
    span: float
    directions: int
    slowest: float
    manipulability: float


class Size(NamedTuple):
    """Size of a hand.

    Attributes:
        length: Distance from the palm's origin to the farthest fingertip, with the fingers straight
            or at rest, whichever is longer [m].
        cloud: RMS distance of the fingertips from their mean at rest [m].
        human_cloud: The same for a human hand of length `HUMAN_LENGTH` [m].
    """

    length: float
    cloud: float
    human_cloud: float

    @property
    def ratio(self) -> float:
        """Length of the hand divided by a human hand's."""
        return self.length / HUMAN_LENGTH


class MotionPart(NamedTuple):
    """How well a robot follows one part of the standard motion.

    Attributes:
        name: What the human hand does.
        error: Largest distance of a point from its target at the end of the part [m].
        worst_point: The point with that error.
        limited: Joints at a position limit at the end of the part.
    """

    name: str
    error: float
    worst_point: str
    limited: tuple[str, ...]


class Fist(NamedTuple):
    """Where the fingertips go as the hand closes, in palm axes.

    Attributes:
        across_deg: Angle between the fingers' common axis of flexion and the palm's x axis, 0 in a
            hand whose axes are right, 180 if the fingers close to the back [deg].
        distal_deg: Angle between the mean direction of the stretched fingers and distal [deg].
        fingers: Fingers that close.
    """

    across_deg: float
    distal_deg: float
    fingers: tuple[str, ...]


class Pinch(NamedTuple):
    """How near the thumb's pad comes to a finger's.

    Attributes:
        finger: The finger.
        gap: Smallest distance between the surfaces of both pads [m]; 0 or less if they touch.
        q: Joint angles there, shape (n,).
    """

    finger: str
    gap: float
    q: np.ndarray

    @property
    def touches(self) -> bool:
        """Whether the pads touch."""
        return self.gap < _TOUCHING


def measure_reach(hand: Hand) -> tuple[FingerReach, ...]:
    """Measure reach and manipulability of every reference point on a finger.

    Args:
        hand: The hand; an arm stays at rest.
    """
    wrist = hand.model.frames[hand.wrist_frame_id].parentJoint
    arm = {hand.model.joints[joint].idx_v for joint in hand.model.supports[wrist]}
    fingers = np.array([v not in arm or wrist == 0 for v in hand.v_indices])
    generator = np.random.default_rng(0)
    size = (_SAMPLES, len(hand.rest))
    shares = np.vstack([generator.random(size), generator.integers(0, 2, size)])
    postures = np.where(fingers, across(hand, shares), hand.rest)
    places = np.array([hand.points(q) for q in postures])
    jacobian = hand.point_jacobian(hand.rest)[:, fingers]
    rows = []
    for i, point in enumerate(hand.reference_points):
        if point.finger is None:
            continue
        motions = np.linalg.svd(jacobian[3 * i : 3 * i + 3], compute_uv=False)
        motions = motions[motions > _LEAST_MOTION]
        gaps = places[:, None, i] - places[None, :: max(1, len(places) // 100), i]
        span, count = float(np.linalg.norm(gaps, axis=2).max()), len(motions)
        slowest, product = (
            (float(motions.min()), float(np.prod(motions))) if count else (0.0, 0.0)
        )
        rows.append(
            FingerReach(point.name, point.finger, span, count, slowest, product)
        )
    return tuple(rows)


def across(hand: Hand, shares: np.ndarray) -> np.ndarray:
    """Return the postures at shares of the joints' ranges, shape (..., n)."""
    return hand.lower_limits + shares * (hand.upper_limits - hand.lower_limits)


def measure_arm(hand: Hand) -> np.ndarray | None:
    """Measure how far an arm moves the wrist from rest, by random postures.

    Returns:
        Distance that it reaches in each of 26 directions around rest [m]; 0 where rest is at the
        edge of its range. None without an arm.
    """
    if hand.is_floating or not hand.has_moving_wrist:
        return None
    postures = across(
        hand, np.random.default_rng(0).random((_ARM_SAMPLES, len(hand.rest)))
    )
    start = hand.frame_pose("wrist", hand.rest)[:3, 3]
    moved = np.array([hand.frame_pose("wrist", q)[:3, 3] - start for q in postures])
    lengths = np.maximum(np.linalg.norm(moved, axis=1), 1e-9)
    # In each direction, the farthest wrist within a cone.
    near = _DIRECTIONS @ (moved / lengths[:, None]).T > _CONE
    return np.array([lengths[row].max() if row.any() else 0.0 for row in near])


def measure_size(hand: Hand) -> Size:
    """Measure the size of a hand relative to a person's.

    Args:
        hand: The hand, with fingertips as reference points.
    """
    human = load_hand("human", points="fingertips", hand_length=HUMAN_LENGTH)
    postures = (hand.rest, np.clip(0.0, hand.lower_limits, hand.upper_limits))
    lengths = [
        np.linalg.norm(hand.points(q) - hand.frame_pose("palm", q)[:3, 3], axis=1).max()
        for q in postures
    ]
    return Size(
        float(max(lengths)),
        _spread(hand.points(hand.rest)),
        _spread(human.points(human.rest)),
    )


def colliding_links(hand: Hand, q: np.ndarray) -> tuple[tuple[str, str], ...]:
    """Return the pairs of links whose collision shapes overlap in one posture.

    Pairs that meet in a joint, or that overlap in most postures, are left out.

    Args:
        hand: The hand.
        q: Joint angles [rad], shape (n,).

    Raises:
        HandError: If a shape cannot be read.
    """
    geometry, model, data = (
        read_collision_shapes(hand),
        hand.model,
        hand.model.createData(),
    )
    shapes = geometry.geometryObjects
    with_shape = {shape.parentJoint for shape in shapes}
    for i, j in itertools.combinations(range(len(shapes)), 2):
        if not _meet(model, shapes[i].parentJoint, shapes[j].parentJoint, with_shape):
            geometry.addCollisionPair(pin.CollisionPair(i, j))
    results = geometry.createData()

    def overlaps(angles: np.ndarray) -> np.ndarray:
        vector = hand.configuration_vector(angles)
        pin.computeCollisions(model, data, geometry, results, vector, False)
        return np.array(
            [result.isCollision() for result in results.collisionResults], dtype=bool
        )

    others = across(hand, np.random.default_rng(0).random((8, len(q))))
    # Shapes that overlap in most postures overlap by design: ignore them.
    found = overlaps(q) & (np.mean([overlaps(other) for other in others], axis=0) < 0.8)
    pairs = [geometry.collisionPairs[i] for i in np.flatnonzero(found).tolist()]
    frames = [
        (shapes[pair.first].parentFrame, shapes[pair.second].parentFrame)
        for pair in pairs
    ]
    return tuple(
        dict.fromkeys(
            (model.frames[one].name, model.frames[other].name) for one, other in frames
        )
    )


def try_motion(hand: Hand) -> tuple[MotionPart, ...]:
    """Map a standard motion of a human hand: from rest to each of `standard_postures`."""
    human = load_hand(
        "human" if hand.side == "right" else "human_left", hand_length=HUMAN_LENGTH
    )
    rigid = "wrist" if hand.has_moving_wrist else "none"
    parts = []
    for name, posture in standard_postures(human).items():
        # A floating hand can turn as a whole; a hand that is held cannot, and its world's axes
        # need not be the human's.
        alignment = "world" if hand.is_floating else "palm"
        mapper = HandMapper(human, hand, rigid_from=rigid, alignment=alignment, dt=_DT)
        mapper.map_step(human.rest, np.eye(4))
        # 0.75 s of motion, then 0.25 s to settle.
        shares = np.concatenate(
            [0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 45)), np.ones(15)]
        )
        steps = [
            mapper.map_step(human.rest + share * (posture - human.rest), np.eye(4))
            for share in shares
        ]
        error, q = steps[-1].point_error, steps[-1].command.q
        worst = int(np.argmax(error))
        limited = tuple(
            joint
            for joint, is_at in zip(
                hand.joint_names, hand.at_position_limit(q), strict=True
            )
            if is_at
        )
        name_of_worst = hand.reference_points[worst].name
        parts.append(MotionPart(name, float(error[worst]), name_of_worst, limited))
    return tuple(parts)


def standard_postures(human: Hand) -> dict[str, np.ndarray]:
    """Return common postures of the human hand, inside its limits [rad], shape (20,) each."""

    def posture(spread: float = 1.0, **flexions: float) -> np.ndarray:
        q = human.rest.copy()
        for i, name in enumerate(human.joint_names):
            finger, _, joint = name.partition("_")
            if finger in flexions and "flexion" in joint:
                share = {"DIP_flexion": 0.8, "IP_flexion": -0.6}.get(joint, 1.0)
                q[i] = share * flexions[finger]
            elif joint == "MCP_abduction":
                q[i] *= spread
        return np.clip(q, human.lower_limits, human.upper_limits)

    fingers = dict.fromkeys(("index", "middle", "ring", "little"), 0.05)
    fist = dict.fromkeys(fingers, 1.4)
    return {
        "flat hand": posture(thumb=0.1, **fingers),
        "spread": posture(thumb=0.0, spread=3.0, **fingers),
        "fist": posture(thumb=0.7, **fist),
        "pointing": posture(thumb=0.7, **{**fist, "index": 0.05}),
        "pinch": posture(thumb=0.6, index=0.9),
    }


def _spread(points: np.ndarray) -> float:
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _meet(model: pin.Model, one: int, other: int, with_shape: set[int]) -> bool:
    """Return whether two joints carry the same body or neighbouring bodies.

    Short bodies and bodies without a shape between them are skipped.
    """
    if one == other:
        return True
    for near, far in ((one, other), (other, one)):
        at = near
        while at > 0:
            parent = model.parents[at]
            if parent == far:
                return True
            length = np.linalg.norm(model.jointPlacements[at].translation)
            if parent in with_shape and length > _SHORT:
                break
            at = parent
    return False


def make_fist(hand: Hand) -> Fist | None:
    """Compare the way in which the fingers, but the thumb, close with the palm's axes.

    Returns:
        The directions; None if fewer than two fingers close, or they close about different axes.
    """
    view, axes, directions = PalmKinematics(hand), {}, []
    for name, finger in find_fingers(hand).items():
        flexion = finger.flexion
        if (
            name == THUMB
            or flexion is None
            or not flexion.curls
            or flexion.sense == 0.0
        ):
            continue
        straight = zero_posture(hand)
        straight[flexion.columns] = flexion.straight
        line = view.points(straight, [finger.tip])[0] - flexion.knuckle
        directions.append(line / np.linalg.norm(line))
        axes[name] = flexion.sense * flexion.axis
    if len(axes) < 2:
        return None
    axis, direction = np.mean([*axes.values()], axis=0), np.mean(directions, axis=0)
    if np.linalg.norm(axis) < _COMMON or np.linalg.norm(direction) < _COMMON:
        return None
    # Flexion turns distal (y) towards palmar (-z), about -x.
    return Fist(
        angle_between(axis, np.array([-1.0, 0.0, 0.0])),
        angle_between(direction, np.array([0.0, 1.0, 0.0])),
        tuple(axes),
    )


def measure_pinches(hand: Hand) -> tuple[Pinch, ...]:
    """Find how near the thumb's pad can come to every other finger's.

    Damped least squares from several postures, within the joint limits.

    Args:
        hand: The hand; an arm stays at rest.

    Returns:
        One entry per finger; none if the hand has no thumb or no second finger.
    """
    fingers = find_fingers(hand)
    if THUMB not in fingers:
        return ()
    pads, pinches = fingertip_pads(hand, fingers), []
    for name, finger in fingers.items():
        if name != THUMB:
            used = [pads[THUMB], pads[name]]
            radii = sum(pad.radius for pad in used)
            columns = np.union1d(fingers[THUMB].columns, finger.columns)
            places = [(pad.joint, pad.offset) for pad in used]
            distance, q = _nearest(hand, places, columns, radii)
            pinches.append(Pinch(name, distance - radii, q))
    return tuple(pinches)


def fingertip_pads(hand: Hand, chains: dict[str, Finger]) -> dict[str, Pad]:
    """Return the pad of each fingertip; a ball of 6 mm around it if the shapes cannot be read."""
    try:
        return find_pads(hand, chains)
    except HandmapError:
        return {name: Pad(*chain.tip, _RADIUS) for name, chain in chains.items()}


def _nearest(
    hand: Hand, places: list[Place], columns: np.ndarray, near: float
) -> tuple[float, np.ndarray]:
    """Return the smallest distance of two points, or one below `near`, and the posture there."""
    view, low, high = (
        PalmKinematics(hand),
        hand.lower_limits[columns],
        hand.upper_limits[columns],
    )
    random = low + np.random.default_rng(0).random((_STARTS, len(columns))) * (
        high - low
    )
    starts = [hand.rest[columns], 0.5 * (low + high), np.clip(0.0, low, high), *random]
    best, best_q = np.inf, hand.rest.copy()
    for start in starts:
        if best < near:
            break
        q = hand.rest.copy()
        q[columns] = start
        for _ in range(_ITERATIONS):
            gap = np.subtract(*view.points(q, places))
            distance = float(np.linalg.norm(gap))
            if distance < best:
                best, best_q = distance, q.copy()
            J = np.subtract(
                *(view.motion(q, place)[:3, columns] for place in reversed(places))
            )
            step = J.T @ np.linalg.solve(J @ J.T + _DAMPING**2 * np.eye(3), gap)
            moved = np.clip(q[columns] + step, low, high)
            if distance < near or np.abs(moved - q[columns]).max() < 1e-4:
                break
            q[columns] = moved
    return best, best_q
