"""Close a hand on an object by its collision shapes: `HandCloser`, from a `Preshape`.

Fingers close one after the other, all closing joints of a finger at once. When a link touches the
object, the joints that carry it stop. The others continue until each has stopped or reached its
limit. Contact between fingers is ignored.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from checks import finite_array, positive_number
from section_four.contacts import Contact, Grasp
from section_four.cube import REFERENCE_HANDS, read_cube_figures

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.fingers import (
    Finger,
    PalmKinematics,
    ends_of,
    nearing,
    place_of,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.objects import Box, Cylinder, Shape, Sphere
from handmap_qp.se3 import PoseLike, check_pose, inverse_pose, transform_points

STEP = 0.02
"""Largest step of a closing joint between two distance queries [rad]."""
MARGIN = 1e-4
"""Distance at which a link touches the object [m]; > 0, so that the normal is well defined."""

# Tolerance of coal's distances [m]; a fingertip moves farther than this in 1e-6 rad.
_DISTANCE_TOLERANCE = 1e-8
# Tolerance of the joint angles at first touch [rad].
_ANGLE_TOLERANCE = 1e-6
# Contacts nearer than this are merged [m]: shapes of neighbouring links overlap at their joint.
_SAME_CONTACT = 1e-3
# Clearance of hands without a `grasp_cube50.json` [m].
_CLEARANCE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Preshape:
    """Posture from which a hand closes, and the direction in which each joint closes.

    Attributes:
        start: Joint angles of the open hand [rad], shape (n,).
        direction: 1 or -1, the sense in which each joint closes; 0 for a joint that keeps its
            angle. Shape (n,).
        clearance: Initial gap between the centre of the palm and the circumscribed sphere of the
            object, for a planner [m].
    """

    start: np.ndarray
    direction: np.ndarray
    clearance: float


def default_preshape(hand: Hand) -> Preshape:
    """Preshape of a hand, derived from its geometry where none is published.

    For the two hands of the paper, and the left human hand, it is the toolbox's
    (`grasp_cube50.json`). For any other hand, the joints that flex each finger start straight and
    close, and jaws start open. All other joints (abduction, spread, opposition) stay at their rest
    angles.
    """
    name = "human" if hand.name == "human_left" else hand.name
    if name in REFERENCE_HANDS:
        figures = read_cube_figures(name)["closing"]
        start = np.array(
            [figures["start"].get(joint, 0.0) for joint in hand.joint_names]
        )
        direction = np.array(
            [float(joint in figures["joints"]) for joint in hand.joint_names]
        )
        return Preshape(start, direction, figures["clearance"])
    return Preshape(*_open_and_closing(hand, _fingers(hand)), _CLEARANCE)


def _open_and_closing(
    hand: Hand, fingers: list[Finger]
) -> tuple[np.ndarray, np.ndarray]:
    """Find how a described hand closes.

    Fingers that curl start straight. Jaws start open, and close towards the other fingertips. Other
    joints keep their rest positions.

    Args:
        hand: The hand.
        fingers: Its fingers.

    Returns:
        The open posture [rad or m], and the sense in which each joint closes, 0 if it does not;
        shape (n,) each.
    """
    view, q, senses = PalmKinematics(hand), hand.rest.copy(), np.zeros(len(hand.rest))
    tips = [finger.tip for finger in fingers]
    for i, finger in enumerate(fingers):
        if finger.flexion is not None:
            curls = finger.closing != 0.0
            senses[curls] = finger.closing[curls]
            q[curls] = finger.flexion.straight[curls]
        else:
            for column in finger.columns:
                ends = ends_of(hand, hand.rest, np.arange(len(hand.rest)) == column)
                senses[column] = np.sign(round(nearing(view, ends, tips, i), 4))
                if senses[column] != 0.0:
                    q[column] = ends[int(senses[column] < 0.0), column]
    return q, senses


def palm_centre(hand: Hand, preshape: Preshape | None = None) -> np.ndarray:
    """Centre of the palm: mean origin of the most proximal closing joint of each finger.

    Args:
        hand: The hand.
        preshape: The preshape; `default_preshape` if omitted.

    Returns:
        Point in the palm frame [m], shape (3,).

    Raises:
        InvalidInputError: If no joint closes.
    """
    how = preshape or default_preshape(hand)
    closing = [
        [i for i in finger.columns if how.direction[i]] for finger in _fingers(hand)
    ]
    joints = [
        hand.model.getJointId(hand.joint_names[found[0]]) for found in closing if found
    ]
    if not joints:
        raise InvalidInputError(
            argument="preshape.direction",
            expected=f"a closing finger joint of {hand.name}",
            got="none",
        )
    return PalmKinematics(hand).axes(how.start, joints)[1].mean(axis=0)


class HandCloser:
    """Closes one hand on one object, from any wrist pose.

    Args:
        hand: The hand; the collision shapes of its URDF are used.
        shape: Shape of the object.
        object_pose: Pose of the object in the world; the identity if omitted.
        preshape: Start posture and closing directions; `default_preshape` if omitted.
        step: Largest step of a joint between two distance queries [rad]. A link that enters and
            leaves the object within one step may be missed.
        margin: Distance at which a link touches the object [m].

    Attributes:
        hand: The hand.
        preshape: The preshape in use.
        links: Link of each of the k collision shapes.

    Raises:
        InvalidInputError: On a preshape that does not fit the hand, an unknown shape, an invalid
            pose, or a step or margin that is not > 0.
        HandError: If the hand has no collision shapes, or they cannot be read.
    """

    def __init__(
        self,
        hand: Hand,
        shape: Shape,
        object_pose: PoseLike | None = None,
        *,
        preshape: Preshape | None = None,
        step: float = STEP,
        margin: float = MARGIN,
    ) -> None:
        self._step = positive_number(step, "step")
        self._margin = positive_number(margin, "margin")
        solid = _solid(shape)
        self.hand = hand
        self.preshape = preshape or default_preshape(hand)
        _check_preshape(hand, self.preshape)
        self._shape = shape
        self._object_pose = (
            np.eye(4) if object_pose is None else check_pose(object_pose, "object_pose")
        )
        self._end = np.where(
            self.preshape.direction > 0.0, hand.upper_limits, hand.lower_limits
        )
        self._geometry = read_collision_shapes(hand)
        if self._geometry.ngeoms == 0:
            raise hand.spec.error(
                "the URDF has no collision shapes to close the hand by",
                key="urdf",
                value=hand.spec.urdf,
            )
        # Adding the object below moves the parts in memory, so keep no reference to one.
        parts = self._geometry.geometryObjects
        self.links = tuple(hand.model.frames[part.parentFrame].name for part in parts)
        self._parents = [part.parentJoint for part in parts]
        self._carries = _carried_parts(hand, self._parents)
        held = self._geometry.addGeometryObject(
            pin.GeometryObject("object", 0, pin.SE3(self._object_pose), solid)
        )
        for part in range(held):
            self._geometry.addCollisionPair(pin.CollisionPair(part, held))
        self._data = hand.model.createData()
        self._geometry_data = self._geometry.createData()
        with warnings.catch_warnings():
            # Coal deprecates this attribute and warns at each access.
            warnings.simplefilter("ignore", DeprecationWarning)
            for request in self._geometry_data.distanceRequests:
                # No warm start: the result must not depend on earlier queries.
                request.enable_cached_gjk_guess = False
                request.gjk_tolerance = request.epa_tolerance = _DISTANCE_TOLERANCE

    def distances(
        self, q: npt.ArrayLike, wrist_pose: np.ndarray | None = None
    ) -> np.ndarray:
        """Signed distance from each collision shape of the hand to the object.

        Args:
            q: Joint angles [rad], shape (n,).
            wrist_pose: Pose of the wrist in the world, shape (4, 4); the identity if omitted.

        Returns:
            Distances [m] in the order of `links`, shape (k,); < 0 where a shape penetrates.

        Raises:
            InvalidInputError: On a wrong shape or an invalid pose.
        """
        vector = self.hand.configuration_vector(q, wrist_pose)
        pin.computeDistances(
            self.hand.model, self._data, self._geometry, self._geometry_data, vector
        )
        return np.array(
            [result.min_distance for result in self._geometry_data.distanceResults]
        )

    def starts_clear(self, wrist_pose: np.ndarray | None = None) -> bool:
        """Whether the open hand does not touch the object."""
        return bool(
            (self.distances(self.preshape.start, wrist_pose) > self._margin).all()
        )

    def close(self, wrist_pose: np.ndarray | None = None) -> Grasp:
        """Close the hand with its wrist at rest.

        Args:
            wrist_pose: Pose of the wrist in the world, shape (4, 4); the identity if omitted. It
                must be omitted for a hand with a fixed wrist.

        Returns:
            The grasp. Contacts are ordered by finger, proximal first on each. There are none if
            the hand missed the object.

        Raises:
            InvalidInputError: If the open hand already touches the object, or the wrist pose is
                invalid.
        """
        if wrist_pose is not None:
            wrist_pose = check_pose(wrist_pose, "wrist_pose")
        if not self.starts_clear(wrist_pose):
            raise InvalidInputError(
                argument="wrist_pose",
                problem=f"the open {self.hand.name} hand already touches the object",
                value=wrist_pose,
            )
        q = self.preshape.start.copy()
        for joints in _groups(
            np.flatnonzero(self.preshape.direction).tolist(), self._carries
        ):
            q = self._close_joints(q, joints, wrist_pose)
        contacts = self._contacts(q, wrist_pose)
        return Grasp(self.hand, q, self._object_pose, contacts, wrist_pose, self._shape)

    def _close_joints(
        self, q: np.ndarray, free: list[int], wrist_pose: np.ndarray | None
    ) -> np.ndarray:
        """Close joints together; each stops at its limit, or when a link that it carries touches.

        The first touch inside a step is found by bisection.
        """
        while free:
            ahead = q.copy()
            ahead[free] += np.clip(self._end[free] - q[free], -self._step, self._step)
            if np.array_equal(ahead, q):
                break
            moving = self._carries[free].any(axis=0)
            touching = moving & (self.distances(ahead, wrist_pose) <= self._margin)
            clear = q
            while touching.any() and np.abs(ahead - clear).max() > _ANGLE_TOLERANCE:
                between = 0.5 * (clear + ahead)
                found = moving & (self.distances(between, wrist_pose) <= self._margin)
                if found.any():
                    ahead, touching = between, found
                else:
                    clear = between
            free = [
                joint for joint in free if not (self._carries[joint] & touching).any()
            ]
            q = ahead
        return q

    def _contacts(
        self, q: np.ndarray, wrist_pose: np.ndarray | None
    ) -> tuple[Contact, ...]:
        near = np.flatnonzero(self.distances(q, wrist_pose) <= self._margin).tolist()
        # Proximal first, finger by finger in the order of the joints.
        order = sorted(
            near, key=lambda part: np.flatnonzero(self._carries[:, part])[-1:].tolist()
        )
        names = [self.links[part] for part in order]
        fingers = _finger_names(self.hand)
        contacts: list[Contact] = []
        points: list[np.ndarray] = []
        for part, name, pose in zip(
            order, names, self.hand.link_poses(names, q, wrist_pose), strict=True
        ):
            result = self._geometry_data.distanceResults[part]
            point = np.array(result.getNearestPoint1())
            if any(np.linalg.norm(point - other) < _SAME_CONTACT for other in points):
                continue
            points.append(point)
            x, y, z = transform_points(inverse_pose(pose), point)
            a, b, c = np.array(result.normal) @ pose[:3, :3]
            finger = fingers.get(self._parents[part])
            contacts.append(Contact(name, (x, y, z), (a, b, c), finger))
        return tuple(contacts)


def _check_preshape(hand: Hand, preshape: Preshape) -> None:
    count = len(hand.joint_names)
    start = finite_array(preshape.start, (count,), "preshape.start")
    direction = finite_array(preshape.direction, (count,), "preshape.direction")
    if not np.isin(direction, (-1.0, 0.0, 1.0)).all() or not direction.any():
        raise InvalidInputError(
            argument="preshape.direction",
            expected="-1, 0 or 1 for each joint, not all 0",
            value=direction,
        )
    if not ((hand.lower_limits <= start) & (start <= hand.upper_limits)).all():
        raise InvalidInputError(
            argument="preshape.start",
            expected="angles within the hand's limits",
            value=start,
        )


def _solid(shape: Shape) -> Any:
    match shape:
        case Box(size):
            return pin.coal.Box(*size)
        case Sphere(radius):
            return pin.coal.Sphere(radius)
        case Cylinder(radius, length):
            return pin.coal.Cylinder(radius, length)
    raise InvalidInputError(
        argument="shape", expected="a Box, Sphere or Cylinder", value=shape
    )


def _carried_parts(hand: Hand, parents: list[int]) -> np.ndarray:
    """Whether each joint, or a mimic joint of it, moves each shape; shape (joints, shapes)."""
    carried = np.zeros((len(hand.joint_names), len(parents)), dtype=bool)
    here = hand.configuration_vector(hand.rest)
    for joint, row in enumerate(carried):
        there = hand.configuration_vector(hand.rest + np.eye(len(carried))[joint])
        moved = {
            j
            for j in range(1, hand.model.njoints)
            if here[hand.model.joints[j].idx_q] != there[hand.model.joints[j].idx_q]
        }
        row[:] = [
            not moved.isdisjoint(hand.model.supports[parent]) for parent in parents
        ]
    return carried


def _groups(joints: list[int], carries: np.ndarray) -> list[list[int]]:
    """Group closing joints that move a common shape: a group per finger or coupled fingers."""
    groups: list[list[int]] = []
    for joint in joints:
        coupled = [group for group in groups if (carries[group] & carries[joint]).any()]
        joined = [member for group in coupled for member in group]
        groups = [group for group in groups if group not in coupled] + [
            sorted([*joined, joint])
        ]
    return groups


def _finger_names(hand: Hand) -> dict[int, str]:
    """Anatomical finger name by joint of the Pinocchio model, from the names of the hand's points.

    Mimic and locked joints are included, and joints of unnamed fingers left out.
    """
    chains = {
        joint: _beyond_palm(hand, joint) for joint in range(1, hand.model.njoints)
    }
    roots: dict[int, str] = {}
    for point in hand.spec.points:
        beyond = chains.get(place_of(hand, point)[0])
        if point.finger is not None and beyond:
            roots[beyond[0]] = point.finger
    return {
        joint: roots[way[0]] for joint, way in chains.items() if way and way[0] in roots
    }


def _fingers(hand: Hand) -> list[Finger]:
    """Return a finger for each joint attached to the palm, with the point farthest out as its tip.

    Joints of an arm belong to no finger.
    """
    found: dict[int, Finger] = {}
    for point in hand.spec.points:
        tip = place_of(hand, point)
        joints = _beyond_palm(hand, tip[0])
        if joints and (
            joints[0] not in found or len(joints) > len(found[joints[0]].joints)
        ):
            found[joints[0]] = Finger(hand, joints, tip)
    return list(found.values())


def _beyond_palm(hand: Hand, joint: int) -> list[int]:
    """Return the joints from the palm to this one, proximal first; none for an arm's joints."""
    palm = hand.palm_frame.parentJoint
    chain = list(hand.model.supports[joint])
    return chain[chain.index(palm) + 1 :] if palm in chain else []
