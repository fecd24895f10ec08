"""What fidelity is measured on: palm, knuckles, middle joints and fingertips over time.

A human's come from raw landmarks, a robot's from its model, its joint angles and its wrist poses,
whatever mapping found those. So every mapping is measured in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS, HumanLengths
from handmap_qp.hands.spec import PointSpec, Side
from handmap_qp.trackers.landmarks import FIRST_JOINTS, PALM, TIPS
from handmap_qp.transform import affine, nearest_rotation

MIDDLES = np.array([3, 6, 10, 14, 18])
"""Landmarks of the middle joints: the thumb's IP and the other fingers' PIP."""
THUMB = "thumb"
"""Name of the finger that the others pinch."""

# A joint flexes a finger if its axis is as parallel as this to that of the finger's last joint.
_PARALLEL = 0.7
# A middle joint is at least this share of the reach away from the knuckle.
_MIDDLE_SHARE = 0.2
_REACH_SAMPLES = 200


@dataclass(frozen=True, slots=True, eq=False)
class FingerTrace:
    """One finger over time.

    Attributes:
        name: Anatomical name, as in `FINGERS`.
        knuckle: Its base: the thumb's CMC, another finger's MCP; in the world [m], shape (T, 3).
        middle: The thumb's IP, another finger's PIP [m], shape (T, 3).
        tip: Fingertip [m], shape (T, 3).
        reach: Largest distance from knuckle to tip that the finger can have [m].
    """

    name: str
    knuckle: np.ndarray
    middle: np.ndarray
    tip: np.ndarray
    reach: float

    @property
    def extension(self) -> np.ndarray:
        """Distance from knuckle to tip as a share of the reach, shape (T,)."""
        return np.linalg.norm(self.tip - self.knuckle, axis=1) / self.reach


@dataclass(frozen=True, slots=True, eq=False)
class HandTrace:
    """A hand over time.

    Attributes:
        fingers: Its fingers, by name.
        palm: Palm poses in the world: origin at the wrist, +y distal, +z dorsal, shape (T, 4, 4).
        size: From the palm's origin over the middle of the knuckles to the stretched fingertips,
            mean over the fingers without the thumb [m].
    """

    fingers: dict[str, FingerTrace]
    palm: np.ndarray
    size: float

    def in_palm(self, points: np.ndarray) -> np.ndarray:
        """Points of every sample in the palm frame.

        Args:
            points: In the world [m], shape (T, 3) or (T, k, 3).

        Returns:
            The same shape [m].
        """
        rotation, origin = self.palm[:, :3, :3], self.palm[:, :3, 3]
        if points.ndim == 3:
            return (points - origin[:, None]) @ rotation
        return np.einsum("tji,tj->ti", rotation, points - origin)

    def at(self, samples: np.ndarray) -> HandTrace:
        """Some of the samples, by index or mask."""
        fingers = {
            name: FingerTrace(name, f.knuckle[samples], f.middle[samples], f.tip[samples], f.reach)
            for name, f in self.fingers.items()
        }
        return HandTrace(fingers, self.palm[samples], self.size)


def trace_human(
    landmarks: np.ndarray,
    lengths: HumanLengths,
    side: Side = "right",
    wrist_poses: np.ndarray | None = None,
) -> HandTrace:
    """Describe a human's motion by its raw landmarks.

    Args:
        landmarks: Measured landmarks [m], shape (T, 21, 3), finite.
        lengths: The person's lengths, as a right hand (`measure_hand`).
        side: Which hand.
        wrist_poses: Wrist poses of the tracker, shape (T, 4, 4). The palm then moves with them; its
            mean pose on the wrist comes from the landmarks. If omitted, the palm is the rigid fit
            (Kabsch 1976) of landmarks 0, 5, 9, 13 and 17 in every sample.

    Returns:
        The trace.

    Raises:
        InvalidInputError: On a wrong shape or numbers that are not finite.
    """
    points = np.asarray(landmarks, dtype=float)
    if points.ndim != 3 or points.shape[1:] != (21, 3) or not np.isfinite(points).all():
        raise InvalidInputError(
            argument="landmarks", expected="finite numbers of shape (T, 21, 3)", value=landmarks
        )
    template = np.vstack([np.zeros(3), lengths.bases[1:]])
    if side == "left":
        template = template * (-1.0, 1.0, 1.0)
    palm = np.array([_rigid_fit(template, sample[PALM]) for sample in points])
    if wrist_poses is not None:
        palm = np.asarray(wrist_poses, dtype=float) @ _mean_pose(np.linalg.inv(wrist_poses) @ palm)
    reach = lengths.segments.sum(axis=1)
    fingers = {
        name: FingerTrace(
            name,
            points[:, FIRST_JOINTS[i]],
            points[:, MIDDLES[i]],
            points[:, TIPS[i]],
            float(reach[i]),
        )
        for i, name in enumerate(FINGERS)
    }
    size = float(np.linalg.norm(lengths.bases[1:].mean(axis=0)) + reach[1:].mean())
    return HandTrace(fingers, palm, size)


@dataclass(frozen=True, slots=True, eq=False)
class FingerChain:
    """Where a finger's points are on a robot's model.

    Attributes:
        name: Anatomical name.
        joints: Joints of the model that move this finger's tip and not the palm, outwards.
        knuckle: Joint of the model that carries the knuckle, and its offset there [m], shape (3,).
        middle: The same of the middle joint.
        tip: The same of the fingertip.
        reach: Largest distance from knuckle to tip within the joint limits [m].
        stretched: Joint angles in the order of `Hand.joint_names` where it has that reach [rad],
            shape (n,).
    """

    name: str
    joints: tuple[int, ...]
    knuckle: tuple[int, np.ndarray]
    middle: tuple[int, np.ndarray]
    tip: tuple[int, np.ndarray]
    reach: float
    stretched: np.ndarray


def find_fingers(hand: Hand) -> dict[str, FingerChain]:
    """Find knuckle, middle joint, tip and reach of every finger of a hand.

    Points that the description names after landmarks (as name or partner) are taken from there.
    Otherwise the tip is the finger's named point farthest from the palm when stretched. The knuckle
    lies on the axis of the first joint that flexes the finger (one whose axis is nearly parallel to
    the last joint's), where it is nearest to the stretched tip. The middle joint lies in the same
    way on the first flexing axis beyond a fifth of the reach. A thumb's knuckle is the origin of
    its first joint, its middle joint that of its last.

    Args:
        hand: The hand.

    Returns:
        Fingers by name, in the order of `FINGERS`; those that the description does not name are
        left out.
    """
    named: dict[str, list[PointSpec]] = {}
    for point in hand.spec.points:
        if point.finger in FINGERS:
            named.setdefault(point.finger, []).append(point)
    tips = {finger: _tip(hand, finger, points) for finger, points in named.items()}
    carriers = {finger: _place(hand, tip)[0] for finger, tip in tips.items()}
    return {
        finger: _chain(hand, finger, named[finger], tips[finger], carriers)
        for finger in FINGERS
        if finger in named
    }


def trace_robot(
    hand: Hand,
    q: np.ndarray,
    wrist: np.ndarray | None = None,
    chains: dict[str, FingerChain] | None = None,
) -> HandTrace:
    """Describe a robot's motion by its joint angles and wrist poses.

    Args:
        hand: The robot hand.
        q: Joint angles in the order of `hand.joint_names` [rad], shape (T, n).
        wrist: Wrist poses in the world, shape (T, 4, 4); omitted for a fixed hand.
        chains: Its fingers, if they have been found before.

    Returns:
        The trace.
    """
    chains = chains or find_fingers(hand)
    count = len(q)
    data, palm = hand.model.createData(), np.empty((count, 4, 4))
    points = np.empty((count, len(chains), 3, 3))
    places = [(chain.knuckle, chain.middle, chain.tip) for chain in chains.values()]
    for t in range(count):
        _forward(hand, data, q[t], None if wrist is None else wrist[t])
        palm[t] = data.oMf[hand.palm_frame_id].homogeneous
        for i, three in enumerate(places):
            for k, (joint, offset) in enumerate(three):
                points[t, i, k] = data.oMi[joint].act(offset)
    fingers = {
        name: FingerTrace(name, points[:, i, 0], points[:, i, 1], points[:, i, 2], chain.reach)
        for i, (name, chain) in enumerate(chains.items())
    }
    return HandTrace(fingers, palm, _robot_size(hand, chains))


def _robot_size(hand: Hand, chains: dict[str, FingerChain]) -> float:
    """Distance from the palm's origin over the knuckles to the stretched tips [m]."""
    data = hand.model.createData()
    _forward(hand, data, np.clip(0.0, hand.lower_limits, hand.upper_limits), None)
    others = [chain for name, chain in chains.items() if name != THUMB] or list(chains.values())
    middle = np.mean([data.oMi[c.knuckle[0]].act(c.knuckle[1]) for c in others], axis=0)
    origin = data.oMf[hand.palm_frame_id].translation
    reach = np.mean([chain.reach for chain in others])
    return float(np.linalg.norm(middle - origin) + reach)


def _tip(hand: Hand, finger: str, points: list[PointSpec]) -> PointSpec:
    for point in points:
        if f"{finger}_tip" in (point.partner, point.name):
            return point
    data = hand.model.createData()
    _forward(hand, data, np.clip(0.0, hand.lower_limits, hand.upper_limits), None)
    origin = data.oMf[hand.palm_frame_id].translation
    distances = []
    for point in points:
        joint, offset = _place(hand, point)
        distances.append(np.linalg.norm(data.oMi[joint].act(offset) - origin))
    return points[int(np.argmax(distances))]


def _place(hand: Hand, point: PointSpec) -> tuple[int, np.ndarray]:
    """The joint of the model that carries a point, and the point's offset on it."""
    frame = hand.model.frames[hand.model.getFrameId(point.link, pin.FrameType.BODY)]
    return frame.parentJoint, frame.placement.act(np.array(point.xyz))


def _chain(
    hand: Hand, finger: str, points: list[PointSpec], tip: PointSpec, carriers: dict[str, int]
) -> FingerChain:
    supports = hand.model.supports
    palm = hand.model.frames[hand.palm_frame_id].parentJoint
    tip_place = _place(hand, tip)
    joints = [j for j in supports[tip_place[0]] if j not in set(supports[palm])]
    own = [
        j
        for j in joints
        if not any(j in supports[other] for name, other in carriers.items() if name != finger)
    ] or joints
    if not own:
        return FingerChain(
            finger, (), tip_place, tip_place, tip_place, float("nan"), hand.rest.copy()
        )
    first, last = ("cmc", "ip") if finger == THUMB else ("mcp", "pip")
    bending = _bending_joints(hand, own)
    knuckle = _named(hand, finger, first, points)
    middle = _named(hand, finger, last, points)
    if knuckle is None:
        on_first = (own[0] if finger == THUMB else bending[0], np.zeros(3))
        knuckle = on_first if finger == THUMB else _nearest_on_axis(hand, on_first[0], tip_place)
    reach, stretched = _reach(hand, joints, knuckle, tip_place)
    if middle is None and finger == THUMB:
        middle = (own[-1], np.zeros(3))
    elif middle is None:
        joint = _middle_joint(hand, own, bending, knuckle, reach, stretched)
        middle = _nearest_on_axis(hand, joint, tip_place)
    return FingerChain(finger, tuple(joints), knuckle, middle, tip_place, reach, stretched)


def _nearest_on_axis(hand: Hand, joint: int, tip: tuple[int, np.ndarray]) -> tuple[int, np.ndarray]:
    """The point of a turning joint's axis nearest to the stretched hand's fingertip."""
    data = hand.model.createData()
    axis = pin.computeJointJacobians(hand.model, data, _stretched(hand))[
        3:, hand.model.joints[joint].idx_v
    ]
    lever = data.oMi[tip[0]].act(tip[1]) - data.oMi[joint].translation
    return joint, data.oMi[joint].rotation.T @ ((lever @ axis) * axis)


def _named(
    hand: Hand, finger: str, joint: str, points: list[PointSpec]
) -> tuple[int, np.ndarray] | None:
    for point in points:
        if f"{finger}_{joint}" in (point.partner, point.name):
            return _place(hand, point)
    return None


def _bending_joints(hand: Hand, joints: list[int]) -> list[int]:
    """Those whose axes are nearly parallel to the last one's in the stretched hand."""
    jacobian = pin.computeJointJacobians(hand.model, hand.model.createData(), _stretched(hand))
    axes = {j: jacobian[3:, hand.model.joints[j].idx_v] for j in joints}
    last = axes[joints[-1]]
    bending = [j for j in joints if abs(float(axes[j] @ last)) > _PARALLEL]
    return bending or joints


def _stretched(hand: Hand) -> np.ndarray:
    """Configuration vector of the stretched hand, its wrist at the origin."""
    q = np.zeros(hand.model.nq)
    hand.write_configuration(q, np.clip(0.0, hand.lower_limits, hand.upper_limits), np.eye(4))
    return q


def _middle_joint(
    hand: Hand,
    own: list[int],
    bending: list[int],
    knuckle: tuple[int, np.ndarray],
    reach: float,
    stretched: np.ndarray,
) -> int:
    """The first flexing joint far enough from the knuckle."""
    data = hand.model.createData()
    _forward(hand, data, stretched, None)
    base = data.oMi[knuckle[0]].act(knuckle[1])
    for joint in bending:
        if np.linalg.norm(data.oMi[joint].translation - base) > _MIDDLE_SHARE * reach:
            return joint
    return own[-1]


def _reach(
    hand: Hand, joints: list[int], knuckle: tuple[int, np.ndarray], tip: tuple[int, np.ndarray]
) -> tuple[float, np.ndarray]:
    """Largest distance from knuckle to tip within the limits, and where: random search, refined."""
    data, model = hand.model.createData(), hand.model
    moving = _moving_columns(hand, joints)

    def distance(q: np.ndarray) -> float:
        _forward(hand, data, q, None)
        return float(
            np.linalg.norm(data.oMi[tip[0]].act(tip[1]) - data.oMi[knuckle[0]].act(knuckle[1]))
        )

    best_q = np.clip(0.0, hand.lower_limits, hand.upper_limits)
    best = distance(best_q)
    if not len(moving) or model.nq == 0:
        return best, best_q
    low, high = hand.lower_limits[moving], hand.upper_limits[moving]
    random = np.random.default_rng(0)
    for _ in range(_REACH_SAMPLES):
        q = best_q.copy()
        q[moving] = random.uniform(low, high)
        if (d := distance(q)) > best + 1e-9:
            best, best_q = d, q
    step = 0.25 * (high - low)
    while (step > 1e-3).any():
        improved = False
        for i, column in enumerate(moving):
            for sign in (-1.0, 1.0):
                q = best_q.copy()
                q[column] = np.clip(q[column] + sign * step[i], low[i], high[i])
                if (d := distance(q)) > best + 1e-9:
                    best, best_q, improved = d, q, True
        if not improved:
            step = 0.5 * step
    return best, best_q


def _moving_columns(hand: Hand, joints: list[int]) -> np.ndarray:
    """Columns of q that move any of these joints of the model, followers included."""
    base, columns = np.clip(0.0, hand.lower_limits, hand.upper_limits), []
    indices = [hand.model.joints[j].idx_q for j in joints]
    vector, changed = np.zeros(hand.model.nq), np.zeros(hand.model.nq)
    hand.write_configuration(vector, base, np.eye(4))
    for i in range(len(base)):
        q = base.copy()
        q[i] += 0.1
        hand.write_configuration(changed, q, np.eye(4))
        if not np.array_equal(changed[indices], vector[indices]):
            columns.append(i)
    return np.array(columns, dtype=int)


def _forward(hand: Hand, data: pin.Data, q: np.ndarray, wrist: np.ndarray | None) -> None:
    vector = np.zeros(hand.model.nq)
    hand.write_configuration(vector, q, np.eye(4) if wrist is None else wrist)
    pin.framesForwardKinematics(hand.model, data, vector)


def _rigid_fit(points: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """Pose that best lays points (n, 3) onto others (n, 3), shape (4, 4)."""
    centre, centre_onto = points.mean(axis=0), onto.mean(axis=0)
    rotation = nearest_rotation((onto - centre_onto).T @ (points - centre))
    return affine(rotation, centre_onto - rotation @ centre)


def _mean_pose(poses: np.ndarray) -> np.ndarray:
    """Rotation nearest to the mean one, and the median origin, shape (4, 4)."""
    rotation = nearest_rotation(poses[:, :3, :3].mean(axis=0))
    return affine(rotation, np.median(poses[:, :3, 3], axis=0))
