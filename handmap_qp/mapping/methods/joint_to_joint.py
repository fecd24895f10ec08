"""Joint to joint: each robot joint takes the share of its range that the human's joint takes.

The usual mapping of data gloves, for hands built like ours. The human's angles are measured on the
landmarks (`FingerAngles`). A finger's joints correspond by their place in the chain: flexions to
flexions outwards, abduction to abduction. A robot finger with fewer flexions has its last one
follow the rest of the human's together; one with more shares them out. An angle becomes a share of
the human joint's range from straight to its limit, and the robot's joint goes to that share of its
own. The thumb's base joints count from rest instead of straight, and turn the way that moves the
tip as the human's joint does.

The targets are the robot's points by forward kinematics at the joint positions wanted, and a task
of the QP pulls the joints themselves there. Both are zero at the same posture, so no weight of the
one disturbs the other. The points alone would leave joints open that they do not see, and the
joints alone would leave nothing to report a point's error against.

Gestures come across where the fingers are alike. Pinches do not: small errors of angle add up at
the tips, and thumbs are built too differently for joints to correspond.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.fingers import (
    Finger,
    PalmKinematics,
    ends_of,
    find_fingers,
    nearing,
    zero_posture,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS, HUMAN_JOINTS, THUMB
from handmap_qp.ik.tasks import TaskRows
from handmap_qp.mapping.alignment import AlignedOptions
from handmap_qp.mapping.method import (
    FOLLOWING,
    HumanPose,
    Preset,
    RobotPosture,
    Targets,
)
from handmap_qp.mapping.palm import (
    PalmMap,
    PalmMethod,
    chain_landmarks,
    require_points,
)
from handmap_qp.se3 import inverse_pose, lengths, transform_points, unit

# Weight of a joint's error [1/rad]: 0.1 rad counts as much as 10 mm of a point.
_JOINT_WEIGHT = 10.0
# Change of the distance from knuckle to tip over the range of a thumb's joint that counts as
# curling, as a share of the thumb's reach.
_CURLING = 0.06
# Bones that point along the axis of abduction say nothing of it: length that pulls it to zero [m].
_STRAIGHTENING = 0.0005
# Cosine from which on two axes are parallel.
_PARALLEL = 1.0 - 1e-9


class JointToJoint(AlignedOptions, frozen=True):
    """Map joint angles to joint angles, scaled by the ranges."""

    def bind(self, human: Hand, robot: Hand) -> BoundJointToJoint:
        """Find the joints that correspond; see `Method.bind`."""
        return BoundJointToJoint(self, human, robot)


PRESETS = {
    "joint-to-joint": Preset(
        JointToJoint(),
        FOLLOWING,
        "to compare: each robot joint takes the share of its range that the human's joint takes",
        "pinches: small errors of angle add up at the tips",
    )
}


class FingerAngles:
    """Joint angles of some fingers of the human hand, by geometry and without iterations.

    A finger has four joints and three bones. The first joint turns the whole finger (abduction),
    the other three bend it, one a bone. The abduction is the direction in which the bones extend
    most across its axis. Each flexion is then the angle of its bone in the frame that the joints
    before it leave. Landmarks of this package's human hand give its joint angles back; measured
    ones, whose bones leave the plane of their finger, give the nearest in that sense.

    Args:
        human: The human hand; its reference points must hold the fingers' four landmarks.
        fingers: Names of the fingers, f of them.

    Attributes:
        columns: Indices of the joints in `human.joint_names`, shape (f, 4).

    Raises:
        InvalidOptionsError: If the hand has other joints than this package's human hand, or its
            reference points lack a landmark.
    """

    def __init__(self, human: Hand, fingers: tuple[str, ...]) -> None:
        if human.joint_names != HUMAN_JOINTS:
            raise InvalidOptionsError(
                option="human",
                problem=f"{human.name} has other joints than the human hand",
                advice="load_hand('human')",
            )
        needed = [name for finger in fingers for name in chain_landmarks(finger)]
        points = require_points(human, needed, "a mapping of joint angles")
        self._points = points.reshape(-1, 4)
        self.columns = np.array(
            [4 * FINGERS.index(finger) + np.arange(4) for finger in fingers]
        )
        found = find_fingers(human)
        self._fingers = [
            _FingerFrames(human, found[finger], columns)
            for finger, columns in zip(fingers, self.columns, strict=True)
        ]

    def measure(self, in_palm: np.ndarray) -> np.ndarray:
        """Return the joint angles [rad], shape (f, 4).

        Args:
            in_palm: The human's reference points in palm axes [m], shape (n_h, 3).
        """
        bones = np.diff(in_palm[self._points], axis=1)
        return np.array(
            [
                frames.angles(each)
                for frames, each in zip(self._fingers, bones, strict=True)
            ]
        )


class _FingerFrames:
    """One finger's joint frames at zero, in palm axes: x along the bones, z along the axis."""

    def __init__(self, human: Hand, finger: Finger, columns: np.ndarray) -> None:
        view = PalmKinematics(human)
        zero = np.zeros(len(human.joint_names))
        axes, origins = view.axes(zero, finger.joints)
        bone = unit(view.points(zero, [finger.tip])[0] - origins[-1])
        self._frames = [
            np.column_stack([bone, np.cross(axis, bone), axis]) for axis in axes
        ]
        self._lower = human.lower_limits[columns]
        self._upper = human.upper_limits[columns]
        # Bones that stay in one plane however the finger bends.
        parallel = np.abs(axes[1:] @ axes[1]) > _PARALLEL
        self._in_plane = 3 if parallel.all() else parallel.argmin()

    def angles(self, bones: np.ndarray) -> np.ndarray:
        """Return the four angles from three bones in palm axes, shape (3, 3)."""
        x, y, _ = bones[: self._in_plane].dot(self._frames[0]).T
        doubled = np.arctan2(2.0 * x.dot(y), x.dot(x) - y.dot(y) + _STRAIGHTENING**2)
        along = 0.5 * doubled
        # The direction has two senses: that within the joint limits is meant.
        angles = self._bend(along, bones)
        if (excess := self._excess(angles)) > 0.0:
            other = self._bend(along - np.copysign(np.pi, along), bones)
            if self._excess(other) < excess:
                return other
        return angles

    def _excess(self, angles: np.ndarray) -> float:
        """Return how far the first two angles are outside their limits [rad]."""
        outside = np.maximum(self._lower - angles, angles - self._upper)[:2]
        return np.maximum(outside, 0.0).sum()

    def _bend(self, abduction: float, bones: np.ndarray) -> np.ndarray:
        """Return all angles, given the first."""
        angles = [abduction]
        turned = pin.exp3(abduction * self._frames[0][:, 2])
        for frame, bone in zip(self._frames[1:], bones, strict=True):
            x, y, _ = frame.T.dot(turned.T.dot(bone))
            angles.append(np.arctan2(y, x))
            turned = turned.dot(pin.exp3(angles[-1] * frame[:, 2]))
        return np.array(angles)


