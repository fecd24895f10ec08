"""`ObjectFollower`: the robot's fingers touch an object where the person's do.

The person's hand and an object are tracked in one world. The robot's object moves as the person's:
in the robot's world, as its palm's target moves as the person's palm (T, imposed exactly). Where a
fingertip of the person is on the surface, the pad of the robot's finger goes to the same place of
it, along the normal there; away from the surface, the finger follows as without an object. Links
that come into the object are pushed out of it. To press on it, joints are commanded farther than
they get, by how far they give way to the force.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterator
from copy import deepcopy
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
import pinocchio as pin
from msgspec import structs
from numpy.typing import ArrayLike

from handmap_core.errors import InvalidOptionsError, expect
from handmap_core.options import Options, Positive
from handmap_core.se3 import (
    Array,
    Arrays,
    check_pose,
    inverse_pose,
    lengths,
    smoothstep,
    transform_points,
    unit,
)
from handmap_core.stream.hand_grip import GripOptions
from handmap_qp.hands import (
    FINGERS,
    Configuration,
    Hand,
    PinocchioConfiguration,
    moved_by,
    read_collision_shapes,
)
from handmap_qp.human import TIPS, HumanSample, Recording, sample_columns
from handmap_qp.ik import AttachedPoints, TaskRows, When
from handmap_qp.mapping import (
    HumanPose,
    MapStep,
    PalmMap,
    Shape,
    Stages,
    TargetSource,
    distances_to,
    nearest,
    parse_object,
    robot_fingers,
)
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from .follower import Follower, map_with

# Weights of a pad's place, and of a link that is nearer to the object than its clearance [1/m, m].
# Links that are this near feel the row, so that they stay where it ends; and what moves pads and
# links is damped by a share of its slopes, without which fingers tremble.
_PLACED, _PUSHED = 3000.0, 1e4
_CLEAR, _AROUND = 5e-4, 5e-3
_DAMPED = 0.5
# Time in which the object takes hold of the hand, and lets go of one that is not led [s].
_EASED = 0.4
# A pad that touches by more than this share, and is farther from its place, is said to be off [m].
_TOUCHED, _OFF = 0.5, 0.01


class ObjectOptions(Options, frozen=True):
    """How fingers go to an object.

    Attributes:
        touching: Distance of a person's fingertip from the surface where its skin touches [m]: 5 to
            10 mm, as landmarks lie inside the fingers.
        near: Distance from which on fingers go to places of the surface [m].
    """

    touching: Positive = 0.01
    near: Positive = 0.02

    def check(self) -> None:
        """Reject fingers that touch before they are near."""
        if self.near <= self.touching:
            expected = f"more than touching, {self.touching:g} m"
            raise InvalidOptionsError(option="near", expected=expected, value=self.near)


class _Touch(NamedTuple):
    """Takes pads to places of an object, and pushes links out of it."""

    hand: Hand  # the hand
    shape: Shape  # the object's shape
    pose: Array  # its pose in the robot's world, shape (4, 4)
    points: AttachedPoints  # the middles of f pads
    places: Array  # where they belong in the robot's world [m], shape (f, 3)
    shares: Array  # shares of the weight of each, shape (f,)
    share: float  # share of all weights
    give: Array  # how far joints give way to what pads press on [rad or m], shape (nv,)
    placed: PinocchioConfiguration  # the hand where they give way

    def links(self, placed: PinocchioConfiguration) -> tuple[Array, Array]:
        """Return the distance of each shape [m], (s,), and its slopes, shape (s, nv)."""
        shapes, moved = _links(self.hand)
        found = distances_to(self.shape, self.pose, placed, shapes)
        gaps = np.array([gap for gap, _ in found])
        ends = [(near.normal, near.getNearestPoint2()) for _, near in found]
        normals, points = np.reshape(ends, (-1, 2, 3)).swapaxes(0, 1)
        linear, angular = placed.data.J.reshape(2, 3, -1)
        slopes = normals @ linear + np.cross(points, normals) @ angular
        return gaps, placed.contracted(slopes * moved)

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return three rows a pad, and one a link; see `Task.linearise`."""
        self.placed.displace(hand.q, -self.give)
        placed = self.placed
        now = self.points.positions(placed)
        weights = self.share * _PLACED * self.shares[:, None]
        pads = weights[..., None] * self.points.jacobians(placed)
        gaps, slopes = self.links(placed)
        near = np.clip((_AROUND - gaps) / _AROUND, 0.0, 1.0)[:, None]
        weight = self.share * _PUSHED * near
        inside = weight * np.minimum(gaps - _CLEAR, 0.0)[:, None]
        off = np.append(weights * (now - self.places), inside)
        rows = np.vstack([*pads, weight * slopes])
        return TaskRows(off, rows, _DAMPED * (rows**2).sum(axis=0))


