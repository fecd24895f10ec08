"""Measure a hand: reach of its fingers, size, self-collisions, and a standard motion."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
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
    [v / np.linalg.norm(v) for i in np.ndindex(3, 3, 3) if (v := np.array(i) - 1.0).any()]
)
_CONE = np.cos(np.radians(25.0))
_DT = 1.0 / 60.0


@dataclass(frozen=True, slots=True)
class FingerReach:
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


@dataclass(frozen=True, slots=True)
class Size:
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


@dataclass(frozen=True, slots=True)
class MotionPart:
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


def measure_reach(hand: Hand) -> tuple[FingerReach, ...]:
    """Measure reach and manipulability of every reference point on a finger.

    Args:
        hand: The hand; an arm stays at rest.

    Returns:
        One entry per point.
    """
    wrist = hand.model.frames[hand.wrist_frame_id].parentJoint
    arm = {hand.model.joints[joint].idx_v for joint in hand.model.supports[wrist]}
    fingers = np.array([v not in arm or wrist == 0 for v in hand.v_indices])
    generator = np.random.default_rng(0)
    shares = np.vstack(
        [
            generator.random((_SAMPLES, len(hand.rest))),
            generator.integers(0, 2, (_SAMPLES, len(hand.rest))),
        ]
    )
    postures = np.where(
        fingers, hand.lower_limits + shares * (hand.upper_limits - hand.lower_limits), hand.rest
    )
    places = np.array([hand.points(q) for q in postures])
    jacobian = hand.point_jacobian(hand.rest)[:, fingers]
    rows = []
    for i, point in enumerate(hand.reference_points):
        if point.finger is None:
            continue
        motions = np.linalg.svd(jacobian[3 * i : 3 * i + 3], compute_uv=False)
        motions = motions[motions > _LEAST_MOTION]
        gaps = places[:, None, i] - places[None, :: max(1, len(places) // 100), i]
        rows.append(
            FingerReach(
                point.name,
                point.finger,
                float(np.linalg.norm(gaps, axis=2).max()),
                len(motions),
                float(motions.min()) if len(motions) else 0.0,
                float(np.prod(motions)) if len(motions) else 0.0,
            )
        )
    return tuple(rows)


def measure_arm(hand: Hand) -> np.ndarray | None:
    """Measure how far an arm moves the wrist from rest, by random postures.

    Args:
        hand: The hand.

    Returns:
        Distance that it reaches in each of 26 directions around rest [m]; 0 where rest is at the
        edge of its range. None without an arm.
    """
    if hand.is_floating or not hand.has_moving_wrist:
        return None
    generator = np.random.default_rng(0)
    shares = generator.random((_ARM_SAMPLES, len(hand.rest)))
    postures = hand.lower_limits + shares * (hand.upper_limits - hand.lower_limits)
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
        float(max(lengths)), _spread(hand.points(hand.rest)), _spread(human.points(human.rest))
    )


def colliding_links(hand: Hand, q: np.ndarray) -> tuple[tuple[str, str], ...]:
    """Return the pairs of links whose collision shapes overlap in one posture.

    Pairs that meet in a joint, or that overlap in most postures, are left out.

    Args:
        hand: The hand.
        q: Joint angles [rad], shape (n,).

    Returns:
        Pairs of link names.

    Raises:
        HandError: If a shape cannot be read.
    """
    geometry, model, data = read_collision_shapes(hand), hand.model, hand.model.createData()
    shapes = geometry.geometryObjects
    with_shape = {shape.parentJoint for shape in shapes}
    for i, j in itertools.combinations(range(len(shapes)), 2):
        if not _meet(model, shapes[i].parentJoint, shapes[j].parentJoint, with_shape):
            geometry.addCollisionPair(pin.CollisionPair(i, j))
    results = geometry.createData()

    def overlaps(angles: np.ndarray) -> np.ndarray:
        vector = hand.configuration_vector(angles)
        pin.computeCollisions(model, data, geometry, results, vector, False)
        return np.array([result.isCollision() for result in results.collisionResults], dtype=bool)

    shares = np.random.default_rng(0).random((8, len(q)))
    others = hand.lower_limits + shares * (hand.upper_limits - hand.lower_limits)
    # Shapes that overlap in most postures overlap by design: ignore them.
    found = overlaps(q) & (np.mean([overlaps(other) for other in others], axis=0) < 0.8)
    pairs = [geometry.collisionPairs[i] for i in np.flatnonzero(found).tolist()]
    frames = [(shapes[pair.first].parentFrame, shapes[pair.second].parentFrame) for pair in pairs]
    return tuple(
        dict.fromkeys((model.frames[one].name, model.frames[other].name) for one, other in frames)
    )


def try_motion(hand: Hand) -> tuple[MotionPart, ...]:
    """Map a standard motion of a human hand: from rest to each of `standard_postures`.

    Args:
        hand: The robot hand.

    Returns:
        One entry per posture.
    """
    human = load_hand("human" if hand.side == "right" else "human_left", hand_length=HUMAN_LENGTH)
    rigid = "wrist" if hand.has_moving_wrist else "none"
    parts = []
    for name, posture in standard_postures(human).items():
        # A floating hand can turn as a whole; a hand that is held cannot, and its world's axes
        # need not be the human's.
        alignment = "world" if hand.is_floating else "palm"
        mapper = HandMapper(human, hand, rigid_from=rigid, alignment=alignment, dt=_DT)
        mapper.map_step(human.rest, np.eye(4))
        # 0.75 s of motion, then 0.25 s to settle.
        shares = np.concatenate([0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 45)), np.ones(15)])
        step = None
        for share in shares:
            step = mapper.map_step(human.rest + share * (posture - human.rest), np.eye(4))
        assert step is not None
        worst = int(np.argmax(step.point_error))
        q = step.command.q
        at_limit = np.flatnonzero(hand.at_position_limit(q))
        limited = tuple(hand.joint_names[i] for i in at_limit)
        parts.append(
            MotionPart(
                name, float(step.point_error[worst]), hand.reference_points[worst].name, limited
            )
        )
    return tuple(parts)


def standard_postures(human: Hand) -> dict[str, np.ndarray]:
    """Return common postures of the human hand, inside its limits [rad], shape (20,) each."""
    names = human.joint_names

    def posture(**flexions: float) -> np.ndarray:
        q = human.rest.copy()
        for i, name in enumerate(names):
            finger, _, joint = name.partition("_")
            if finger in flexions and "flexion" in joint:
                q[i] = (
                    flexions[finger]
                    * (0.8 if "DIP" in joint else 1.0)
                    * (-0.6 if joint == "IP_flexion" else 1.0)
                )
            if "spread" in flexions and joint == "MCP_abduction":
                q[i] = human.rest[i] * flexions["spread"]
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
