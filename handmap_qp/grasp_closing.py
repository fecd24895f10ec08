"""Closing a hand on an object by its collision shapes: `close_hand`, or `HandCloser` for many wrist poses.

Every finger closes on its own, all its closing joints at once. Where one of its links touches the object, the joints that carry
that link stop, and the others go on, until each has stopped or is at its limit. Fingers do not see one another.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp import Contact, Grasp
from handmap_qp.grasp_reference import REFERENCE_HANDS, read_cube_figures
from handmap_qp.grasp_statics import finite_array
from handmap_qp.hand import Hand, package_share
from handmap_qp.shapes import Box, Cylinder, Shape, Sphere
from handmap_qp.transform import PoseLike, check_pose, inverse_pose, transform_points

STEP = 0.02
"""Largest step of a closing joint between two looks at the object [rad]."""
MARGIN = 1e-4
"""A link touches the object when it is this near [m]. Distances are good to about a micrometre, so a link that touches does not
reach in, and the direction between the two is still well defined."""

# Joint angles at which a link touches are found this exactly [rad].
_ANGLE_TOLERANCE = 1e-6
# Neighbouring links share the skin round the joint between them; contacts of the two that are this near are one [m].
_SAME_CONTACT = 1e-3
# Joints whose axes are this parallel bend a finger in one plane.
_PARALLEL = 0.99
# A hand that has no figures of its own starts this far from the sphere round the object [m].
_CLEARANCE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Closing:
    """How a hand closes.

    Attributes:
        start: Joint angles to begin with [rad], shape (n,).
        direction: Sense in which each joint closes, 1 or -1; 0 for one that keeps its angle. Shape (n,).
        clearance: Where a planner puts the hand: gap between the middle of the palm and the sphere round the object [m].
    """

    start: np.ndarray
    direction: np.ndarray
    clearance: float


def default_closing(hand: Hand) -> Closing:
    """How a hand closes unless the caller says otherwise.

    The hands of the paper have the toolbox's preshape and closing joints (`grasp_cube50.json`), a left human hand the right one's.
    For any other hand the geometry tells: the outermost joint of each finger closes, and so do the joints before it that turn about
    the same direction; they start stretched and close towards the farther limit. All others (abduction, spread, opposition) rest.

    Args:
        hand: The hand.

    Returns:
        Its closing.
    """
    name = "human" if hand.name == "human_left" else hand.name
    if name in REFERENCE_HANDS:
        figures = read_cube_figures(name)["closing"]
        start = np.array([figures["start"].get(joint, 0.0) for joint in hand.joint_names])
        direction = np.array([float(joint in figures["joints"]) for joint in hand.joint_names])
        return Closing(start, direction, figures["clearance"])
    direction = np.zeros(len(hand.joint_names))
    axes, _ = _joint_axes(hand, hand.rest)
    for finger in _fingers(hand):
        for joint in reversed(finger):
            if abs(axes[joint] @ axes[finger[-1]]) < _PARALLEL:
                break
            direction[joint] = 1.0 if hand.upper_limits[joint] + hand.lower_limits[joint] >= 0.0 else -1.0
    stretched = np.clip(0.0, hand.lower_limits, hand.upper_limits)
    return Closing(np.where(direction == 0.0, hand.rest, stretched), direction, _CLEARANCE)


def palm_centre(hand: Hand, closing: Closing | None = None) -> np.ndarray:
    """The middle of the palm: the mean place of the innermost closing joint of each finger.

    Args:
        hand: The hand.
        closing: How it closes; `default_closing` if omitted.

    Returns:
        Point in the palm frame [m], shape (3,).

    Raises:
        InvalidInputError: If no joint closes.
    """
    how = closing or default_closing(hand)
    _, origins = _joint_axes(hand, how.start)
    innermost = [next((joint for joint in finger if how.direction[joint]), None) for finger in _fingers(hand)]
    places = np.array([origins[joint] for joint in innermost if joint is not None])
    if len(places) == 0:
        raise InvalidInputError(f"{hand.name}: no joint closes")
    return transform_points(inverse_pose(hand.frame_pose("palm", how.start)), places).mean(axis=0)


class HandCloser:
    """Closes one hand on one object, from any wrist pose.

    Args:
        hand: The hand; its URDF's collision shapes count.
        shape: The object.
        object_pose: The object in the world; the identity if omitted.
        closing: How the hand closes; `default_closing` if omitted.
        step: Largest step of a joint between two looks at the object [rad]; a link that would meet the object and leave it again
            within one step may be missed.
        margin: A link touches the object when it is this near [m].

    Attributes:
        hand: The hand.
        closing: How it closes.

    Raises:
        InvalidInputError: On a closing that does not fit the hand, or a step or margin that is not > 0.
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
        self._object_pose = np.eye(4) if object_pose is None else check_pose(object_pose, "object_pose")
        self._step = step
        self._margin = margin
        self._end = np.where(self.closing.direction > 0.0, hand.upper_limits, hand.lower_limits)
        self._geometry = _collision_shapes(hand)
        joints = [hand.model.getJointId(name) for name in hand.joint_names]
        parents = [part.parentJoint for part in self._geometry.geometryObjects]
        # Which links each joint carries, shape (joints, shapes).
        self._carries = np.array([[joint in hand.model.supports[parent] for parent in parents] for joint in joints])
        solid = pin.GeometryObject("object", 0, pin.SE3(self._object_pose), _solid(shape))
        held = self._geometry.addGeometryObject(solid)
        for link in range(len(parents)):
            self._geometry.addCollisionPair(pin.CollisionPair(link, held))
        self._data = hand.model.createData()
        self._geometry_data = self._geometry.createData()
        self._fingers = _fingers(hand)

    def distances(self, q: npt.ArrayLike, wrist_pose: np.ndarray | None = None) -> np.ndarray:
        """Distance of each of the hand's collision shapes from the object; below 0 where it reaches in.

        Args:
            q: Joint angles [rad], shape (n,).
            wrist_pose: Wrist in the world, shape (4, 4); the identity if omitted.

        Returns:
            Distances [m], in the order of the URDF's collision shapes as Pinocchio reads them, shape (k,).
        """
        vector = self.hand.configuration_vector(q, wrist_pose)
        pin.computeDistances(self.hand.model, self._data, self._geometry, self._geometry_data, vector)
        return np.array([result.min_distance for result in self._geometry_data.distanceResults])

    def starts_clear(self, wrist_pose: np.ndarray | None = None) -> bool:
        """Whether the open hand touches nothing."""
        return bool((self.distances(self.closing.start, wrist_pose) > self._margin).all())

    def close(self, wrist_pose: np.ndarray | None = None) -> Grasp:
        """Close the hand, its wrist standing still.

        Args:
            wrist_pose: Wrist in the world, shape (4, 4); the identity if omitted, and for a fixed hand.

        Returns:
            The grasp; its contacts are ordered by finger, and outwards on each. A hand that closed beside the object has none.

        Raises:
            InvalidInputError: If the open hand touches the object already, or the wrist pose cannot be used.
        """
        if wrist_pose is not None:
            wrist_pose = check_pose(wrist_pose, "wrist_pose")
        if not self.starts_clear(wrist_pose):
            raise InvalidInputError(f"wrist_pose: the open {self.hand.name} hand touches the object there", value=wrist_pose)
        q = self.closing.start.copy()
        for finger in self._fingers:
            q = self._close_finger(q, [joint for joint in finger if self.closing.direction[joint]], wrist_pose)
        return Grasp(self.hand, q, self._object_pose, self._contacts(q, wrist_pose), wrist_pose, self._shape)

    def _close_finger(self, q: np.ndarray, joints: list[int], wrist_pose: np.ndarray | None) -> np.ndarray:
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
        self, clear: np.ndarray, touch: np.ndarray, moving: np.ndarray, touching: np.ndarray, wrist_pose: np.ndarray | None
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
        results, shapes, frames = self._geometry_data.distanceResults, self._geometry.geometryObjects, self.hand.model.frames
        # From the palm outwards, finger by finger in the order of the joints.
        order = sorted(near, key=lambda link: np.flatnonzero(self._carries[:, link])[-1:].tolist())
        names = [frames[shapes[link].parentFrame].name for link in order]
        links = self.hand.link_poses(names, q, wrist_pose)
        finger_of = _finger_names(self.hand)
        contacts: list[Contact] = []
        places: list[np.ndarray] = []
        for link, name, pose in zip(order, names, links, strict=True):
            place = np.array(results[link].getNearestPoint1())
            if any(np.linalg.norm(place - other) < _SAME_CONTACT for other in places):
                continue
            places.append(place)
            x, y, z = transform_points(inverse_pose(pose), place)
            a, b, c = np.array(results[link].normal) @ pose[:3, :3]
            contacts.append(Contact(name, (x, y, z), (a, b, c), finger_of.get(shapes[link].parentJoint)))
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
    return HandCloser(hand, shape, object_pose, closing=closing, step=step, margin=margin).close(wrist_pose)