@dataclass(frozen=True, slots=True)
class JointLink:
    """One robot joint and the human joints that it follows.

    Attributes:
        finger: Name of the finger.
        column: Index of the robot's joint in `Hand.joint_names`.
        human: Which of the finger's four human joints lead, with their sense: +1 where a positive
            angle flexes, shape (4,).
        zero: Angle of the human's joints that counts as none [rad].
        human_range: Least and largest angle beside that [rad].
        robot_zero: Position of the robot's joint there [rad or m].
        ends: Positions of the robot's joint at the human's least and largest angle [rad or m].
    """

    finger: str
    column: int
    human: np.ndarray
    zero: float
    human_range: tuple[float, float]
    robot_zero: float
    ends: tuple[float, float]

    def position(self, angles: np.ndarray) -> float:
        """Return the robot joint's position for the finger's human angles, shape (4,)."""
        angle = float(self.human.dot(angles)) - self.zero
        share = angle / self.human_range[angle >= 0.0]
        end = self.ends[angle >= 0.0]
        return self.robot_zero + min(max(share, 0.0), 1.0) * (end - self.robot_zero)


class JointPositions:
    """A task that pulls joints to positions; see `Task`.

    Args:
        robot: The hand.
        columns: Indices of the joints in `Hand.joint_names`, shape (k,).
        q: Positions of all joints, of which those are wanted [rad or m], shape (n,).
    """

    def __init__(self, robot: Hand, columns: np.ndarray, q: np.ndarray) -> None:
        self._q_indices = robot.q_indices[columns]
        self._wanted = q[columns]
        self._active = robot.joint_columns[columns]

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return a row a joint; see `Task.linearise`."""
        jacobian = np.zeros((len(self._active), hand.nv))
        jacobian[np.arange(len(self._active)), self._active] = _JOINT_WEIGHT
        return TaskRows(
            _JOINT_WEIGHT * (hand.q[self._q_indices] - self._wanted), jacobian
        )


class BoundJointToJoint(PalmMethod):
    """The method for two hands; see `BoundMethod`.

    Attributes:
        links: The joints that correspond.
    """

    needs_wrist = "joint angles in palm axes"

    def __init__(self, method: JointToJoint, human: Hand, robot: Hand) -> None:
        super().__init__(method, human, robot)
        chains = {
            name: chain for name, chain in find_fingers(robot).items() if chain.joints
        }
        if not chains:
            raise InvalidOptionsError(
                option="method",
                problem=f"joints correspond by finger, and no point of {robot.name} names one",
                advice="add `finger` to the points of its hand.yaml",
            )
        self.fingers = tuple(chains)
        self.angles = FingerAngles(human, self.fingers)
        self.links = [
            link
            for finger, columns in zip(self.fingers, self.angles.columns, strict=True)
            for link in _finger_links(
                human,
                robot,
                chains[finger],
                [other for name, other in chains.items() if name != finger],
                columns,
            )
        ]
        self.columns = np.unique([link.column for link in self.links])

    def start(self, sample: HumanPose, robot: RobotPosture) -> JointMap:
        """Count the palm's displacement from here; the joints need no reference."""
        return JointMap(self, sample, robot)

    def positions(self, angles: np.ndarray) -> np.ndarray:
        """Return the joint positions (n,) for human angles (f, 4); the mean where fingers share."""
        of_finger = dict(zip(self.fingers, angles, strict=True))
        q = self.robot.rest.copy()
        count = np.zeros(len(self.robot.rest))
        for link in self.links:
            count[link.column] += 1.0
            by = link.position(of_finger[link.finger]) - q[link.column]
            q[link.column] += by / count[link.column]
        return q


