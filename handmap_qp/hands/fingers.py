"""The fingers of any hand: knuckle, middle joint, fingertip and reach, found on its model."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS
from handmap_qp.hands.spec import PointSpec

THUMB = "thumb"
"""Name of the finger that the others pinch."""

# A joint flexes a finger if its axis is as parallel as this to that of the finger's last joint.
_PARALLEL = 0.7
# A middle joint is at least this share of the reach away from the knuckle.
_MIDDLE_SHARE = 0.2
_REACH_SAMPLES = 200
# Pinocchio's names of prismatic joints, along an axis of the frame or any other.
_PRISMATIC = ("JointModelPX", "JointModelPY", "JointModelPZ", "JointModelPrismatic")


@dataclass(frozen=True, slots=True, eq=False)
class FingerEnd:
    """Where a fingertip is on a hand's model.

    Attributes:
        joints: Joints of the model that move this finger's tip and not the palm, outwards.
        tip: Joint of the model that carries the fingertip, and its offset there [m], shape (3,).
    """

    joints: tuple[int, ...]
    tip: tuple[int, np.ndarray]


@dataclass(frozen=True, slots=True, eq=False)
class FingerChain(FingerEnd):
    """Where all of a finger's points are on a hand's model.

    Attributes:
        name: Anatomical name.
        knuckle: Joint of the model that carries the knuckle, and its offset there [m], shape (3,).
        middle: The same of the middle joint.
        reach: Largest distance from knuckle to tip within the joint limits [m].
        stretched: Joint angles in the order of `Hand.joint_names` where it has that reach [rad],
            shape (n,).
        is_jaw: True if all its joints are prismatic, so that it can neither bend nor stretch.
    """

    name: str
    knuckle: tuple[int, np.ndarray]
    middle: tuple[int, np.ndarray]
    reach: float
    stretched: np.ndarray
    is_jaw: bool = False


def find_finger_ends(hand: Hand) -> dict[str, FingerEnd]:
    """Find the fingertip of every finger, and the joints that move it.

    Args:
        hand: The hand.

    Returns:
        Fingers by name, as of `find_fingers`.
    """
    named = _points_by_finger(hand)
    places = {f: _place(hand, _tip(hand, f, named[f])) for f in FINGERS if f in named}
    return {finger: FingerEnd(_moving_joints(hand, tip), tip) for finger, tip in places.items()}


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
    named = _points_by_finger(hand)
    ends = find_finger_ends(hand)
    carriers = {finger: end.tip[0] for finger, end in ends.items()}
    return {
        finger: _chain(hand, finger, named[finger], end, carriers) for finger, end in ends.items()
    }


def finger_tips(hand: Hand) -> dict[str, str]:
    """Return the name of the description's point at the tip of each finger, by finger."""
    return {f: _tip(hand, f, points).name for f, points in _points_by_finger(hand).items()}


def partner_names(robot: Hand, landmarks: Collection[str]) -> list[str]:
    """Return the name of the human point that each reference point of a robot corresponds to.

    It is the point's `partner`, else the landmark of its own name. A point with neither corresponds
    to `<finger>_tip` if it is the last point of a named finger: the farthest from the palm with the
    hand stretched.

    Args:
        robot: The robot hand.
        landmarks: Names of the human's points.

    Returns:
        Names in the order of `robot.reference_points`; a point's own name where there is no such
        landmark.
    """
    last = {name: f"{finger}_tip" for finger, name in finger_tips(robot).items()}
    return [
        point.partner
        or (point.name if point.name in landmarks else last.get(point.name, point.name))
        for point in robot.reference_points
    ]


def _points_by_finger(hand: Hand) -> dict[str, list[PointSpec]]:
    """Return the description's points of each finger with an anatomical name."""
    named: dict[str, list[PointSpec]] = {}
    for point in hand.spec.points:
        if point.finger in FINGERS:
            named.setdefault(point.finger, []).append(point)
    return named


