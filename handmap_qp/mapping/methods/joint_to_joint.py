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

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_core.errors import InvalidOptionsError
from handmap_core.se3 import Array, frozen, lengths, unit
from handmap_qp.hands import (
    FINGERS,
    HUMAN_JOINTS,
    THUMB,
    Finger,
    Hand,
    Names,
    PalmKinematics,
    ends_of,
    find_fingers,
    nearing,
)
from handmap_qp.human import LANDMARK_NAMES
from handmap_qp.ik import JointPositions
from handmap_qp.mapping import (
    FOLLOWING,
    AlignedOptions,
    HumanPose,
    PalmMap,
    PalmMethod,
    Preset,
    Targets,
    points_in_palm,
    require_points,
    robot_fingers,
)

# Weight of a joint's error [1/rad]: 0.1 rad counts as much as 10 mm of a point.
_JOINT_WEIGHT = 10.0
# Change of the distance from knuckle to tip over the range of a thumb's joint that counts as
# curling, as a share of the thumb's reach.
_CURLING = 0.06
# Bones that point along the axis of abduction say nothing of it: length that pulls it to zero [m].
_STRAIGHTENING = 0.0005
# Cosine from which on two axes are parallel.
_PARALLEL = 1.0 - 1e-9


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
        view: Kinematics of the human hand.

    Raises:
        InvalidOptionsError: If the hand has other joints than this package's human hand, or its
            reference points lack a landmark.
    """

    def __init__(self, human: Hand, fingers: Names) -> None:
        if human.joint_names != HUMAN_JOINTS:
            raise InvalidOptionsError(
                f"{human.name} has other joints than the human hand",
                option="human",
                advice="load_hand('human')",
            )
        self.columns = np.array(
            [4 * FINGERS.index(finger) + np.arange(4) for finger in fingers]
        )
        # A finger has as many landmarks as joints.
        needed = [LANDMARK_NAMES[1 + column] for column in self.columns.flat]
        points = require_points(human, needed, "a mapping of joint angles")
        self._points = points.reshape(-1, 4)
        found = find_fingers(human)
        self.view = PalmKinematics(human)
        self._fingers = [
            _FingerFrames(self.view, found[finger], columns)
            for finger, columns in zip(fingers, self.columns, strict=True)
        ]

    def measure(self, in_palm: Array) -> Array:
        """Return the joint angles [rad], shape (f, 4).

        Args:
            in_palm: The human's reference points in palm axes [m], shape (n_h, 3).
        """
        bones = np.diff(in_palm[self._points], axis=1)
        return np.array([*map(_FingerFrames.angles, self._fingers, bones)])


class _FingerFrames:
    """One finger's joint frames at zero, in palm axes: x along the bones, z along the axis."""

    def __init__(self, view: PalmKinematics, finger: Finger, columns: Array) -> None:
        human = view.hand
        zero = np.zeros(len(human.joint_names))
        axes, origins = view.axes(zero, finger.joints)
        bone = unit(view.points(zero, [finger.tip])[0] - origins[-1])
        self._frames = [
            np.column_stack([bone, pin.skew(axis) @ bone, axis]) for axis in axes
        ]
        self._lower, self._upper = human.limits[:, columns]
        # Bones that stay in one plane however the finger bends.
        parallel = np.abs(axes[1:] @ axes[1]) > _PARALLEL
        self._in_plane = 3 if parallel.all() else parallel.argmin()

    def angles(self, bones: Array) -> Array:
        """Return the four angles from three bones in palm axes, shape (3, 3)."""
        x, y, _ = bones[: self._in_plane].dot(self._frames[0]).T
        doubled = np.arctan2(2.0 * x.dot(y), x.dot(x) - y.dot(y) + _STRAIGHTENING**2)
        along = 0.5 * doubled
        # The direction has two senses: that within the joint limits is meant.
        angles = self._bend(along, bones)
        if not self._excess(angles):
            return angles
        other = self._bend(along - np.copysign(np.pi, along), bones)
        return min(angles, other, key=self._excess)

    def _excess(self, angles: Array) -> float:
        """Return how far the first two angles are outside their limits [rad]."""
        outside = np.maximum(self._lower - angles, angles - self._upper)
        return outside[:2].clip(0.0).sum()

    def _bend(self, abduction: float, bones: Array) -> Array:
        """Return all angles, given the first."""
        angles = [abduction]
        turned = pin.exp3(abduction * self._frames[0][:, 2])
        for frame, bone in zip(self._frames[1:], bones, strict=True):
            x, y, _ = frame.T.dot(turned.T.dot(bone))
            angles.append(np.arctan2(y, x))
            turned = turned.dot(pin.exp3(angles[-1] * frame[:, 2]))
        return np.array(angles)