class JointMap(PalmMap):
    """From samples to targets; see `TargetMap`."""

    _method: BoundJointToJoint

    def __init__(
        self, method: BoundJointToJoint, sample: HumanPose, robot: RobotPosture
    ) -> None:
        super().__init__(method, sample, robot)
        self._configuration = method.robot.configuration()

    def targets(self, sample: HumanPose) -> Targets:
        """Measure the human's angles, and place the robot's points where its joints would."""
        method = self._method
        robot = method.robot
        _, palm, now = self.follow(sample)
        angles = method.angles.measure(now)
        q = method.positions(angles)
        placed = self._configuration
        placed.place(robot.configuration_vector(q))
        to_palm = inverse_pose(placed.wrist.homogeneous @ robot.wrist_to_palm)
        return Targets(
            *self.placed(palm, transform_points(to_palm, placed.points)),
            {"angles": angles, "q": q},
            (JointPositions(robot, method.columns, q),),
        )


def _finger_links(
    human: Hand,
    robot: Hand,
    finger: Finger,
    others: list[Finger],
    human_columns: np.ndarray,
) -> list[JointLink]:
    """Find which joints of one finger correspond, from where to where they go, and which way."""
    is_thumb = finger.name == THUMB
    columns = finger.columns.tolist()
    flexes = [column for column in columns if finger.closing[column]] or columns[:1]
    spreads = [column for column in columns if column not in flexes]
    if is_thumb and spreads:
        # A thumb's axes are not parallel: the first joint brings it before the palm.
        spreads = columns[:1]
        flexes = columns[1:]
    pairs = [(column, [0]) for column in spreads[:1]]
    pairs += [
        (column, _leaders(place, len(flexes))) for place, column in enumerate(flexes)
    ]
    # Every flexion of the resting hand is one: its sign is the sense.
    sense = np.where(human.rest[human_columns] < 0.0, -1.0, 1.0)
    sense[0] = 1.0
    found = []
    for column, leaders in pairs:
        senses = np.zeros(4)
        senses[leaders] = sense[leaders]
        end = _closed_end(human, robot, finger, others, column, human_columns, senses)
        zero = human.rest[human_columns] if end.counts_from_rest else np.zeros(4)
        limits = np.array(
            [human.lower_limits[human_columns], human.upper_limits[human_columns]]
        )
        reach = np.where(senses < 0.0, -limits[::-1], limits) * np.abs(senses)
        least, most = reach.sum(axis=1) - senses @ zero
        ends = robot.lower_limits[column].item(), robot.upper_limits[column].item()
        found.append(
            JointLink(
                finger.name,
                column,
                senses,
                float(senses @ zero),
                (min(float(least), -1e-6), max(float(most), 1e-6)),
                end.start,
                ends if end.is_upper else ends[::-1],
            )
        )
    return found