def _tip(hand: Hand, finger: str, points: list[PointSpec]) -> PointSpec:
    for point in points:
        if f"{finger}_tip" in (point.partner, point.name):
            return point
    data = hand.model.createData()
    place_robot(hand, data, np.clip(0.0, hand.lower_limits, hand.upper_limits), None)
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


def _moving_joints(hand: Hand, tip: tuple[int, np.ndarray]) -> tuple[int, ...]:
    """Return the joints that move a fingertip and not the palm, outwards."""
    supports = hand.model.supports
    in_palm = set(supports[hand.model.frames[hand.palm_frame_id].parentJoint])
    return tuple(joint for joint in supports[tip[0]] if joint not in in_palm)


def _chain(
    hand: Hand, finger: str, points: list[PointSpec], end: FingerEnd, carriers: dict[str, int]
) -> FingerChain:
    supports, joints, tip = hand.model.supports, end.joints, end.tip
    own = [
        j
        for j in joints
        if not any(j in supports[other] for name, other in carriers.items() if name != finger)
    ] or list(joints)
    if not own:
        return FingerChain((), tip, finger, tip, tip, float("nan"), hand.rest.copy())
    first, last = ("cmc", "ip") if finger == THUMB else ("mcp", "pip")
    bending = _bending_joints(hand, own)
    knuckle = _named(hand, finger, first, points)
    middle = _named(hand, finger, last, points)
    if knuckle is None:
        on_first = (own[0] if finger == THUMB else bending[0], np.zeros(3))
        knuckle = on_first if finger == THUMB else _nearest_on_axis(hand, on_first[0], tip)
    reach, stretched = _reach(hand, joints, knuckle, tip)
    if middle is None and finger == THUMB:
        middle = (own[-1], np.zeros(3))
    elif middle is None:
        joint = _middle_joint(hand, own, bending, knuckle, reach, stretched)
        middle = _nearest_on_axis(hand, joint, tip)
    is_jaw = all(hand.model.joints[j].shortname().startswith(_PRISMATIC) for j in joints)
    return FingerChain(joints, tip, finger, knuckle, middle, reach, stretched, is_jaw)


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
    place_robot(hand, data, stretched, None)
    base = data.oMi[knuckle[0]].act(knuckle[1])
    for joint in bending:
        if np.linalg.norm(data.oMi[joint].translation - base) > _MIDDLE_SHARE * reach:
            return joint
    return own[-1]


def _reach(
    hand: Hand,
    joints: Sequence[int],
    knuckle: tuple[int, np.ndarray],
    tip: tuple[int, np.ndarray],
) -> tuple[float, np.ndarray]:
    """Largest distance from knuckle to tip within the limits, and where: random search, refined."""
    data, model = hand.model.createData(), hand.model
    moving, vector = moving_columns(hand, joints), _stretched(hand)

    def distance(q: np.ndarray) -> float:
        hand.write_configuration(vector, q)
        pin.forwardKinematics(model, data, vector)
        return math.dist(data.oMi[tip[0]].act(tip[1]), data.oMi[knuckle[0]].act(knuckle[1]))

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
                q[column] = min(max(q[column] + sign * step[i], low[i]), high[i])
                if (d := distance(q)) > best + 1e-9:
                    best, best_q, improved = d, q, True
        if not improved:
            step = 0.5 * step
    return best, best_q


def moving_columns(hand: Hand, joints: Sequence[int]) -> np.ndarray:
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


def place_robot(hand: Hand, data: pin.Data, q: np.ndarray, wrist: np.ndarray | None) -> None:
    """Place joints and frames of a hand at joint angles (n,) and a wrist pose (4, 4) or None."""
    vector = np.zeros(hand.model.nq)
    hand.write_configuration(vector, q, np.eye(4) if wrist is None else wrist)
    pin.framesForwardKinematics(hand.model, data, vector)
