"""Close a hand on an object by its collision shapes: `HandCloser`.

Fingers close one after the other, all closing joints of a finger at once. When a link touches the
object, the joints that carry it stop. The others continue until each has stopped or reached its
limit. Contact between fingers is ignored.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.checks import finite_array, positive_number
from handmap_qp.grasp.contacts import Contact, Grasp
from handmap_qp.grasp.objects import Box, Cylinder, Shape, Sphere
from handmap_qp.grasp.preshape import Preshape, default_preshape, finger_names
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.hand import Hand
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
        self._end = np.where(self.preshape.direction > 0.0, hand.upper_limits, hand.lower_limits)
        self._geometry = read_collision_shapes(hand)
        if self._geometry.ngeoms == 0:
            raise hand.spec.error(
                "the URDF has no collision shapes to close the hand by",
                key="urdf",
                value=hand.spec.urdf,
            )
        parts = list(self._geometry.geometryObjects)
        self.links = tuple(hand.model.frames[part.parentFrame].name for part in parts)
        self._carries = _carried_parts(hand, [part.parentJoint for part in parts])
        held = self._geometry.addGeometryObject(
            pin.GeometryObject("object", 0, pin.SE3(self._object_pose), solid)
        )
        for part in range(len(parts)):
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
        self._groups = _groups(np.flatnonzero(self.preshape.direction).tolist(), self._carries)

    def distances(self, q: npt.ArrayLike, wrist_pose: np.ndarray | None = None) -> np.ndarray:
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
        return np.array([result.min_distance for result in self._geometry_data.distanceResults])

    def starts_clear(self, wrist_pose: np.ndarray | None = None) -> bool:
        """Whether the open hand does not touch the object."""
        return bool((self.distances(self.preshape.start, wrist_pose) > self._margin).all())

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
        for joints in self._groups:
            q = self._close_joints(q, joints, wrist_pose)
        return Grasp(
            self.hand, q, self._object_pose, self._contacts(q, wrist_pose), wrist_pose, self._shape
        )

    def _close_joints(
        self, q: np.ndarray, joints: list[int], wrist_pose: np.ndarray | None
    ) -> np.ndarray:
        free = joints
        while free:
            ahead = q.copy()
            ahead[free] += np.clip(self._end[free] - q[free], -self._step, self._step)
            if np.array_equal(ahead, q):
                break
            moving: np.ndarray = np.any(self._carries[free], axis=0)
            touching: np.ndarray = moving & (self.distances(ahead, wrist_pose) <= self._margin)
            if touching.any():
                ahead, touching = self._first_touch(q, ahead, moving, touching, wrist_pose)
                free = [joint for joint in free if not (self._carries[joint] & touching).any()]
            q = ahead
        return q

    def _first_touch(
        self,
        clear: np.ndarray,
        touch: np.ndarray,
        moving: np.ndarray,
        touching: np.ndarray,
        wrist_pose: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Bisect between two postures: the first that touches, and the shapes that touch there."""
        while np.abs(touch - clear).max() > _ANGLE_TOLERANCE:
            between = 0.5 * (clear + touch)
            found = moving & (self.distances(between, wrist_pose) <= self._margin)
            if found.any():
                touch, touching = between, found
            else:
                clear = between
        return touch, touching

    def _contacts(self, q: np.ndarray, wrist_pose: np.ndarray | None) -> tuple[Contact, ...]:
        near = np.flatnonzero(self.distances(q, wrist_pose) <= self._margin).tolist()
        results, parts = self._geometry_data.distanceResults, self._geometry.geometryObjects
        # Proximal first, finger by finger in the order of the joints.
        order = sorted(near, key=lambda part: np.flatnonzero(self._carries[:, part])[-1:].tolist())
        names = [self.links[part] for part in order]
        links = self.hand.link_poses(names, q, wrist_pose)
        finger_of = finger_names(self.hand)
        contacts: list[Contact] = []
        points: list[np.ndarray] = []
        for part, name, pose in zip(order, names, links, strict=True):
            point = np.array(results[part].getNearestPoint1())
            if any(np.linalg.norm(point - other) < _SAME_CONTACT for other in points):
                continue
            points.append(point)
            x, y, z = transform_points(inverse_pose(pose), point)
            a, b, c = np.array(results[part].normal) @ pose[:3, :3]
            contacts.append(
                Contact(name, (x, y, z), (a, b, c), finger_of.get(parts[part].parentJoint))
            )
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
            argument="preshape.start", expected="angles within the hand's limits", value=start
        )


def _solid(shape: Shape) -> Any:
    match shape:
        case Box(size):
            return pin.coal.Box(*size)
        case Sphere(radius):
            return pin.coal.Sphere(radius)
        case Cylinder(radius, length):
            return pin.coal.Cylinder(radius, length)
    raise InvalidInputError(argument="shape", expected="a Box, Sphere or Cylinder", value=shape)


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
        row[:] = [not moved.isdisjoint(hand.model.supports[parent]) for parent in parents]
    return carried


def _groups(joints: list[int], carries: np.ndarray) -> list[list[int]]:
    """Group closing joints that move a common shape: a group per finger or coupled fingers."""
    groups: list[list[int]] = []
    for joint in joints:
        coupled = [group for group in groups if (carries[group] & carries[joint]).any()]
        joined = [member for group in coupled for member in group]
        groups = [group for group in groups if group not in coupled] + [sorted([*joined, joint])]
    return groups