def _check_closing(hand: Hand, closing: Closing) -> None:
    count = len(hand.joint_names)
    start = finite_array(closing.start, (count,), "closing.start")
    direction = finite_array(closing.direction, (count,), "closing.direction")
    if not np.isin(direction, (-1.0, 0.0, 1.0)).all() or not direction.any():
        raise InvalidInputError(f"closing.direction: expected -1, 0 and 1, and not 0 alone, got {direction}", value=direction)
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
    raise InvalidInputError(f"shape: expected a Box, Sphere or Cylinder, got {shape!r}", value=shape)


def _collision_shapes(hand: Hand) -> pin.GeometryModel:
    spec = hand.spec
    folders = [str(spec.directory or ".")]
    if spec.urdf.startswith("package://"):
        folders.append(str(package_share(spec.urdf.removeprefix("package://").partition("/")[0])))
    try:
        geometry = pin.buildGeomFromUrdfString(hand.model, hand.urdf_text, pin.GeometryType.COLLISION, package_dirs=folders)
    except (RuntimeError, ValueError) as error:
        raise spec.error(f"the collision shapes cannot be read: {' '.join(str(error).split())}", key="urdf") from error
    for part in geometry.geometryObjects:
        if hasattr(part.geometry, "buildConvexRepresentation"):
            # A bare mesh is a surface without an inside: a link could lie within the object unnoticed.
            part.geometry.buildConvexRepresentation(False)
            part.geometry = part.geometry.convex
    if geometry.ngeoms == 0:
        raise spec.error("the URDF has no collision shapes to close the hand by", key="urdf", value=spec.urdf)
    return geometry