@lru_cache(maxsize=8)
def _links(hand: Hand) -> tuple[pin.GeometryModel, Array]:
    """Return a hand's s shapes, and which velocities of the model move each, shape (s, nv)."""
    shapes = read_collision_shapes(hand)
    joints = [shape.parentJoint for shape in shapes.geometryObjects]
    return shapes, moved_by(hand.model, joints)


def can_touch(source: TargetSource) -> bool:
    """Return whether an `ObjectFollower` can let the robot hand of a source touch objects."""
    method = source.method
    follows_palm = isinstance(method, Teleoperation) and method.scale == 1.0
    return follows_palm and source.robot.has_moving_wrist


class ObjectFollower:
    """Lets a follower touch an object where the person does.

    It is for one hand and the preset `teleoperation`, whose palm follows the person's.

    Args:
        follower: Follows the samples.
        shape: The object's shape.
        options: How fingers go to it.
        grip: Stiffness of joints, and force with which pads press; they do not press if omitted.

    Attributes:
        follower: As given.
        shape: As given.
        options: As given.
        grip: As given.
        object_pose: Pose of the robot's object in its world at the last sample, shape (4, 4); None
            before one is followed.

    Raises:
        InvalidInputError: If it is for another preset, the wrist stays where it is or after a hold,
            there is a scale, or the shape is none, or the grip.
        HandError: If a collision shape cannot be read.
    """

    def __init__(
        self,
        follower: Follower,
        shape: Shape,
        options: ObjectOptions | None = None,
        grip: GripOptions | None = None,
    ) -> None:
        self.follower = follower
        self.shape = shape
        self.options = options or ObjectOptions()
        self.grip = grip
        self._source = source = follower.mapper.source
        self._hand = hand = source.robot
        is_shape = isinstance(shape, Shape)
        expect(is_shape, "shape", "an object, as of `parse_object`", value=shape)
        is_grip = isinstance(grip, GripOptions | None)
        expect(is_grip, "grip", "`GripOptions`", value=grip)
        self._check_follower()
        # Shapes that cannot be read are refused here.
        _links(hand)
        fingers = robot_fingers(hand)
        is_usable = not (grip and fingers.has_jaws)
        expect(is_usable, "grip", "none for jaws", value=hand.name)
        self._tips = TIPS[[FINGERS.index(name) for name in fingers.names]]
        pads = [fingers.pads[name] for name in fingers.names]
        self._points = AttachedPoints(hand, [pad.place for pad in pads])
        self._radii = np.array([pad.radius for pad in pads])
        self._placed = hand.configuration()
        self.object_pose: Array | None = None
        # Since the reference of the last sample: the person's object where it was seen last, and
        # how far it has taken hold.
        self._reference: HumanPose | None = None
        self._seen: Array | None = None
        self._eased = 0.0

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    def map_sample(
        self,
        sample: HumanSample,
        object_pose: ArrayLike | None,
        *,
        dt: When | None = None,
        arrival: float | None = None,
    ) -> MapStep:
        """Map one sample of a tracker; see `Follower.map_sample`.

        The object takes hold of the hand within .4 s of a reference, of a hold or of a glide, so
        that nothing jumps.

        Args:
            sample: The sample.
            object_pose: Pose of the object in the tracker's world, shape (4, 4); None if it is not
                seen. It then stays where it was, and lets go of the hand within .4 s. Arbitrary
                where the sample is not valid.
            dt: As of `Follower.map_sample` [s].
            arrival: Likewise.

        Returns:
            The step; with a grip, its command has the `effort`. Diagnostics are `object_pose`; of
            each finger with joints, the thumb first, `touching`, the share to which the person's
            touches, and `touch_error`, how far the robot's pad is from its place [m], shape (f,);
            and `clearance` of the nearest link [m]. `off_object` flags pads off by over 10 mm.

        Raises:
            InvalidInputError: As there, if the pose is none, or the mapper's method was changed to
                another one.
            InvalidOptionsError: As there.
        """
        is_seen = sample.valid and object_pose is not None
        pose = check_pose(object_pose, "object_pose") if is_seen else self._seen
        self._check_follower()
        source = self._source
        self._eased *= source.reference is self._reference
        follower = self.follower
        terms = [*self._touches(sample, pose)]
        step = map_with(follower, terms, sample, dt=dt, arrival=arrival)
        self._seen = pose
        self._reference = source.reference
        is_still = step.status in ("held", "released")
        is_followed = is_seen and not is_still and step.status != "gliding"
        taken = follower.mapper.motion.dt
        change = taken if is_followed else -taken
        self._eased = min(max(self._eased + change / _EASED, 0.0), 1.0)
        world = self._world
        if is_still or pose is None or world is None:
            return step
        self.object_pose = world @ pose
        return self._described(step, terms, self.object_pose)

    def _described(self, step: MapStep, terms: list[_Touch], pose: Array) -> MapStep:
        """Return a step that says where the object is, and how it is touched."""
        found = {"object_pose": pose}
        flags = step.asked.flags
        command = step.command
        for touch in terms:
            self._placed.displace(step.ik.q, -touch.give)
            gaps, _ = touch.links(self._placed)
            errors = lengths(touch.points.positions(self._placed) - touch.places)
            found["touching"] = touch.shares
            found["touch_error"] = errors
            found["clearance"] = gaps.min(initial=np.inf)
            if errors[touch.shares > _TOUCHED].max(initial=0.0) > _OFF:
                flags = (*flags, "off_object")
            if self.grip:
                effort = self.grip.stiffness * touch.give[self._hand.joint_columns]
                command = structs.replace(command, effort=effort)
        diagnostics = ChainMap(found, cast("Arrays", step.asked.diagnostics))
        targets = structs.replace(step.asked, diagnostics=diagnostics, flags=flags)
        stages = Stages(step.stages.pose, targets, step.ik, command)
        return structs.replace(step, stages=stages)

    def _check_follower(self) -> None:
        is_usable = can_touch(self._source) and self.follower.rejoin == "glide"
        wanted = "a hand that `teleoperation` moves and whose wrist glides, at scale 1"
        expect(is_usable, "follower", wanted, value=self._hand.name)

    @property
    def _world(self) -> Array | None:
        """The tracker's world in the robot's, (4, 4); None until there is a reference."""
        target_map = self._source.target_map
        return target_map.world if isinstance(target_map, PalmMap) else None

    def _touches(self, sample: HumanSample, pose: Array | None) -> Iterator[_Touch]:
        """Yield the term by which the robot touches an object as the person does."""
        world = self._world
        if not sample.valid or pose is None or world is None or self._eased == 0.0:
            return
        options = self.options
        tips = transform_points(inverse_pose(pose), sample.landmarks[self._tips])
        found = nearest(self.shape, tips)
        away = np.maximum(found.distances - options.touching, 0.0)
        shares = smoothstep(1.0 - away / (options.near - options.touching))
        aims = found.places + (self._radii + away)[:, None] * found.normals
        there = world @ pose
        places = transform_points(there, aims)
        share = float(smoothstep(self._eased))
        give = np.zeros(self._placed.nv)
        if self.grip:
            forces = self.grip.force * share * shares[0] * shares[1:]
            forces /= max(shares[1:].sum(), 1.0)
            now = self._points.positions(self._placed)
            slopes = self._points.jacobians(self._placed)
            # The wrist moves both pads of a pair, and not their distance.
            pairs = unit(now[1:] - now[0])[:, None] @ (slopes[1:] - slopes[0])
            give -= forces / self.grip.stiffness @ pairs[:, 0]
        yield _Touch(
            self._hand,
            self.shape,
            there,
            self._points,
            places,
            shares,
            share,
            give,
            self._placed,
        )


def follow_recording(
    follower: Follower, recording: Recording, wrists: Array | None = None
) -> Iterator[MapStep]:
    """Map a recording sample by sample, with its object where the method can touch one.

    A hand with an object whose shape is not known is mapped alone.

    Args:
        follower: Follows the samples.
        recording: The recording.
        wrists: Poses of the wrist, as of `sample_columns`.

    Raises:
        InvalidInputError: As `Follower.map_sample`, or if the shape is none.
    """
    samples = sample_columns(recording, wrists)
    if not (recording.object_shape and can_touch(follower.mapper.source)):
        yield from map(follower.map_sample, samples)
        return
    shape = parse_object(recording.object_shape, "object_shape")
    holding = ObjectFollower(follower, shape)
    poses = np.asarray(recording.object_pose)
    for sample, pose in zip(samples, poses, strict=True):
        is_seen = np.isfinite(pose).all()
        yield holding.map_sample(sample, pose if is_seen else None)