class _ClosedEnd(NamedTuple):
    """Where a robot's joint starts, whether it closes at its upper limit, and from where to count.

    Attributes:
        start: Position where the human's angle counts as none [rad or m].
        is_upper: Whether the human's largest angle is at the upper limit.
        counts_from_rest: Whether the human's angle counts from rest instead of zero.
    """

    start: float
    is_upper: bool
    counts_from_rest: bool = False


def _closed_end(
    human: Hand,
    robot: Hand,
    finger: Finger,
    others: list[Finger],
    column: int,
    human_columns: np.ndarray,
    senses: np.ndarray,
) -> _ClosedEnd:
    is_thumb = finger.name == THUMB
    flexion = finger.flexion
    view = PalmKinematics(robot)
    if flexion is not None and finger.closing[column] and not is_thumb:
        start = float(flexion.straight[flexion.columns == column][0])
        return _ClosedEnd(start, bool(finger.closing[column] > 0.0))
    ends = ends_of(robot, finger.stretched, [column])
    places = view.points(ends, [finger.tip, finger.knuckle])
    reaches = lengths(places[:, 0] - places[:, 1])
    if is_thumb and finger.reach - reaches.min() > _CURLING * finger.reach:
        return _ClosedEnd(
            float(finger.stretched[column]), bool(reaches[1] <= reaches[0])
        )
    motion = view.motion(robot.rest, finger.tip)[:, column]
    if not motion[3:].any():
        # A jaw closes towards the other fingertips.
        ends = ends_of(robot, robot.rest, [column])
        tips = [each.tip for each in (finger, *others)]
        is_upper = nearing(view, ends, tips, 0) >= 0.0
        return _ClosedEnd(float(ends[int(not is_upper), column]), is_upper, is_thumb)
    leader = np.flatnonzero(senses)[0]
    tip = find_fingers(human)[finger.name].tip
    wanted = PalmKinematics(human).motion(human.rest, tip)[:, human_columns[leader]]
    # Hands differ in where their axes are: what counts is where the tip goes.
    is_upper = bool(senses[leader] * wanted[:3] @ motion[:3] >= 0.0)
    start = robot.rest if is_thumb else zero_posture(robot)
    return _ClosedEnd(float(start[column]), is_upper, is_thumb)


def _leaders(place: int, count: int) -> list[int]:
    """Return which of a human finger's flexions (1 to 3) lead the robot's, counted outwards."""
    if count > 3:
        return [1 + place * 3 // count]
    return [1 + place] if place < count - 1 else list(range(1 + place, 4))
