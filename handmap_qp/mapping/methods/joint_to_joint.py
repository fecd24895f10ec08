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

import numpy as np

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.fingers import THUMB, FingerChain, find_fingers, moving_columns
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs
from handmap_qp.ik.tasks import AttachedPoints, TaskRows
from handmap_qp.mapping.finger_angles import FingerAngles
from handmap_qp.mapping.method import (
    FOLLOWING,
    HumanPose,
    MethodOptions,
    Preset,
    RobotPosture,
    Targets,
)
from handmap_qp.mapping.palm import PalmFollower, palm_of
from handmap_qp.transform import inverse_pose, transform_points

# Weight of a joint's error [1/rad]: 0.1 rad counts as much as 10 mm of a point.
_JOINT_WEIGHT = 10.0
# A joint flexes a finger if its axis is as parallel as this to that of the finger's last joint.
_PARALLEL = 0.7
# Change of the distance from knuckle to tip over a joint's range that counts as curling, as a share
# of the finger's reach.
_CURLING = 0.06
# Step of derivatives by differences [rad or m].
_STEP = 1e-5


class JointToJoint(MethodOptions, frozen=True):
    """Map joint angles to joint angles, scaled by the ranges."""

    def bind(self, human: Hand, robot: Hand) -> BoundJointToJoint:
        """Find the joints that correspond; see `Method.bind`."""
        return BoundJointToJoint(human, robot)


PRESETS = {
    "joint-to-joint": Preset(
        JointToJoint(),
        FOLLOWING,
        "to compare: each robot joint takes the share of its range that the human's joint takes",
        "pinches: small errors of angle add up at the tips",
    )
}


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
        share, end = angle / self.human_range[angle >= 0.0], self.ends[angle >= 0.0]
        return self.robot_zero + min(max(share, 0.0), 1.0) * (end - self.robot_zero)


class JointPositions:
    """A task that pulls joints to positions; see `Task`.

    Args:
        robot: The hand.
        columns: Indices of the joints in `Hand.joint_names`, shape (k,).
        q: Positions of all joints, of which those are wanted [rad or m], shape (n,).
    """

    def __init__(self, robot: Hand, columns: np.ndarray, q: np.ndarray) -> None:
        self._q_indices, self._wanted = robot.q_indices[columns], q[columns]
        self._active = robot.joint_columns[columns]

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return a row a joint; see `Task.linearise`."""
        jacobian = np.zeros((len(self._active), hand.nv))
        jacobian[np.arange(len(self._active)), self._active] = _JOINT_WEIGHT
        return TaskRows(_JOINT_WEIGHT * (hand.q[self._q_indices] - self._wanted), jacobian)


class BoundJointToJoint:
    """The method for two hands; see `BoundMethod`.

    Attributes:
        links: The joints that correspond.
    """

    contacts: ShapePairs | None = None
    needs_wrist = "joint angles in palm axes"
    reference_needs_wrist = ""
    renews_reference = False

    def __init__(self, human: Hand, robot: Hand) -> None:
        self.human, self.robot = human, robot
        chains = {name: chain for name, chain in find_fingers(robot).items() if chain.joints}
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
            for link in _FingerLinks(human, robot, chains, finger, columns).links
        ]
        self.columns = np.unique([link.column for link in self.links])

    def start_palm(self, sample: HumanPose) -> np.ndarray:
        """Return the human's palm."""
        return palm_of(sample, self.human)

    def start(self, sample: HumanPose, robot: RobotPosture) -> JointMap:
        """Count the palm's displacement from here; the joints need no reference."""
        return JointMap(self, sample, robot)

    def positions(self, angles: np.ndarray) -> np.ndarray:
        """Return the joint positions (n,) for human angles (f, 4); the mean where fingers share."""
        of_finger = dict(zip(self.fingers, angles, strict=True))
        q, count = self.robot.rest.copy(), np.zeros(len(self.robot.rest))
        for link in self.links:
            count[link.column] += 1.0
            by = link.position(of_finger[link.finger]) - q[link.column]
            q[link.column] += by / count[link.column]
        return q