class JointLink(NamedTuple):
    """One robot joint and the human joints that it follows.

    Attributes:
        finger: Name of the finger.
        column: Index of the robot's joint in `Hand.joint_names`.
        human: Which of the finger's four human joints lead, with their sense: +1 where a positive
            angle flexes, shape (4,).
        angles: Sum of the human's joints at its least, where it counts as none, and at its largest
            [rad], increasing, shape (3,).
        positions: Positions of the robot's joint there [rad or m], shape (3,).
    """

    finger: str
    column: int
    human: Array
    angles: tuple[float, ...]
    positions: tuple[float, ...]

    def position(self, angles: Array) -> float:
        """Return the robot joint's position for the finger's human angles, shape (4,)."""
        angle = float(self.human.dot(angles))
        # Piecewise linear, as `np.interp`, which takes ten times as long for one number.
        end = 2 if angle >= self.angles[1] else 0
        share = (angle - self.angles[1]) / (self.angles[end] - self.angles[1])
        start = self.positions[1]
        return start + min(share, 1.0) * (self.positions[end] - start)


class JointMap(PalmMap):
    """From samples to targets; see `TargetMap`."""

    _method: BoundJointToJoint

    def targets(self, sample: HumanPose) -> Targets:
        """Measure the human's angles, and place the robot's points where its joints would."""
        method = self._method
        robot = method.robot
        _, palm, now = self.follow(sample)
        angles = method.angles.measure(now)
        q = method.positions(angles)
        return Targets(
            *self.placed(palm, points_in_palm(robot, q)),
            {"angles": angles, "q": q},
            (JointPositions(robot, method.columns, q.copy(), _JOINT_WEIGHT),),
        )