def _fingers(hand: Hand) -> list[list[int]]:
    """Joints of each finger, outwards, as places in `joint_names`; a finger is all that hangs from one joint of the palm."""
    fingers: dict[int, list[int]] = {}
    supports = [list(hand.model.supports[hand.model.getJointId(name)]) for name in hand.joint_names]
    for joint, support in enumerate(supports):
        fingers.setdefault(support[1 + hand.is_floating], []).append(joint)
    return [sorted(finger, key=lambda joint: len(supports[joint])) for finger in fingers.values()]


def _finger_names(hand: Hand) -> dict[int, str]:
    """Anatomical name of the finger that each joint of the model is part of, as far as the hand's points tell."""
    names: dict[int, str] = {}
    for point in hand.spec.points:
        joint = hand.model.frames[hand.model.getFrameId(point.link, pin.FrameType.BODY)].parentJoint
        if point.finger is not None and joint > hand.is_floating:
            root = hand.model.supports[joint][1 + hand.is_floating]
            names.update({j: point.finger for j in range(1, hand.model.njoints) if root in list(hand.model.supports[j])})
    return names


def _joint_axes(hand: Hand, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes and origins of the joints with the wrist at the identity, in the order of `joint_names`, shapes (n, 3)."""
    data = hand.model.createData()
    pin.computeJointJacobians(hand.model, data, hand.configuration_vector(q))
    joints = [hand.model.getJointId(name) for name in hand.joint_names]
    frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    columns = [pin.getJointJacobian(hand.model, data, j, frame)[:, hand.model.joints[j].idx_v] for j in joints]
    return np.array(columns)[:, 3:], np.array([data.oMi[j].translation for j in joints])