class JointMap:
    """From samples to targets; see `TargetMap`."""

    def __init__(self, method: BoundJointToJoint, sample: HumanPose, robot: RobotPosture) -> None:
        self.rest = method.robot.rest
        self._method = method
        self._follower = PalmFollower(method.human, method.robot, sample, robot)
        self._configuration = method.robot.configuration()
        self._vector = np.zeros(method.robot.model.nq)

    def targets(self, sample: HumanPose) -> Targets:
        """Measure the human's angles, and place the robot's points where its joints would."""
        method, robot = self._method, self._method.robot
        human_palm, palm = self._follower.palms(sample)
        angles = method.angles.measure(transform_points(inverse_pose(human_palm), sample.points))
        q = method.positions(angles)
        robot.write_configuration(self._vector, q, np.eye(4))
        self._configuration.place_frames(self._vector)
        placed = self._configuration.wrist.homogeneous @ robot.wrist_to_palm
        return Targets(
            transform_points(palm @ inverse_pose(placed), self._configuration.points),
            self._follower.wrist(palm),
            {"angles": angles, "q": q},
            (JointPositions(robot, method.columns, q),),
        )


class _FingerLinks:
    """Finds which joints of one finger correspond, from where to where they go, and which way.

    Attributes:
        links: The correspondences.
    """

    def __init__(
        self,
        human: Hand,
        robot: Hand,
        chains: dict[str, FingerChain],
        finger: str,
        human_columns: np.ndarray,
    ) -> None:
        self._human, self._robot, self._chain = human, robot, chains[finger]
        self._others = [chain for name, chain in chains.items() if name != finger]
        self._human_columns = human_columns
        self._tip = human.with_points((f"{finger}_tip",))
        self._is_thumb = finger == THUMB
        self._human_zero = human.rest if self._is_thumb else np.zeros(len(human.rest))
        straight = np.clip(0.0, robot.lower_limits, robot.upper_limits)
        self._posture = robot.rest if self._is_thumb else straight
        columns, axes = self._columns_outwards()
        bends = [len(axes) == 1 or abs(float(axis @ axes[-1])) > _PARALLEL for axis in axes]
        spreads = [column for column, bend in zip(columns, bends, strict=True) if not bend]
        if self._is_thumb and spreads:
            # A thumb's axes are not parallel: the first joint brings it before the palm.
            spreads = columns[:1]
        flexes = [column for column in columns if column not in spreads]
        self.links = [self._link(column, [0]) for column in spreads[:1]]
        for place, column in enumerate(flexes):
            self.links.append(self._link(column, _leaders(place, len(flexes))))

    def _columns_outwards(self) -> tuple[list[int], np.ndarray]:
        """Return the joints of this finger from the palm outwards, and the axis of each."""
        joints = self._chain.joints
        first = {
            column: place
            for place, joint in reversed(list(enumerate(joints)))
            for column in moving_columns(self._robot, [joint]).tolist()
        }
        columns = sorted(first, key=lambda column: first[column])
        return columns, np.array([self._motion(column)[1] for column in columns])

    def _link(self, column: int, leaders: list[int]) -> JointLink:
        """Say where a robot joint goes with the human joints that lead it."""
        human, columns = self._human, self._human_columns
        lower, upper = self._robot.lower_limits[column], self._robot.upper_limits[column]
        # Every flexion of the resting hand is one: its sign is the sense.
        senses = np.zeros(4)
        for k in leaders:
            senses[k] = -1.0 if k > 0 and human.rest[columns[k]] < 0.0 else 1.0
        is_curling, is_upper = self._curls(column)
        counts_from_rest = self._is_thumb and not is_curling
        zero = self._human_zero[columns] if counts_from_rest else np.zeros(4)
        limits = np.array([human.lower_limits[columns], human.upper_limits[columns]])
        reach = np.where(senses < 0.0, -limits[::-1], limits) * np.abs(senses)
        least, most = reach.sum(axis=1) - senses @ zero
        straight = self._chain.stretched[column] if is_curling else self._posture[column]
        if not is_curling:
            velocity, axis = self._motion(column)
            if np.any(axis):
                human_velocity, human_axis = self._human_motion(leaders[0], senses)
                # Thumbs differ in where their axes are: what counts is where the tip goes.
                agreement = human_velocity @ velocity if self._is_thumb else human_axis @ axis
                is_upper = bool(agreement >= 0.0)
            else:
                is_upper = self._approaches_others(column)
                straight = lower if is_upper else upper
        return JointLink(
            self._chain.name,
            column,
            senses,
            float(senses @ zero),
            (min(float(least), -1e-6), max(float(most), 1e-6)),
            float(straight),
            (float(lower), float(upper)) if is_upper else (float(upper), float(lower)),
        )

    def _curls(self, column: int) -> tuple[bool, bool]:
        """Return whether a joint shortens the finger, and whether it does so at its upper limit."""
        robot, stretched = self._robot, self._chain.stretched
        lengths = []
        for end in (robot.lower_limits[column], robot.upper_limits[column]):
            q = stretched.copy()
            q[column] = end
            tip, knuckle, _ = self._place(q)
            lengths.append(float(np.linalg.norm(tip - knuckle)))
        change = max(self._chain.reach - min(lengths), 0.0)
        return change > _CURLING * self._chain.reach, lengths[1] <= lengths[0]

    def _approaches_others(self, column: int) -> bool:
        """Return whether a jaw's tip is nearest to the other fingertips at its upper limit."""
        distances = []
        for end in (self._robot.lower_limits[column], self._robot.upper_limits[column]):
            q = self._posture.copy()
            q[column] = end
            points = AttachedPoints(self._robot, [c.tip for c in (self._chain, *self._others)])
            configuration = self._robot.configuration()
            configuration.place_frames(self._robot.configuration_vector(q))
            tip, *others = points.positions(configuration)
            distances.append(sum(float(np.linalg.norm(tip - other)) for other in others))
        return distances[1] <= distances[0]

    def _place(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return tip and knuckle in palm axes [m], and the rotation of the tip's link."""
        robot, chain = self._robot, self._chain
        configuration = robot.configuration()
        configuration.place_frames(robot.configuration_vector(q))
        palm = inverse_pose(configuration.wrist.homogeneous @ robot.wrist_to_palm)
        rotations, origins, _ = configuration.joints
        points = [
            rotations[joint].dot(offset) + origins[joint]
            for joint, offset in (chain.tip, chain.knuckle)
        ]
        tip, knuckle = transform_points(palm, np.array(points))
        return tip, knuckle, palm[:3, :3] @ rotations[chain.tip[0]]

    def _motion(self, column: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a joint's effect on the tip: velocity [m] and axis, by differences, (3,) each."""
        places = []
        for step in (-_STEP, _STEP):
            q = self._posture.copy()
            q[column] += step
            places.append(self._place(q))
        (tip_before, _, before), (tip_after, _, after) = places
        turn = after @ before.T
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        length = np.linalg.norm(axis)
        unit = axis / length if length > _STEP else np.zeros(3)
        return (tip_after - tip_before) / (2.0 * _STEP), unit

    def _human_motion(self, leader: int, senses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the effect of one of the human's joints on the tip, likewise."""
        hand, column = self._tip, self._human_columns[leader]
        configuration = hand.configuration()
        configuration.place_with_jacobians(hand.configuration_vector(self._human_zero))
        palm = configuration.wrist.homogeneous @ hand.wrist_to_palm
        velocity = configuration.point_jacobian()[:3, hand.joint_columns[column]]
        axis = configuration.joint_jacobian()[3:, hand.v_indices[column]]
        return senses[leader] * velocity @ palm[:3, :3], senses[leader] * axis @ palm[:3, :3]


def _leaders(place: int, count: int) -> list[int]:
    """Return which of a human finger's flexions (1 to 3) lead the robot's, counted outwards."""
    if count > 3:
        return [1 + place * 3 // count]
    return [1 + place] if place < count - 1 else list(range(1 + place, 4))