class BoundJointToJoint(PalmMethod):
    """The method for two hands; see `BoundMethod`.

    Attributes:
        links: The joints that correspond.
    """

    needs_wrist = "joint angles in palm axes"
    map_type = JointMap

    def __init__(self, method: JointToJoint, human: Hand, robot: Hand) -> None:
        super().__init__(method, human, robot)
        self.chains = robot_fingers(robot).used
        if not self.chains:
            raise InvalidOptionsError(
                f"joints correspond by finger, and no point of {robot.name} names one",
                option="method",
                advice="add `finger` to the points of its hand.yaml",
            )
        self.fingers = tuple(self.chains)
        self.angles = FingerAngles(human, self.fingers)
        self._view = PalmKinematics(robot)
        self.links = [
            link
            for finger, leading in zip(self.fingers, self.angles.columns, strict=True)
            for link in self._links(self.chains[finger], leading)
        ]
        # Tasks hand it out.
        self.columns = frozen(np.unique([link.column for link in self.links]))

    def positions(self, angles: Array) -> Array:
        """Return the joint positions (n,) for human angles (f, 4); the mean where fingers share."""
        of_finger = dict(zip(self.fingers, angles, strict=True))
        asked = [link.position(of_finger[link.finger]) for link in self.links]
        columns = [link.column for link in self.links]
        q = self.robot.rest.copy()
        q[columns] = (
            np.bincount(columns, asked)[columns] / np.bincount(columns)[columns]
        )
        return q

    def _links(self, finger: Finger, leading: Array) -> list[JointLink]:
        """Find which joints of a finger correspond, from where to where they go, and which way."""
        columns = finger.columns.tolist()
        flexes = [column for column in columns if finger.closing[column]] or columns[:1]
        spreads = [column for column in columns if column not in flexes]
        if finger.name == THUMB and spreads:
            # A thumb's axes are not parallel: the first joint brings it before the palm.
            spreads = columns[:1]
            flexes = columns[1:]
        pairs = [(column, [0]) for column in spreads[:1]]
        pairs += [
            (column, _leaders(place, len(flexes)))
            for place, column in enumerate(flexes)
        ]
        rest = self.human.rest[leading]
        limits = self.human.limits[:, leading]
        # Every flexion of the resting hand is one: its sign is the sense.
        sense = np.where(rest < 0.0, -1.0, 1.0)
        sense[0] = 1.0
        links = []
        for column, leaders in pairs:
            senses = np.zeros(4)
            senses[leaders] = sense[leaders]
            start, is_upper, counts_from_rest = self._closed_end(
                finger, column, leading[leaders[0]], sense[leaders[0]]
            )
            zero = senses @ rest * counts_from_rest
            least, most = np.sort(senses * limits, axis=0).sum(axis=1)
            low, high = self.robot.limits[:, column]
            links.append(
                JointLink(
                    finger.name,
                    column,
                    senses,
                    (min(least, zero - 1e-6), zero, max(most, zero + 1e-6)),
                    (low, start, high) if is_upper else (high, start, low),
                )
            )
        return links

    def _closed_end(
        self, finger: Finger, column: int, leader: int, sense: float
    ) -> tuple[float, bool, bool]:
        """Find where a robot's joint goes, which a human's joint leads with a sense.

        It is the position where the human's angle counts as none [rad or m], whether its largest is
        at the upper limit, and whether it counts from rest instead of zero.
        """
        robot = self.robot
        view = self._view
        closing = finger.closing[column]
        is_thumb = finger.name == THUMB
        start = robot.rest
        own = np.arange(len(start)) == column
        if is_thumb:
            straight = finger.stretched
            ends = ends_of(robot, straight, own)
            places = view.points(ends, [finger.tip, finger.knuckle])
            reaches = lengths(places[:, 0] - places[:, 1])
            if finger.reach - reaches.min() > _CURLING * finger.reach:
                return straight[column], reaches[1] <= reaches[0], False
        else:
            start = robot.zero
            if closing and (flexion := finger.flexion):
                return flexion.straight[column], closing > 0.0, False
        motion = view.motion(robot.rest, finger.tip)[:, column]
        if motion[3:].any():
            # Hands differ in where their axes are: what counts is where the tip goes.
            tip = find_fingers(self.human)[finger.name].tip
            wanted = self.angles.view.motion(self.human.rest, tip)[:, leader]
            is_upper = sense * wanted[:3].dot(motion[:3]) >= 0.0
        else:
            # A jaw closes towards the other fingertips.
            ends = ends_of(robot, robot.rest, own)
            tips = [each.tip for each in self.chains.values()]
            i = self.fingers.index(finger.name)
            is_upper = nearing(view, ends, tips, i) >= 0.0
            start = ends[int(not is_upper)]
        return start[column], is_upper, is_thumb


def _leaders(place: int, count: int) -> list[int]:
    """Return which of a human finger's flexions (1 to 3) lead the robot's, counted outwards."""
    if count > 3:
        return [1 + place * 3 // count]
    return [1 + place] if place < count - 1 else list(range(1 + place, 4))


class JointToJoint(AlignedOptions, frozen=True):
    """Map joint angles to joint angles, scaled by the ranges."""

    bound_type = BoundJointToJoint


PRESETS = {
    "joint-to-joint": Preset(
        JointToJoint(),
        FOLLOWING,
        "to compare: each robot joint takes the share of its range that the human's joint takes",
        "pinches: small errors of angle add up at the tips",
    )
}
