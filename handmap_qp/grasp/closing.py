"""Closing a hand on an object by its collision shapes.

`close_hand`, or `HandCloser` for many wrist poses.

Every finger closes on its own, all its closing joints at once. Where one of its links touches the
object, the joints that carry that link stop, and the others go on, until each has stopped or is at
its limit. Fingers do not see one another.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.contacts import Contact, Grasp
from handmap_qp.grasp.objects import Box, Cylinder, Shape, Sphere
from handmap_qp.grasp.preshape import Closing, default_closing, finger_names
from handmap_qp.grasp.statics import finite_array
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.hand import Hand
from handmap_qp.transform import PoseLike, check_pose, inverse_pose, transform_points

STEP = 0.02
"""Largest step of a closing joint between two looks at the object [rad]."""
MARGIN = 1e-4
"""A link touches the object when it is this near [m]: so near that it makes no difference, and
still far enough for the direction from the one to the other to be well defined."""

# Coal's own tolerance, well below what a microradian moves a fingertip.
_DISTANCE_TOLERANCE = 1e-8
# Joint angles at which a link touches are found this exactly [rad].
_ANGLE_TOLERANCE = 1e-6
# Neighbouring links share the skin round the joint between them; contacts of the two that are this
# near are one [m].
_SAME_CONTACT = 1e-3


class HandCloser:
    """Closes one hand on one object, from any wrist pose.

    Args:
        hand: The hand; its URDF's collision shapes count.
        shape: The object.
        object_pose: The object in the world; the identity if omitted.
        closing: How the hand closes; `default_closing` if omitted.
        step: Largest step of a joint between two looks at the object [rad]; a link that would meet
            the object and leave it again within one step may be missed.
        margin: A link touches the object when it is this near [m].

    Attributes:
        hand: The hand.
        closing: How it closes.
        links: The link of each collision shape, k of them.

    Raises:
        InvalidInputError: On a closing that does not fit the hand, or a step or margin that is not
            > 0.
        HandError: If the hand has no collision shapes, or they cannot be read.
    """

    def __init__(
        self,
        hand: Hand,
        shape: Shape,
        object_pose: PoseLike | None = None,
        *,
        closing: Closing | None = None,
        step: float = STEP,
        margin: float = MARGIN,
    ) -> None:
        for name, value in (("step", step), ("margin", margin)):
            if not (np.isfinite(value) and value > 0.0):
                raise InvalidInputError(f"{name}: expected a number > 0, got {value}", value=value)
        self.hand = hand
        self.closing = closing or default_closing(hand)
        _check_closing(hand, self.closing)
        self._shape = shape
        self._object_pose = (
            np.eye(4) if object_pose is None else check_pose(object_pose, "object_pose")
        )
        self._step = step
        self._margin = margin
        self._end = np.where(self.closing.direction > 0.0, hand.upper_limits, hand.lower_limits)
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
        solid = pin.GeometryObject("object", 0, pin.SE3(self._object_pose), _solid(shape))
        held = self._geometry.addGeometryObject(solid)
        for part in range(len(parts)):
            self._geometry.addCollisionPair(pin.CollisionPair(part, held))
        self._data = hand.model.createData()
        self._geometry_data = self._geometry.createData()
        with warnings.catch_warnings():
            # Coal is about to rename this switch; until then it says so at every touch.
            warnings.simplefilter("ignore", DeprecationWarning)
            for request in self._geometry_data.distanceRequests:
                # Without a warm start a distance depends on the posture alone, not on those looked
                # at before.
                request.enable_cached_gjk_guess = False
                request.gjk_tolerance = request.epa_tolerance = _DISTANCE_TOLERANCE
        self._groups = _groups(np.flatnonzero(self.closing.direction).tolist(), self._carries)

    def distances(self, q: npt.ArrayLike, wrist_pose: np.ndarray | None = None) -> np.ndarray:
        """Distance of each of the hand's collision shapes from the object.

        Below 0 where it reaches in.

        Args:
            q: Joint angles [rad], shape (n,).
            wrist_pose: Wrist in the world, shape (4, 4); the identity if omitted.

        Returns:
            Distances [m] in the order of `links`, shape (k,).
        """
        vector = self.hand.configuration_vector(q, wrist_pose)
        pin.computeDistances(
            self.hand.model, self._data, self._geometry, self._geometry_data, vector
        )
        return np.array([result.min_distance for result in self._geometry_data.distanceResults])

    def starts_clear(self, wrist_pose: np.ndarray | None = None) -> bool:
        """Whether the open hand touches nothing."""
        return bool((self.distances(self.closing.start, wrist_pose) > self._margin).all())

    def close(self, wrist_pose: np.ndarray | None = None) -> Grasp:
        """Close the hand, its wrist standing still.

        Args:
            wrist_pose: Wrist in the world, shape (4, 4); the identity if omitted, and for a fixed
                hand.

        Returns:
            The grasp; its contacts are ordered by finger, and outwards on each. A hand that closed
            beside the object has none.

        Raises:
            InvalidInputError: If the open hand touches the object already, or the wrist pose cannot
                be used.
        """
        if wrist_pose is not None:
            wrist_pose = check_pose(wrist_pose, "wrist_pose")
        if not self.starts_clear(wrist_pose):
            raise InvalidInputError(
                f"wrist_pose: the open {self.hand.name} hand touches the object there",
                value=wrist_pose,
            )
        q = self.closing.start.copy()
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
        """Where on the way between two postures the moving links begin to touch, and which do."""
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
        # From the palm outwards, finger by finger in the order of the joints.
        order = sorted(near, key=lambda part: np.flatnonzero(self._carries[:, part])[-1:].tolist())
        names = [self.links[part] for part in order]
        links = self.hand.link_poses(names, q, wrist_pose)
        finger_of = finger_names(self.hand)
        contacts: list[Contact] = []
        places: list[np.ndarray] = []
        for part, name, pose in zip(order, names, links, strict=True):
            place = np.array(results[part].getNearestPoint1())
            if any(np.linalg.norm(place - other) < _SAME_CONTACT for other in places):
                continue
            places.append(place)
            x, y, z = transform_points(inverse_pose(pose), place)
            a, b, c = np.array(results[part].normal) @ pose[:3, :3]
            contacts.append(
                Contact(name, (x, y, z), (a, b, c), finger_of.get(parts[part].parentJoint))
            )
        return tuple(contacts)


def close_hand(
    hand: Hand,
    shape: Shape,
    object_pose: PoseLike | None = None,
    wrist_pose: np.ndarray | None = None,
    *,
    closing: Closing | None = None,
    step: float = STEP,
    margin: float = MARGIN,
) -> Grasp:
    """Close a hand on an object once; arguments as of `HandCloser` and `HandCloser.close`."""
    return HandCloser(hand, shape, object_pose, closing=closing, step=step, margin=margin).close(
        wrist_pose
    )


def _check_closing(hand: Hand, closing: Closing) -> None:
    count = len(hand.joint_names)
    start = finite_array(closing.start, (count,), "closing.start")
    direction = finite_array(closing.direction, (count,), "closing.direction")
    if not np.isin(direction, (-1.0, 0.0, 1.0)).all() or not direction.any():
        raise InvalidInputError(
            f"closing.direction: expected -1, 0 and 1, and not 0 alone, got {direction}",
            value=direction,
        )
    if not ((hand.lower_limits <= start) & (start <= hand.upper_limits)).all():
        raise InvalidInputError("closing.start: outside the hand's limits", value=start)


def _solid(shape: Shape) -> Any:
    match shape:
        case Box(size):
            return pin.coal.Box(*size)
        case Sphere(radius):
            return pin.coal.Sphere(radius)
        case Cylinder(radius, length):
            return pin.coal.Cylinder(radius, length)
    raise InvalidInputError(
        f"shape: expected a Box, Sphere or Cylinder, got {shape!r}", value=shape
    )


def _carried_parts(hand: Hand, parents: list[int]) -> np.ndarray:
    """Which collision shapes each joint moves, itself or by followers, shape (joints, shapes)."""
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
    """Closing joints put together where they move a shape in common.

    A finger each, or fingers that are coupled.
    """
    groups: list[list[int]] = []
    for joint in joints:
        coupled = [group for group in groups if (carries[group] & carries[joint]).any()]
        joined = [member for group in coupled for member in group]
        groups = [group for group in groups if group not in coupled] + [sorted([*joined, joint])]
    return groups
